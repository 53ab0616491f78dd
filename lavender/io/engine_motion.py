"""Judge the quantity that moved the bodies: an engine's forces, or its acceleration.

An engine's solver returns forces f and an acceleration a, and its integrator uses one of them. They describe the same
motion only if the solver has converged. The forces are judged by `lavender.residual` itself. The acceleration is judged
by the difference of velocities from the exact solution:

    error of row i = J_i (v+ - v_exact)     v+ = v* + dt (a - a0)     v_exact = v* + M^-1 J^T lambda                (1)

lambda is the solution by Newton's method from the engine's forces; its own residual belongs to the rounding of (1).

**Forces without digits.** If R is far below d = (J M^-1 J^T)_ii, neither the engine's forces nor lambda have digits
(`lavender.io.stiff_rows`). One Newton step over velocities, with the engine's own R and the active rows of the forces,
then leads from v+ to the solution:

    (M + sum_active J_i^T J_i / R_i) delta = M (a - a0) dt - dt J^T f                                               (2)

Rounding of f belongs to a delta of the size of rounding of a. On active rows, the slack of v+ is -J_i delta for the
impulses of the solution; on other rows, it is w = J v+ - target. The error of each row is the step of one more
projected update, as for every other impulse. If the step changes the active rows, the error is as large as the
impulses that have the wrong sign.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from lavender.base.arrays import BoolArray, FloatArray, IntArray
from lavender.judge.residuals import EXACT_TOL, MAX_STIFF_RATIO, Residual, replace_error
from lavender.problem import Problem
from lavender.solving.solve import solve

MOVERS = ("acceleration", "forces")
MAX_MOTION_ENTRIES = (
    1_000_000  # Entries of J above which the dense QR factorisation of (2) takes seconds.
)
MAX_BOUNDARY_ROUNDOFFS = (
    32.0  # [unit round-offs] Friction within this part of its bound is on the boundary.
)
ROUNDOFF_OF_PRECISION = {"float64": 2.0**-53, "float32": 2.0**-24}
SOLVERS = ("auto", "newton")  # The second one solves if the first one does not converge.
# [-] Largest error of the solution in (1), relative to the error of the engine's forces.
MAX_SOLUTION_ERROR = 0.1


@dataclass(frozen=True, eq=False)
class EngineMotion:
    """The part of an engine's answer to one problem that its integrator uses; `residual` judges it."""

    # [N s] (m,): the engine's forces times the time step; the motion belongs to exactly these impulses.
    impulse: FloatArray
    change: FloatArray  # [m/s, rad/s] (nv,): velocity change by the constraints, dt (a - a0).
    compliance: FloatArray  # [1/kg] (m,): the engine's R, in the rows of the problem.
    moved_by: str  # {"acceleration", "forces"}
    # [N s, N m s] (nv,): J^T impulse as the engine computed it (dt qfrc_constraint), which differs by rounding if large
    # forces cancel.
    momentum: FloatArray | None = None

    def judge(self, problem: Problem, forces: Residual) -> Residual:
        """Return the residual of the forces (`forces`) or of the acceleration, by `moved_by`."""
        general = problem.generalized
        if general is None or not (
            np.isfinite(self.impulse).all() and np.isfinite(self.change).all()
        ):
            return forces
        rigid = np.where(problem.d > 0.0, problem.d, np.inf)
        ratio = float(np.min(self.compliance / rigid, where=self.compliance > 0.0, initial=1.0))
        is_stiff = ratio <= MAX_STIFF_RATIO and problem.m * general.nv <= MAX_MOTION_ENTRIES
        if not is_stiff and self.moved_by == "forces":
            return forces
        if not is_stiff:
            for solver in SOLVERS:
                solution = solve(problem, solver, tol=EXACT_TOL, impulse=self.impulse)
                own = solution.residual
                if (
                    own.relative <= EXACT_TOL
                    or own.velocity <= MAX_SOLUTION_ERROR * forces.velocity
                ):
                    break
            else:
                return forces
            delta = self.change - general.change(solution.impulse)
            rounding = self._estimate_rounding(problem) + own.velocity_by_row
            return _make_velocity_error(problem, forces, general.velocity_of(delta), rounding)
        digits = float(-np.log10(ratio))
        found = forces
        boundary = _find_boundary_normals(problem, self.impulse)
        # The step (2) is not possible if M is not positive definite to rounding.
        with contextlib.suppress(np.linalg.LinAlgError):
            step = _compute_newton_step(
                problem, self.compliance, self.impulse, self.change, boundary
            )
            slack = (
                general.velocity_of(self.change)
                - problem.b
                + self.compliance * self.impulse
                - step[1]
            )
            error = _compute_error(problem, self.impulse, step[0], slack, boundary)
            rounding = self._estimate_rounding(problem) / np.where(
                problem.d > 0.0, problem.d, np.inf
            )
            by_step = replace_error(forces, problem, error, rounding)
            found = by_step if by_step.velocity < forces.velocity else forces
        if self.moved_by == "acceleration":
            return replace(found, lost_digits=digits)
        # The raised compliances of the problem do not belong to these forces: compare motions.
        used = (
            general.change(self.impulse) if self.momentum is None else general.solve(self.momentum)
        )
        rounding = self._estimate_rounding(problem) + np.abs(found.velocity_by_row)
        moved = _make_velocity_error(
            problem, forces, general.velocity_of(used - self.change), rounding
        )
        if not found.velocity < MAX_SOLUTION_ERROR * moved.velocity:
            return replace(forces, lost_digits=digits)
        return replace(
            moved, moved_by="impulse", lost_digits=digits, acceleration_error=found.velocity
        )

    def _estimate_rounding(self, problem: Problem) -> FloatArray:
        """Return the rounding of the slack of each row (m,) [m/s]."""
        general = problem.generalized
        assert general is not None
        moved = np.abs(self.change)
        if problem.precision == "float32":  # M is rounded, too: |M^-1| |M| |change|.
            columns = np.eye(general.nv)
            mass = np.abs([general.momentum_of(column) for column in columns])
            moved = moved + np.abs([general.solve(column) for column in columns]) @ (mass @ moved)
        moved = moved + 2.0 * np.abs(general.v_free)
        moved = moved if general.order is None else moved[general.order]
        indptr, columns, entries = general.operator.jac  # A sparse array would import SciPy.
        rows = np.repeat(np.arange(problem.m), np.diff(indptr))
        of_jacobian = np.bincount(
            rows, weights=np.abs(entries) * moved[columns], minlength=problem.m
        )
        terms: FloatArray = of_jacobian + np.abs(problem.b) + self.compliance * np.abs(self.impulse)
        return ROUNDOFF_OF_PRECISION[problem.precision] * terms


class EngineMotions(Mapping[int, EngineMotion]):
    """The motions of the worlds of a batch, by the index of the world, in flat arrays of all worlds.

    Parameters
    ----------
    rows, velocities : (n, 2) int
        First row and first velocity of each world, and their ends.
    has_motion : (n,) bool
        Whether a world has a motion.
    impulse, compliance : (rows of all worlds,)
    change, momentum : (velocities of all worlds,)
    moved_by : {"acceleration", "forces"}
        As for `EngineMotion`, of every world.
    """

    def __init__(
        self,
        rows: IntArray,
        velocities: IntArray,
        has_motion: BoolArray,
        impulse: FloatArray,
        change: FloatArray,
        compliance: FloatArray,
        moved_by: str,
        momentum: FloatArray | None,
    ) -> None:
        self.rows, self.velocities, self.has_motion = rows, velocities, has_motion
        self.impulse, self.change, self.compliance = impulse, change, compliance
        self.moved_by, self.momentum = moved_by, momentum

    def __getitem__(self, i: int) -> EngineMotion:
        if not (0 <= i < len(self.has_motion) and self.has_motion[i]):
            raise KeyError(i)
        of_rows, of_velocities = slice(*self.rows[i]), slice(*self.velocities[i])
        momentum = None if self.momentum is None else self.momentum[of_velocities]
        change, compliance = self.change[of_velocities], self.compliance[of_rows]
        return EngineMotion(self.impulse[of_rows], change, compliance, self.moved_by, momentum)

    def __iter__(self) -> Iterator[int]:
        return iter(np.flatnonzero(self.has_motion).tolist())

    def __len__(self) -> int:
        return int(np.count_nonzero(self.has_motion))

    def find_worlds_moved_by_acceleration(self, impulse: FloatArray) -> BoolArray:
        """Return which worlds (n,) an acceleration has moved, if these flat impulses [N s] are the engine's own."""
        if self.moved_by != "acceleration":
            return np.zeros(len(self.has_motion), bool)
        differs = np.concatenate([[0], np.cumsum(impulse != self.impulse)])
        return self.has_motion & (differs[self.rows[:, 0]] == differs[self.rows[:, 1]])


def _make_velocity_error(
    problem: Problem, forces: Residual, error: FloatArray, rounding: FloatArray
) -> Residual:
    """Return the residual with the velocity error of each row (m,) [m/s] and its rounding (m,) [m/s]."""
    weight = np.where(problem.metric.weight > 0.0, problem.metric.weight, np.inf)
    return replace_error(forces, problem, error / weight, rounding / weight)


def _find_boundary_normals(
    problem: Problem, impulse: FloatArray
) -> dict[int, tuple[IntArray, FloatArray]]:
    """Return rows and outward normal of each friction component at its bound, by the component's first friction row."""
    cones = problem.cones
    found = {}
    margin = MAX_BOUNDARY_ROUNDOFFS * ROUNDOFF_OF_PRECISION[problem.precision]
    for block, rows in cones.friction_components():
        first = cones.ptr[block]
        mu = float(cones.friction_coefficient[rows[0]])
        size = float(np.linalg.norm(impulse[rows]))
        bound = mu * float(impulse[first])
        if size >= (1.0 - margin) * bound:
            outward = impulse[rows] / size if size > 0.0 else np.zeros(len(rows))
            own = rows
            if problem.friction == "cone":
                own = np.append(first, rows)
                outward = np.append(-mu, outward)
            found[int(rows[0])] = own, outward
    return found


def _compute_newton_step(
    problem: Problem,
    compliance: FloatArray,
    impulse: FloatArray,
    change: FloatArray,
    boundary: dict[int, tuple[IntArray, FloatArray]],
) -> tuple[FloatArray, FloatArray]:
    """Solve (1); return the changes of the impulses (m,) [N s] and of the velocities of active rows (m,) [m/s]."""
    from scipy.linalg import qr, solve_triangular  # Its import takes longer than most solves.

    general, cones = problem.generalized, problem.cones
    assert general is not None
    jac = general.jac.toarray()
    # Impulses of contradictory rows cancel, so that their sum needs more digits than float64 has.
    missing = (general.momentum_of(change) - jac.T.astype(np.longdouble) @ impulse).astype(float)
    is_open = np.repeat((impulse[cones.ptr[:-1]] <= 0.0) & cones.is_contact, np.diff(cones.ptr))
    active = (impulse > cones.lower) & (impulse < cones.upper) & ~is_open & (compliance > 0.0)
    inside = active.copy()
    combinations = []  # Outward normals of friction components at their bounds, as combinations of rows.
    for rows, outward in boundary.values():
        inside[rows] = False
        if active[rows].all():
            combinations.append((rows, outward))
    rows_of_combinations = [outward @ jac[rows] for rows, outward in combinations]
    compliances = [float(np.square(outward) @ compliance[rows]) for rows, outward in combinations]
    weighted = np.vstack([jac[inside], *rows_of_combinations])
    weighted /= np.sqrt(np.append(compliance[inside], compliances))[:, None]
    mass = np.array([general.momentum_of(column) for column in np.eye(general.nv)])
    stacked = np.vstack([weighted, np.linalg.cholesky(mass).T])
    # Householder's QR of rows in descending order keeps the digits of each row, whatever the weights are.
    order = np.argsort(-np.abs(stacked).max(axis=1), kind="stable")
    upper, pivots = qr(stacked[order], mode="r", pivoting=True)
    upper = upper[: general.nv]
    step = np.zeros(general.nv)
    step[pivots] = solve_triangular(upper, solve_triangular(upper, missing[pivots], trans="T"))
    moved = general.velocity_of(step)
    delta = np.where(inside, -moved / np.where(inside, compliance, 1.0), 0.0)
    for (rows, outward), soft in zip(combinations, compliances, strict=True):
        delta[rows] = -outward * float(outward @ moved[rows]) / soft
    return delta, np.where(active, moved, 0.0)


def _compute_error(
    problem: Problem,
    impulse: FloatArray,
    delta: FloatArray,
    slack: FloatArray,
    boundary: dict[int, tuple[IntArray, FloatArray]],
) -> FloatArray:
    """Return the error e (m,) [N s] of the impulses `impulse` + `delta` with this slack, without cancellation."""
    cones = problem.cones
    d = problem.d.copy()
    is_cone = problem.friction == "cone"
    for _, rows in cones.friction_components():
        d[rows] = d[rows].mean()
    step = slack / np.where(d > 0.0, d, np.inf)
    low, high = impulse - cones.lower, impulse - cones.upper  # inf and -inf without bounds.
    error = np.clip(step, high + delta, low + delta)
    for block, rows in cones.friction_components():
        first = cones.ptr[block]
        mu = float(cones.friction_coefficient[rows[0]])
        own = np.append(first, rows) if is_cone else rows
        error[own] = step[own]
        if impulse[first] + delta[first] <= 0.0:
            if not is_cone:
                error[own] = 0.0
                continue
            # Project the impulse -step on the friction cone in the metric of d.
            root = np.sqrt(d[own])
            y = -root * step[own]
            slope = mu * root[1] / root[0]
            size = float(np.linalg.norm(y[1:]))
            if size > slope * y[0]:
                length = max(0.0, (float(y[0]) + slope * size) / (1.0 + slope * slope))
                error[own] = -np.append(length, y[1:] * (slope * length / size)) / root
        elif int(rows[0]) in boundary:
            outward = boundary[int(rows[0])][1]
            if (
                outward @ step[own] < 0.0
            ):  # The update leaves the set and is projected on its boundary.
                normal = outward / d[own]
                error[own] -= normal * float(outward @ step[own]) / float(outward @ normal)
    return error
