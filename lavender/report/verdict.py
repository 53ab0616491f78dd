"""What a whole report comes to: one sentence, and lines of Python to copy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from lavender.bench.cases import SUFFIXES
from lavender.bench.record import Record, level_name
from lavender.bench.store import Records
from lavender.report import tables
from lavender.report.moved import by_speed, speed_levels, speed_name
from lavender.report.tables import Advice
from lavender.report.text import count, residual, seconds
from lavender.suite import FAMILIES

__all__ = ["Verdict", "verdict"]

PYTHON_SHARE = 2e-4  # s: below it what is measured is largely the way through Python, some 50 µs of it
QUICKER = 0.5  # of the time to the level: a time budget below that is worth another sentence
SHAPES = ("separate", "chain", "mesh", "stack", "pile", "dense")


@dataclass(frozen=True)
class Verdict:
    """The first thing to read."""

    sentences: tuple[str, ...]
    code: tuple[str, ...]  # lines of Python
    leaders: tuple[str, ...]  # solvers that the page draws in colour, the recommended one first

    @property
    def text(self) -> str:
        """All sentences in one line."""
        return " ".join(self.sentences)


@dataclass(frozen=True)
class _Scale:
    """What a level is of: a residual, or metres per second of motion error."""

    reached: Callable[[float], str]  # "to 1e-6"
    short: Callable[[float], str]  # how far one came in a time
    tol: Callable[[str, float], float]  # to ask a solver for, so that it reaches a level
    useless: float  # how far is too far to be worth a sentence


BY_RESIDUAL = _Scale(lambda x: f"to {level_name(x)}", residual, lambda solver, x: x, 1.0)


def verdict(records: Records, times: Sequence[float] = ()) -> Verdict:
    """The recommendation for everything that was measured together.

    By motion error where the plan names speed levels; where motion errors were measured beside residuals, a sentence
    says who is first by them.
    """
    if tables.is_campaign(records) or not len(records):
        return Verdict((), (), ())
    newest = next(reversed(list(records.runs.values())), None)
    speeds = speed_levels(records)
    if not speeds:
        return _of(records, times, BY_RESIDUAL)
    moving = by_speed(records)
    scale = _Scale(
        lambda x: f"until no body is wrong by more than {speed_name(x)}",
        lambda x: f"wrong by {residual(x)} m/s",
        lambda solver, x: _tolerance(moving, solver, x),
        math.inf,
    )
    if newest is not None and newest.plan.get("speed_levels"):
        return _of(moving, times, scale)
    found = _of(records, times, BY_RESIDUAL)
    best = _best(moving, "all")[0].best
    if best is None:
        return found
    level = speeds[len(speeds) // 2]
    more = f"By motion error {best.solver}: {seconds(best.score)} {scale.reached(level)}."
    return replace(found, sentences=(*found.sentences, more))


def _best(records: Records, what: str) -> tuple[Advice, str]:
    # of the middle level, and what it is of
    levels = tables.levels_of(records)
    level = levels[len(levels) // 2]
    cases = list(dict.fromkeys(r.case for r in records if r.step < 0))
    if cases:
        return tables.to_level(records, what, cases, level), _name(records, cases)
    best = next(a for a in tables.advice_by_sequence(records, ())[0] if a.target == level)
    return best, f"a step of {best.family}"


def _of(records: Records, times: Sequence[float], scale: _Scale) -> Verdict:
    cases = list(dict.fromkeys(r.case for r in records if r.step < 0))
    times = tuple(times) or tables.time_budgets(records)
    best, what = _best(records, "all")
    if cases:
        quick = [tables.within(records, "all", cases, t) for t in times]
    else:
        quick = [a for a in tables.advice_by_sequence(records, times)[1] if a.family == best.family]
    return _verdict(what, best, quick, scale)


def _tolerance(records: Records, solver: str, level: float) -> float:
    """The residual to ask for: the tightest that the quickest runs to this speed were asked for, over the cases."""
    quickest: dict[str, Record] = {}
    for r in records:
        if r.solver != solver or r.mode != "tol" or r.relative > level:
            continue
        if r.case not in quickest or r.time_min < quickest[r.case].time_min:
            quickest[r.case] = r
    tightest = min((r.tol for r in quickest.values()), default=math.nan)
    if not tightest > 0.0:
        return math.nan
    power = math.floor(math.log10(tightest))
    return float(f"{math.floor(tightest / 10.0**power + 1e-9)}e{power}")  # rounded down: it still gets there


def _verdict(what: str, best: Advice, quick: Sequence[Advice], scale: _Scale) -> Verdict:
    first, level = best.best, best.target
    leaders = [c.solver for c in best.ranking[:3] if c.solved]
    if first is None:
        return Verdict((f"Nobody brings any of {what} {scale.reached(level)}.",), (), tuple(leaders))
    said = f"Use {first.solver}: {seconds(first.score)} {scale.reached(level)} on {what}"
    if first.solved < first.cases:
        said += f", of which it brings {first.solved} there"
    elif math.isfinite(first.worst) and first.worst > 3.0 * first.score:
        said += f" (at worst {seconds(first.worst)}: {first.hardest})"
    said += "."
    sentences = [said]
    if best.ties:
        sentences.append(f"As good within noise: {', '.join(best.ties)}.")
    tol = scale.tol(first.solver, level)
    by_budget = bool(first.iterations) and first.how.startswith(f"{first.iterations} iterations")
    if by_budget or not math.isfinite(tol):
        code = [_budget(first.solver, first.iterations)]
    else:
        code = [f'lv.solve(problem, "{first.solver}", tol={level_name(tol)})']
    shorter = [
        a for a in quick if a.target <= QUICKER * first.score and a.best and a.best.score < scale.useless
    ]
    if shorter:
        other = shorter[-1].best
        assert other is not None
        how = f", {other.how}" if other.how else ""
        sentences.append(
            f"If you have only {seconds(shorter[-1].target)}, take {other.solver}{how}: {scale.short(other.score)}."
        )
        if other.iterations:
            code.append(_budget(other.solver, other.iterations))
        leaders.insert(1, other.solver)
    if first.score < PYTHON_SHARE:
        sentences.append(
            f"Below {seconds(PYTHON_SHARE)} Python's share of a call decides as much as the solver."
        )
    return Verdict(tuple(sentences), tuple(code), tuple(dict.fromkeys(leaders))[:3])


def _budget(solver: str, iterations: int) -> str:
    return f'lv.solve(problem, "{solver}", tol=0, max_iter={iterations})'


def _name(records: Records, cases: Sequence[str]) -> str:
    words = [set(records.cases[c].structure) for c in cases]
    shape = next((s for s in SHAPES if all(s in w for w in words)), "")
    if all(c.partition("(")[0] in FAMILIES and not records.cases[c].source.endswith(SUFFIXES) for c in cases):
        return f"the {count(len(cases), 'built-in problem')}" if len(cases) > 1 else cases[0]
    if shape in ("", "separate", "dense"):
        return f"your {count(len(cases), 'problem')}" if len(cases) > 1 else "your problem"
    plural = {"mesh": "meshes"}.get(shape, shape + "s")
    return f"your {count(len(cases), shape, plural)}" if len(cases) > 1 else f"your {shape}"
