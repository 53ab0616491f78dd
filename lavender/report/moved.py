"""A report by motion error: the same tables over the same records, matched by metres per second."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from lavender.bench.record import Record, level_name
from lavender.bench.store import Records
from lavender.report.tables.advice import Advice, advice_by_level
from lavender.report.tables.campaigns import Robustness, robustness
from lavender.report.tables.cases import Reach, reaches

__all__ = [
    "Idle",
    "advice_by_speed",
    "by_speed",
    "idle",
    "moved",
    "robustness_by_speed",
    "speed_levels",
    "speed_name",
    "working",
]

USUAL = (1e-2, 1e-3)  # m/s, where the plan names none


@dataclass(frozen=True)
class Idle:
    """A case where doing nothing is right, and the worst that a solver made of it."""

    case: str
    rows: int
    solver: str  # of the largest velocity error
    velocity: float  # m/s
    energy: float  # sqrt J


def speed_name(level: float) -> str:
    """A speed as people write it: 1e-3 m/s."""
    return f"{level_name(level)} m/s"


def speed_levels(records: Records) -> tuple[float, ...]:
    """Speed levels of the newest run's plan [m/s], the usual ones where it has none; empty without motion errors."""
    if all(r.motion_speed is None for r in records):
        return ()
    for run in reversed(list(records.runs.values())):
        if run.plan.get("speed_levels"):
            return tuple(sorted(map(float, run.plan["speed_levels"]), reverse=True))
    return USUAL


def by_speed(records: Records) -> Records:
    """The records as if m/s of motion error were their residual; runs without one reached nothing."""
    levels = speed_levels(records)
    found = records.having(
        replace(r, relative=math.inf if r.motion_speed is None else r.motion_speed, floor=0.0)
        for r in records
        if not r.turns
    )
    for run in records.runs.values():
        found.add(replace(run, plan={**run.plan, "levels": levels}))
    return found


def advice_by_speed(records: Records) -> list[Advice]:
    """For each structure and speed level: who brings most cases there, and who is fastest."""
    return advice_by_level(by_speed(records)) if speed_levels(records) else []


def robustness_by_speed(records: Records) -> list[Robustness]:
    """Campaigns: shares of cases brought to each speed level, motion errors [m/s] by budget; none without them."""
    return robustness(by_speed(records)) if speed_levels(records) else []


def moved(records: Records) -> list[Reach]:
    """How far and how fast each solver came on each case by motion error [m/s]; none without motion errors."""
    levels = speed_levels(records)
    return reaches(by_speed(records), levels) if levels else []


def working(records: Records) -> Records:
    """The records without cases where doing nothing is right: nobody solves those, and nobody fails."""
    still = {name for name, info in records.cases.items() if info.nothing_to_do}
    if not still:
        return records
    kept = (r for r in records if r.case not in still)
    return records.having(kept, lambda entry: getattr(entry, "case", None) not in still)


def idle(records: Records) -> list[Idle]:
    """Cases where doing nothing is right, with the worst residual of any run in units."""
    worsts: dict[str, Record] = {}
    for r in records:
        if r.case not in worsts or r.velocity > worsts[r.case].velocity:
            worsts[r.case] = r
    out = []
    for name, info in records.cases.items():
        if info.nothing_to_do:
            worst = worsts.get(name)
            if worst is None:
                out.append(Idle(name, info.rows, "", 0.0, 0.0))
            else:
                out.append(Idle(name, info.rows, worst.solver, worst.velocity, worst.energy))
    return out
