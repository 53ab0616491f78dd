"""Convert records so that tables and figures show motion errors [m/s], and list cases that the zero impulse solves."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from lavender.lab.bench.record import format_tolerance
from lavender.lab.bench.store import Records

DEFAULT_VELOCITY_TOLERANCES = (1e-2, 1e-3)  # [m/s] Velocity tolerances of tables if the plan has none.


@dataclass(frozen=True)
class CaseSolvedAtZero:
    """A case that the zero impulse solves, and the worst result of any solver on it.

    Parameters
    ----------
    case, rows : name, number of rows
    solver : solver with the largest velocity error
    velocity, energy : residual of that solver [m/s], [sqrt J]
    """

    case: str
    rows: int
    solver: str
    velocity: float
    energy: float


def format_speed(tolerance: float) -> str:
    """Return a speed in words: 1e-3 m/s."""
    return f"{format_tolerance(tolerance)} m/s"


def get_velocity_tolerances(records: Records) -> tuple[float, ...]:
    """Return the velocity tolerances [m/s] of the newest run's plan, or the defaults; empty without motion errors."""
    if all(r.motion_speed is None for r in records):
        return ()
    for run in reversed(list(records.runs.values())):
        if run.plan.get("velocity_tolerances"):
            return tuple(sorted(map(float, run.plan["velocity_tolerances"]), reverse=True))
    return DEFAULT_VELOCITY_TOLERANCES


def convert_to_motion_errors(records: Records) -> Records:
    """Return the records with the motion error [m/s] as residual, inf for runs without one; empty if all have none."""
    tolerances = get_velocity_tolerances(records)
    if not tolerances:
        return Records()
    converted = records.with_records(
        replace(r, relative=math.inf if r.motion_speed is None else r.motion_speed, roundoff_floor=0.0)
        for r in records
        if not r.interleave_group
    )
    for run in records.runs.values():
        converted.add(replace(run, plan={**run.plan, "tolerances": tolerances}))
    return converted


def list_cases_solved_at_zero(records: Records) -> list[CaseSolvedAtZero]:
    """List cases that the zero impulse solves, with the worst residual of any run in units."""
    worst: dict[str, tuple[str, float, float]] = {}
    for r in sorted(records, key=lambda r: -r.velocity):
        worst.setdefault(r.case, (r.solver, r.velocity, r.energy))
    no_run = ("", 0.0, 0.0)
    idle = ((name, info.rows) for name, info in records.cases.items() if info.nothing_to_do)
    return [CaseSolvedAtZero(name, rows, *worst.get(name, no_run)) for name, rows in idle]
