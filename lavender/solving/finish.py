"""Compare the solver's claim with the judge's residual and build the `Solution`.

With r the relative residual of the judge, "explained" r <= 1e-5 and at most twice the round-off floor, and "excused" an
ill-conditioned M, or a solver that reads matrices only of a problem given by bodies or by J and M:

    claimed status          r <= tol        r > tol, explained   r > tol, not explained
    CONVERGED               CONVERGED       ROUNDOFF_LIMIT       CONVERGED, contradicted; excused: STALLED
    STALLED                 CONVERGED       ROUNDOFF_LIMIT       STALLED
    ROUNDOFF_LIMIT          ROUNDOFF_LIMIT  ROUNDOFF_LIMIT       ROUNDOFF_LIMIT, contradicted; excused: STALLED
    MAX_ITERATIONS,
      TIME_LIMIT            CONVERGED       unchanged            unchanged; STALLED if M is ill-conditioned
    INFEASIBLE              CONVERGED       INFEASIBLE: confirmed, not proven or contradicted
    DIVERGED, INTERRUPTED,
      NUMERICAL_ERROR       unchanged       unchanged            unchanged

CONVERGED in place of the claims of the fourth line needs tol > 0. If the floor is above tol, ROUNDOFF_LIMIT replaces
every CONVERGED of the second column, and STALLED that of the last.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import NEVER, Deadline
from lavender.base.errors import InputError
from lavender.judge.certificates import format_lower_bound, prove_infeasibility
from lavender.judge.residuals import (
    Residual,
    combine_best_islands,
    divide_by_reference,
    get_zero_impulse_reference,
    make_residual,
    reuse_or_judge_impulse,
)
from lavender.judge.solution import (
    CONFIRMED,
    CONTRADICTED,
    CONVERGED,
    DIVERGED,
    INFEASIBLE,
    MAX_ITERATIONS,
    NOT_PROVEN,
    NUMERICAL_ERROR,
    ROUNDOFF_LIMIT,
    STALLED,
    TIME_LIMIT,
    Claim,
    History,
    Solution,
    SolverRun,
    Status,
    format_work_count,
    get_order_name,
)
from lavender.problem import Problem
from lavender.problem.cones import ROUND, ROW, project_impulse
from lavender.solvers.registry import SolverSpec, specs
from lavender_ext.judge.measure import Judged, all_finite, project_far_excess_of

# A lower bound of every solution's impulse is reported only if it is at least this multiple of sum |b_i| / d_i, the
# impulse that the rows would need one by one. Smaller bounds also hold for well-posed problems. Rows that contradict
# each other up to a relative difference delta need about 1 / delta times that sum.
CONTRADICTING_IMPULSE_RATIO = 100.0


#: Reasons why no solver ran, if the start is no solution, by the status of the claim.
REASONS_WITHOUT_WORK = {
    ROUNDOFF_LIMIT: "the start is at its floor: its residual is rounding",
    TIME_LIMIT: "the time limit left no time for a solver",
    MAX_ITERATIONS: "no iterations were allowed",
}


class FinishedRun(NamedTuple):
    """One run of a solver: the arguments, the impulse and the claim that it returned, and the time that it took."""

    problem: Problem
    spec: SolverSpec
    options: dict[str, Any]
    impulse: FloatArray  # (m,) [N s]
    claim: Claim
    tol: float
    start: FloatArray | None = None  # (m,) [N s] Start as it was given; None: the zero impulse.
    setup_time: float = 0.0  # [s]
    solve_time: float = 0.0  # [s]
    history: History | None = None
    sweeps_per_decade: float = math.nan
    deadline: Deadline = NEVER  # Certificates are not polished after it.


class Rule(NamedTuple):
    """One row of `RULES`: a claim in `claims` is replaced by `status` if the judge's finding `applies`."""

    claims: tuple[Status, ...]
    applies: Callable[[FinishedRun, Residual], bool]
    status: Status
    message: str = (
        ""  # Reason, which is appended to the solver's message; "{floor}" is the round-off floor.
    )


def _hides_b(run: FinishedRun, judged: Residual) -> bool:
    """Return whether the impulse is so large that float64 loses b: the floor alone exceeds tol."""
    relative = divide_by_reference(run.problem.metric, judged.energy, judged.velocity)
    return run.tol < judged.relative == judged.roundoff_floor and relative <= run.tol


_ILL_CONDITIONED = (
    "M is ill-conditioned: residuals below {floor:.1e} are rounding errors of float64"
)
_HIDDEN = "rounding to float64 alone can cause a relative residual of {floor:.1e}"
_FORMED = "its test was met only on A as it was formed, not on the given data"
# The rules are applied in order, each to the status that the rules before it have left. `_float64_relative` is the
# residual before its refinement for an ill-conditioned M.
RULES = (
    Rule((CONVERGED, STALLED), _hides_b, DIVERGED, "next to such impulses float64 loses b"),
    Rule(
        (MAX_ITERATIONS, TIME_LIMIT, STALLED),
        lambda run, r: run.tol > 0.0 and r.relative <= run.tol,
        CONVERGED,
    ),
    Rule(
        (CONVERGED, STALLED, MAX_ITERATIONS, TIME_LIMIT),
        lambda run, r: r._float64_relative <= run.tol < r.relative,
        STALLED,
        _ILL_CONDITIONED,
    ),
    Rule(
        (ROUNDOFF_LIMIT,),
        lambda run, r: run.tol < r.relative and r._float64_relative < math.inf,
        STALLED,
        _ILL_CONDITIONED,
    ),
    Rule(
        (CONVERGED,),
        lambda run, r: r.relative > run.tol and _holds_as_formed(run),
        STALLED,
        _FORMED,
    ),
    Rule(
        (ROUNDOFF_LIMIT,),
        lambda run, r: not r.above_floor <= run.tol and _holds_as_formed(run),
        STALLED,
        _FORMED,
    ),
    Rule(
        (CONVERGED, STALLED), lambda run, r: r.above_floor <= run.tol < r.relative, ROUNDOFF_LIMIT
    ),
    # The impulse is a solution to tol, even if no exact solution exists.
    Rule(
        (INFEASIBLE,),
        lambda run, r: r.relative <= run.tol,
        CONVERGED,
        "the impulse meets tol nevertheless",
    ),
    Rule(
        (CONVERGED,),
        lambda run, r: r.relative <= run.tol < r.roundoff_floor,
        ROUNDOFF_LIMIT,
        _HIDDEN,
    ),
    Rule(
        (CONVERGED,), lambda run, r: run.tol < min(r.relative, r.roundoff_floor), STALLED, _HIDDEN
    ),
)


def finish(run: FinishedRun) -> Solution:
    """Build the solution: the judge's residual, the status that it supports, and the check of the claim."""
    problem, claim, impulse, tol = run.problem, run.claim, run.impulse, run.tol
    claim = name_lost_row(problem, impulse, claim)
    if claim.status is INFEASIBLE:
        # Project the impulse on its bounds, so that an engine that applies it does not pull at a contact.
        impulse = project_impulse(problem.cones, impulse)
        if tol > 0.0:
            impulse = combine_best_islands(problem, problem._start, (impulse,), tol, by_energy=True)
    # Solvers work in float64, whatever the precision of the data.
    judged = reuse_or_judge_impulse(problem, impulse, claim.judged).refine(tol)
    inside = impulse if tol == 0.0 else project_far_excess_of(problem.metric, impulse)
    if inside is not impulse and (run.spec.builtin or judged.relative <= tol):
        projected = reuse_or_judge_impulse(problem, inside).refine(tol)
        if projected.relative <= tol or not judged.relative <= tol:
            impulse, judged = inside, projected
    if claim is not run.claim or impulse is not run.impulse:
        run = run._replace(claim=claim, impulse=impulse)
    impulse.setflags(write=False)
    values = {
        "impulse": impulse,
        "tol": tol,
        "setup_time": run.setup_time,
        "solve_time": run.solve_time,
    }
    is_met = claim.status is CONVERGED and judged.relative <= tol
    is_met = is_met and (judged.roundoff_floor <= tol or tol == 0.0)
    is_late = (
        claim.status is TIME_LIMIT and not min(judged.relative, judged.float64_relative) <= tol
    )
    is_late = is_late and claim.certificate is None  # No rule changes this status.
    if (is_met or is_late) and not claim.refutation:
        # The other fields are computed when one of them is first read.
        late = make_residual, (problem, judged)
        rest = make_fields, (run, judged, is_late)
        values |= {"status": claim.status, "_late_residual": late, "_rest": rest}
    else:
        values = make_fields(run, judged, True) | values
    return Solution.from_fields(values)


def make_fields(run: FinishedRun, judged: Judged, needs_check: bool = False) -> dict[str, Any]:
    """Return the other fields of a solution, the status included if the claim needs a check; else it is confirmed."""
    spec = run.spec
    claim = run.claim
    if not (claim.iterations or any(claim.work.values())):
        claim = replace(claim, message=explain_why_nothing_ran(run, judged.relative))
        run = run._replace(claim=claim)
    order = ""
    if spec.order:
        order = get_order_name(run.options.get("order", "given"))
    result = make_residual(run.problem, judged)
    fields: dict[str, Any] = {
        "residual": result,
        "iterations": claim.iterations,
        "work": MappingProxyType(dict(claim.work)),
        "solver": SolverRun(spec.name, run.options, claim.form, order),
        "message": claim.message,
        "history": run.history,
        "dual": claim.dual,
        "certificate": None,
        "impulse_bound": None,
        "claim_check": CONFIRMED,
        "status_conflict": "",
        "sweeps_per_decade": run.sweeps_per_decade,
        "stages": claim.stages,
    }
    return fields | check_claim(run, result) if needs_check else fields


def explain_why_nothing_ran(run: FinishedRun, relative: float) -> str:
    """Return why no solver ran, as the message of a solution without work; no other function calls a start a solution.

    `relative` is the relative residual of the returned impulse. The message names how many impulses of the start were
    changed.
    """
    problem, claim = run.problem, run.claim
    if not problem.m:
        return "nothing to solve"
    start = problem._start if run.start is None else run.start
    changed = int(np.count_nonzero(run.impulse != start))
    moved = f"{changed} of {problem.m} impulses were moved to their bounds or to zero"
    if claim.message:
        is_moved = changed and run.spec.builtin and not run.spec.external
        return f"{claim.message}; of the start {moved}" if is_moved else claim.message
    if claim.status is CONVERGED or relative <= run.tol:
        return f"the start is a solution after {moved}" if changed else "the start is a solution"
    reason = REASONS_WITHOUT_WORK.get(claim.status, "no solver ran")
    return f"{reason}; of the start {moved}" if changed else reason


def check_claim(run: FinishedRun, judged: Residual) -> dict[str, Any]:
    """Apply `RULES` to a claim, check its certificate, and name the conflict with the judge's residual.

    Return the fields of the solution that depend on the comparison.
    """
    problem, claim, tol, refutation = run.problem, run.claim, run.tol, run.claim.refutation
    status, message, relative = claim.status, claim.message, judged.relative
    for rule in RULES:
        if status in rule.claims and rule.applies(run, judged):
            status = rule.status
            message = _joined(message, rule.message.format(floor=judged.roundoff_floor))
    certificate = None
    bound = None
    unproven = ""
    status_conflict = ""
    if status is INFEASIBLE and claim.certificate is None:
        unproven = "no certificate was given"
    elif status in (INFEASIBLE, STALLED) and claim.certificate is not None:
        proof = prove_infeasibility(problem, claim.certificate, tol, run.deadline)
        bound = proof.impulse_bound or None
        if status is INFEASIBLE and not proof.reason:
            certificate = proof.y
            message = _joined(message, proof.message)
        elif bound == math.inf:
            status = STALLED
            message = _joined(message, proof.reason)
        elif status is INFEASIBLE:
            unproven = proof.reason
        elif bound is not None:
            usual = CONTRADICTING_IMPULSE_RATIO * float(np.sum(np.abs(problem.b) / problem.d))
            if bound > max(np.abs(run.impulse).sum(), usual):
                least = format_lower_bound(bound)
                message = _joined(message, f"every solution has an impulse of at least {least} N s")
    if unproven:
        message = _joined(message, f"not proven: {unproven}")
        status_conflict = f"says INFEASIBLE, {refutation}" if refutation else ""
    elif status is CONVERGED and not relative <= tol:
        status_conflict = f"says CONVERGED, relative residual {relative:.2e} is above tol {tol:.1e}"
    elif status is CONVERGED and claim.status is CONVERGED and refutation:
        status_conflict = f"says CONVERGED, {refutation}"
    elif status is ROUNDOFF_LIMIT and not judged.above_floor <= tol:
        status_conflict = (
            "says ROUNDOFF_LIMIT, rounding does not explain a relative residual of "
            f"{judged.above_floor:.2e}"
        )
    if status in (DIVERGED, STALLED) and not message and run.spec.resumable:
        message = describe_end(problem, status, claim.iterations)
    if status is MAX_ITERATIONS:
        message = _joined(message, _predict_iterations(run, relative))
    unfinished = (
        status not in (CONVERGED, ROUNDOFF_LIMIT, NUMERICAL_ERROR) and judged.worst_island >= 0
    )
    if tol > 0.0 and unfinished and not relative <= tol:
        message = _joined(message, describe_islands(judged, tol))
    claim_check = CONTRADICTED if status_conflict else NOT_PROVEN if unproven else CONFIRMED
    return {
        "status": status,
        "message": message,
        "certificate": certificate,
        "impulse_bound": bound,
        "claim_check": claim_check,
        "status_conflict": status_conflict,
    }


def describe_end(problem: Problem, status: Status, iterations: int) -> str:
    """Describe why a solver that returned no message found no solution; bad diagonal entries of A come first."""
    reason = (
        "the residual grew instead of falling"
        if status is DIVERGED
        else "the residual falls no further"
    )
    message = f"{reason}, {format_work_count(iterations, 'iterations')}"
    if problem.matrix is None:
        return message
    diagonal = problem.matrix.diagonal()
    rows = np.flatnonzero(diagonal <= 0.0)
    if len(rows):
        value = diagonal[rows[0]]
        size = "a zero diagonal" if value == 0.0 else f"a negative diagonal, {value:.3g}"
        return f"{problem.row_name(int(rows[0]))} has {size}: sweeps need A_ii > 0; {message}"
    if status is DIVERGED:
        message += ": sweeps are sure to converge only if A is symmetric and positive definite"
    return message


def describe_islands(judged: Residual, tol: float) -> str:
    """Return how many islands meet tol, and the first and last block of the worst island; empty for one island."""
    label, relative = judged.islands[:2]
    if len(relative) < 2:
        return ""
    problem = judged._problem
    blocks = np.flatnonzero(label == judged.worst_island)
    first, last = (problem.block_name(int(i)) for i in blocks[[0, -1]])
    names = first if len(blocks) == 1 else f"{first} to {last}"
    solved = int(np.count_nonzero(relative <= tol))
    return f"{solved} of {len(relative)} islands meet tol, island {judged.worst_island} ({names}) does not"


def name_lost_row(problem: Problem, impulse: FloatArray, claim: Claim) -> Claim:
    """Return the claim; if an impulse is not finite, return it as DIVERGED with the first such row in the message."""
    if claim.status is NUMERICAL_ERROR or all_finite(impulse):
        return claim
    row = int(np.argmin(np.isfinite(impulse)))
    message = _joined(claim.message, f"the impulse of {problem.row_name(row)} is {impulse[row]}")
    return replace(claim, status=DIVERGED, message=message)


def _joined(message: str, addition: str) -> str:
    """Append `addition` to the message, unless the message contains it already."""
    return message if addition in message else f"{message}; {addition}".removeprefix("; ")


def _holds_as_formed(run: FinishedRun) -> bool:
    """Return whether A was formed, and its residual meets tol or its floor, so that only rounding separates both."""
    problem = run.problem
    if problem.operator in run.spec.operators:
        return False
    try:
        formed = problem.csr_data
    except InputError:  # A is too large to be formed.
        return False
    get_zero_impulse_reference(problem)
    formed.share_reference(problem.metric)
    return bool(Judged(formed, run.impulse).above_floor <= run.tol)


def _predict_iterations(run: FinishedRun, relative: float) -> str:
    """Return a message about an exhausted budget that predicts the iterations needed to reach tol.

    It is empty if no more iterations than were done are predicted.
    """
    per_decade, tol = run.sweeps_per_decade, run.tol
    if not (tol > 0.0 and 0.0 < relative < math.inf):
        return ""
    remaining = per_decade * math.log10(relative / tol)
    if not run.claim.iterations < remaining < math.inf:
        return ""
    others = [s for s in specs().values() if not (s.resumable or s.external or s.missing())]
    return (
        f"the residual falls tenfold in {per_decade:.3g} iterations, so tol needs about {remaining:.2g} more; "
        f"solvers of another kind may be faster: {', '.join(s.name for s in others if not s.refuses(run.problem))}"
    )


def decide_empty_rows(
    problem: Problem, impulse: FloatArray, tol: float
) -> tuple[str, FloatArray, list[int]] | None:
    """Set the impulses of zero rows of A to the bound that minimises -b lambda, in place.

    Returns
    -------
    tuple or None
        If no impulse can meet b of such a row to `tol`: a message, the certificate y (m,), and all such rows, with
        those of contacts under the cone law that slide. None otherwise.
    """
    cones = problem.cones
    empty = problem.metric.empty
    impossible = list[int]()
    directions = {} if problem.law != "cone" else _find_slides_of_empty_contacts(problem)
    # Leave out friction rows, which have no fixed bounds.
    nonzero = empty[(problem.b[empty] != 0.0) & ~cones.friction_rows[empty]]
    if (
        problem.law == "cone"
    ):  # Under the cone law, a separating normal may carry the friction of a sliding contact.
        nonzero = nonzero[
            (problem.b[nonzero] > 0.0) | ~np.append(cones.friction_rows, False)[nonzero + 1]
        ]
    for i in np.setdiff1d(nonzero, problem.vanished_rows).tolist():
        b = problem.b[i]
        bound = cones.upper[i] if b > 0.0 else cones.lower[i]
        if i in directions:
            continue
        if np.isfinite(bound):
            impulse[i] = bound
        else:
            impossible.append(i)
    impossible += directions
    if not impossible:
        return None
    get_zero_impulse_reference(problem)
    data = problem.metric
    size = np.abs(problem.b)
    energy = size / np.sqrt(data.d)
    velocity = data.weight * size / data.d
    worst = max(impossible, key=lambda i: divide_by_reference(data, energy[i], velocity[i], [i]))
    b = problem.b[worst]
    y = np.zeros(problem.m)
    y[worst] = math.copysign(1.0, b)
    y = directions.get(worst, y)
    if prove_infeasibility(problem, y, tol).reason:
        return None  # b of these rows is negligible, so that the answer can meet tol.
    unit = "rad/s" if problem.angular_rows[worst] else "m/s"
    message = (
        f"{problem.row_name(worst)}: its row of A is zero, so nothing can meet b = {b:.3g} {unit}"
    )
    if worst in directions:
        message = f"{problem.row_name(worst)}: the contact's rows of A are zero, so nothing can stop its sliding"
    rows = [np.flatnonzero(directions[i]) if i in directions else [i] for i in impossible]
    return message, y, np.concatenate(rows).tolist()


def _find_slides_of_empty_contacts(problem: Problem) -> dict[int, FloatArray]:
    """Return {normal: y (m,)} of contacts under the cone law that slide, and whose rows of A are all zero.

    y = (1, a_g b_g / |b_g|) is the direction of the cone with the largest b.y, which is positive.
    """
    cones = problem.cones
    is_empty = np.zeros(problem.m, bool)
    is_empty[np.setdiff1d(problem.metric.empty, problem.vanished_rows)] = True
    found = dict[int, FloatArray]()
    blocks = np.unique(np.searchsorted(cones.ptr, problem.metric.empty, "right") - 1)
    for block in blocks[(cones.kind[blocks] != ROW) & (cones.kind[blocks] != ROUND)].tolist():
        first, end = cones.ptr[block], cones.ptr[block + 1]
        if (
            is_empty[first:end].all()
            and problem.b[first] <= 0.0
            and problem.b[first + 1 : end].any()
        ):
            found[int(first)] = np.zeros(problem.m)
            found[int(first)][first] = 1.0
    for block, rows in cones.friction_components() if found else ():
        size = float(np.hypot.reduce(problem.b[rows]))
        y = found.get(int(cones.ptr[block]))
        if y is not None and size > 0.0:
            y[rows] = cones.friction_coefficient[rows] * problem.b[rows] / size
    return {i: y for i, y in found.items() if problem.b @ y > 0.0}
