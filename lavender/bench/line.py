"""Lines of Python: what a user copies, and exactly what was timed."""

from __future__ import annotations

from typing import Any

from lavender import registry
from lavender.bench.record import Record, level_name

__all__ = ["code_of", "needs_more"]

CARRIED = (
    "before, impulse = problems[0], None",
    "for problem in problems:",
    "    start = None if impulse is None else lv.bench.carry(before, impulse, problem)",
)


def needs_more(solver: str, iterations: int) -> bool:
    """A solve took more iterations than the solver's default budget: its line has to ask for them."""
    spec = registry.specs().get(solver)
    return spec is not None and iterations > spec.max_iter


def code_of(record: Record) -> tuple[str, ...]:
    """The lines that a record is of."""
    asked: dict[str, Any] = {"tol": level_name(record.tol) if record.tol else "0"}
    given = record.turns and record.max_iter  # in turns with others: what all of the cases need
    if record.mode == "budget" or given or needs_more(record.solver, record.iterations):
        asked["max_iter"] = record.max_iter
    if record.mode == "time":
        asked["time_limit"] = level_name(record.time_limit)
    words = ", ".join(f"{name}={value}" for name, value in asked.items())
    if record.way == "batch":
        return (f'solutions = lv.solve_many(problems, "{record.solver}", {words})',)
    if record.start != "carried":
        return (f'lv.solve(problem, "{record.solver}", {words})',)
    return (
        *CARRIED,
        f'    solution = lv.solve(problem, "{record.solver}", impulse=start, {words})',
        "    before, impulse = problem, solution.impulse",
    )
