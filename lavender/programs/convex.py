"""Convex programs as backends receive them: equilibration by powers of two, and one Newton step on the active rows.

    min 1/2 x.P x + q.x   subject to   (J x)_i = t_i for i < free,   (J x)_i >= t_i,   J x - t in second-order cones

A backend receives the program in scaled variables x', with x = sigma D x', rows multiplied by E and the cost by c
(`lavender_ext/program/error.pyx`), so that the numbers of every program are near 1. Its x is kept; a row has the
multiplier E lambda' / (c sigma). Bounds and rows beyond FAR_SIDE in scaled units, such as placeholder bounds of 1e9,
are left out in the first call. The judge of the caller has all rows.

`polish` improves an answer by one step of Newton's method for the optimality conditions, with the inequalities that the
judge of programs calls active as equations:

    [ P  -J_a^T ] [ dx   ]     [ P x + q - J_a^T lambda ]
    [ J_a   0   ] [ dlam ] = - [ J_a x - t_a            ]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import import_module_under_lock
from lavender.base.lazy_import import sparse as sp
from lavender.problem.derived import cached_property
from lavender.problem.generalized import Compressed
from lavender.problem.program import MAX_SINGULAR_PIVOT
from lavender_ext.program.error import (
    MAX_TERM_GROWTH,
    TERM_ROUNDING,
    equilibrate_program,
    find_components,
    judge_program,
)
from lavender_ext.program.rows import (
    INFINITE,
    NewtonStep,
    compute_slacks,
    is_below,
    join_multipliers,
    make_columns,
    make_dense,
    scale_program,
    split_multipliers,
    split_rows,
)

IntArray = npt.NDArray[np.int32]
# [-] Inequalities with a scaled right-hand side below -FAR_SIDE are left out in the first call.
FAR_SIDE = 1e6
# [-] Multiples of the largest diagonal entry that are added to a singular P for backends that need a definite one, in
# the first and in the second call. The Newton step removes their effect.
DEFINITE_SHIFTS = 1e-7, 1e-5
# [-] A claim "infeasible" with a larger error of its proof is followed by a second call.
MAX_CLAIM_ERROR = 1e-3
# The matrix of a step of k equations is factored as sparse with at most MAX_SPARSE_GROWTH k^3 and MAX_SPARSE_SHARE k^2
# entries. Matrices of public programs (k = 150 to 550) then take no longer than dense on one thread, random patterns up
# to 5 times as long. On a busy machine, the threads of a dense factorisation may take 100 times as long.
MAX_SPARSE_GROWTH, MAX_SPARSE_SHARE = 1.5e-4, 0.08
MAX_FIT_SIZE = 300  # Largest number of variables and of active rows for `fit_multipliers`.
NEAR_SLACK = (
    1e-8  # [-] Rows with a smaller slack in scaled units may be active with a multiplier of 0.
)
# [-] Shift of the diagonal of a singular or sparse matrix of the step; each refinement reduces its effect.
STEP_SHIFT, REFINEMENTS_OF_SHIFTED_STEP = 1e-9, 4
# [-] A contradiction is searched first among rows with right-hand sides up to this multiple of those of
# violated rows, in scaled units: larger ones would hide it.
MAX_SIDE_RATIO = 2.0**20
# [-] Entries of x that differ from 0 or a bound by less than this share of the largest one are tried there.
ROUNDED_SHARES = 2.0**-100, 2.0**-53, 2.0**-43, 2.0**-33


@dataclass(frozen=True, eq=False)
class ConvexProgram:
    """A convex program; see the module."""

    P: Compressed  # (indptr, indices, data): both triangles, in compressed rows.
    q: FloatArray  # (n,)
    J: Compressed  # (indptr, indices, data)
    t: FloatArray  # (m,)
    free: int  # Number of equations, which are the first rows.
    # (m,) int: variable of a row that is a bound, x_j >= t_i or -x_j >= t_i; -1 for other rows.
    variable: IntArray
    cones: tuple[int, ...] = ()  # Sizes of the second-order cones, which are the last rows.
    definite: bool = False  # Whether P is known to be positive definite.

    @cached_property
    def hessian(self) -> Any:
        """P as `csc_matrix` with sorted indices; its rows are its columns, since P is symmetric."""
        ptr, idx, value = self.P
        matrix = sp.csc_matrix((value, idx, ptr), (len(self.q), len(self.q)))
        matrix.sort_indices()
        return matrix

    @cached_property
    def jacobian(self) -> Any:
        """J as `csr_matrix`."""
        ptr, idx, value = self.J
        return sp.csr_matrix((value, idx, ptr), (len(self.t), len(self.q)))

    @cached_property
    def scales(self) -> tuple[FloatArray, FloatArray, float, float]:
        """D (n,), E (m,), sigma and c."""
        d, e, sigma, c = equilibrate_program(
            self.P, self.q, self.J, self.t, self.variable, self.free
        )
        first = len(self.t) - sum(self.cones)
        for size in self.cones:  # The rows of a cone have one scale.
            e[first : first + size] = e[first : first + size].min()
            first += size
        return d, e, sigma, c

    @cached_property
    def scaled(self) -> ScaledProgram:
        """The program in scaled variables."""
        hessian, q, jac, t = scale_program(self.P, self.q, self.J, self.t, self.scales)
        return ScaledProgram(
            P=hessian,
            q=q,
            J=jac,
            t=t,
            free=self.free,
            variable=self.variable,
            cones=self.cones,
            definite=self.definite,
        )

    def scale_point(self, x: FloatArray, lam: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Convert x (n,) and multipliers (m,) to the scaled program."""
        d, e, sigma, c = self.scales
        return x / (sigma * d), lam * (c * sigma) / e

    def restore_point(self, x: FloatArray, lam: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Convert x' (n,) and multipliers (m,) of the scaled program to the program."""
        d, e, sigma, c = self.scales
        return x * (sigma * d), lam * e / (c * sigma)

    def without_cost(self) -> ConvexProgram:
        """Return the program with P = 0 and q = 0."""
        n = len(self.q)
        empty = np.zeros(n + 1, np.int32), np.zeros(0, np.int32), np.zeros(0)
        return replace(self, P=empty, q=np.zeros(n))

    def judge(self, x: FloatArray, lam: FloatArray) -> tuple[Any, ...]:
        """Judge x and multipliers of a program without cones: `judge_program`."""
        return judge_program(
            self.P, self.q, self.J, self.t, self.scales, self.components, lam, x, self.free
        )

    @cached_property
    def components(self) -> tuple[IntArray, int]:
        """Components of the columns and rows (n + m,), and their number: `find_components`."""
        return find_components(self.P, self.J, len(self.q), len(self.t))

    def clip_to_bounds(self, x: FloatArray) -> FloatArray:
        """Return x (n,) with each variable within its bounds."""
        low, high = self._bounds
        return x if low is None or high is None else np.minimum(np.maximum(x, low), high)

    def list_rounded_points(self, x: FloatArray) -> Iterator[FloatArray]:
        """Yield points with entries at 0 or at a bound that differ from these by rounding of the largest x_j / D_j.

        A local error compares a variable with its own size, so that the rounding of large variables counts
        in small ones. If all entries are rounding of 0, the size sigma of x takes the place of the largest one.
        """
        low, high = self._bounds
        d, _, sigma, _ = self.scales
        size = d * max(np.abs(x / d).max(initial=0.0), sigma)
        last = x
        for share in ROUNDED_SHARES:
            y = np.where(np.abs(x) <= share * size, 0.0, x)
            if low is not None and high is not None:
                for bound in (low, high):
                    finite = np.isfinite(bound)
                    reach = share * np.maximum(size, np.abs(np.where(finite, bound, 0.0)))
                    y = np.where(finite & (np.abs(y - bound) <= reach), bound, y)
                y = np.minimum(np.maximum(y, low), high)
            if (y != last).any():
                yield y
            last = y

    def find_rows_of_failing_size(self, x: FloatArray, tol: float) -> IntArray:
        """Return the rows with right-hand sides of up to the size of the rows that x (n,) violates.

        A row is violated by more than tol |t_i|; rounding of its terms is subtracted unless they are large. If
        all of these have right-hand sides of 0, their residuals take the place of these.
        """
        slack = self.jacobian @ x - self.t
        side = np.abs(self.t)
        terms = abs(self.jacobian) @ np.abs(x) + side
        size = np.where(
            slack < 0.0, -slack, np.where(np.arange(len(slack)) < self.free, slack, 0.0)
        )
        rounding = np.where(terms > MAX_TERM_GROWTH * side, 0.0, TERM_ROUNDING * terms)
        scaled_side = side * self.scales[1]
        is_violated = size - rounding > tol * side
        limit = scaled_side.max(initial=0.0, where=is_violated)
        if limit == 0.0:
            limit = (size * self.scales[1]).max(initial=0.0, where=is_violated)
        return np.flatnonzero(scaled_side <= MAX_SIDE_RATIO * limit).astype(np.int32)

    def has_hidden_column(self, x: FloatArray, lam: FloatArray, tol: float) -> bool:
        """Return whether a residual above tol |q_j| of a column counts as rounding of larger terms.

        There the strict error cannot tell a solution from a point far along a ray.
        """
        force, cost = self.jacobian.T, np.abs(self.q)
        residual = np.abs(self.hessian @ x + self.q - force @ lam)
        terms = abs(self.hessian) @ np.abs(x) + cost + abs(force) @ np.abs(lam)
        limit = tol * cost
        is_hidden = (residual > limit) & (TERM_ROUNDING * terms > limit) & (cost > 0.0)
        return bool(is_hidden.any())

    def get_reached_side(self, x: FloatArray) -> FloatArray:
        """Return the largest right-hand side of each row's component that x (n,) reaches (m,), in scaled units."""
        side = np.minimum(np.abs(self.t), abs(self.jacobian) @ np.abs(x)) * self.scales[1]
        part, count = self.components
        largest = np.zeros(count)
        np.maximum.at(largest, part[len(x) :], side)
        reached: FloatArray = largest[part[len(x) :]]
        return reached

    def select_rows_and_columns(self, rows: IntArray, columns: IntArray) -> ConvexProgram:
        """Return the program of these rows and columns (ascending) of a program without cones."""
        place = np.full(len(self.q), -1, np.int32)
        place[columns] = np.arange(len(columns), dtype=np.int32)
        variable = self.variable[rows]
        return ConvexProgram(
            P=_get_compressed(sp.csr_matrix(self.hessian)[columns][:, columns]),
            q=self.q[columns],
            J=_get_compressed(self.jacobian[rows][:, columns]),
            t=self.t[rows],
            free=int(np.count_nonzero(rows < self.free)),
            variable=np.where(variable >= 0, place[variable], -1).astype(np.int32),
        )

    def list_components(self) -> Iterator[tuple[IntArray, IntArray]]:
        """Yield the rows and the columns of each component that has columns."""
        n = len(self.q)
        part, count = self.components
        order = np.argsort(part, kind="stable").astype(np.int32)
        for members in np.split(order, np.cumsum(np.bincount(part, minlength=count))[:-1]):
            if members[0] < n:
                yield members[members >= n] - n, members[members < n]

    @cached_property
    def _bounds(self) -> tuple[FloatArray | None, FloatArray | None]:
        """Lower and upper bounds of the variables (n,), infinite without one; None without any."""
        low, high = split_rows(self.J, self.t, self.variable, None, len(self.q), self.free)[2:]
        return low, high

    def resize(self, x: FloatArray) -> ConvexProgram:
        """Return the program with the size of x (n,) as the size of its variables; the same object if x is 0."""
        d, e, _, _ = self.scales
        largest = float(np.abs(x / d).max(initial=0.0))
        if not 0.0 < largest < np.inf:
            return self
        sigma = float(np.exp2(np.round(np.log2(largest))))
        terms = sigma * d * (np.abs(self.q) + abs(self.hessian) @ np.abs(x))
        cost = float(terms.max())
        new = replace(self)
        c = float(np.exp2(-np.round(np.log2(cost)))) if 0.0 < cost < np.inf else 1.0
        new.__dict__["scales"] = d, e, sigma, c
        return new

    @np.errstate(all="ignore")  # The caller judges a step that overflows.
    def polish(
        self, x: FloatArray, lam: FloatArray, active: npt.NDArray[np.bool_], max_size: int
    ) -> tuple[FloatArray, FloatArray] | None:
        """Do one Newton step with iterative refinement; None with cones or with more than `max_size` equations.

        It is computed in scaled units, in which all roundings are the same, because the scales are powers of two.
        Variables at active bounds are eliminated.
        """
        if self.cones:
            return None
        s = self.scaled
        step = NewtonStep(s.P, s.q, s.J, s.t, self.variable, self.scales, active, x, lam)
        size = step.size
        if size > max_size:
            return None
        if size:
            try:
                share = min(MAX_SPARSE_GROWTH * size, MAX_SPARSE_SHARE)
                is_dense = step.count_entries() > share * size**2
                solve, refinements = (_factor_dense if is_dense else _factor_sparse)(step)
            except RuntimeError:  # The sparse matrix is singular in spite of its shift.
                return None
            for _ in range(refinements):
                step.move(solve(step.compute_residual()))
        point: tuple[FloatArray, FloatArray] | None = step.finish()
        return point

    def compare_multipliers_with_slacks(
        self, x: FloatArray, lam: FloatArray
    ) -> npt.NDArray[np.bool_]:
        """Return the equations, and the inequalities with a multiplier that exceeds the slack in scaled units.

        At the end of an interior point one of the two is far below the other, also on a row with a right-hand side of
        0 and no other terms, which `judge_program` compares with its own slack.
        """
        _, e, sigma, c = self.scales
        slack, _, _ = compute_slacks(self.scaled.J, self.scaled.t, self.scales, x)
        active: npt.NDArray[np.bool_] = lam * (c * sigma) / e > slack
        active[: self.free] = True
        return active

    @np.errstate(all="ignore")
    def fit_multipliers(self, x: FloatArray, active: npt.NDArray[np.bool_]) -> FloatArray | None:
        """Return the multipliers (m,) of active rows that fit the gradient at x best: nonnegative least squares.

        None if there are more than MAX_FIT_SIZE variables or active rows.
        """
        rows = np.flatnonzero(active)
        scaled = self.scaled
        if max(len(x), len(rows)) > MAX_FIT_SIZE or not len(rows):
            return None
        x = x / (self.scales[0] * self.scales[2])
        P = scaled.hessian
        cost = abs(P) @ np.abs(x) + np.abs(scaled.q)
        weight = 1.0 / np.maximum(cost, NEAR_SLACK * max(cost.max(), 1e-300))
        matrix = (scaled.jacobian[rows].toarray() * weight).T
        free = rows < self.free
        signed = np.concatenate([matrix, -matrix[:, free]], axis=1)
        size = np.sqrt((signed * signed).sum(axis=0))
        size[size == 0.0] = 1.0
        try:
            nnls = import_module_under_lock("scipy.optimize").nnls
            found = nnls(signed / size, weight * (P @ x + scaled.q))[0] / size
        except RuntimeError:
            return None
        lam = np.zeros(len(scaled.t))
        lam[rows] = found[: len(rows)]
        lam[rows[free]] -= found[len(rows) :]
        return self.restore_point(x, lam)[1]

    def find_near_rows(self, x: FloatArray) -> npt.NDArray[np.bool_]:
        """Return the equations, and the inequalities with a slack of almost 0 in scaled units."""
        slack, _, top = compute_slacks(self.scaled.J, self.scaled.t, self.scales, x)
        near: npt.NDArray[np.bool_] = slack <= NEAR_SLACK * (max(top, 1.0) + np.abs(self.scaled.t))
        near[: self.free] = True
        return near

    def update_active_rows(
        self, x: FloatArray, lam: FloatArray, active: npt.NDArray[np.bool_], tol: float
    ) -> npt.NDArray[np.bool_]:
        """Return the active rows after a step: without negative multipliers, with rows that are violated by tol."""
        slack, terms, _ = compute_slacks(self.scaled.J, self.scaled.t, self.scales, x)
        active = (active & (lam > 0.0)) | (slack < -tol * terms)
        active[: self.free] = True
        return active


@dataclass(frozen=True, eq=False)
class ScaledProgram(ConvexProgram):
    """A scaled program as backends receive it: A x = b, G x <= h, lb <= x <= ub, and G' x <= h' in cones."""

    # (m,) bool: rows that the backend receives; default: all.
    is_kept: npt.NDArray[np.bool_] | None = field(default=None)
    shift: float = 0.0  # Number that was added to the diagonal of P.

    @property
    def n(self) -> int:
        """Number of variables."""
        return len(self.q)

    def without_far_rows(self) -> ScaledProgram:
        """Return the program without inequalities that hold by far at x = 0; the same object if there are none."""
        is_far = self.t < -FAR_SIDE
        is_far[: self.free] = False
        is_far[len(self.t) - sum(self.cones) :] = False
        return replace(self, is_kept=~is_far) if is_far.any() else self

    @property
    def is_representable(self) -> bool:
        """Whether all numbers of the rows that are kept are below INFINITE."""
        side = self.t if self.is_kept is None else self.t[self.is_kept]
        return bool(is_below(INFINITE, self.P[2], self.q, self.J[2], side))

    def is_nearly_proven_unsolvable(self, x: FloatArray | None, lam: FloatArray | None) -> bool:
        """Return whether lam nearly proves that no point satisfies the rows, or x that the objective is unbounded.

        The test is only to recognise claims without foundation: a proof is checked by `proofs.py`.
        """
        if x is None or lam is None:
            return False
        jac = self.jacobian
        y = np.append(lam[: self.free], np.maximum(lam[self.free :], 0.0))
        forces = np.abs(jac.T @ y).max(initial=0.0)
        if forces <= MAX_CLAIM_ERROR * np.abs(y).max(initial=0.0) and self.t @ y > 0.0:
            return True
        slope = jac @ x
        size = MAX_CLAIM_ERROR * np.abs(x).max(initial=0.0)
        errors = np.abs(self.hessian @ x), np.abs(slope[: self.free]), -slope[self.free :]
        return bool(self.q @ x < 0.0 and max(part.max(initial=0.0) for part in errors) <= size)

    @cached_property
    def is_definite(self) -> bool:
        """Whether P has a Cholesky factor without negligible pivots."""
        if self.definite:
            return True
        P = make_dense(self.P, self.n)
        try:
            pivots = np.square(np.linalg.cholesky(P).diagonal())
        except np.linalg.LinAlgError:
            return False
        return bool((pivots > MAX_SINGULAR_PIVOT * P.diagonal()).all())

    def make_definite(self, attempt: int) -> ScaledProgram:
        """Return the program with DEFINITE_SHIFTS[attempt] on the diagonal of P, at first only if P is singular."""
        if self.is_definite and not attempt:
            return self
        P = make_dense(self.P, self.n)
        shift = DEFINITE_SHIFTS[attempt] * float(P.diagonal().max(initial=0.0) or 1.0)
        P[np.diag_indices(self.n)] += shift
        flat = np.arange(self.n * self.n, dtype=np.int32) % max(self.n, 1)
        ptr = np.arange(self.n + 1, dtype=np.int32) * self.n
        return replace(self, P=(ptr.astype(np.int32), flat, P.ravel()), shift=shift)

    def split_rows(
        self, bounds_as_rows: bool
    ) -> tuple[IntArray, IntArray, FloatArray | None, FloatArray | None]:
        """Return the rows of A and of G, and lb and ub (n,), None without bounds; or bounds as rows of A and G."""
        fields = self.J, self.t, self.variable, self.is_kept, self.n, self.free
        rows: tuple[Any, Any, Any, Any] = split_rows(*fields, bounds_as_rows)
        return rows

    def select_rows(self, rows: IntArray, sign: float, dense: bool) -> Any:
        """Return sign J of these rows, dense or as `csc_matrix`."""
        if dense:
            return make_dense(self.J, self.n, np.asarray(rows, np.int32), sign)
        columns = make_columns(self.J, self.n, np.asarray(rows, np.int32), sign)
        return sp.csc_matrix(columns, (len(rows), self.n))

    def get_hessian(self, dense: bool) -> Any:
        """Return a new dense P, or P as `csc_matrix` with sorted indices."""
        return make_dense(self.P, self.n) if dense else self.hessian

    def make_upper_triangle(self) -> Any:
        """Return the upper triangle of P as `csc_matrix`."""
        return sp.csc_matrix(make_columns(self.P, self.n, None, 1.0, True), (self.n, self.n))

    def join_multipliers(
        self, y: Any, z: Any, box: Any, bounds_as_rows: bool = False
    ) -> FloatArray:
        """Return lambda (m,) of multipliers with the signs of qpsolvers; missing ones count as 0."""
        fields = self.J, self.variable, self.is_kept, self.n, self.free
        lam: FloatArray = join_multipliers(*fields, y, z, box, bounds_as_rows)
        return lam

    def split_multipliers(self, lam: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return (y, z, box) of multipliers (m,), with the signs of qpsolvers."""
        y, z, box = split_multipliers(self.J, self.variable, self.is_kept, self.n, self.free, lam)
        return y, z, box


def _get_compressed(matrix: Any) -> Compressed:
    """Return (indptr, indices, data) of a `csr_matrix`, with ascending indices of 32 bits."""
    matrix.sort_indices()
    return matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32), matrix.data


def _factor_dense(step: Any) -> tuple[Any, int]:
    """Return the solver of the step's equations and the number of its refinements; singular equations are shifted."""
    lapack = import_module_under_lock("scipy.linalg.lapack")
    lu, pivots, info = lapack.dgetrf(step.make_dense(0.0), overwrite_a=True)
    pivot = np.abs(lu.diagonal())
    refinements = 2
    if info != 0 or not pivot.min() > MAX_SINGULAR_PIVOT * pivot.max():
        lu, pivots, _ = lapack.dgetrf(step.make_dense(STEP_SHIFT), overwrite_a=True)
        refinements = REFINEMENTS_OF_SHIFTED_STEP
    return lambda rhs: lapack.dgetrs(lu, pivots, rhs)[0], refinements


def _factor_sparse(step: Any) -> tuple[Any, int]:
    """Return the solver of the step's equations with a shifted diagonal, and the number of its refinements."""
    matrix = sp.csc_matrix(step.make_columns(STEP_SHIFT), (step.size, step.size))
    return import_module_under_lock("scipy.sparse.linalg").splu(
        matrix
    ).solve, REFINEMENTS_OF_SHIFTED_STEP
