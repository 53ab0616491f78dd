"""Lines of Python: what a user copies, and exactly what was timed."""

from __future__ import annotations

from typing import Any

from lavender.lab.bench.record import Record, level_name
from lavender.solvers import registry

COLD = "dataclasses.replace({}, guess=None)"  # a problem without the start that came with it
CARRIED = (
    "before, impulse = problems[0], None",
    "for problem in problems:",
    "    start = problem.start() if impulse is None else lv.bench.carry(before, impulse, problem)",
)


def needs_more(solver: str, iterations: int) -> bool:
    """A solve took more iterations than the solver's default budget: its line has to ask for them."""
    spec = registry.specs().get(solver)
    return spec is not None and iterations > spec.max_iter


def asked_of(what: Any, iterations: int) -> dict[str, Any]:
    """What the line of a Task or Record passes to `lv.solve` beside problem, name and start: timed, and printed.

    `iterations` are those that a solve took.
    """
    asked: dict[str, Any] = {"tol": what.tol}
    given = what.turns and what.max_iter  # in turns with others: what all of the cases need
    if what.mode == "budget" or given or needs_more(what.solver, iterations):
        asked["max_iter"] = what.max_iter
    if what.mode == "time":
        asked["time_limit"] = what.time_limit
    return asked


def _exact(x: float, short: str) -> str:
    """A number's short form where that is the number, else all of its digits."""
    return short if float(short) == x else repr(x)


def code_of(record: Record, guessed: bool = False) -> tuple[str, ...]:
    """The lines that a record is of; the last one was timed.

    `guessed`: there are problems that bring a guess, which a cold start leaves out.
    """
    asked = asked_of(record, record.iterations)
    text = {
        name: str(x) if name == "max_iter" else _exact(x, level_name(x) if x else "0")
        for name, x in asked.items()
    }
    words = ", ".join(f"{name}={value}" for name, value in text.items())
    if record.way == "batch":
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
