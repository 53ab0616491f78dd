"""A of float64 numbers that are taken as exact."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError
from lavender.base.lazy_import import sparse as sp
from lavender.lab.proof.numbers import UNIT, Balls, matrix, times, upper_end
from lavender.problem import Problem
from lavender.problem.derived import cached_property

LARGEST = 2000  # coupled unknowns of J and M, whose M^-1 is dense, in balls: a minute, 0.3 GB

SMALL = 64  # rows up to which A is dense balls

DENSE = 300  # rows up to which float64 numbers are dense

RANGE = 2.0**300  # of numbers whose products of three float64 holds


class Rounded(NamedTuple):
    """Float64 numbers and how far they may be off: arrays up to DENSE rows, sparse above."""

    near: Any
    off: Any


def _in_range(a: Any) -> bool:
    live = abs(a.data[a.data != 0.0])
    return bool(((live > 1.0 / RANGE) & (live < RANGE)).all())


def wider(x: Any) -> Any:
    """More than these, which are rounded sums of nothing negative."""
    return x * (1.0 + 1e-9)


class Part:
    """A of some rows and columns: exactly, times balls, and as float64 numbers with a bound."""

    def __init__(self, operator: Operator, kind: Balls, which: Any) -> None:
        self.which, self._operator, self._kind = which, operator, kind
        self.dense = len(which) <= SMALL or operator.problem.generalized is not None
        if not self.dense:
            self._matrices = self._factors()
            self.dense = not all(map(_in_range, self._matrices)) and operator.transposed is not None
        if self.dense:
            if len(which) > LARGEST:
                raise CapabilityError(
                    f"{len(which)} unknowns of J and M are coupled with each other; up to {LARGEST} are proven"
                )
            return
        self._numbers = [_numbers(kind, f) for f in self._matrices]
        theta = operator.problem.compliance
        self._theta = np.zeros(len(which)) if theta is None else theta[which]
        self._soft = [kind.number(t) for t in self._theta.tolist()]

    def _factors(self) -> list[Any]:
        """Matrices whose product, with the compliance, is A: the last one first."""
        operator = self._operator
        rows = operator.rows[self.which]
        if operator.transposed is None:
            return [rows[:, self.which]]
        used = np.unique(rows.indices)
        j = rows[:, used]
        return [j.T.tocsr(), operator.inverse[used][:, used], j]

    @cached_property
    def exact(self) -> Any:
        """A as a dense matrix of balls."""
        return self._operator.block(self._kind, self.which)

    def times(self, x: list[Any]) -> list[Any]:
        """A x."""
        if self.dense:
            return list((self.exact * self._kind.matrix(len(x), 1, x)).entries())
        y = x
        for factor in self._numbers:
            y = [sum((p * y[k] for p, k in row), self._kind.number(0.0)) for row in factor]
        return [p + t * q if t else p for p, t, q in zip(y, self._soft, x, strict=True)]

    @cached_property
    def bounded(self) -> Rounded:
        """A as float64 numbers, and how far they may be off."""
        if self._operator.transposed is None:
            a = self._operator.rows[self.which][:, self.which]
            return self._bounded(a, abs(a) * 0.0)
        if self.dense:
            n, entries = len(self.which), self.exact.entries()
            near = [float(x.mid()) for x in entries]
            off = [upper_end(x - y) for x, y in zip(entries, near, strict=True)]
            both = (np.array(v).reshape(n, n) for v in (near, off))
            return Rounded(*(v if n <= DENSE else sp.csr_array(v) for v in both))
        _, inner, j = self._matrices
        soft, inner_size, size = sp.diags_array(self._theta), abs(inner), abs(j)
        half, half_size = j @ inner, size @ inner_size
        k = int(np.diff(j.indptr).max() + np.diff(half.indptr).max()) + 2  # sums of sums of so many products
        off = 2.0 * k * UNIT * (half_size @ size.T + soft)
        return self._bounded(half @ j.T + soft, wider(off))

    def _bounded(self, near: Any, off: Any) -> Rounded:
        dense = len(self.which) <= DENSE
        return Rounded(*(a.toarray() if dense else sp.csr_array(a) for a in (near, off)))


def _numbers(kind: Any, a: Any) -> list[list[tuple[Any, int]]]:
    """The entries of each row of a sparse matrix, in numbers of a kind."""
    entries = list(zip([kind.number(x) for x in a.data.tolist()], a.indices.tolist(), strict=True))
    ptr = a.indptr.tolist()
    return [entries[s:e] for s, e in pairwise(ptr)]


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
