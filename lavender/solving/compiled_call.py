"""Solve a small problem in one compiled call; the solution's other fields are computed when one is first read."""

from __future__ import annotations

from math import inf
from time import perf_counter
from typing import Any

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline
from lavender.judge.residuals import get_zero_impulse_reference, make_residual
from lavender.judge.solution import CONVERGED, TIME_LIMIT, Claim, Solution, Status, name_start
from lavender.problem import Problem
from lavender.solvers.costs import get_loose_limit
from lavender.solvers.decisions import DECISIONS, SMALL_ROWS
from lavender.solvers.registry import SolverSpec, get
from lavender.solving.finish import FinishedRun, make_fields
from lavender.solving.loop import select_best_impulse
from lavender_ext.batch.many import bind_types, solve_compiled

NO_STAGE_MESSAGE = "the time limit was over before its turn: the start"


def fits_in_time(problem: Problem, deadline: Deadline, loosely: bool = False) -> bool:
    """Return whether the compiled call of a problem that `auto` may continue ends before the deadline.

    `loosely`: return False unless the limit is so long that no estimate is needed.
    """
    if (
        not deadline.is_set
        or len(problem.b) <= SMALL_ROWS
        or deadline.fits(get_loose_limit(problem))
    ):
        return True
    return not loosely and deadline.fits(
        DECISIONS.call_time * get("newton").load()().estimate_total_cost(problem)
    )


def choose_call_deadline(problem: Problem, deadline: Deadline) -> Deadline:
    """Return the deadline of the compiled call: of a problem that `auto` may continue, a part of the time."""
    left = deadline.get_remaining_seconds()
    if left is None or len(problem.b) <= SMALL_ROWS:
        return deadline
    return Deadline(DECISIONS.time_share * left)


def solve_small(
    problem: Problem, spec: SolverSpec, impulse: Any, tol: float, deadline: Deadline
) -> tuple[Solution | None, tuple[int, ...] | None]:
    """Solve and judge a small problem by one compiled call, if the solver has one that accepts the problem.

    At the deadline, the result is the better of its iterate and the start if the problem has at most SMALL_ROWS rows,
    and otherwise None, because time may remain for other solvers.

    Returns
    -------
    Solution or None
        None if `Prepared` has to solve the problem.
    tuple of int or None
        Work counts of a call that did not solve the problem. None if the first result is a solution or no call was
        made.
    """
    if spec.small is None or not fits_in_time(problem, deadline, spec.delegates):
        return None, None
    begin = perf_counter()
    own = choose_call_deadline(problem, deadline)
    solution, judged, counts, start = solve_compiled(problem, spec, impulse, tol, own)
    if solution is not None:
        return solution, None
    if (
        judged is None
        or not deadline.is_set
        or own is not deadline
        or judged.relative == judged.roundoff_floor
    ):
        # `Prepared` continues: time remains, or the impulses are so large that rounding hides b.
        return None, counts
    judged = select_best_impulse(problem, judged, start, tol).refine(inf)
    judged.impulse.setflags(write=False)
    start = start if start is None or impulse is None else start.copy()
    rest = compute_postponed_fields, (problem, spec, judged, counts, start, TIME_LIMIT)
    solution = Solution.from_fields(
        {
            "impulse": judged.impulse,
            "status": TIME_LIMIT,
            "tol": tol,
            "setup_time": 0.0,
            "solve_time": perf_counter() - begin,
            "start": name_start(problem.guess, impulse),
            "_rest": rest,
        }
    )
    return solution, None


def compute_postponed_fields(
    problem: Problem,
    spec: SolverSpec,
    judged: Any,
    counts: Any,
    start: FloatArray | None,
    status: Status = CONVERGED,
) -> dict[str, Any]:
    """Return the fields of the solution of a compiled call that are computed when one of them is first read."""
    if spec.small is None:  # Only worlds of `solve_many` have no compiled call of their own.
        claim = Claim(status, 0, {}, NO_STAGE_MESSAGE)
    else:
        claim = spec.small.make_claim(problem, counts, start, judged.relative, status)
    run = FinishedRun(problem, spec, {}, judged.impulse, claim, tol=0.0, start=start)
    return make_fields(run, judged)


bind_types(
    (
        Problem,
        Solution,
        CONVERGED,
        compute_postponed_fields,
        make_residual,
        get_zero_impulse_reference,
        name_start,
    )
)
