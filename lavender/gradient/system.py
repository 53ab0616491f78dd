"""The linear system of a derivative: choice of its factorisation, and solves if it is singular."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import factor_sparse_lu
from lavender.problem import Problem
from lavender.solvers.factors import USE_WIDE_LANES
from lavender_ext.derivative.linear import Linear
from lavender_ext.factor.linear import LinearSystem
from lavender_ext.factor.sparse import extract_free_part
from lavender_ext.newton.solve import is_dense_factor_faster

# G counts as singular if its smallest pivot divided by its largest pivot is below this.
MIN_PIVOT_RATIO = 1e-12
# Shift of each diagonal entry of a singular G, relative to the entry: eps of equation (6) in `lavender.gradient`.
SHIFT_OF_SINGULAR = 1e-11
# Largest number of proximal steps of (6). Each step divides the error of a component by 1 + pivot / shift: eight steps
# leave 2^-8 of it if the pivot equals the shift, and 1e-16 if the pivot is 100 times the shift.
MAX_PROXIMAL_STEPS = 8
# The iteration (6) ends if a step changes x by up to this fraction of its largest entry.
MIN_PROXIMAL_CHANGE = 1e-14
NULL_VECTORS = 2  # Number of random vectors that are projected on the null space of G.
MAX_KERNEL_ROWS = (
    64  # Systems of up to this many rows are factored as dense matrices by the kernel.
)
# Larger systems of up to this many rows are factored as dense matrices if a contact slides, or if A is not symmetric.
MAX_DENSE_ROWS = 400

# Function that solves G x = r; its arguments are r and whether to transpose G.
Solve = Callable[[FloatArray, bool], FloatArray]


def factor_dense(problem: Problem, linear: Linear, shift: float = 0.0) -> bool:
    """Factor G + shift P as a dense matrix in the kernel; return whether it is regular."""
    data = problem.csr_data if problem.generalized is None else problem.metric
    is_regular: bool = linear.prepare(data, shift)
    return is_regular


class System:
    """A factor of G on the rows in which G is not the identity, with solves for G and G^T.

    Attributes
    ----------
    singular : bool
        Whether G is singular; solves then iterate by (6).
    of_kernel : bool
        Whether G is regular and the kernel has its factor.
    """

    def __init__(self, problem: Problem, linear: Linear) -> None:
        self.problem = problem
        self.linear = linear
        self.n = linear.rows
        is_symmetric = (
            self.n > MAX_KERNEL_ROWS and not linear.has_sliding_contact and problem.is_symmetric
        )
        if is_symmetric and not is_dense_factor_faster(problem.csr.nnz, problem.m, True):
            factor = self._factor_symmetric
        else:
            factor = self._factor_dense if self.n <= MAX_DENSE_ROWS else self._factor_lu
        # For systems of up to MAX_KERNEL_ROWS rows, `Derivative` has called `factor_dense` before.
        is_factored = self.n <= MAX_KERNEL_ROWS
        solve = (
            linear.solve if is_factored and linear.regular else None if is_factored else factor(0.0)
        )
        self.singular = solve is None
        self.of_kernel = solve is not None and factor == self._factor_dense
        if solve is None:
            self.g: Any = (
                linear.matrix() if factor == self._factor_dense else self._form_matrix(0.0)
            )
            solve = factor(SHIFT_OF_SINGULAR)
        if solve is None:
            raise CapabilityError(
                f"the linear system of the derivative is singular even with {SHIFT_OF_SINGULAR:g} of its diagonal "
                "added: A is indefinite, or states of contacts are wrong. Solve with a smaller tol first"
            )
        self._solve_factored = solve
        self._null_vectors: dict[bool, FloatArray] = {}

    def _factor_dense(self, shift: float) -> Solve | None:
        return self.linear.solve if factor_dense(self.problem, self.linear, shift) else None

    def _form_h(self) -> tuple[Any, Any, FloatArray]:
        """Form H on the rows of the system; return the arrays of its compressed rows."""
        a = self.problem.csr
        linear = self.linear
        indptr, indices, data = extract_free_part(
            a.indptr, a.indices, a.data, linear.system_row, self.n
        )
        root = linear.root[linear.system_row >= 0]
        return indptr, indices, data / (np.repeat(root, np.diff(indptr)) * root[indices])

    def _factor_symmetric(self, shift: float) -> Solve | None:
        """Factor G with a shifted diagonal if no contact slides: G equals H then and is symmetric."""
        indptr, indices, data = self._form_h()
        system = LinearSystem((indptr, indices), USE_WIDE_LANES)
        failed = system.factor(data, None, shift, MIN_PIVOT_RATIO)
        return None if failed else lambda r, transpose: system.solve(r)

    def _form_matrix(self, shift: float) -> Any:
        """Form G + shift P = I - P + P (H + shift I) as a sparse matrix."""
        indptr, indices, data = self._form_h()
        h = sp.csr_array((data, indices, indptr), shape=(self.n, self.n))
        c = self.problem.cones
        one = sp.eye_array(self.n)
        block = np.repeat(np.arange(c.n_blocks), np.diff(c.ptr))
        is_row = ~c.is_contact[block]
        # P has one diagonal entry for a bounded row, and a dense block for a contact.
        ends = np.concatenate([[0], np.cumsum(np.where(is_row, 1, np.diff(c.ptr)[block]))])
        first = np.where(is_row, np.arange(c.n_rows), c.ptr[block])
        columns = np.arange(ends[-1]) + np.repeat(first - ends[:-1], np.diff(ends))
        rows = np.flatnonzero(self.linear.system_row >= 0)
        p = sp.csr_array((self.linear.p, columns, ends), shape=(c.n_rows, c.n_rows))[rows][:, rows]
        return sp.csc_array(one - p + p @ (h + shift * one))

    def _factor_lu(self, shift: float) -> Solve | None:
        """Factor G + shift P by SuperLU; return None if it is singular."""
        try:
            lu = factor_sparse_lu(self._form_matrix(shift))
        except RuntimeError:
            return None
        pivots = np.abs(lu.U.diagonal())
        if not pivots.min() > MIN_PIVOT_RATIO * pivots.max():
            return None
        return lambda r, transpose: lu.solve(r, trans="T" if transpose else "N")

    def solve(self, r: FloatArray, transpose: bool = False) -> FloatArray:
        """Solve G x = r or G^T x = r; if G is singular, iterate by equation (6) of `lavender.gradient`."""
        x = self._solve_factored(r, transpose)
        if self.singular:
            g = self.g.T if transpose else self.g
            for _ in range(MAX_PROXIMAL_STEPS):
                step = self._solve_factored(r - g @ x, transpose)
                x = x + step
                if not np.abs(step).max() > MIN_PROXIMAL_CHANGE * np.abs(x).max():
                    break
        return x

    def draw_null_vectors(self, transpose: bool) -> FloatArray:
        """Return random unit vectors (NULL_VECTORS, n) in the null space of G, or of G^T; empty if G is regular."""
        if transpose in self._null_vectors:
            return self._null_vectors[transpose]
        if not self.singular:
            return np.zeros((0, self.n))
        g = self.g.T if transpose else self.g
        vectors = []
        for x in np.random.default_rng(0).standard_normal((NULL_VECTORS, self.n)):
            for _ in range(MAX_PROXIMAL_STEPS):
                x = x - self._solve_factored(g @ x, transpose)
            vectors.append(x / np.linalg.norm(x))
        return self._null_vectors.setdefault(transpose, np.stack(vectors))

    def has_null_component(self, r: FloatArray, limit: float, transpose: bool) -> bool:
        """Return whether the cosine of r with a null vector of G, or of G^T, exceeds the limit."""
        size = limit * float(np.linalg.norm(r))
        return any(abs(float(x @ r)) > size for x in self.draw_null_vectors(transpose))
