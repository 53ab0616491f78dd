"""A of float64 numbers that are taken as exact."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.later import sparse as sp
from lavender.lab.proof.numbers import UNIT, matrix, times
from lavender.problem import Problem

__all__ = ["Operator"]


class Operator:
    """A of float64 numbers that are taken as exact: its rows times impulses, and blocks of it, in numbers of a kind."""

    def __init__(self, problem: Problem) -> None:
        self.problem: Any = problem
        self.rows = problem.csr if problem.matrix is not None else problem.jacobian
        if problem.matrix is None and problem.rows is not None:
            self.inverse = problem.rows.inverse_mass_matrix().tocsr()
        self.transposed = self.rows.T.tocsr() if problem.matrix is None else None
        self.target, self.v = self._targets()
        self._mass: dict[Any, Any] = {}  # M^-1, by kind of number
        self._bias: dict[Any, list[Any]] = {}  # b

    def _targets(self) -> tuple[FloatArray, FloatArray | None]:
        """What b was made of, target - J v*: a target that is nothing but rounding is 0. (b, None) of a matrix."""
        problem = self.problem
        if problem.matrix is not None:
            return problem.b, None
        v = problem.rows.v_free.ravel() if problem.generalized is None else problem.generalized.v_free
        target = problem.b + self.rows @ v
        dust = 4.0 * UNIT * (abs(self.rows) @ abs(v) * (1 + np.diff(self.rows.indptr)) + abs(problem.b))
        return np.where(abs(target) <= dust, 0.0, target), v

    def soft(self, row: int) -> bool:
        """Whether a row has a compliance."""
        return self.transposed is not None and bool(self.problem.compliance[row] > 0.0)

    def bias(self, kind: Any) -> list[Any]:
        """b of exact numbers."""
        if type(kind) in self._bias:
            return self._bias[type(kind)]
        out = [kind.number(x) for x in self.target.tolist()]
        if self.v is not None:
            moved = times(kind, self.rows, [kind.number(x) for x in self.v.tolist()], None)
            out = [x - y for x, y in zip(out, moved, strict=True)]
        self._bias[type(kind)] = out
        return out

    def weighed(self, kind: Any, right: Any) -> Any:
        """M^-1 times a matrix of balls or rationals (nv, k)."""
        generalized = self.problem.generalized
        if generalized is None:
            return matrix(kind, self.inverse) * right
        if type(kind) not in self._mass:
            self._mass[type(kind)] = matrix(kind, generalized.mass).inv()
        return self._mass[type(kind)] * right

    def block(self, kind: Any, which: Any) -> Any:
        """A of these rows and columns."""
        if self.transposed is None:
            return matrix(kind, self.rows[which][:, which])
        part = self.rows[which]
        used = np.unique(part.indices)
        if self.problem.generalized is None:
            inner = self.inverse[used][:, used]
            j = matrix(kind, part[:, used])
            a = j * matrix(kind, inner) * j.transpose()
        else:
            j = matrix(kind, part)
            a = j * self.weighed(kind, j.transpose())
        for k, i in enumerate(which.tolist()):
            a[k, k] += kind.number(float(self.problem.compliance[i]))
        return a

    def pattern(self, which: Any) -> Any:
        """Where A of these rows and columns may be other than 0: float64 may round a sum of products to 0."""
        if self.transposed is None:
            return (self.rows[which][:, which] != 0).astype(float)
        generalized = self.problem.generalized
        inner = (self.inverse if generalized is None else sp.csr_array(generalized.mass)) != 0
        if generalized is not None:
            label = sp.csgraph.connected_components(inner, directed=False)[1]
            inner = sp.coo_array((np.ones(len(label)), (np.arange(len(label)), label))).tocsr()
            inner = inner @ inner.T
        j = (self.rows[which] != 0).astype(float)
        return j @ inner.astype(float) @ j.T

    def slack(self, kind: Any, impulse: list[Any]) -> list[Any]:
        """w = A lambda - b of all rows."""
        problem, number = self.problem, kind.number
        # A ball about 0 is not 0; `!=` would have to be certain.
        at = np.flatnonzero(~np.array([x == 0 for x in impulse], bool))
        if self.transposed is None:
            a = times(kind, self.rows, impulse, at)
        else:
            pulled = times(kind, self.transposed, impulse, at)
            if problem.generalized is None:
                moved = times(kind, self.inverse, pulled, None)
            else:
                moved = self.weighed(kind, kind.matrix(len(pulled), 1, pulled)).entries()
            a = times(kind, self.rows, moved, None)
        theta = [0.0] * problem.m if problem.compliance is None else problem.compliance.tolist()
        return [
            x + number(t) * y - b if t else x - b
            for x, t, y, b in zip(a, theta, impulse, self.bias(kind), strict=True)
        ]

    def semidefinite(self) -> bool:
        """Proof that x.A x >= 0 for every x, of exact numbers."""
        problem = self.problem
        if problem.matrix is not None:
            return _semidefinite(problem.dense())
        if problem.generalized is not None:
            return _semidefinite(problem.generalized.mass.toarray())
        return bool((problem.rows.inv_mass >= 0.0).all()) and _semidefinite(problem.rows.inv_inertia)


def _semidefinite(a: FloatArray) -> bool:
    """Whether Cholesky of symmetric matrices (..., n, n) less c I runs through, c what it may round.

    S. M. Rump 2006, Verification of positive definiteness, BIT 46, 433-452: c = g tr(A) / (1 - g), g = (n + 2) UNIT.
    """
    if not (a == np.swapaxes(a, -1, -2)).all():
        return False
    n = a.shape[-1]
    eye, empty = np.eye(n), ~(a != 0.0).any(axis=-1)
    scale = abs(a).max(axis=(-1, -2), keepdims=True, initial=0.0)
    a = a / np.exp2(np.ceil(np.log2(np.where(scale > 0.0, scale, 1.0)))) + empty[..., None] * eye
    trace = np.trace(a, axis1=-2, axis2=-1)[..., None, None]
    try:
        # Twice as much: of the trace, of the subtraction and of what underflows, too.
        np.linalg.cholesky(a - 2.0 * (n + 3) * UNIT * np.maximum(trace, 1.0) * eye)
    except np.linalg.LinAlgError:
        return False
    return True
