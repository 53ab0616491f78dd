"""Choose the calls that are worth timing alternately, and time them.

A report prints calls of `lv.solve`. Those near the best call that `bench.run` measured are timed again, interleaved
with each other (`lavender.report.bench.time_alternately`), so that the printed times are times of exactly these calls.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from lavender.report.bench.cases import Source
from lavender.report.bench.recommendation import SHORT_TIME_RATIO, Advice, Subject, list_subjects
from lavender.report.bench.resampling import TimedCall, rank_calls_in_time, select_calls_with_most_cases
from lavender.report.bench.running.alternating import time_alternately
from lavender.report.bench.running.plan import UNLIMITED_ITERATIONS, Plan
from lavender.report.bench.running.timing import CallSpec
from lavender.report.bench.statistics import drop_cases_solved_at_zero
from lavender.report.bench.store import Records
from lavender.report.bench.timed_call import exceeds_default_budget
from lavender.solvers.registry import specs

# A solver is a candidate if its time is at most this multiple of the best: a rerun may rank it first.
CANDIDATE_TIME_RATIO = 1.6
MAX_CANDIDATES = 4  # Solvers timed for a tolerance and for each time limit, at most.
# Fractions of a time budget to which `time_limit` of a call is set; set-up and judge need the remaining time.
TIME_LIMIT_FRACTIONS = (0.5, 0.8)


def choose_calls_to_time(records: Records, times: Sequence[float] = ()) -> list[CallSpec]:
    """List the calls to time alternately.

    These are calls to the middle tolerance for single problems and for a batch, and calls with a time limit for each
    time budget in `times` [s]. If `times` is empty, the budgets are those from `choose_time_budgets` that are short
    enough to be reported.
    """
    call_specs: list[CallSpec] = []
    for subject in list_subjects(records, times):
        tolerance, best = subject.best.target, subject.best.best
        if best is None:
            continue
        equal = [c for c in subject.best.ranking if c.solved == best.solved]
        near = [c for i, c in enumerate(equal) if i < 2 or c.score <= CANDIDATE_TIME_RATIO * best.score]
        for solver in [c.solver for c in near[:MAX_CANDIDATES]]:
            max_iter = _find_required_max_iter(records, solver, tolerance)
            # Mapping the previous step's impulses to the next takes time: if steps are quick, a cold start may win.
            for start in ("cold", "carried") if subject.timing_mode == "steps" else ("cold",):
                call_specs.append(
                    CallSpec(solver, "tol", tolerance, max_iter, timing_mode=subject.timing_mode, start=start)
                )
            call_specs.append(CallSpec(solver, "tol", tolerance, max_iter, timing_mode="batch"))
        single = select_calls_with_most_cases(records, subject.timing_mode, interleaved=False)
        for advice in subject.quick:
            if times or advice.target <= SHORT_TIME_RATIO * best.score:
                call_specs += _list_time_limited_calls(records, subject, single, advice, tolerance)
    return list(dict.fromkeys(call_specs))


def _find_required_max_iter(records: Records, solver: str, tolerance: float) -> int:
    """Return `max_iter` of a call to a tolerance: 0 (the default), or unlimited if a case needs more."""
    runs = (r for r in records if r.solver == solver and r.mode == "tol" and r.tol == tolerance)
    return UNLIMITED_ITERATIONS if any(exceeds_default_budget(solver, r.iterations) for r in runs) else 0


def _list_time_limited_calls(
    records: Records, subject: Subject, single: Sequence[TimedCall], advice: Advice, tolerance: float
) -> list[CallSpec]:
    """List calls for one time budget, `advice.target` [s].

    The best solvers without third-party code get a `time_limit`; the best calls with a fixed number of sweeps that
    serve a case within the budget follow.
    """
    start = "carried" if subject.timing_mode == "steps" else "cold"
    own = [
        c.solver for c in advice.ranking if not (s := specs().get(c.solver)) or not (s.external or s.requires)
    ]
    call_specs = [
        CallSpec(
            solver,
            "time",
            tolerance,
            time_limit=fraction * advice.target,
            timing_mode=subject.timing_mode,
            start=start,
        )
        for solver in dict.fromkeys([*own[: MAX_CANDIDATES - 1], *(s for s in own if s == "auto")])
        for fraction in TIME_LIMIT_FRACTIONS
    ]
    ranking = rank_calls_in_time(records, single, advice.target)
    for call, choice in () if ranking is None else ranking.ranking[:MAX_CANDIDATES]:
        if choice.solved:
            line = call.as_record
            call_specs.append(
                CallSpec(
                    line.solver,
                    "budget",
                    0.0,
                    line.max_iter,
                    timing_mode=subject.timing_mode,
                    start=line.start,
                )
            )
    return call_specs


def time_candidates(
    cases: Iterable[Source], records: Records, plan: Plan, store: Any = None, **more: Any
) -> Records:
    """Choose the candidates among the calls that `bench.run` measured, and time them by `bench.time_alternately`."""
    remaining = drop_cases_solved_at_zero(records)
    if not len(remaining):
        return records
    return time_alternately(cases, choose_calls_to_time(remaining, plan.times), records, plan, store, **more)
