"""A report by motion error: the same tables over the same records, matched by metres per second."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from lavender.lab.bench.record import level_name
from lavender.lab.bench.store import Records

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
    """The records as if m/s of motion error were their residual; runs without one reached nothing.

    None of them where no motion error is known.
    """
    levels = speed_levels(records)
    if not levels:
        return Records()
    found = records.having(
        replace(r, relative=math.inf if r.motion_speed is None else r.motion_speed, floor=0.0)
        for r in records
        if not r.turns
    )
    for run in records.runs.values():
        found.add(replace(run, plan={**run.plan, "levels": levels}))
    return found


def working(records: Records) -> Records:
    """The records without cases where doing nothing is right: nobody solves those, and nobody fails."""
    still = {name for name, info in records.cases.items() if info.nothing_to_do}
    if not still:
        return records
    kept = (r for r in records if r.case not in still)
    return records.having(kept, lambda entry: getattr(entry, "case", None) not in still)


def idle(records: Records) -> list[Idle]:
    """Cases where doing nothing is right, with the worst residual of any run in units."""
    worst: dict[str, tuple[str, float, float]] = {}
    for r in sorted(records, key=lambda r: -r.velocity):
        worst.setdefault(r.case, (r.solver, r.velocity, r.energy))
    nobody = ("", 0.0, 0.0)
    still = ((name, info.rows) for name, info in records.cases.items() if info.nothing_to_do)
    return [Idle(name, rows, *worst.get(name, nobody)) for name, rows in still]
