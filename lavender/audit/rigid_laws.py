"""Causes of what an audit found: of errors against the engine's own problem, and of differences from the rigid laws.

A few steps are read again as records, and `lavender.causes` divides each difference into parts.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from lavender.audit.bodies import get_geoms
from lavender.audit.simulated_worlds import Runs, simulate_world
from lavender.audit.slip import name_blocks, read_slip
from lavender.base.arrays import FloatArray
from lavender.base.errors import LavenderError
from lavender.causes.comparison import Comparison, compare
from lavender.causes.text import WORDS
from lavender.io.mujoco_step import step_from_mujoco
from lavender.report.text import format_size

# Steps of a world that are compared with the rigid laws, evenly spaced.
COMPARED_STEPS = 6
# Larger steps are not compared: each one has up to 100 exact solutions.
MAX_ROWS, MAX_VELOCITIES = 300, 120
MIN_SHOWN_PART = 0.05  # [-] Parts below this fraction of the difference are not listed.
MAX_RIGID_SHARE = (
    0.1  # [-] A contact with at most this part of its speed would not slide by the rigid laws.
)
OWN_PARTS = ("solver", "lost digits", "noslip")


class StepCauses(NamedTuple):
    """Causes of one step's differences."""

    world: int
    step: int
    # Name and size [m/s, rad/s] of the largest part of the error against the engine's own problem; "" if it is exact.
    own: tuple[str, float]
    velocity: str  # Name of the velocity with the largest difference from the rigid laws.
    unit: str
    difference: float  # [m/s, rad/s]
    # (name, mean, smallest, largest) [m/s, rad/s] of its parts, the largest first.
    parts: tuple[tuple[str, float, float, float], ...]
    causes: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """The difference from the rigid laws with its causes and their intervals."""
        texts = []
        for name, mean, low, high in self.parts:
            text = f"{WORDS.get(name, name)} {format_signed(mean)}"
            if high - low > 0.02 * abs(mean):
                text += f" ({format_signed(low)} to {format_signed(high)} by order)"
            texts.append(text)
        return (
            f"From the rigid laws, the velocity of {self.velocity} in step {self.step} of world {self.world} "
            f"differs by {format_signed(self.difference)} {self.unit}: {', '.join(texts)}."
        )


def format_signed(x: float) -> str:
    """Return a number with two digits and its sign."""
    return ("+" if x >= 0.0 else "-") + format_size(abs(x))


class Slide(NamedTuple):
    """A contact that slides after a step, and would not by the rigid laws."""

    world: int
    step: int
    contact: str
    speed: float  # [m/s]
    rigid: float  # [m/s] By the rigid laws.
    state: FloatArray  # Vector of mjSTATE_INTEGRATION before the step.


def explain_steps(
    runs: Runs, worst: Iterable[tuple[int, int]]
) -> tuple[list[StepCauses], Slide | None]:
    """Return the causes of the worst steps, then of the evenly spaced step with the largest difference.

    The second result is the contact of these steps that slides fastest where it would not by the rigid laws.

    Parameters
    ----------
    runs : Runs
        Of a model of MuJoCo.
    worst : (world, step) of the worst steps
    """
    if runs.model.nv > MAX_VELOCITIES or runs.model.nv == 0:
        return [], None
    wanted = list(worst)
    # The first worlds; world 0 starts without the spread of the velocities.
    first = range(min(runs.worlds, 2))
    states = {
        w: simulate_world(runs, w)[0] for w in dict.fromkeys([*(w for w, _ in wanted), *first])
    }
    slides: list[Slide] = []
    found = [x for x in (_explain(runs, states, w, k, []) for w, k in wanted) if x is not None]
    steps = np.unique(np.linspace(0, runs.steps - 1, COMPARED_STEPS).astype(int))
    spaced = [
        x
        for w in first
        for k in steps
        if (x := _explain(runs, states, w, int(k), slides)) is not None
    ]
    spaced.sort(key=lambda x: -abs(x.difference))
    fastest = max(slides, key=lambda x: x.speed, default=None)
    return found + [x for x in spaced[:1] if x.parts], fastest


def _explain(
    runs: Runs, states: dict[int, FloatArray], world: int, step: int, slides: list[Slide]
) -> StepCauses | None:
    """Return the causes of one step, and add its sliding contacts; None if it cannot be compared."""
    state = states[world][step]
    if not np.isfinite(state).all():
        return None
    mj, model = runs.mj, runs.model
    data = mj.MjData(model)
    mj.mj_setState(model, data, state, mj.mjtState.mjSTATE_INTEGRATION)
    try:
        record = step_from_mujoco(model, data)
        if not record.blocks or record.n_rows > MAX_ROWS:
            return None
        comparison = compare(record)
        for name, block in zip(name_blocks(record), record.blocks, strict=True):
            if block.has_friction:
                rows, surface = read_slip(block)
                velocities = record.velocity_after, comparison.a.velocity_after
                speed, rigid = (float(np.linalg.norm(rows @ v - surface)) for v in velocities)
                if rigid <= MAX_RIGID_SHARE * speed:
                    slides.append(Slide(world, step, get_geoms(name), speed, rigid, state))
        return describe_step(comparison, world, step)
    except (LavenderError, mj.FatalError, np.linalg.LinAlgError):
        return None


def describe_step(comparison: Comparison, world: int, step: int) -> StepCauses:
    """Return the causes of a comparison with the rigid laws."""
    total = comparison.difference
    i = int(np.argmax(np.abs(total)))
    row = np.eye(len(total))[i]
    size = abs(float(total[i]))
    parts = tuple(
        (part.name, mean, low, high) for part, mean, low, high in comparison.rank(row)
        if max(abs(low), abs(high)) > max(MIN_SHOWN_PART * size, comparison.rounding)
    )  # fmt: skip
    errors = {n: float(np.abs(comparison.parts[n].mean).max()) for n in OWN_PARTS}
    own: Any = max(errors.items(), key=lambda x: x[1])
    return StepCauses(
        world, step, own if own[1] > comparison.rounding else ("", 0.0), comparison.b.names[i],
        "rad/s" if comparison.b.angular[i] else "m/s", float(total[i]), parts,
        tuple(comparison.list_causes(row)),
    )  # fmt: skip
