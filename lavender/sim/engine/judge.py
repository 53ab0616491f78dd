"""How wrong a step was: its residual by kind of row, and how wrong the bodies move."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.later import above
from lavender.judge.residuals import Residual, residual
from lavender.problem import Problem

motion = above("lavender.lab.motion")

PARTS = ("joint", "normal", "disk", "spin", "rolling")


def judged(problem: Problem, impulse: FloatArray) -> dict[str, Any]:
    """See `Simulation.residual`."""
    found = residual(problem, impulse)
    return {
        "relative": found.relative,
        "energy": found.energy,
        "velocity": found.velocity,
        "floor": found.floor,
        "worst": found.worst_name,
        "share": _shares(problem, found),
    }


def moved(problem: Problem, impulse: FloatArray, moving: Sequence[str]) -> dict[str, Any]:
    """See `Simulation.motion`; `moving` names the bodies that are not static."""
    error, apart = motion.measure(problem, impulse, motion.reference(problem)), 0.0
    if problem.law == "coulomb":
        own = motion.branch(problem, impulse)
        near = motion.measure(problem, impulse, own)
        if own.accepted and error.reference.accepted:
            apart = motion.measure(problem, own.impulse, error.reference).speed or 0.0
        if near.kinetic is not None and (error.kinetic is None or near.kinetic < error.kinetic):
            error = near
    names = ("relative", "kinetic", "speed", "spin", "bound", "bound_speed")
    body = moving[error.body] if error.body >= 0 else ""
    return {**{name: getattr(error, name) for name in names}, "body": body, "open": apart}


def _shares(problem: Problem, found: Residual) -> dict[str, float]:
    c = problem.cones
    part = np.zeros(problem.m, np.int32)
    contact = np.flatnonzero(c.kind > 0)
    part[c.ptr[0] :] = 2
    joints = len(c.kind) - len(contact)
    part[: c.ptr[joints]] = 0
    part[c.ptr[:-1][contact]] = 1
    part[c.spin_rows[c.spin_rows >= 0]] = 3
    for k in (0, 1):
        part[c.rolling_rows[c.rolling_rows >= 0] + k] = 4
    with np.errstate(invalid="ignore"):
        size = np.sqrt(problem.d) * np.abs(found.error)
    top = float(size.max(initial=0.0))
    # Over the largest, so that squares neither overflow nor vanish; what is infinite has no shares.
    energy = (size / top) ** 2 if 0.0 < top < np.inf else np.zeros(problem.m)
    total = float(energy.sum())
    names = PARTS if c.has_rolling else PARTS[:4]
    sums = np.bincount(part, weights=energy, minlength=len(names)) if problem.m else np.zeros(len(names))
    return {name: float(x / total) if total > 0.0 else 0.0 for name, x in zip(names, sums, strict=True)}
