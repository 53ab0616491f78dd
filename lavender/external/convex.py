"""Convex programs as backends receive them: equilibration by powers of two, and one Newton step on the active rows.

    min 1/2 x.P x + q.x   subject to   (J x)_i = t_i for i < free,   (J x)_i >= t_i,   J x - t in second-order cones

A backend receives the program in scaled variables x', with x = sigma D x', rows multiplied by E and the cost by c
(`lavender_ext/judge/program.pyx`), so that the numbers of every program are near 1. Its x is kept; a row has the
multiplier E lambda' / (c sigma). Bounds and rows beyond FAR_SIDE in scaled units, such as placeholder bounds of 1e9,
are left out in the first call. The judge of the caller has all rows.

`polish` improves an answer by one step of Newton's method for the optimality conditions, with the inequalities that the
judge of programs calls active as equations:

    [ P  -J_a^T ] [ dx   ]     [ P x + q - J_a^T lambda ]
    [ J_a   0   ] [ dlam ] = - [ J_a x - t_a            ]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import import_module_under_lock
from lavender.base.lazy_import import sparse as sp
from lavender.problem.derived import cached_property
from lavender.problem.generalized import Compressed
from lavender_ext.judge.program import equilibrate_program, judge_program, scale_rows

IntArray = npt.NDArray[np.int32]
MAX_BACKEND_NUMBER = 1e20  # Backends treat larger numbers as infinite, or fail.
# [-] Inequalities with a scaled right-hand side below -FAR_SIDE are left out in the first call.
FAR_SIDE = 1e6
# [-] A matrix counts as singular if a squared pivot of its Cholesky factor is at most this multiple of the diagonal.
MAX_SINGULAR_PIVOT = 1e-13
# [-] Multiples of the largest diagonal entry that are added to a singular P for backends that need a definite one, in
# the first and in the second call. The Newton step removes their effect.
DEFINITE_SHIFTS = 1e-7, 1e-5
MAX_CLAIM_ERROR = (
    1e-3  # [-] A claim "infeasible" with a larger error of its proof is followed by a second call.
)
# P and J are dense with at most this many entries together, and with more than this share of nonzeros.
MAX_CONVERTED_ENTRIES, MIN_DENSE_FILL = 10**5, 0.2
MAX_DENSE_STEP_SIZE = 300  # The matrix of the step is dense up to this many variables and active rows.
MAX_STEP_SIZE = 20_000  # No step is done with more variables and active rows.
MAX_FIT_SIZE = 300  # Largest number of variables and of active rows for `fit_multipliers`.
NEAR_SLACK = 1e-8  # [-] Rows with a smaller slack in scaled units may be active with a multiplier of 0.
# [-] Shift of the diagonal of a singular or sparse matrix of the step; each refinement reduces its effect.
STEP_SHIFT, REFINEMENTS_OF_SHIFTED_STEP = 1e-9, 4
MAX_SINGULAR_STEP_PIVOT = 1e-13  # [-] A dense matrix counts as singular below this ratio of its pivots.


@dataclass(frozen=True, eq=False)
class ConvexProgram:
    """A convex program; see the module.

    Parameters
    ----------
    P : (indptr, indices, data)
        Both triangles, in compressed rows.
    q : (n,)
    J : (indptr, indices, data)
    t : (m,)
    free : int
        Number of equations, which are the first rows.
    variable : (m,) int
        Variable of a row that is a bound, x_j >= t_i or -x_j >= t_i; -1 for other rows.
    cones : tuple of int
        Sizes of the second-order cones, which are the last rows.
    """

    P: Compressed
    q: FloatArray
    J: Compressed
    t: FloatArray
    free: int
    variable: IntArray
    cones: tuple[int, ...] = ()

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
        d, e, sigma, c = equilibrate_program(self.P, self.q, self.J, self.t, self.variable, self.free)
        first = len(self.t) - sum(self.cones)
        for size in self.cones:  # The rows of a cone have one scale.
            e[first : first + size] = e[first : first + size].min()
            first += size
        return d, e, sigma, c

    @cached_property
    def scaled(self) -> ScaledProgram:
        """The program in scaled variables."""
        d, e, sigma, c = self.scales
        hessian, jac = scale_rows(self.P, c * sigma * sigma * d, d), scale_rows(self.J, e, d)
        return ScaledProgram(
            P=hessian, q=c * sigma * d * self.q, J=jac, t=e * self.t / sigma, free=self.free,
            variable=self.variable, cones=self.cones,
        )  # fmt: skip

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
        return judge_program(self.P, self.q, self.J, self.t, self.scales, lam, x, self.free)

    def clip_to_bounds(self, x: FloatArray) -> FloatArray:
        """Return x (n,) with each variable within its bounds."""
        low, high = self._bounds
        return np.minimum(np.maximum(x, low), high)

    @cached_property
    def _bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of the variables (n,); infinite without one."""
        bound = np.flatnonzero(self.variable >= 0)
        side = self.t[bound] * self.J[2][self.J[0][bound]]
        is_low, is_fixed = self.J[2][self.J[0][bound]] > 0.0, bound < self.free
        low, high = np.full(len(self.q), -np.inf), np.full(len(self.q), np.inf)
        low[self.variable[bound[is_low]]] = side[is_low]
        high[self.variable[bound[~is_low | is_fixed]]] = side[~is_low | is_fixed]
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
        self, x: FloatArray, lam: FloatArray, active: npt.NDArray[np.bool_]
    ) -> tuple[FloatArray, FloatArray] | None:
        """Do one Newton step with iterative refinement; None if the program has cones or is too large.

        It is computed in scaled units, in which all roundings are the same, because the scales are powers of two.
        Variables at active bounds are eliminated.
        """
        n, scaled = len(x), self.scaled
        rows, at_bound = (
            np.flatnonzero(active & (self.variable < 0)),
            np.flatnonzero(active & (self.variable >= 0)),
        )
        fixed, first = np.unique(self.variable[at_bound], return_index=True)
        at_bound = at_bound[first]
        is_free = np.ones(n, bool)
        is_free[fixed] = False
        free = np.flatnonzero(is_free)
        size = len(free) + len(rows)
        if self.cones or size > MAX_STEP_SIZE:
            return None
        (P, J), t = scaled.matrices, scaled.t[rows]
        J = J[rows]
        largest = np.abs(scaled.P[2]).max(initial=0.0)
        weight = 1.0 / float(largest) if 0.0 < largest < np.inf else 1.0
        x, lam = self.scale_point(x, lam)
        sign = scaled.J[2][scaled.J[0][at_bound]]
        x[fixed] = sign * scaled.t[at_bound]
        multipliers = lam[rows]
        if size:
            parts = weight * P[:, free][free], J[:, free]
            if size <= MAX_DENSE_STEP_SIZE and sp.issparse(P):
                parts = parts[0].toarray(), parts[1].toarray()
            try:
                solve, refinements = (_factor_sparse if sp.issparse(parts[0]) else _factor_dense)(*parts)
            except RuntimeError:  # The sparse matrix is singular in spite of its shift.
                return None
            for _ in range(refinements):
                gradient = P @ x + scaled.q - J.T @ multipliers
                move = solve(np.concatenate([-weight * gradient[free], t - J @ x]))
                x[free] += move[: len(free)]
                multipliers = multipliers + move[len(free) :] / weight
        lam = np.zeros(len(lam))
        lam[rows] = multipliers
        lam[at_bound] = sign * (P @ x + scaled.q - J.T @ multipliers)[fixed]
        return self.restore_point(x, lam) if np.isfinite(x).all() else None

    def compare_multipliers_with_slacks(self, x: FloatArray, lam: FloatArray) -> npt.NDArray[np.bool_]:
        """Return the equations, and the inequalities with a multiplier that exceeds the slack in scaled units.

        At the end of an interior point one of the two is far below the other, also on a row with a right-hand side of
        0 and no other terms, which `judge_program` compares with its own slack.
        """
        x, lam = self.scale_point(x, lam)
        active: npt.NDArray[np.bool_] = lam > self.scaled.matrices[1] @ x - self.scaled.t
        active[: self.free] = True
        return active

    @np.errstate(all="ignore")
    def fit_multipliers(self, x: FloatArray, active: npt.NDArray[np.bool_]) -> FloatArray | None:
        """Return the multipliers (m,) of active rows that fit the gradient at x best: nonnegative least squares.

        None if there are more than MAX_FIT_SIZE variables or active rows.
        """
        rows, scaled = np.flatnonzero(active), self.scaled
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
            found = (
                import_module_under_lock("scipy.optimize").nnls(signed / size, weight * (P @ x + scaled.q))[0]
                / size
            )
        except RuntimeError:
            return None
        lam = np.zeros(len(scaled.t))
        lam[rows] = found[: len(rows)]
        lam[rows[free]] -= found[len(rows) :]
        return self.restore_point(x, lam)[1]

    def find_near_rows(self, x: FloatArray) -> npt.NDArray[np.bool_]:
        """Return the equations, and the inequalities with a slack of almost 0 in scaled units."""
        x = x / (self.scales[0] * self.scales[2])
        size = np.abs(x).max(initial=1.0) + np.abs(self.scaled.t)
        near: npt.NDArray[np.bool_] = self.scaled.matrices[1] @ x - self.scaled.t <= NEAR_SLACK * size
        near[: self.free] = True
        return near

    def update_active_rows(
        self, x: FloatArray, lam: FloatArray, active: npt.NDArray[np.bool_], tol: float
    ) -> npt.NDArray[np.bool_]:
        """Return the active rows after a step: without negative multipliers, with rows that are violated by tol."""
        x, (_, J), t = x / (self.scales[0] * self.scales[2]), self.scaled.matrices, self.scaled.t
        active = (active & (lam > 0.0)) | (J @ x - t < -tol * (abs(J) @ np.abs(x) + np.abs(t)))
        active[: self.free] = True
        return active


@dataclass(frozen=True, eq=False)
class ScaledProgram(ConvexProgram):
    """A scaled program as backends receive it: A x = b, G x <= h, lb <= x <= ub, and G' x <= h' in cones.

    Parameters
    ----------
    is_kept : (m,) bool, optional
        Rows that the backend receives; default: all.
    shift : float
        Number that was added to the diagonal of P.
    """

    is_kept: npt.NDArray[np.bool_] | None = field(default=None)
    shift: float = 0.0

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
        """Whether all numbers of the rows that are kept are below MAX_BACKEND_NUMBER."""
        side = self.t if self.is_kept is None else self.t[self.is_kept]
        numbers = (self.P[2], self.q, self.J[2], side)
        return all(bool(np.abs(x).max(initial=0.0) < MAX_BACKEND_NUMBER) for x in numbers)

    def is_nearly_proven_unsolvable(self, x: FloatArray | None, lam: FloatArray | None) -> bool:
        """Return whether lam nearly proves that no point satisfies the rows, or x that the objective is unbounded.

        The test is only to recognise claims without foundation: a proof is checked by `proofs.py`.
        """
        if x is None or lam is None:
            return False
        jac, y = self.jacobian, np.append(lam[: self.free], np.maximum(lam[self.free :], 0.0))
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
        P = self.get_hessian(True)
        try:
            pivots = np.square(np.linalg.cholesky(P).diagonal())
        except np.linalg.LinAlgError:
            return False
        return bool((pivots > MAX_SINGULAR_PIVOT * P.diagonal()).all())

    def make_definite(self, attempt: int) -> ScaledProgram:
        """Return the program with DEFINITE_SHIFTS[attempt] on the diagonal of P, at first only if P is singular."""
        if self.is_definite and not attempt:
            return self
        P = self.get_hessian(True)
        shift = DEFINITE_SHIFTS[attempt] * float(P.diagonal().max(initial=0.0) or 1.0)
        P[np.diag_indices(self.n)] += shift
        flat = np.arange(self.n * self.n, dtype=np.int32) % max(self.n, 1)
        ptr = np.arange(self.n + 1, dtype=np.int32) * self.n
        return replace(self, P=(ptr.astype(np.int32), flat, P.ravel()), shift=shift)

    @cached_property
    def parts(self) -> tuple[Any, Any, Any, Any]:
        """Rows of A, rows of G with the rows of the cones at the end, rows that are lower and that are upper bounds."""
        rows, is_general = np.arange(len(self.t)), self.variable < 0
        is_kept = np.ones(len(rows), bool) if self.is_kept is None else self.is_kept
        sign = np.ones(len(rows))
        bound = np.flatnonzero(~is_general)
        sign[bound] = self.J[2][self.J[0][bound]]
        return (
            rows[is_general & (rows < self.free)],
            rows[is_general & (rows >= self.free) & is_kept],
            rows[~is_general & is_kept & (sign > 0.0)],
            rows[~is_general & is_kept & ((sign < 0.0) | (rows < self.free))],
        )

    def list_bounds(self) -> tuple[FloatArray, FloatArray] | None:
        """Return lb and ub (n,), or None if no variable is bounded."""
        _, _, low, high = self.parts
        if not len(low) and not len(high):
            return None
        lb, ub = np.full(self.n, -np.inf), np.full(self.n, np.inf)
        lb[self.variable[low]] = self.t[low]
        ub[self.variable[high]] = np.where(high < self.free, self.t[high], -self.t[high])
        return lb, ub

    def select_rows(self, rows: Any, sign: float, dense: bool) -> Any:
        """Return sign J of these rows, dense or as `csc_matrix`."""
        if dense:
            J = self.matrices[1]
            return sign * (J[rows].toarray() if sp.issparse(J) else J[rows])
        ptr, idx, value = self.J
        first, last = (int(rows[0]), int(rows[-1])) if len(rows) else (0, -1)
        if last - first + 1 != len(rows):
            return (sign * self.jacobian[rows]).tocsc()
        at = slice(ptr[first], ptr[last + 1])  # Consecutive rows are sliced in a tenth of the time.
        arrays = sign * value[at], idx[at], ptr[first : last + 2] - ptr[first]
        return sp.csr_matrix(arrays, (len(rows), self.n)).tocsc()

    @cached_property
    def matrices(self) -> tuple[Any, Any]:
        """P and J, dense if they are small or full, otherwise sparse."""
        entries = self.n * (self.n + len(self.t))
        nonzeros = len(self.P[2]) + len(self.J[2])
        if entries <= MAX_CONVERTED_ENTRIES or nonzeros > MIN_DENSE_FILL * entries:
            return _make_dense(self.P, self.n), _make_dense(self.J, self.n)
        return self.hessian, self.jacobian

    def get_hessian(self, dense: bool) -> Any:
        """Return a new dense P, or P as `csc_matrix` with sorted indices."""
        return _make_dense(self.P, self.n) if dense else self.hessian

    def join_multipliers(self, y: Any, z: Any, box: Any) -> FloatArray:
        """Return lambda (m,) of multipliers with the signs of qpsolvers; missing ones (None) count as 0."""
        a, g, low, high = self.parts
        lam = np.zeros(len(self.t))
        if y is not None:
            lam[a] = -y
        if z is not None:
            lam[g] = z
        if box is not None:
            lower, upper = box[self.variable[low]], box[self.variable[high]]
            lam[high] = np.maximum(upper, 0.0)
            lam[low] = np.where(low < self.free, -lower, np.maximum(-lower, 0.0))
        return lam

    def split_multipliers(self, lam: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return (y, z, box) of multipliers (m,), with the signs of qpsolvers."""
        a, g, low, high = self.parts
        box = np.zeros(self.n)
        inequality = high >= self.free
        np.add.at(box, self.variable[low], -lam[low])
        np.add.at(box, self.variable[high[inequality]], lam[high[inequality]])
        return -lam[a], lam[g], box


def _make_dense(compressed: Compressed, n: int) -> FloatArray:
    """Return compressed rows of n columns as a new dense matrix."""
    ptr, idx, value = compressed
    matrix = np.zeros((len(ptr) - 1, n))
    matrix[np.repeat(np.arange(len(ptr) - 1), np.diff(ptr)), idx] = value
    return matrix


def _factor_dense(hessian: FloatArray, jac: FloatArray) -> tuple[Callable[[FloatArray], FloatArray], int]:
    """Return the solver of the step's equations and the number of its refinements; singular equations are shifted."""
    lapack, (k, n) = import_module_under_lock("scipy.linalg.lapack"), jac.shape
    matrix = np.zeros((n + k, n + k))
    matrix[:n, :n], matrix[:n, n:], matrix[n:, :n] = hessian, -jac.T, jac
    lu, pivots, info = lapack.dgetrf(matrix)
    pivot, refinements = np.abs(lu.diagonal()), 2
    if info != 0 or not pivot.min() > MAX_SINGULAR_STEP_PIVOT * pivot.max():
        matrix[np.diag_indices(n + k)] += STEP_SHIFT
        lu, pivots, _ = lapack.dgetrf(matrix)
        refinements = REFINEMENTS_OF_SHIFTED_STEP
    return lambda rhs: lapack.dgetrs(lu, pivots, rhs)[0], refinements


def _factor_sparse(hessian: Any, jac: Any) -> tuple[Callable[[FloatArray], FloatArray], int]:
    """Return the solver of the step's equations with a shifted diagonal, and the number of its refinements."""
    n, k = jac.shape[1], jac.shape[0]
    shift = STEP_SHIFT * sp.eye_array(n + k)
    matrix = sp.csc_array(sp.block_array([[hessian, -jac.T], [jac, None]]) + shift)
    return import_module_under_lock("scipy.sparse.linalg").splu(matrix).solve, REFINEMENTS_OF_SHIFTED_STEP
