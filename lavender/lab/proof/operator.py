"""The operator A of exact float64 entries in three arithmetics: balls, rationals, and float64 with error bounds."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError
from lavender.base.lazy_import import sparse as sp
from lavender.lab.proof.numbers import UNIT, Balls, multiply_sparse_by_vector, round_up_magnitude, to_dense
from lavender.problem import Problem
from lavender.problem.derived import cached_property

# Largest number of coupled velocities of M. M^-1 is a dense matrix of balls; at this size it takes a minute and 0.3
# GB.
MAX_COUPLED_UNKNOWNS = 2000

MAX_DENSE_BALL_ROWS = 64  # Up to this many rows, A is a dense matrix of balls.

MAX_DENSE_FLOAT_ROWS = 300  # Up to this many rows, float64 matrices are dense.

# Products of three numbers between 1 / this and this neither overflow nor underflow in float64.
PRODUCT_RANGE = 2.0**300


class Rounded(NamedTuple):
    """Float64 numbers and bounds of their errors: arrays up to MAX_DENSE_FLOAT_ROWS rows, sparse matrices above."""

    near: Any
    off: Any


def _is_in_product_range(a: Any) -> bool:
    """Whether all non-zero numbers are in PRODUCT_RANGE."""
    live = abs(a.data[a.data != 0.0])
    return bool(((live > 1.0 / PRODUCT_RANGE) & (live < PRODUCT_RANGE)).all())


def round_up(x: Any) -> Any:
    """Return upper bounds of rounded sums x of non-negative numbers."""
    return x * (1.0 + 1e-9)


class Part:
    """A of some rows and columns: as exact balls, as a product with balls, and as float64 with error bounds."""

    def __init__(self, operator: Operator, kind: Balls, which: Any) -> None:
        self.which, self._operator, self._kind = which, operator, kind
        self.dense = len(which) <= MAX_DENSE_BALL_ROWS or operator.problem.generalized is not None
        if not self.dense:
            self._matrices = self._list_factors()
            self.dense = (
                not all(map(_is_in_product_range, self._matrices)) and operator.transposed is not None
            )
        if self.dense:
            if len(which) > MAX_COUPLED_UNKNOWNS:
                raise CapabilityError(
                    f"{len(which)} unknowns of J and M are coupled; up to {MAX_COUPLED_UNKNOWNS} are proven"
                )
            return
        self._numbers = [_list_row_entries(kind, f) for f in self._matrices]
        theta = operator.problem.compliance
        self._theta = np.zeros(len(which)) if theta is None else theta[which]
        self._soft = [kind.number(t) for t in self._theta.tolist()]

    def _list_factors(self) -> list[Any]:
        """Return the factors of A without compliance, in the order in which they are applied to x."""
        operator = self._operator
        rows = operator.rows[self.which]
        if operator.transposed is None:
            return [rows[:, self.which]]
        used = np.unique(rows.indices)
        j = rows[:, used]
        return [j.T.tocsr(), operator.inverse[used][:, used], j]

    @cached_property
    def exact_matrix(self) -> Any:
        """Return A as a dense matrix of balls."""
        return self._operator.compute_block(self._kind, self.which)

    def multiply(self, x: list[Any]) -> list[Any]:
        """Compute A x."""
        if self.dense:
            return list((self.exact_matrix * self._kind.matrix(len(x), 1, x)).entries())
        y = x
        for factor in self._numbers:
            y = [sum((p * y[k] for p, k in row), self._kind.number(0.0)) for row in factor]
        return [p + t * q if t else p for p, t, q in zip(y, self._soft, x, strict=True)]

    @cached_property
    def matrix_with_error_bounds(self) -> Rounded:
        """Return A as float64 numbers with error bounds."""
        if self._operator.transposed is None:
            a = self._operator.rows[self.which][:, self.which]
            return self._make_rounded(a, abs(a) * 0.0)
        if self.dense:
            n, entries = len(self.which), self.exact_matrix.entries()
            near = [float(x.mid()) for x in entries]
            off = [round_up_magnitude(x - y) for x, y in zip(entries, near, strict=True)]
            both = (np.array(v).reshape(n, n) for v in (near, off))
            return Rounded(*(v if n <= MAX_DENSE_FLOAT_ROWS else sp.csr_array(v) for v in both))
        _, inner, j = self._matrices
        soft, inner_size, size = sp.diags_array(self._theta), abs(inner), abs(j)
        half, half_size = j @ inner, size @ inner_size
        # Each entry of A is a nested sum of at most k products.
        k = int(np.diff(j.indptr).max() + np.diff(half.indptr).max()) + 2
        off = 2.0 * k * UNIT * (half_size @ size.T + soft)
        return self._make_rounded(half @ j.T + soft, round_up(off))

    def _make_rounded(self, near: Any, off: Any) -> Rounded:
        """Build a `Rounded` of dense or sparse matrices, by the number of rows."""
        dense = len(self.which) <= MAX_DENSE_FLOAT_ROWS
        return Rounded(*(a.toarray() if dense else sp.csr_array(a) for a in (near, off)))


def _list_row_entries(kind: Any, a: Any) -> list[list[tuple[Any, int]]]:
    """Return (number, column) of the entries of each row of a sparse matrix, as balls or rationals."""
    entries = list(zip([kind.number(x) for x in a.data.tolist()], a.indices.tolist(), strict=True))
    ptr = a.indptr.tolist()
    return [entries[s:e] for s, e in pairwise(ptr)]


class Operator:
    """The operator A with exact float64 entries: products with impulses, and blocks, in balls or rationals."""

    def __init__(self, problem: Problem) -> None:
        self.problem: Any = problem
        self.rows = problem.csr if problem.matrix is not None else problem.jacobian
        if problem.matrix is None and problem.rows is not None:
            self.inverse = problem.rows.inverse_mass_matrix().tocsr()
        self.transposed = self.rows.T.tocsr() if problem.matrix is None else None
        self.target, self.v = self._split_rhs()
        self._mass: dict[Any, Any] = {}  # M^-1 in balls and in rationals.
        self._bias: dict[Any, list[Any]] = {}  # b in balls and in rationals.

    def _split_rhs(self) -> tuple[FloatArray, FloatArray | None]:
        """Return (target, v*) with b = target - J v*, or (b, None) for a problem in matrix form.

        Targets of the size of rounding errors are set to 0.
        """
        problem = self.problem
        if problem.matrix is not None:
            return problem.b, None
        v = problem.rows.v_free.ravel() if problem.generalized is None else problem.generalized.v_free
        target = problem.b + self.rows @ v
        rounding_bound = (
            4.0 * UNIT * (abs(self.rows) @ abs(v) * (1 + np.diff(self.rows.indptr)) + abs(problem.b))
        )
        return np.where(abs(target) <= rounding_bound, 0.0, target), v

    def has_compliance(self, row: int) -> bool:
        """Whether a row has compliance."""
        return self.transposed is not None and bool(self.problem.compliance[row] > 0.0)

    def compute_bias(self, kind: Any) -> list[Any]:
        """Compute b from targets and v*, exactly."""
        if type(kind) in self._bias:
            return self._bias[type(kind)]
        out = [kind.number(x) for x in self.target.tolist()]
        if self.v is not None:
            velocity = multiply_sparse_by_vector(
                kind, self.rows, [kind.number(x) for x in self.v.tolist()], None
            )
            out = [x - y for x, y in zip(out, velocity, strict=True)]
        self._bias[type(kind)] = out
        return out

    def apply_inverse_mass(self, kind: Any, right: Any) -> Any:
        """Multiply M^-1 by a matrix (nv, k) of balls or rationals."""
        generalized = self.problem.generalized
        if generalized is None:
            return to_dense(kind, self.inverse) * right
        if type(kind) not in self._mass:
            self._mass[type(kind)] = to_dense(kind, generalized.mass).inv()
        return self._mass[type(kind)] * right

    def compute_block(self, kind: Any, which: Any) -> Any:
        """Compute A of the rows and columns `which`, as a dense matrix."""
        if self.transposed is None:
            return to_dense(kind, self.rows[which][:, which])
        part = self.rows[which]
        used = np.unique(part.indices)
        if self.problem.generalized is None:
            inner = self.inverse[used][:, used]
            j = to_dense(kind, part[:, used])
            a = j * to_dense(kind, inner) * j.transpose()
        else:
            j = to_dense(kind, part)
            a = j * self.apply_inverse_mass(kind, j.transpose())
        for k, i in enumerate(which.tolist()):
            a[k, k] += kind.number(float(self.problem.compliance[i]))
        return a

    def compute_sparsity_pattern(self, which: Any) -> Any:
        """Return a sparsity pattern that contains the one of A, also entries that float64 arithmetic rounds to 0."""
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

    def compute_slack(self, kind: Any, impulse: list[Any]) -> list[Any]:
        """Compute w = A lambda - b of all rows."""
        problem, number = self.problem, kind.number
        # For a ball that contains 0 and other numbers, `!= 0` is false, as it is not certain: select entries by `not
        # ==`.
        at = np.flatnonzero(~np.array([x == 0 for x in impulse], bool))
        if self.transposed is None:
            a = multiply_sparse_by_vector(kind, self.rows, impulse, at)
        else:
            generalized_impulse = multiply_sparse_by_vector(kind, self.transposed, impulse, at)
            if problem.generalized is None:
                velocity = multiply_sparse_by_vector(kind, self.inverse, generalized_impulse, None)
            else:
                velocity = self.apply_inverse_mass(
                    kind, kind.matrix(len(generalized_impulse), 1, generalized_impulse)
                ).entries()
            a = multiply_sparse_by_vector(kind, self.rows, velocity, None)
        theta = [0.0] * problem.m if problem.compliance is None else problem.compliance.tolist()
        return [
            x + number(t) * y - b if t else x - b
            for x, t, y, b in zip(a, theta, impulse, self.compute_bias(kind), strict=True)
        ]

    def prove_semidefinite(self) -> bool:
        """Prove that x.A x >= 0 for every x, with the numbers as exact; False if the proof fails."""
        problem = self.problem
        if problem.matrix is not None:
            return _prove_semidefinite_by_cholesky(problem.dense())
        if problem.generalized is not None:
            return _prove_semidefinite_by_cholesky(problem.generalized.mass.toarray())
        return bool((problem.rows.inv_mass >= 0.0).all()) and _prove_semidefinite_by_cholesky(
            problem.rows.inv_inertia
        )


def _prove_semidefinite_by_cholesky(a: FloatArray) -> bool:
    """Return whether symmetric matrices `a` (..., n, n) are proved semidefinite: a - c I has Cholesky factors.

    c bounds the rounding errors of the factorisation.

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
        # Twice the bound covers the rounding of the trace, of the subtraction and underflow.
        np.linalg.cholesky(a - 2.0 * (n + 3) * UNIT * np.maximum(trace, 1.0) * eye)
    except np.linalg.LinAlgError:
        return False
    return True
