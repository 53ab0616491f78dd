"""What a whole report comes to: one sentence, and lines of Python to copy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from lavender.bench.record import level_name
from lavender.bench.store import Records
from lavender.report import tables
from lavender.report.tables import Advice
from lavender.report.text import count, residual, seconds

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


def verdict(records: Records, times: Sequence[float] = ()) -> Verdict:
    """The recommendation for everything that was measured together."""
    cases = list(dict.fromkeys(r.case for r in records if r.step < 0))
    if tables.is_campaign(records) or not len(records):
        return Verdict((), (), ())
    levels = tables.levels_of(records)
    level = levels[len(levels) // 2]
    times = tuple(times) or tables.time_budgets(records)
    if cases:
        best = tables.to_level(records, "all", cases, level)
        quick = [tables.within(records, "all", cases, t) for t in times]
        return _verdict(_name(records, cases), best, quick, level)
    by_level, by_time = tables.advice_by_sequence(records, times)
    best = next(a for a in by_level if a.target == level)
    quick = [a for a in by_time if a.family == best.family]
    return _verdict(f"a step of {best.family}", best, quick, level)


def _verdict(what: str, best: Advice, quick: Sequence[Advice], level: float) -> Verdict:
    first = best.best
    leaders = [c.solver for c in best.ranking[:3] if c.solved]
    if first is None:
        return Verdict((f"Nobody brings any of {what} to {level_name(level)}.",), (), tuple(leaders))
    said = f"Use {first.solver}: {seconds(first.score)} to {level_name(level)} on {what}"
    if first.solved < first.cases:
        said += f", of which it brings {first.solved} there"
    elif math.isfinite(first.worst) and first.worst > 3.0 * first.score:
        said += f" (at worst {seconds(first.worst)}: {first.hardest})"
    said += "."
    sentences = [said]
    if best.ties:
        sentences.append(f"As good within noise: {', '.join(best.ties)}.")
    if first.iterations and first.how.startswith(f"{first.iterations} iterations"):
        code = [_budget(first.solver, first.iterations)]
    else:
        code = [f'lv.solve(problem, "{first.solver}", tol={level_name(level)})']
    shorter = [a for a in quick if a.target <= QUICKER * first.score and a.best and a.best.score < 1.0]
    if shorter:
        other = shorter[-1].best
        assert other is not None
        how = f", {other.how}" if other.how else ""
        sentences.append(
            f"If you have only {seconds(shorter[-1].target)}, take {other.solver}{how}: {residual(other.score)}."
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
    if shape in ("", "separate", "dense"):
        return f"your {count(len(cases), 'problem')}" if len(cases) > 1 else "your problem"
    plural = {"mesh": "meshes"}.get(shape, shape + "s")
    return f"your {count(len(cases), shape, plural)}" if len(cases) > 1 else f"your {shape}"
