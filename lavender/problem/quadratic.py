"""Quadratic programs as constraint problems: a pure conversion, and the way back.

    min 1/2 x.P x + q.x   subject to   A x = b,  G x <= h,  lb <= x <= ub                                 (1)

is the constraint problem of the generalised velocities x with

    M = P,   v* = -P^-1 q,   J = [A; I_f; -G; I_l; -I_u],   target = [b; lb_f; -h; lb_l; -ub_u]           (2)

f: variables with lb = ub, whose rows are free like those of A; l, u: other finite bounds; of G the rows with finite h,
where what is 1e20 or more in size is infinite.
All other impulses are >= 0. As M (x - v*) = J^T lambda,

    P x + q + A^T y + G^T z + z_box = 0,   y = -lambda_A,  z = lambda_G,  z_box = lambda_u - lambda_l - lambda_f  (3)

P singular: M = P + D and v* = M^-1 (D c - q) with D >= 0 diagonal: a step of the proximal point method from the
centre c (Rockafellar 1976, Monotone operators and the proximal point algorithm). Its solution has the dual residual
D (c - x), and `lavender.solve_qp` repeats it around the x found until that is small. Where the rows of P
whose diagonal is zero are zero, as they must be, D stands on these alone; if P is singular otherwise, on every row. A
P that is nearly singular takes v* so far from x that rounding hides x: then such steps follow, with D by the forces.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import (
    FloatArray,
    as_array,
    borrowed,
    check_not_nan,
    check_sizes,
    read_only,
    shape_of,
)
from lavender.base.errors import InputError
from lavender.base.lazy_import import issparse
from lavender.problem.cones import Cones
from lavender.problem.derived import cached_property
from lavender.problem.generalized import Compressed, Generalized, compressed, lower_of
from lavender_ext.core.assemble import dense_to_csr, stacked
from lavender_ext.core.checks import largest
from lavender_ext.judge.measure import all_finite, program_residuals
from lavender_ext.newton.program import balanced

IntpArray = npt.NDArray[np.intp]

PROXIMAL = 1e-9  # D over P_ii, or over the largest of them where P_ii = 0
SINGULAR = 1e-10  # least pivot over its diagonal entry up to which P counts as singular
SHIFT = 1e-12  # of P_ii: P + SHIFT diag(P) has a factor where P is semidefinite to rounding
FAR = 1e3  # v* over the size of x that right-hand sides, or else q, let one expect: D is made large enough
FLAT = 1e-3  # of max |P_ij| max |x_i|: what forces are measured by where q is zero: all of them may vanish
TINY = 1e-300  # beside x = 0
BALANCED = 10  # passes by which units of variables without a P_ii are found: factors of 1e4 are left at 1.01
ENDLESS = 1e20  # h and bounds from which they are none, as other packages have it for infinity
SHOWN = 1000  # variables up to which the least eigenvalue of an indefinite P is computed for the message
Given = tuple[Any, Any, Any, Any, Any, Any, Any, Any]  # P, q, G, h, A, b, lb, ub


@dataclass(frozen=True, eq=False)
class QPSolution:
    """x and the multipliers of a quadratic program, in the signs of OSQP and qpsolvers, and how wrong they are.

    P x + q + A^T y + G^T z + z_box = 0,  z >= 0,  z_box > 0 at ub and < 0 at lb.

    Parameters
    ----------
    x : (n,)
    y : (me,), or None without A
        Multipliers of A x = b.
    z : (mi,), or None without G
        Multipliers of G x <= h; 0 where h is infinite, from 1e20 on.
    z_box : (n,), or None without lb and ub
        Multipliers of the bounds.
    solution : Solution or None
        Of the constraint problem: status, work, certificate.
    ray : (n,), or None
        A direction in which the objective falls for ever, |ray| = 1 in its largest entry, where a point that fulfils
        the constraints was found: the program is unbounded.
    tol : float
        The error that was asked for.
    """

    x: FloatArray
    y: FloatArray | None
    z: FloatArray | None
    z_box: FloatArray | None
    solution: Any
    ray: FloatArray | None
    impulse: FloatArray = field(repr=False)  # (m,) lambda
    qp: QuadraticProgram = field(repr=False)
    tol: float = 1e-6

    def __str__(self) -> str:
        if self.ray is not None:
            return f"unbounded: the objective falls for ever along ray; at x it is {self.objective:.6g}"
        # The solution's status is that of its own problem, with an M for P: no verdict on the program.
        how = "" if self.solution is None or self.found else f"{self.solution.status.name}, "
        if self.solution is not None and self.solution.claim_check == "not proven":
            how = f"{self.solution.status.name} (not proven), "
        if how == "CONVERGED, ":
            how = "the last step CONVERGED, "
        words = "solved" if self.found else f"not solved to {self.tol:g}"
        wrong = "" if self.solution is None else self.solution.status_conflict
        wrong = f"; CONTRADICTED: {wrong}" if wrong else ""
        return f"{words}: {how}error {self.error:.1e}, objective {self.objective:.6g}{wrong}"

    @cached_property
    def _curvature(self) -> FloatArray:
        """P x (n,)."""
        px, proximal = self.qp.generalized.momentum_of(self.x), self.qp.proximal
        return px if proximal is None else px - proximal * self.x

    @cached_property
    def _residuals(self) -> tuple[float, ...]:
        """r_p, r_d, gap, the three relative to their own terms, and the largest of these."""
        qp, of = self.qp, self.qp.generalized
        curved = 0.0
        if largest(qp.q) == 0.0:  # all forces may vanish; with q an x that runs away must not excuse it
            curved = FLAT * min(largest(of.operator.mass[2]), self._unseen / max(largest(self.x), TINY))
        found: tuple[float, ...] = program_residuals(
            self.x, qp.q, self._curvature, of.force(self.impulse), of.velocity_of(self.x), qp.target, self.impulse,
            qp.free, of.operator.jac, self.x if of.order is None else self.x[of.order],
            qp.sizes_without_rows, curved,
        )  # fmt: skip
        return found

    @property
    def _unseen(self) -> float:
        """max_i sum_j |P_ij| X_j (force): a share of X_j more of x_j is no more than that share in any row of J."""
        of, size = self.qp.generalized, self.qp.sizes(self.x, self.impulse, np.minimum, np.inf)
        ptr, column, value = of.operator.mass  # the lower triangle, diagonal last, in the order of its factor
        size = size if of.order is None else size[of.order]
        row, share = np.repeat(np.arange(of.nv), np.diff(ptr)), np.abs(value)
        sums = np.bincount(row, share * size[column]) + np.bincount(column, share * size[row])
        return float((sums - share[ptr[1:] - 1] * size).max(initial=0.0))

    @property
    def objective(self) -> float:
        """1/2 x.P x + q.x."""
        return float(0.5 * self.x @ self._curvature + self.qp.q @ self.x)

    @property
    def primal_residual(self) -> float:
        """Largest violation of a row: |A x - b|, G x - h, lb - x, x - ub."""
        return self._residuals[0]

    @property
    def dual_residual(self) -> float:
        """max |P x + q + A^T y + G^T z + z_box|, or the largest negative z where that is more."""
        return self._residuals[1]

    @property
    def duality_gap(self) -> float:
        """|x.P x + q.x + b.y + h.z + bounds.z_box|."""
        return self._residuals[2]

    @property
    def error(self) -> float:
        """The largest of the three residuals, each relative to its own terms; 0 is a solution.

        Primal: the violation of each row relative to the largest of |J_ij x_j| and |target_i| of this row. If these
        vanish, as in x >= 0, it is relative to what the acting rows make of its variables. Dual: relative to the
        largest of |q|, |P x| and |J^T lambda|. Gap: relative to the objective, which is the largest of |x.P x|, |q.x|
        and |target.lambda|; if these cancel, to 1e-3 of the sum of their terms. A row that does not act enters no
        scale: one that is satisfied and has no multiplier, or is far from its bound.

        If q is 0 all forces may vanish: then the dual residual is also relative to 1e-3 of the largest force of an x as
        large as rows let one expect, or to 1e-3 max |P_ij| max |x_i| if that is less.
        """
        return self._residuals[6]

    @property
    def found(self) -> bool:
        """Whether the error is at most `tol`, no ray or certificate shows that there is no solution, and the solver's
        claim is not contradicted.
        """
        if self.ray is not None or not self.error <= self.tol:
            return False
        solution = self.solution
        if solution is None:
            return True
        if solution.status.name == "INFEASIBLE":
            return bool(solution.claim_check == "not proven")
        return not solution.is_contradicted


@dataclass(frozen=True, eq=False)
class QuadraticProgram:
    """What a problem made by `Problem.from_qp` knows of its program (`problem.qp`).

    Parameters
    ----------
    generalized : Generalized
        J of (2) and M = P + D.
    q : (n,)
    target : (m,)
        The right-hand sides of (2).
    free : int
        Rows of A and of variables with lb = ub, which come first.
    n_equalities, n_inequalities : int or None
        Rows of A and of G as given; None without.
    kept : (mi,) int or None
        Rows of G that are in J; None: all.
    fixed, lower, upper : (n_f,), (n_l,), (n_u,) int, or None without lb and ub
        Variables of the rows of bounds.
    proximal : (n,) or None
        D, where P is singular.
    unit : (n,) or None
        P_ii, or what stands for it where it is 0, where P is singular: 1 / sqrt(unit) is a unit of each variable.
    """

    generalized: Generalized
    q: FloatArray
    target: FloatArray
    free: int
    n_equalities: int | None
    n_inequalities: int | None
    kept: IntpArray | None
    fixed: IntpArray | None
    lower: IntpArray | None
    upper: IntpArray | None
    proximal: FloatArray | None
    unit: FloatArray | None

    @property
    def cones(self) -> Cones:
        """Free rows, then impulses >= 0."""
        return _one_sided(self.free, len(self.target))

    def around(self, centre: FloatArray, d: FloatArray) -> QuadraticProgram:
        """The proximal step from a centre (n,), with this D."""
        of, before = self.generalized, self.proximal
        if d is not before:
            of = of.shifted(d if before is None else d - before)
        general = of.with_jacobian(v_free=of.solve(d * centre - self.q))
        return replace(self, generalized=general, proximal=d)

    def nearer(self, x: FloatArray, impulse: FloatArray) -> FloatArray:
        """D (n,) with which no force takes x_i further than FAR times what rows let one expect of it.

        Forces and sizes are those of x (n,) and of impulses (m,) that are found so far.
        """
        of, far = self.generalized, self.sizes(x, impulse, np.maximum, 0.0)
        force = np.abs(self.q) + abs(of.mass) @ far + np.abs(impulse) @ abs(of.jac)
        return read_only(np.divide(force, FAR * far, out=np.zeros(len(x)), where=far > 0.0))

    def sizes_without_rows(self) -> FloatArray:
        """(n,) Size of each variable without rows, |q_i| / M_ii or else |v*_i|, in the order of J's columns."""
        of = self.generalized
        ptr, _, value = of.operator.mass  # the lower triangle, diagonal last
        force, free = np.abs(self.q), np.abs(of.v_free)
        if of.order is not None:
            force, free = force[of.order], free[of.order]
        size = force / value[ptr[1:] - 1]
        out: FloatArray = np.where(size > 0.0, size, free)
        return out

    def sizes(self, x: FloatArray, impulse: FloatArray, most: np.ufunc, without: float) -> FloatArray:
        """(n,) What x_i would be if it were all of its rows: of the smallest or largest, by np.minimum or np.maximum.

        Rows that do not act, as in `program_residuals`, are left out. `without`: the size without a row; the largest of
        x for inf.
        """
        slack = self.generalized.velocity_of(x) - self.target
        jac, x = self.generalized.jac, np.abs(x)
        of, size = np.repeat(np.arange(len(self.target)), np.diff(jac.indptr)), np.abs(jac.data)
        row = np.maximum(np.bincount(of, size * x[jac.indices], len(self.target)), np.abs(self.target))
        acts = (slack < 0.0) | ((impulse > 0.0) & (slack <= 0.5 * row))
        acts[: self.free] = True
        of, size, column = of[acts[of]], size[acts[of]], jac.indices[acts[of]]
        far = np.full(len(x), without)
        most.at(far, column, row[of] / size)
        return np.where(far < np.inf, far, x.max(initial=0.0))

    def multipliers(
        self, impulse: FloatArray
    ) -> tuple[FloatArray | None, FloatArray | None, FloatArray | None]:
        """(y, z, z_box) of impulses (m,); of a certificate the proof that the program has no feasible point.

        Then A^T y + G^T z + z_box = 0 and b.y + h.z + (ub or lb).z_box < 0.
        """
        y = z = box = None
        at, end = self.n_equalities or 0, len(impulse)
        if self.n_equalities is not None:
            y = -impulse[:at]
        if self.fixed is not None and self.lower is not None and self.upper is not None:
            box = np.zeros(len(self.q))
            box[self.upper] = impulse[end - len(self.upper) :]
            end -= len(self.upper)
            box[self.lower] -= impulse[end - len(self.lower) : end]
            end -= len(self.lower)
            box[self.fixed] = -impulse[at : self.free]
        if self.n_inequalities is not None:
            z = impulse[self.free : end]
            if self.kept is not None:
                whole = np.zeros(self.n_inequalities)
                whole[self.kept] = z
                z = whole
        return y, z, box

    def solution(self, solution: Any, tol: float = 1e-6, x: FloatArray | None = None) -> QPSolution:
        """x, y, z and z_box of a `Solution` of this problem, or of impulses (m,), found if the error is at most tol.

        x (n,), if it is known better than v* + M^-1 J^T lambda.
        """
        given = getattr(solution, "impulse", None)
        impulse = as_array("impulse", solution, (len(self.target),)) if given is None else given
        if x is None:
            x = self.generalized.v_free + self.generalized.change(impulse)
        found = None if given is None else solution
        y, z, box = self.multipliers(impulse)
        return QPSolution(
            x=x, y=y, z=z, z_box=box, solution=found, ray=None, impulse=impulse, qp=self, tol=tol
        )

    def ray(self, direction: FloatArray, tol: float) -> FloatArray | None:
        """A direction (n,) in unit length, if the objective falls along it for ever, to `tol`; else None."""
        if self.proximal is None or self.unit is None or not self.q @ direction < 0.0:
            return None
        root = np.sqrt(self.unit)
        size = np.abs(root * direction).max()
        if not size < np.inf:
            return None
        d = direction / size  # at most a unit of each variable
        of = self.generalized
        along = of.velocity_of(d)
        curved = np.abs(of.momentum_of(d) - self.proximal * d)
        short = np.concatenate([np.abs(along[: self.free]), -along[self.free :]])
        # Each row by the most that a unit of one variable does in it: units of rows and variables do not matter.
        each = _largest_of_rows((of.jac.indptr, of.jac.indices, of.jac.data), root)
        steep = -float(self.q @ d) > tol * np.abs(self.q / root).max()
        falls = steep and (curved <= tol * root).all() and (short <= tol * each).all()
        return read_only(d / np.abs(d).max()) if falls else None


@lru_cache(maxsize=8)  # programs of one controller have the same
def _one_sided(free: int, m: int) -> Cones:
    low = np.zeros(m)
    low[:free] = -np.inf
    return Cones.bounded(low, np.inf)


def quadratic(given: Given) -> QuadraticProgram:
    """The program of P, q, G, h, A, b, lb, ub as a constraint problem; see `Problem.from_qp`."""
    P, q, G, h, A, b, lb, ub = given
    q = as_array("q", q, (None,))
    n = len(q)
    lower = _hessian(P, n)
    rows = _Rows(n)
    n_a, _ = rows.given("A", A, "b", b)
    fixed = low = up = None
    if lb is not None or ub is not None:
        lb, ub = (
            np.full(n, infinite) if x is None else as_array(name, x, (n,), finite=False)
            for name, x, infinite in (("lb", lb, -np.inf), ("ub", ub, np.inf))
        )
        _check_bounds(lb, ub)
        equal = lb == ub
        fixed, low, up = (
            np.flatnonzero(on) for on in (equal, (lb > -ENDLESS) > equal, (ub < ENDLESS) > equal)
        )
        rows.bounds(fixed, lb, 1.0)
    free = rows.m
    n_g, kept = rows.given("G", G, "h", h)
    if low is not None and up is not None:
        rows.bounds(low, lb, 1.0)
        rows.bounds(up, ub, -1.0)
    jac, target = rows.stacked
    generalized, proximal, unit = _definite(lower, jac, q, read_only(target))
    return QuadraticProgram(
        generalized=generalized, q=q, target=target, free=free, n_equalities=n_a, n_inequalities=n_g, kept=kept,
        fixed=fixed, lower=low, upper=up, proximal=proximal, unit=unit,
    )  # fmt: skip


# -- what is given ------------------------------------------------------------------------------------


def unpacked(given: Given) -> Given:
    """The eight arrays; the first may be a `qpsolvers.Problem`, or another object with these eight attributes."""
    P = given[0]
    if given[1] is not None and not hasattr(P, "ub"):
        return given
    names = ("P", "q", "G", "h", "A", "b", "lb", "ub")
    if not all(hasattr(P, name) for name in names):
        raise InputError(
            f"P is a {type(P).__name__}, q None; P and q are needed, or a qpsolvers.Problem alone"
        )
    if any(x is not None for x in given[1:]):
        raise InputError("a qpsolvers.Problem holds all arrays: give it alone")
    return tuple(getattr(P, name) for name in names)


def _matrix(name: str, given: Any, n: int, sign: float) -> Compressed:
    """Rows of a dense or sparse matrix of n columns times a sign, without zeros, checked; one dimension is one row."""
    sparse = issparse(given)
    if not sparse:
        dense = borrowed(name, given, (None,) * max(1, len(shape_of(name, given))))
        given = dense[None] if dense.ndim == 1 else dense
    if len(given.shape) != 2 or given.shape[1] != n:
        raise InputError(f"{name} has shape {given.shape}; (any, {n}) is needed, as q has {n} entries")
    return compressed(name, given, sign) if sparse else dense_to_csr(given, sign)


def _hessian(P: Any, n: int) -> Compressed:
    """P's lower triangle with its diagonal."""
    if shape_of("P", P) != (n, n):
        raise InputError(f"P has shape {shape_of('P', P)}; ({n}, {n}) is needed, as q has {n} entries")
    return lower_of("P", P, "give both triangles, or (P + P^T) / 2, which has the same x.P x")


class _Rows:
    """J and target of (2), put together from above."""

    def __init__(self, n: int) -> None:
        self.n, self.m = n, 0
        self.parts = list[Compressed]()
        self.targets = list[FloatArray]()

    def put(self, rows: Compressed, target: FloatArray) -> None:
        self.parts.append(rows)
        self.targets.append(target)
        self.m += len(target)

    @property
    def stacked(self) -> tuple[Compressed, FloatArray]:
        """J and target, all parts one under another."""
        if len(self.parts) == 1:
            return self.parts[0], self.targets[0]
        parts = [(*rows, False, 1.0, len(rows[0]) - 1) for rows in self.parts]
        return stacked(self.n, parts), np.concatenate([np.zeros(0), *self.targets])

    def bounds(self, at: IntpArray, bound: FloatArray, sign: float) -> None:
        """sign x_i >= sign bound_i of these variables."""
        k = len(at)
        rows = np.arange(k + 1, dtype=np.int32), at.astype(np.int32), np.full(k, sign)
        self.put(rows, sign * bound[at])

    def given(self, name: str, matrix: Any, side: str, vector: Any) -> tuple[int | None, IntpArray | None]:
        """A or G; how many rows were given, and which of them are put here: None, all; not those with h infinite."""
        if (matrix is None) != (vector is None):
            missing = name if matrix is None else side
            raise InputError(f"{missing} is missing: {name} and {side} go together")
        if matrix is None:
            return None, None
        rows = _matrix(name, matrix, self.n, 1.0 if name == "A" else -1.0)
        m = len(rows[0]) - 1
        if name == "A":
            self.put(rows, as_array(side, vector, (m,)))
            return m, None
        right, kept = as_array(side, vector, (m,), finite=False), None
        if not (all_finite(right) and (right < ENDLESS).all()):
            check_not_nan(side, right)
            kept = np.flatnonzero(right < ENDLESS)
            rows, right = _picked(rows, kept), right[kept]
            if not all_finite(right):
                raise InputError(f"h is -inf at [{kept[np.argmin(right)]}]: no x is below it")
        self.put(rows, -right)
        return m, kept


def _picked(rows: Compressed, kept: IntpArray) -> Compressed:
    ptr, idx, val = rows
    size = np.diff(ptr)
    on = np.repeat(np.isin(np.arange(len(size)), kept), size)
    return np.concatenate([[0], np.cumsum(size[kept])]).astype(np.int32), idx[on], val[on]


def _check_bounds(lb: FloatArray, ub: FloatArray) -> None:
    bad = np.flatnonzero(~((lb <= ub) & (lb < np.inf) & (ub > -np.inf)))
    if len(bad):
        i = bad[0]
        raise InputError(
            f"variable {i}: lb = {lb[i]}, ub = {ub[i]}; lb <= ub is needed, and a number between them"
        )


# -- P that is singular -------------------------------------------------------------------------------


def _definite(
    lower: Compressed, jac: Compressed, q: FloatArray, target: FloatArray
) -> tuple[Generalized, FloatArray | None, FloatArray | None]:
    """J, M = P + D, D and the units of variables, None where P is positive definite."""
    momentum, laid = -q, Generalized.laid_out(jac, lower)
    plain = _shifted(laid, np.zeros(len(q)), momentum)
    if plain is not None and plain.operator.least_pivot > SINGULAR:
        return plain, None, None
    diagonal = lower[2][lower[0][1:] - 1]
    zero = diagonal == 0.0
    unit = _units(jac, diagonal) if zero.any() else diagonal
    d = np.where(zero, PROXIMAL * unit, 0.0)
    made = _shifted(laid, d, momentum) if zero.any() and _rows_are_empty(lower, zero) else None
    if made is None:
        if _shifted(laid, SHIFT * unit, momentum) is None:
            check_sizes("the diagonal of P", np.abs(diagonal))
            raise InputError(f"P is not positive semidefinite: {_least(lower, diagonal)}")
        d = PROXIMAL * unit
        made = _shifted(laid, d, momentum)
        assert made is not None  # as with less
    root = np.sqrt(unit)
    size = _largest_of_rows(jac, root)
    expected = np.abs(target[size > 0.0] / size[size > 0.0]).max(initial=0.0) or np.abs(momentum / root).max(
        initial=0.0
    )
    far = np.abs(root * made.v_free).max(initial=0.0) / (FAR * expected) if expected > 0.0 else 0.0
    if far > 1.0:
        further = _shifted(laid, far * d, momentum)
        if further is not None:  # D within the numbers that M may have
            made, d = further, far * d
    return made, read_only(d), read_only(unit)


def _units(jac: Compressed, diagonal: FloatArray) -> FloatArray:
    """P_ii, and where it is 0 what rows of J say of x_i beside other variables: entries J_ki / (r_k c_i) near 1.

    c = sqrt(unit) and r are found as Ruiz (2001, A scaling algorithm to equilibrate both rows and columns norms in
    matrices) does, with c kept where P_ii > 0.
    """
    held = diagonal > 0.0
    nothing = np.zeros(len(diagonal) + 1, np.int32), np.zeros(0, np.int32), np.zeros(0)
    start = 1.0 / np.sqrt(np.where(held, diagonal, diagonal.max(initial=0.0) or 1.0))
    column, _ = balanced(nothing, jac, BALANCED, start, ~held)
    return 1.0 / column**2


def _largest_of_rows(jac: Compressed, root: FloatArray) -> FloatArray:
    """max_i |J_ki| / root_i of each row k."""
    ptr, idx, val = jac
    most = np.zeros(len(ptr) - 1)
    np.maximum.at(most, np.repeat(np.arange(len(ptr) - 1), np.diff(ptr)), np.abs(val) / root[idx])
    return most


def _shifted(laid: Generalized, d: FloatArray, momentum: FloatArray) -> Generalized | None:
    """With P + diag(d); None where that is not positive definite."""
    try:
        return laid.shifted(d, momentum)
    except InputError:
        return None


def _rows_are_empty(lower: Compressed, zero: FloatArray) -> bool:
    """Whether rows and columns whose diagonal is zero hold nothing else, so that P is semidefinite as its rest is."""
    ptr, idx, _ = lower
    beside = zero[idx] | np.repeat(zero, np.diff(ptr))
    return bool(np.count_nonzero(beside) == np.count_nonzero(zero))


def _least(lower: Compressed, diagonal: FloatArray) -> str:
    n = len(diagonal)
    if n <= SHOWN:
        ptr, idx, val = lower
        dense = np.zeros((n, n))
        dense[np.repeat(np.arange(n), np.diff(ptr)), idx] = val
        value = np.linalg.eigvalsh(dense)  # which reads the lower triangle
        return f"its least eigenvalue is {value[0]:.3g}, its largest {value[-1]:.3g}"
    i = int(np.argmin(diagonal))
    return f"P + {SHIFT:g} diag(P) has no Cholesky factor; the least diagonal entry is P[{i}, {i}] = {diagonal[i]:.3g}"
