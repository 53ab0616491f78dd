"""How wrong the bodies move, on a record: by the case's own reference, outside every clock."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from lavender import motion
from lavender.bench.record import Record
from lavender.problem import Problem

__all__ = ["SEARCH", "with_motion"]

SEARCH = 6  # runs of the search for several motions, once for each Coulomb problem


def with_motion(record: Record, problem: Problem, impulse: Any) -> Record:
    """The record with `motion`, `motion_speed` and `bound` of the impulses (m,) [N s] that came out, None without any.

    The reference, and under Coulomb's law the motions that a search finds, are kept with `problem`.
    """
    if impulse is None:
        return record
    problem, impulse = problem.disk, problem.on_disk(impulse)
    found = motion.motions_of(problem, SEARCH) if problem.law == "coulomb" else None
    error = (
        motion.motion_error(problem, impulse) if found is None else motion.nearest(problem, impulse, found)
    )
    speed = error.rows if error.speed is None else error.speed
    return replace(record, motion=error.relative, motion_speed=speed, bound=error.bound)
