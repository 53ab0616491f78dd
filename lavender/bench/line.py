"""Lines of Python: what a user copies, and exactly what was timed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from lavender import registry
from lavender.bench.record import Record, level_name

if TYPE_CHECKING:
    from lavender.bench.running.timing import Task

__all__ = ["asked_of", "c_of", "code_of", "needs_more"]

C_OPTIONS = {"memory": "{}", "convex": "{}", "omega": "{!r}"}
C_WORDS = {
    ("order", "symmetric"): "order = LAV_SYMMETRIC", ("order", "random"): "order = LAV_RANDOM",
    ("order", "reverse"): "order = LAV_REVERSE", ("sweep", "pgs"): "sweep = LAV_PGS_SWEEP",
    ("sweep", "blocks"): "sweep = LAV_BLOCK_SWEEP", ("restart", "against"): "keeps = 1",
}  # fmt: skip

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


def asked_of(what: Task | Record, iterations: int) -> dict[str, Any]:
    """What the line of a measurement passes to `lv.solve` beside problem, name and start: timed, and printed.

    Parameters
    ----------
    what : Task or Record
    iterations : that a solve took
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


def c_of(record: Record) -> tuple[str, ...]:
    """The C calls of a record, on `options` and `budget`; none where the library lacks the solver or an option."""
    spec = registry.specs().get(record.solver)
    if spec is None or spec.external or spec.delegates or not spec.own or record.way == "batch":
        return ()
    out = [f"lav_default_options(LAV_{record.solver.upper()}, &options)"]
    for key, value in {"order": record.order or "given", **record.options}.items():
        if not isinstance(value, (str, int, float)):
            return ()  # of a file that somebody else wrote: no option of the library
        if key in C_OPTIONS:
            out.append(f"options.{key} = {C_OPTIONS[key].format(value)}")
        elif isinstance(value, str) and (key, value) in C_WORDS:
            out.append(f"options.{C_WORDS[key, value]}")
        elif (key, value) != ("order", "given"):
            return ()
    if record.seed and record.order == "random":
        out.append(f"options.seed = {record.seed}")
    asked = asked_of(record, record.iterations)
    out.append("lav_default_budget(&budget)")
    out.append(f"budget.tol = {_exact(record.tol, f'{record.tol:g}')}")
    out.append(f"budget.iterations = {asked.get('max_iter') or spec.max_iter}")
    if "time_limit" in asked:
        out.append(f"budget.seconds = {_exact(record.time_limit, f'{record.time_limit:g}')}")
    return tuple(out)
