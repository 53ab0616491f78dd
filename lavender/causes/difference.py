"""The difference of the velocities of two engines after one step, divided into parts by their causes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.causes.matching import Pairing
from lavender.causes.mixture import Mixture
from lavender.io.step_record import StepRecord

LEFT_OVER = ("state", "solver", "lost digits", "noslip", "rest")  # Parts that no mixture has.
MIN_EQUAL_RATIO = 0.9  # [-] Two causes count as equal if their ratio may be at least this.
# [-] A difference below this multiple of the velocities is rounding.
ROUNDING = {"float64": 1e-10, "float32": 1e-5}


@dataclass(frozen=True, eq=False)
class Part:
    """Part of a difference of velocities by one cause."""

    name: str
    mean: FloatArray  # (nv,) m/s, rad/s: mean over all orders of exchange.
    # (orders, nv) m/s, rad/s: the change by the exchange, for each set of other ingredients that are exchanged before.
    changes: FloatArray
    alone_in_a: FloatArray  # (nv,): the change if only this one is exchanged in the first engine.
    alone_in_b: (
        FloatArray  # (nv,): minus the change if only this one is exchanged in the second engine.
    )
    parts: tuple[Part, ...] = ()  # Parts within an ingredient.

    def measure(self, row: FloatArray) -> tuple[float, float, float]:
        """Return mean, smallest and largest change of the velocity row . v [m/s, rad/s]."""
        changes = self.changes @ row
        return float(self.mean @ row), float(changes.min()), float(changes.max())


@dataclass(frozen=True, eq=False)
class Quantity:
    """A velocity whose difference is explained: of a joint, or along an axis of a contact."""

    name: str
    unit: str
    row: FloatArray  # (nv,)
    kind: str  # "joint" or "contact".


@dataclass(frozen=True, eq=False)
class Difference:
    """Difference of the velocities of two engines after one step, and its parts."""

    a: StepRecord
    b: StepRecord
    parts: Mapping[str, Part]  # By the name of the ingredient, and of `LEFT_OVER`.
    exact_a: FloatArray  # (nv,) m/s, rad/s: exact solution of the first engine's own step.
    exact_b: FloatArray
    pairing: Pairing
    mixtures: Mapping[tuple[bool, ...], Mixture] = field(repr=False, default_factory=dict)
    active: tuple[str, ...] = ()  # Ingredients that differ.
    is_ideal: bool = False  # Whether the first record is the ideal twin of the second one.
    warnings: tuple[str, ...] = ()

    @property
    def difference(self) -> FloatArray:
        """v_b - v_a (nv,) [m/s, rad/s]."""
        return self.b.velocity_after - self.a.velocity_after

    @property
    def rounding(self) -> float:
        """Difference [m/s, rad/s] up to which two velocities are equal to rounding."""
        size = max(1.0, float(np.abs(self.b.velocity_after).max(initial=0.0)))
        is_float32 = "float32" in (self.a.precision, self.b.precision)
        return ROUNDING["float32" if is_float32 else "float64"] * size

    def list_quantities(self, joints: int = 3, contacts: int = 2) -> list[Quantity]:
        """Return the joint velocities and velocities of contacts with the largest differences."""
        total = self.difference
        own = [
            Quantity(name, "rad/s" if is_angular else "m/s", row, "joint")
            for name, is_angular, row in zip(
                self.a.names, self.a.angular, np.eye(len(total)), strict=True
            )
        ]
        axes = ("along its normal", "along tangent 1", "along tangent 2")
        touching = [
            Quantity(f"{block.key}, {axis}", "m/s", row, "contact")
            for block in self.b.blocks if block.role == "contact"
            for axis, row in zip(axes, block.jacobian[: min(3, block.condim)], strict=False)
        ]  # fmt: skip
        chosen = []
        for quantities, count in ((own, joints), (touching, contacts)):
            quantities.sort(key=lambda q: -abs(float(q.row @ total)))
            chosen += [q for q in quantities[:count] if abs(q.row @ total) > self.rounding]
        return chosen

    def rank(self, row: FloatArray) -> list[tuple[Part, float, float, float]]:
        """Return (part, mean, smallest, largest) of a velocity, the largest mean first."""
        measured = [(part, *part.measure(row)) for part in self.parts.values()]
        return sorted(measured, key=lambda x: -abs(x[1]))

    def list_causes(self, row: FloatArray) -> list[str]:
        """Return the names of the causes of a velocity's difference, the largest first.

        A second cause is named if the interval of the first one contains 0, or comes within `MIN_EQUAL_RATIO` of the
        second's.
        """
        ranked = [x for x in self.rank(row) if abs(x[1]) > self.rounding]
        if not ranked:
            return []
        first, largest, low, high = ranked[0]
        smallest = 0.0 if low <= 0.0 <= high else MIN_EQUAL_RATIO * min(abs(low), abs(high))
        return [first.name] + [
            part.name for part, mean, low, high in ranked[1:]
            if max(abs(low), abs(high)) >= smallest and abs(mean) >= 0.1 * abs(largest)
        ]  # fmt: skip
