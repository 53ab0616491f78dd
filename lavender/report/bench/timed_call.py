"""Format the timed call as arguments of `lv.solve` and as the lines of Python that a report prints."""

from __future__ import annotations

from typing import Any

from lavender.report.bench.record import Record, format_tolerance
from lavender.solvers import registry

COLD_PROBLEM = "dataclasses.replace({}, guess=None)"  # Python expression of a problem without its guess.
CARRIED_START = (
    "before, impulse = problems[0], None",
    "for problem in problems:",
    "    start = problem.start() if impulse is None else lv.bench.carry_impulses(before, impulse, problem)",
)


def exceeds_default_budget(solver: str, iterations: int) -> bool:
    """Whether a solve took more iterations than the solver's default budget, so that its call needs `max_iter`."""
    spec = registry.specs().get(solver)
    return spec is not None and iterations > spec.max_iter


def make_call_arguments(measurement: Any, iterations: int) -> dict[str, Any]:
    """Return the keyword arguments, without the start, of the timed and printed call of a Task or Record.

    `iterations` is the number that a solve took.
    """
    arguments: dict[str, Any] = {"tol": measurement.tol}
    # Solvers that are timed alternately get one max_iter, which suffices for all cases.
    is_common = measurement.interleave_group and measurement.max_iter
    if measurement.mode == "budget" or is_common or exceeds_default_budget(measurement.solver, iterations):
        arguments["max_iter"] = measurement.max_iter
    if measurement.mode == "time":
        arguments["time_limit"] = measurement.time_limit
    return arguments


def _format_exactly(x: float, short: str) -> str:
    """Return a number's short form if it is exact, else all of its digits."""
    return short if float(short) == x else repr(x)


def format_call(record: Record, guessed: bool = False) -> tuple[str, ...]:
    """Return the lines of Python with which a record was measured; the last line is the timed call.

    If `guessed` is true, some problems have a guess, and the lines of a cold start remove it.
    """
    arguments = make_call_arguments(record, record.iterations)
    text = {
        name: str(x) if name == "max_iter" else _format_exactly(x, format_tolerance(x) if x else "0")
        for name, x in arguments.items()
    }
    argument_text = ", ".join(f"{name}={value}" for name, value in text.items())
    if record.timing_mode == "batch":
        cold = (f"problems = [{COLD_PROBLEM.format('p')} for p in problems]",) if guessed else ()
        return (*cold, f'solutions = lv.solve_many(problems, "{record.solver}", {argument_text})')
    if record.start != "carried":
        cold = (f"problem = {COLD_PROBLEM.format('problem')}",) if guessed and record.start == "cold" else ()
        return (*cold, f'lv.solve(problem, "{record.solver}", {argument_text})')
    return (
        *CARRIED_START,
        f'    solution = lv.solve(problem, "{record.solver}", impulse=start, {argument_text})',
        "    before, impulse = problem, solution.impulse",
    )
