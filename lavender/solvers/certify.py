"""Search for certificates that a problem has no solution, and for conflicting constraints, after all solvers failed.

    A^T y <= 0 (= 0 on free rows),  y >= 0 (any sign on free rows),  b.y > 0

On a contact, y has only a normal component, as Coulomb's law requires, and z = A^T y satisfies z_n + mu |z_t| <= 0. In
the linear program, the sum of |z_t| over the tangents replaces the norm. Every certificate that it finds is valid, but
with two tangents it misses a few.

With Coulomb friction, the convex relaxation is tried last. A certificate y of the relaxation that has tangential
components proves nothing for Coulomb's law, but it shows which blocks conflict (`prove_relaxation_infeasible`).

With J and M, the certificate is computed from the smallest violation of J v = target, which does not depend on M
(`certify_by_least_violation`).

One infeasible island makes the problem infeasible. The unsolved islands are tried one by one, because a linear program
accepts no rows with upper bounds, and other islands may have them. `log` is the `SolveLog` of a solve by `auto`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import NEVER, Deadline
from lavender.base.errors import InputError
from lavender.base.lazy_import import sparse as sp
from lavender.judge.certificates import Proof, prove_infeasibility
from lavender.judge.residuals import measure_residual
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender.problem.ordering import group_blocks_by_island
from lavender.solvers.islands import get_rows_of_blocks, restrict_to_blocks
from lavender.solvers.newton_systems import general
from lavender.solvers.registry import get
from lavender_ext.core.checks import MAX_MAGNITUDE, MIN_MAGNITUDE
from lavender_ext.judge.measure import residuals_by_island

# Linear programs are used for problems of up to this many rows in all islands together.
CERTIFICATE_ROWS = 3000
LINEAR_PROGRAM_STAGE = "linear program"  # Name of the stage in the solution.
SIMPLEX_STEPS_PER_ROW = 100  # Largest number of simplex steps per row.
# Largest number of factorisations to prove that the convex relaxation has no solution.
MAX_RELAXATION_STEPS = 150
MAX_SOFTENED_STEPS = (
    300  # Largest number of factorisations to solve a problem with nearly rigid rows.
)
# [-] Compliances eps of rigid rows, as multiples of d, which are tried one after the other to find a motion with the
# smallest violation of the constraints.
NEARLY_RIGID_COMPLIANCES = 1e-6, 1e-8, 1e-10
VIOLATION_TOLERANCE = (
    1e-6  # Relative residual to which the problems with these compliances are solved.
)
# Rows of a direction are set to zero if they are below this fraction of its largest entry in the metric of D.
NEGLIGIBLE_ROW_FRACTION = 1e-6


@np.errstate(all="ignore")  # Results that overflow are judged.
def prove_relaxation_infeasible(
    problem: Problem, tol: float, deadline: Deadline = NEVER
) -> Proof | None:
    """Return the proof that the convex relaxation has no solution, or None."""
    inner = problem.relaxed("cone")
    spec = get("newton")
    left = deadline.get_remaining_seconds()
    if spec.refuses(inner) is not None or (left is not None and left <= 0.0):
        return None
    solver = spec.load()()
    claim = solver.run(solver.prepare(inner), inner.start(), MAX_RELAXATION_STEPS, tol, left)
    if claim.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    if claim.certificate is None:
        return None
    proof = prove_infeasibility(inner, claim.certificate, tol, deadline)
    return None if proof.reason else proof


@np.errstate(all="ignore")  # Results that overflow are judged.
def drop_negligible_rows(y: FloatArray, d: FloatArray) -> FloatArray:
    """Return a direction y (m,) with small entries, in the metric of d (m,), set to zero."""
    size = np.sqrt(d) * np.abs(y)
    return np.where(size > NEGLIGIBLE_ROW_FRACTION * size.max(), y, 0.0)


def certify_by_least_violation(log: Any) -> None:
    """Search for a certificate of a problem with J and M, from the motion with the smallest violation of J v = target.

    With a diagonal mass C instead of M and compliances eps d, the impulses lambda(eps) of

        min 1/2 (v' - v).C (v' - v) + 1/2 |violation|^2 / (eps d)

    grow as y / eps + constant if a violation remains, with J^T y = 0 and b.y > 0. The difference of lambda for two
    values of eps gives y to many digits, and the judge refines it. Rows with compliance may be violated: their eps is
    1 and their y is 0. Under Coulomb's law, friction is left out.
    """
    problem = log.problem
    generalized = log.problem.generalized
    assert generalized is not None and problem.compliance is not None
    v = np.clip(generalized.change(log.impulse), -MAX_MAGNITUDE, MAX_MAGNITUDE)
    cones = problem.cones
    if problem.law == "coulomb":
        cones = replace(cones, mu=0.0 * cones.mu, rolling=0.0 * cones.rolling)
    squares = generalized.jac.multiply(generalized.jac).tocsr()
    mass = squares.T @ (1.0 / np.maximum(squares.sum(axis=1), np.finfo(float).tiny))
    mass[mass < MIN_MAGNITUDE] = 1.0  # These velocities occur in no row, up to rounding noise.
    d = squares @ (1.0 / mass)
    y = lam = np.zeros(generalized.m)
    has_compliance = problem.compliance > 0.0
    try:
        rigid = Problem.from_jacobian(
            generalized.jac, sp.diags_array(mass), v, target=problem.b, cones=cones, friction="cone"
        )
    except InputError:  # Numbers are out of range; for example, C = 1 is too small if J is 1e47.
        return
    for fraction in NEARLY_RIGID_COMPLIANCES:
        eps = np.where(has_compliance, 1.0, fraction) * d
        # Set rows of J with negligible entries to zero.
        soft = replace(rigid, compliance=np.where(eps < MIN_MAGNITUDE, 0.0, eps))
        kernel = general.prepare_islands(soft)
        if kernel is None or log.deadline.has_passed():
            return
        before = lam
        lam = lam.copy()
        steps = MAX_SOFTENED_STEPS * max(1, kernel.islands)
        claim = general.run_newton_steps(
            soft, kernel, lam, steps, VIOLATION_TOLERANCE, log.deadline
        )
        if claim.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        # Try the difference of both impulses, and the last impulse, which is better if other rows' impulses decreased.
        for y in (lam - before, lam):
            y = drop_negligible_rows(np.where(has_compliance, 0.0, y), d)
            outside = (np.isfinite(cones.upper) & (y > 0.0)) | (
                np.isfinite(cones.lower) & (y < 0.0)
            )
            if not outside.any():
                break
        y[outside] = 0.0
        if not prove_infeasibility(problem, y, log.tol, log.deadline).reason:
            break
    claim = Claim(Status.STALLED, 0, {"certificates": 1}, certificate=y)
    log.record_stage("least violation", claim, log.best)


@np.errstate(all="ignore")  # Results that overflow are judged.
def certify_infeasibility(log: Any) -> None:
    """Search for a certificate that a problem has no solution; under Coulomb's law, also for the convex relaxation."""
    problem = log.problem
    if problem.generalized is None and LINEAR_PROGRAM_STAGE not in [
        stage.solver for stage in log.stages
    ]:
        certify_by_linear_programs(log)
    is_small = problem.m <= CERTIFICATE_ROWS
    if log.certificate is None and problem.law == "coulomb" and is_small and log.best > 1e-6:
        log.conflict = prove_relaxation_infeasible(problem, log.tol, log.deadline)


def certify_by_linear_programs(log: Any) -> None:
    """Search for a certificate by linear programs, one for each unsolved island without upper bounds."""
    problem = log.problem
    if log.best < 1e-6:
        return
    total_rows = 0
    for part, rows in _list_unsolved_islands(log):
        total_rows += part.m
        if total_rows > CERTIFICATE_ROWS or log.deadline.has_passed():
            return
        if not _has_simple_bounds(part):
            continue
        y = find_certificate_by_linear_program(part, log.deadline)
        proof = None
        if y is not None:
            proof = np.zeros(problem.m)
            proof[rows] = y
        claim = Claim(Status.STALLED, 0, {"certificates": 1}, certificate=proof)
        log.record_stage(LINEAR_PROGRAM_STAGE, claim, log.best)
        if log.certificate is not None:
            return


def _list_unsolved_islands(log: Any) -> Any:
    """Yield (problem, rows) of each unsolved island, the smallest first, or the whole problem if it is one island."""
    problem = log.problem
    label, table = residuals_by_island(problem.metric, log.impulse)
    if len(table) <= 1:
        yield problem, slice(None)
        return
    blocks = group_blocks_by_island(len(table), label)
    for i in sorted(np.flatnonzero(table[:, 0] > log.tol), key=lambda i: len(blocks[i])):
        rows = get_rows_of_blocks(problem, blocks[i])
        yield restrict_to_blocks(problem, blocks[i], rows), rows


def _has_simple_bounds(problem: Problem) -> bool:
    """Return whether every row is free or has only the lower bound 0."""
    cones = problem.cones
    free = np.isneginf(cones.lower) & np.isposinf(cones.upper)
    return bool(np.all(free | ((cones.lower == 0.0) & np.isposinf(cones.upper))))


def find_certificate_by_linear_program(problem: Problem, deadline: Deadline) -> FloatArray | None:
    """Compute a direction y (m,) by a linear program; the caller checks it.

    None if a row has a bound other than 0 below, a number is not finite, or the program has no solution.
    """
    if not _has_simple_bounds(problem):
        return None
    from scipy.optimize import (
        linprog,
    )  # Imported here: it takes 0.1 s, and only this function needs it.

    # Maximise b.y with A^T y + R u <= 0 (= 0 on free rows), |A^T y| <= u on tangents and 0 <= y <= 1, in the metric of
    # d.
    cones = problem.cones
    contact, tangent = cones.contact_rows, cones.friction_rows
    free = np.isneginf(cones.lower) & np.isposinf(cones.upper) & ~contact
    scale = 1.0 / np.sqrt(problem.d)
    normal = np.repeat(cones.ptr[:-1], np.diff(cones.ptr))
    limit = cones.friction_coefficient * scale[normal] / scale
    rim = sp.csr_array(
        (limit[tangent], (normal[tangent], np.arange(tangent.sum()))),
        (problem.m, int(tangent.sum())),
    )
    at = (problem.csr.T.multiply(scale[:, None])).multiply(scale[None, :]).tocsr()
    if not all(np.isfinite(x).all() for x in (at.data, rim.data, scale * problem.b)):
        return None
    unit = sp.eye_array(rim.shape[1], format="csr")
    below = ~free & ~tangent
    rows = [[at[below], rim[below]], [at[tangent], -unit], [-at[tangent], -unit]]
    above = sp.vstack([sp.hstack(x) for x in rows]).tocsr()
    level = sp.hstack([at[free], rim[free]]).tocsr()
    low = np.concatenate([np.where(free, -1.0, 0.0), np.zeros(rim.shape[1])])
    high = np.concatenate([np.where(tangent, 0.0, 1.0), np.full(rim.shape[1], np.inf)])
    if (
        problem.compliance is not None
    ):  # A certificate is 0 on rows with compliance, since y.A y = 0.
        low[: problem.m][problem.compliance > 0.0] = high[: problem.m][problem.compliance > 0.0] = (
            0.0
        )
    gain = np.concatenate([scale * problem.b, np.zeros(rim.shape[1])])
    options: dict[str, Any] = {"maxiter": SIMPLEX_STEPS_PER_ROW * problem.m}
    if deadline.is_set:
        options["time_limit"] = deadline.get_remaining_seconds(1e-3)
    result = linprog(
        -gain,
        A_ub=above,
        b_ub=np.zeros(above.shape[0]),
        A_eq=level,
        b_eq=np.zeros(level.shape[0]),
        bounds=np.stack([low, high], 1),
        method="highs",
        options=options,
    )
    if result.x is None:
        return None
    x = result.x[: problem.m]
    y: FloatArray = np.where((x > 0.0) | free, x, 0.0) * scale
    return y


def check_infeasibility_claim(
    problem: Problem, claim: Claim, tol: float, deadline: Deadline
) -> Claim:
    """Check the claim of another package's solver or of a plug-in that a problem has no solution.

    If its certificate is not valid, `auto` searches for one. The claim returned has this certificate, or the solution
    that `auto` found instead as its refutation.
    """
    if _is_proof(problem, claim, tol, deadline):
        return claim
    spec = get("auto")
    left = deadline.get_remaining_seconds()
    if problem.m > CERTIFICATE_ROWS or (left is not None and left <= 0.0):
        return claim
    solver = spec.load()()
    impulse = problem.start()
    own_claim = solver.run(solver.prepare(problem), impulse, spec.max_iter, tol, left)
    if own_claim.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    if _is_proof(problem, own_claim, tol, deadline):
        message = f"{claim.message}; auto found the certificate".removeprefix("; ")
        return replace(claim, certificate=own_claim.certificate, message=message)
    relative = measure_residual(problem, impulse, "float64").relative
    if not relative <= tol:
        return claim
    solution = f"auto found a solution to a relative residual of {relative:.1e}"
    return replace(claim, refutation=solution)


def _is_proof(problem: Problem, claim: Claim, tol: float, deadline: Deadline) -> bool:
    """Return whether the certificate of a claim proves that no impulse meets `tol`."""
    y = claim.certificate
    return y is not None and not prove_infeasibility(problem, y, tol, deadline).reason
