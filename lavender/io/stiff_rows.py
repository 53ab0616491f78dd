"""Judge an engine's answer by its acceleration if its forces have lost their digits.

MuJoCo computes the force of a row from its acceleration a: f = -r / R with r = J a - aref. If R is far below
d = (J M^-1 J^T)_ii, as on a body whose centre of mass lies on the axle of its joint, rounding of r changes f by about
2^-53 d / R of itself. The acceleration is exact, and the forces are noise. Such rows are treated in two steps:

1. The problem has a larger R in rows with R below `MIN_COMPLIANCE_RATIO` d, because float64 cannot hold the impulses of
   contradictory rows: `raise_compliance`. All of these rows get the same factor, so that contradictory rows keep their
   weights. The velocities of the solution change by about `MIN_COMPLIANCE_RATIO` of themselves.
2. The engine's acceleration is judged in place of its forces: `find_engine_answer`. One Newton step over velocities,
   with the engine's own R and the active rows of the forces, leads from v+ = v + dt a to the solution:

       (M + sum_active J_i^T J_i / R_i) delta = M (a - a0) dt - dt J^T f                                           (1)

   Rounding of f belongs to a delta of the size of rounding of a. On active rows, the slack of v+ is -J_i delta for
   the impulses of the solution; on other rows, it is w = J v+ - target. The error of each row is the step of one more
   projected update, as for every other impulse. If the step changes the active rows, the error is as large as the
   impulses that have the wrong sign.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np

from lavender.base.arrays import FloatArray, IntArray, mark_read_only
from lavender.base.errors import InputError
from lavender.batch.data import Batch
from lavender.judge.residuals import EngineAnswer, divide_by_reference, get_zero_impulse_reference, residual
from lavender.problem import Problem

# [1/kg] If all compliances are larger, no row is examined. A common contact has 1e-3 to 1.
MAX_EXAMINED_COMPLIANCE = 1e-4
# [-] Smallest R / d of a problem. In float64, impulses of contradictory rows have an error of 2^-53 d / R = 2e-6 of
# the velocities. The raised R changes the motion by R / d = 6e-11.
MIN_COMPLIANCE_RATIO = 2.0**-34
# [-] Rows with compliances up to this factor above the smallest one keep their weights against each other.
MAX_COMPLIANCE_SPAN = 2.0**8
MAX_RAISED_RATIO = 2.0**-10  # [-] Largest R / d of a raised row, which a row with a small d would exceed.
MAX_STIFF_RATIO = (
    1e-5  # [-] If R / d of all rows is larger, forces keep 11 of 16 digits and are judged themselves.
)
MAX_MOTION_ENTRIES = 1_000_000  # Entries of J above which the dense QR factorisation of (1) takes seconds.
MAX_BOUNDARY_ROUNDOFFS = (
    2.0**5
)  # [unit round-offs] Friction within this part of its bound is on the boundary.
ROUNDOFF_OF_PRECISION = {"float64": 2.0**-53, "float32": 2.0**-24}


def raise_compliance(problem: Problem) -> FloatArray | None:
    """Return the compliance (m,) [1/kg] with which float64 can hold the impulses; None if it needs no change."""
    assert problem.compliance is not None
    compliance = np.broadcast_to(problem.compliance, problem.m)
    if not problem.m or compliance.min() > MAX_EXAMINED_COMPLIANCE:
        return None
    rigid = problem.d - compliance
    needed = MIN_COMPLIANCE_RATIO * rigid
    is_low = (compliance < needed) & (compliance > 0.0)
    if not is_low.any():
        return None
    is_alike = (compliance > 0.0) & (compliance <= MAX_COMPLIANCE_SPAN * compliance[is_low].min())
    factor = np.max(needed[is_low & is_alike] / compliance[is_low & is_alike])
    alike = np.minimum(factor * compliance, MAX_RAISED_RATIO * rigid)
    raised = np.where(is_alike, alike, np.where(is_low, needed, compliance))
    return np.maximum(raised, compliance)


def find_engine_answer(
    problem: Problem, compliance: FloatArray, impulse: FloatArray, change: FloatArray
) -> EngineAnswer | None:
    """Judge an engine's acceleration; return None if its forces are judged themselves.

    Parameters
    ----------
    problem : Problem
        In generalised coordinates.
    compliance : (m,), 1/kg
        The engine's R, in the rows of the problem.
    impulse : (m,), N s
        The engine's forces times the time step.
    change : (nv,), m/s, rad/s
        Velocity change by the constraints, dt (a - a0).
    """
    general, m = problem.generalized, problem.m
    assert general is not None
    is_usable = np.isfinite(impulse).all() and np.isfinite(change).all()
    if (
        not m
        or not is_usable
        or m * general.nv > MAX_MOTION_ENTRIES
        or compliance.min() > MAX_EXAMINED_COMPLIANCE
    ):
        return None
    ratio = np.min(
        compliance / np.where(problem.d > 0.0, problem.d, np.inf), where=compliance > 0.0, initial=1.0
    )
    if ratio > MAX_STIFF_RATIO:
        return None
    boundary = _find_boundary_normals(problem, impulse)
    try:
        delta, correction = _compute_newton_step(problem, compliance, impulse, change, boundary)
    except np.linalg.LinAlgError:  # M is not positive definite to rounding.
        return None
    slack = general.velocity_of(change) - problem.b + compliance * impulse - correction
    error = _compute_error(problem, impulse, delta, slack, boundary)
    moved = np.abs(change)
    if problem.precision == "float32":  # M is rounded, too: |M^-1| |M| |change|.
        columns = np.eye(general.nv)
        mass = np.abs([general.momentum_of(column) for column in columns])
        moved = moved + np.abs([general.solve(column) for column in columns]) @ (mass @ moved)
    terms = abs(general.jac) @ (moved + 2.0 * np.abs(general.v_free)) + np.abs(problem.b)
    terms += compliance * np.abs(impulse)
    size = (
        error,
        ROUNDOFF_OF_PRECISION[problem.precision] * terms / np.where(problem.d > 0.0, problem.d, np.inf),
    )
    get_zero_impulse_reference(problem)
    energies = [float(np.sqrt(np.sum(problem.d * e * e))) for e in size]
    speeds = [problem.metric.weight * np.abs(e) for e in size]
    relative, floor = (
        divide_by_reference(problem.metric, e, float(v.max())) for e, v in zip(energies, speeds, strict=True)
    )
    if not speeds[0].max() < residual(problem, impulse, "float64").velocity:
        return None
    return EngineAnswer(
        impulse=impulse.copy(), relative=relative, energy=energies[0], velocity=float(speeds[0].max()),
        roundoff_floor=floor, worst_row=int(speeds[0].argmax()), error=mark_read_only(error),
        slack=mark_read_only(slack), lost_digits=float(-np.log10(ratio)),
    )  # fmt: skip


def judge_stiff_worlds(
    make_batch: Callable[[FloatArray], Batch],
    compliance: FloatArray,
    impulse: FloatArray | None = None,
    change: FloatArray | None = None,
) -> Batch:
    """Raise the compliances of stiff rows of a batch, make the batch, and judge the engine's accelerations.

    Parameters
    ----------
    make_batch : callable
        Returns the batch with given compliances.
    compliance : array of the batch's shape, 1/kg
    impulse : array of the batch's shape, N s, optional
        The engine's forces times the time step; if it or `change` is not given, the compliances are raised only.
    change : (n, nv), m/s, rad/s, optional
        Velocity changes by the constraints.
    """
    batch = make_batch(compliance)
    engine, raised, stiff = compliance.reshape(-1), compliance.reshape(-1).copy(), []
    for i in range(len(batch)) if engine.min(initial=np.inf) < MAX_EXAMINED_COMPLIANCE else ():
        rows = batch.rows_of(i)
        if engine[rows].min(initial=np.inf) < MAX_EXAMINED_COMPLIANCE:
            with contextlib.suppress(InputError):  # A world that is not finite is not judged.
                higher = raise_compliance(batch[i])
                raised[rows] = engine[rows] if higher is None else higher
                stiff.append(i)
    if not np.array_equal(raised, engine):
        batch = make_batch(raised.reshape(compliance.shape))
    if impulse is not None and change is not None:
        flat = impulse.reshape(-1)
        for i in stiff:
            rows = batch.rows_of(i)
            answer = find_engine_answer(batch[i], engine[rows], flat[rows], change[i])
            if answer is not None:
                batch.engine_answers[i] = answer
    return batch


def _find_boundary_normals(problem: Problem, impulse: FloatArray) -> dict[int, tuple[IntArray, FloatArray]]:
    """Return rows and outward normal of each friction component at its bound, by the component's first friction row."""
    cones, found = problem.cones, {}
    margin = MAX_BOUNDARY_ROUNDOFFS * ROUNDOFF_OF_PRECISION[problem.precision]
    for block, rows in cones.friction_components():
        first, mu = cones.ptr[block], float(cones.friction_coefficient[rows[0]])
        size, bound = float(np.linalg.norm(impulse[rows])), mu * float(impulse[first])
        if size >= (1.0 - margin) * bound:
            outward, own = impulse[rows] / size if size > 0.0 else np.zeros(len(rows)), rows
            if problem.friction == "cone":
                own, outward = np.append(first, rows), np.append(-mu, outward)
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
    from scipy.linalg import (
        qr,
        solve_triangular,
    )  # Imported here: few answers need it, and every command would load it.

    stacked = np.vstack([weighted, np.linalg.cholesky(mass).T])
    # Householder's QR of rows in descending order keeps the digits of each row, whatever the weights are.
    order = np.argsort(-np.abs(stacked).max(axis=1), kind="stable")
    upper, pivots = qr(stacked[order], mode="r", pivoting=True)
    upper, step = upper[: general.nv], np.zeros(general.nv)
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
    cones, d, is_cone = problem.cones, problem.d.copy(), problem.friction == "cone"
    for _, rows in cones.friction_components():
        d[rows] = d[rows].mean()
    step = slack / np.where(d > 0.0, d, np.inf)
    low, high = impulse - cones.lower, impulse - cones.upper  # inf and -inf without bounds.
    error = np.clip(step, high + delta, low + delta)
    for block, rows in cones.friction_components():
        first, mu = cones.ptr[block], float(cones.friction_coefficient[rows[0]])
        own = np.append(first, rows) if is_cone else rows
        error[own] = step[own]
        if impulse[first] + delta[first] <= 0.0:
            error[own] = -_project_on_cone(-step[own], d[own], mu) if is_cone else 0.0
        elif int(rows[0]) in boundary:
            outward = boundary[int(rows[0])][1]
            if outward @ step[own] < 0.0:  # The update leaves the set and is projected on its boundary.
                normal = outward / d[own]
                error[own] -= normal * float(outward @ step[own]) / float(outward @ normal)
    return error


def _project_on_cone(impulse: FloatArray, d: FloatArray, mu: float) -> FloatArray:
    """Return the projection of an impulse, normal first, on the friction cone in the metric of d."""
    root = np.sqrt(d)
    y = root * impulse
    slope, size = mu * root[1] / root[0], float(np.linalg.norm(y[1:]))
    if size <= slope * y[0]:
        return impulse
    along = max(0.0, (float(y[0]) + slope * size) / (1.0 + slope * slope))
    return np.append(along, y[1:] * (slope * along / size)) / root
