"""Which lines are worth timing in turns: those near the best of what was measured, for each question that is asked."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from lavender.lab.bench.cases import Source
from lavender.lab.bench.running.alternating import time_alternately
from lavender.lab.bench.running.plan import UNLIMITED, Plan
from lavender.lab.bench.running.timing import Ask
from lavender.lab.bench.store import Records
from lavender.lab.bench.timed_call import exceeds_default_budget
from lavender.lab.report import choices, tables
from lavender.lab.report.choices import Advice
from lavender.lab.report.finals import Final, in_time, lines
from lavender.lab.report.moved import working
from lavender.solvers.registry import specs

NEAR = 1.6  # times the best's, within which a rerun may put another first
MOST = 4  # solvers for a level, and for a time
SHARES = (0.5, 0.8)  # of a time that a time limit asks for: set-up and judge take the rest
QUICKER = 0.5  # of the time to the level: a time below that is worth another sentence


@dataclass(frozen=True)
class Subject:
    """What a recommendation is for: all single cases, or all sequences."""

    names: tuple[str, ...]  # cases, or sequences
    cases: tuple[str, ...]  # cases, or steps of the sequences
    way: str  # "call" or "steps"
    best: Advice  # to the middle level
    quick: tuple[Advice, ...]  # in each time


def subjects(records: Records, times: Sequence[float] = ()) -> list[Subject]:
    """Single cases, then sequences, each where there are any."""
    levels = tables.levels_of(records)
    level = levels[len(levels) // 2]
    times = tuple(times) or choices.time_budgets(records)
    found = []
    cases = tuple(dict.fromkeys(r.case for r in records if r.step < 0))
    if cases:
        quick = tuple(choices.within(records, "all", cases, t) for t in times)
        found.append(Subject(cases, cases, "call", choices.to_level(records, "all", cases, level), quick))
    sequences = choices.steps_of(records)
    if sequences:
        steps = [step for some in sequences.values() for step in some]
        quick = tuple(choices.within(records, "all", steps, t) for t in times)
        found.append(
            Subject(
                tuple(sequences), tuple(steps), "steps", choices.to_level(records, "all", steps, level), quick
            )
        )
    return found


def contenders(records: Records, times: Sequence[float] = ()) -> list[Ask]:
    """Lines to the middle level, the same in a batch, and lines for each time that is asked for or worth a sentence."""
    asks: list[Ask] = []
    for subject in subjects(records, times):
        level, best = subject.best.target, subject.best.best
        if best is None:
            continue
        equal = [c for c in subject.best.ranking if c.solved == best.solved]
        near = [c for i, c in enumerate(equal) if i < 2 or c.score <= NEAR * best.score]
        for solver in [c.solver for c in near[:MOST]]:
            needed = _needed(records, solver, level)
            # Carrying impulses has its price: where steps are quick, a cold start may be the quicker line.
            for start in ("cold", "carried") if subject.way == "steps" else ("cold",):
                asks.append(Ask(solver, "tol", level, needed, way=subject.way, start=start))
            asks.append(Ask(solver, "tol", level, needed, way="batch"))
        plain = lines(records, subject.way, rounds=False)
        for advice in subject.quick:
            if times or advice.target <= QUICKER * best.score:
                asks += _in_time(records, subject, plain, advice, level)
    return list(dict.fromkeys(asks))


def _needed(records: Records, solver: str, level: float) -> int:
    """`max_iter` of a line to a level: none, unless some case needs more than the solver's default."""
    runs = (r for r in records if r.solver == solver and r.mode == "tol" and r.tol == level)
    return UNLIMITED if any(exceeds_default_budget(solver, r.iterations) for r in runs) else 0


def _in_time(
    records: Records, subject: Subject, plain: Sequence[Final], advice: Advice, level: float
) -> list[Ask]:
    """Time limits for those that come closest, and the budgets of sweeps that stay within."""
    start = "carried" if subject.way == "steps" else "cold"
    own = [
        c.solver for c in advice.ranking if not (s := specs().get(c.solver)) or not (s.external or s.requires)
    ]
    asks = [
        Ask(solver, "time", level, time_limit=share * advice.target, way=subject.way, start=start)
        for solver in dict.fromkeys([*own[: MOST - 1], *(s for s in own if s == "auto")])
        for share in SHARES
    ]
    race = in_time(records, plain, advice.target)
    for final, choice in () if race is None else race.ranking[:MOST]:
        if choice.solved:
            line = final.line
            asks.append(Ask(line.solver, "budget", 0.0, line.max_iter, way=subject.way, start=line.start))
    return asks


def time_lines(
    cases: Iterable[Source], records: Records, plan: Plan, store: Any = None, **more: Any
) -> Records:
    """Choose the contenders among what `bench.run` measured, and time them; see `bench.time_alternately`."""
    busy = working(records)
    if not len(busy) or plan.speed_levels:
        return records
    return time_alternately(cases, contenders(busy, plan.times), records, plan, store, **more)
