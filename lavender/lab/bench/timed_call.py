"""The Python call that was timed, as arguments for `lv.solve` and as the lines that a report prints."""

from __future__ import annotations

from typing import Any

from lavender.lab.bench.record import Record, format_tolerance
from lavender.solvers import registry

COLD = "dataclasses.replace({}, guess=None)"  # removes the start that came with a problem
CARRIED = (
    "before, impulse = problems[0], None",
    "for problem in problems:",
    "    start = problem.start() if impulse is None else lv.bench.carry(before, impulse, problem)",
)


def exceeds_default_budget(solver: str, iterations: int) -> bool:
    """Whether a solve took more iterations than the solver's default budget, so that its line needs `max_iter`."""
    spec = registry.specs().get(solver)
    return spec is not None and iterations > spec.max_iter


def make_call_arguments(what: Any, iterations: int) -> dict[str, Any]:
    """Return the keyword arguments, without the start, of the timed and printed call of a Task or Record.

    `iterations` is the number that a solve took.
    """
    asked: dict[str, Any] = {"tol": what.tol}
    given = (
        what.interleave_group and what.max_iter
    )  # timed alternately with others: the number that all cases need
    if what.mode == "budget" or given or exceeds_default_budget(what.solver, iterations):
        asked["max_iter"] = what.max_iter
    if what.mode == "time":
        asked["time_limit"] = what.time_limit
    return asked


def _exact(x: float, short: str) -> str:
    """Return a number's short form if it is exact, else all of its digits."""
    return short if float(short) == x else repr(x)


def format_call(record: Record, guessed: bool = False) -> tuple[str, ...]:
    """Return the lines that a record was measured with; the last one was timed.

    `guessed`: some problems bring a guess, which a cold start removes.
    """
    asked = make_call_arguments(record, record.iterations)
    text = {
        name: str(x) if name == "max_iter" else _exact(x, format_tolerance(x) if x else "0")
        for name, x in asked.items()
    }
    words = ", ".join(f"{name}={value}" for name, value in text.items())
    if record.timing_mode == "batch":
        cold = (f"problems = [{COLD.format('p')} for p in problems]",) if guessed else ()
        return (*cold, f'solutions = lv.solve_many(problems, "{record.solver}", {words})')
    if record.start != "carried":
        cold = (f"problem = {COLD.format('problem')}",) if guessed and record.start == "cold" else ()
        return (*cold, f'lv.solve(problem, "{record.solver}", {words})')
    return (
        *CARRIED,
        f'    solution = lv.solve(problem, "{record.solver}", impulse=start, {words})',
        "    before, impulse = problem, solution.impulse",
    )
