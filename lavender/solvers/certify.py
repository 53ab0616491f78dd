"""A certificate that a problem has no solution, which `auto` looks for if all candidates fail; and who fights.

    A^T y <= 0 (= 0 on free rows),  y >= 0 (any sign there),  b.y > 0

On a contact y is along the normal, as Coulomb's law requires, and z = A^T y satisfies z_n + mu |z_t| <= 0. The sum of
|z_t| replaces its norm: every certificate found this way is valid, but with two tangents a few are not found.

Of Coulomb friction the convex relaxation is asked at last. A y of its that leaves the normals proves nothing for
Coulomb's law, but tells who fights: with a compliance on the rows of y no such y is left (`conflict_of`).

Of J and M it is what the least violation of J v = target needs (`least_violation`), whatever M is.

One infeasible island makes the problem infeasible. The unsolved islands are tried one by one, because an upper bound in
another island does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.base.deadline import Deadline
from lavender.base.errors import InputError
from lavender.base.lazy_import import sparse as sp
from lavender.judge.certificates import Proof, list_conflicting_blocks, prove
from lavender.judge.residuals import residual
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender.problem.ordering import blocks_by_island
from lavender.solvers.islands import islands, restrict, rows_of
from lavender.solvers.newton_systems import general
from lavender.solvers.registry import get
from lavender.solvers.setup_times import loading
from lavender.solvers.solve_log import SolveLog
from lavender_ext.core.checks import LEAST, MOST
from lavender_ext.judge.measure import by_island

CERTIFICATE_ROWS = (
    3000  # rows up to which a linear program is asked for a certificate, of all islands together
)
LINEAR = "linear program"  # in turns
LINEAR_PROGRAM = 5e6  # ns that scipy takes for the smallest
CERTIFICATE_STEPS = 100  # of the simplex method for each row at most
RELAXATION_STEPS = 150  # factorisations that the relaxation has for its proof
SOFT_STEPS = 300  # and a problem with a compliance
SOFT = 1e-4, 1e-2  # of d: compliances that are tried
NEARLY_RIGID = 1e-6, 1e-8, 1e-10  # of d: compliances under which the violation is least
CLOSE = 1e-6  # tol of these impulses
DUST = 1e-6  # of the largest y in the metric of D: below, a row of a difference takes no part


@dataclass(frozen=True)
class Conflict:
    """Rows that ask for what cannot be, of a problem or of its convex relaxation."""

    proof: Proof  # of the relaxation
    blocks: tuple[int, ...]  # that take part
    soft_rows: tuple[int, ...]  # whose compliance gives an answer; empty: none of SOFT does
    compliance: float  # 1/kg, the largest of them
    soft: str  # their blocks, by name

    @property
    def advice(self) -> str:
        """What to do, in words."""
        if not self.soft_rows:
            return ""
        return f"a compliance of {self.compliance:.1g} 1/kg on {self.soft} gives an answer"


@np.errstate(all="ignore")  # what overflows is judged
def conflict_of(problem: Problem, tol: float, deadline: Deadline | None = None) -> Conflict | None:
    """Who fights in a problem whose convex relaxation is proved to have no solution; None where it is not."""
    inner = problem.relaxed("cone")
    claim = _newton(inner, RELAXATION_STEPS, tol, deadline)[1]
    if claim is None or claim.certificate is None:
        return None
    proof = prove(inner, claim.certificate, tol, deadline)
    if proof.reason:
        return None
    joints, contacts = list_conflicting_blocks(problem, proof.y)
    soft, first, last = joints or contacts, problem.cones.ptr[:-1], problem.cones.ptr[1:]
    tries = [
        (np.concatenate([np.arange(first[i], last[i]) for i in soft]), proof.conflict.split(" against ")[0])
    ]
    if contacts:  # others may fight as well, of which this proof says nothing
        tries.append((np.flatnonzero(problem.cones.contact_rows), "all contacts"))
    for rows, told in tries:
        for share in SOFT:
            more = np.zeros(problem.m)
            more[rows] = share * problem.d[rows]
            try:
                softer = softened(problem, more)
            except InputError:  # A or the compliance is at the most that the door lets in
                continue
            if _newton(softer, SOFT_STEPS, tol, deadline)[0] <= tol:
                return Conflict(proof, joints + contacts, tuple(map(int, rows)), float(more.max()), told)
    return Conflict(proof, joints + contacts, (), 0.0, "")


def softened(problem: Problem, more: FloatArray) -> Problem:
    """With so much compliance (m,) [1/kg] more."""
    if problem.matrix is None:
        assert problem.compliance is not None
        return replace(problem, compliance=problem.compliance + more)
    return replace(problem, matrix=(problem.csr + sp.diags_array(more)).tocsr())


def _newton(
    problem: Problem, steps: int, tol: float, deadline: Deadline | None
) -> tuple[float, Claim | None]:
    """Relative residual and claim of Newton's method from nothing; inf, None where it does not take the problem."""
    spec, left = get("newton"), None if deadline is None else deadline.remaining()
    if spec.refuses(problem) is not None or (left is not None and left <= 0.0):
        return np.inf, None
    solver, impulse = spec.load()(), problem.start()
    claim = solver.run(solver.prepare(problem), impulse, steps, tol, left)
    if claim.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return residual(problem, impulse).relative, claim


@np.errstate(all="ignore")  # what overflows is judged
def without_dust(y: FloatArray, d: FloatArray) -> FloatArray:
    """Of a direction (m,) the rows that take part, in the metric of d (m,)."""
    size = np.sqrt(d) * np.abs(y)
    return np.where(size > DUST * size.max(), y, 0.0)


def least_violation(log: SolveLog) -> None:
    """Of J and M: the motion that violates J v = target least, near that of the best impulse.

    With a diagonal mass C in the place of M and compliances eps d, the impulses lambda(eps) of

        min 1/2 (v' - v).C (v' - v) + 1/2 |violation|^2 / (eps d)

    grow as y / eps + a constant where some violation is left, and then J^T y = 0, b.y > 0. A difference of two is a y
    to many digits, and the judge polishes it. Rows of a compliance may be violated, so eps is 1 there and y 0. Under
    Coulomb's law the same without friction.
    """
    problem, of = log.problem, log.problem.generalized
    assert of is not None and problem.compliance is not None
    v, cones = np.clip(of.change(log.impulse), -MOST, MOST), problem.cones
    if problem.law == "coulomb":
        cones = replace(cones, mu=0.0 * cones.mu, rolling=0.0 * cones.rolling)
    squares = of.jac.multiply(of.jac).tocsr()
    mass = squares.T @ (1.0 / np.maximum(squares.sum(axis=1), np.finfo(float).tiny))
    mass[mass < LEAST] = 1.0  # of what no row moves, or dust alone
    d = squares @ (1.0 / mass)
    y = lam = np.zeros(of.m)
    yields = problem.compliance > 0.0
    try:
        rigid = Problem.from_jacobian(
            of.jac, sp.diags_array(mass), v, target=problem.b, cones=cones, friction="cone"
        )
    except InputError:  # beside J of 1e47 a C of 1 is as nothing
        return
    for share in NEARLY_RIGID:
        eps = np.where(yields, 1.0, share) * d
        soft = replace(rigid, compliance=np.where(eps < LEAST, 0.0, eps))  # rows of dust are empty
        kernel = general.prepare(soft)
        if kernel is None or log.ends_late(LINEAR_PROGRAM):
            return
        before, lam = lam, lam.copy()
        steps = SOFT_STEPS * max(1, kernel.islands)
        if general.run(soft, kernel, lam, steps, CLOSE, log.time_left).status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        for y in (lam - before, lam):  # the second where rows pushed more under the eps before
            y = without_dust(np.where(yields, 0.0, y), d)
            outside = (np.isfinite(cones.upper) & (y > 0.0)) | (np.isfinite(cones.lower) & (y < 0.0))
            if not outside.any():
                break
        y[outside] = 0.0
        if not prove(problem, y, log.tol, log.deadline).reason:
            break
    log.note("least violation", Claim(Status.STALLED, 0, {"certificates": 1}, certificate=y), log.best)


@np.errstate(all="ignore")  # what overflows is judged
def certify(log: SolveLog) -> None:
    """Look for a certificate that a problem has no solution; under Coulomb's law, else of its relaxation."""
    problem = log.problem
    if problem.generalized is None and LINEAR not in [stage.solver for stage in log.stages]:
        linear_programs(log)
    if (
        log.certificate is None
        and problem.law == "coulomb"
        and problem.m <= CERTIFICATE_ROWS
        and log.best > 1e-6
    ):
        log.conflict = conflict_of(problem, log.tol, log.deadline)


def linear_programs(log: SolveLog) -> None:
    """A certificate for rows of bodies or of any A, without upper bounds."""
    problem = log.problem
    if log.best < 1e-6 or log.ends_late(LINEAR_PROGRAM + 1e9 * loading("scipy.optimize")):
        return
    asked = 0
    for part, rows in _parts(log):
        asked += part.m
        if asked > CERTIFICATE_ROWS or log.ends_late(LINEAR_PROGRAM):
            return
        if not _is_open(part):
            continue
        y = find_direction(part, log.deadline)
        proof = None
        if y is not None:
            proof = np.zeros(problem.m)
            proof[rows] = y
        claim = Claim(Status.STALLED, 0, {"certificates": 1}, certificate=proof)
        log.note(LINEAR, claim, log.best)
        if log.certificate is not None:
            return


def _parts(log: SolveLog) -> Any:
    """Unsolved islands and their rows, the smallest first; the whole problem if there is only one."""
    problem = log.problem
    count, label = islands(problem)
    if count <= 1:
        yield problem, slice(None)
        return
    blocks = blocks_by_island(count, label)
    for i in sorted(_wrong(log, label), key=lambda i: len(blocks[i])):
        rows = rows_of(problem, blocks[i])
        yield restrict(problem, blocks[i], rows), rows


def _wrong(log: SolveLog, label: IntArray) -> IntArray:
    """Return the islands whose relative residual is above the tolerance."""
    own, table = by_island(log.problem.metric, log.impulse)
    if len(table) == 1:
        return np.unique(label) if table[0, 0] > log.tol else np.zeros(0, np.int32)
    return np.unique(label[(table[:, 0] > log.tol)[own]])


def _is_open(problem: Problem) -> bool:
    """Every row is free, or bounded by 0 below alone."""
    cones = problem.cones
    free = np.isneginf(cones.lower) & np.isposinf(cones.upper)
    return bool(np.all(free | ((cones.lower == 0.0) & np.isposinf(cones.upper))))


def find_direction(problem: Problem, deadline: Deadline) -> FloatArray | None:
    """Find a direction y (m,) by a linear program, to be checked; None if a row has another bound than 0 below."""
    if not _is_open(problem):
        return None
    from scipy.optimize import linprog  # 0.1 s to import, needed only here

    # max b.y, A^T y + R u <= 0 (= 0 on free rows), |A^T y| <= u on tangents, 0 <= y <= 1, in units of d.
    cones = problem.cones
    contact, tangent = cones.contact_rows, cones.friction_rows
    free = np.isneginf(cones.lower) & np.isposinf(cones.upper) & ~contact
    scale = 1.0 / np.sqrt(problem.d)
    normal = np.repeat(cones.ptr[:-1], np.diff(cones.ptr))
    limit = cones.reach * scale[normal] / scale
    rim = sp.csr_array(
        (limit[tangent], (normal[tangent], np.arange(tangent.sum()))), (problem.m, int(tangent.sum()))
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
    if problem.compliance is not None:  # y.A y = 0 has none of these
        low[: problem.m][problem.compliance > 0.0] = high[: problem.m][problem.compliance > 0.0] = 0.0
    gain = np.concatenate([scale * problem.b, np.zeros(rim.shape[1])])
    options: dict[str, Any] = {"maxiter": CERTIFICATE_STEPS * problem.m}
    if deadline.is_set:
        options["time_limit"] = deadline.remaining(1e-3)
    found = linprog(
        -gain, A_ub=above, b_ub=np.zeros(above.shape[0]), A_eq=level, b_eq=np.zeros(level.shape[0]),
        bounds=np.stack([low, high], 1), method="highs", options=options,
    )  # fmt: skip
    if found.x is None:
        return None
    x = found.x[: problem.m]
    y: FloatArray = np.where((x > 0.0) | free, x, 0.0) * scale
    return y


def check_infeasible(
    problem: Problem, claim: Claim, tol: float, deadline: Deadline
) -> tuple[Claim, bool, str]:
    """Check the claim of another package's solver or a plug-in that a problem has no solution.

    If its certificate does not hold, `auto` looks for one.

    Returns
    -------
    Claim
        With the certificate that `auto` found, if it found one.
    bool
        Whether the certificate of this claim holds.
    str
        Which solution `auto` found instead; empty without one.
    """
    if claim.certificate is not None and not prove(problem, claim.certificate, tol, deadline).reason:
        return claim, True, ""
    spec, left = get("auto"), deadline.remaining()
    if problem.m > CERTIFICATE_ROWS or (left is not None and left <= 0.0):
        return claim, False, ""
    solver, impulse = spec.load()(), problem.start()
    found = solver.run(solver.prepare(problem), impulse, spec.max_iter, tol, left)
    if found.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    if found.certificate is not None and not prove(problem, found.certificate, tol, deadline).reason:
        words = f"{claim.message}; auto found the certificate".removeprefix("; ")
        return replace(claim, certificate=found.certificate, message=words), True, ""
    relative = residual(problem, impulse, "float64").relative
    words = f"auto found a solution to a relative residual of {relative:.1e}"
    return claim, False, words if relative <= tol else ""
