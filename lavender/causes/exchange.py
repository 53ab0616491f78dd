"""Solve all mixtures of two steps, and divide their difference over the orders of exchange."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.causes.difference import Part
from lavender.causes.matching import Pairing
from lavender.causes.mixture import INGREDIENTS, PARTS, Mixture, solve_mixture
from lavender.io.step_record import ConstraintBlock, Softness, StepRecord

FLUID = ("fluid_force", "fluid_matrix")


class Mixtures:
    """Solved mixtures of two records."""

    def __init__(self, a: StepRecord, b: StepRecord, pairing: Pairing) -> None:
        self.records, self.pairing = (a, b), pairing
        self.different = find_different_parts(a, b, pairing)
        self.solutions: dict[frozenset[str], Mixture] = {}
        self.warnings: list[str] = []

    def solve(self, exchanged: Mapping[str, bool]) -> Mixture:
        """Return the mixture with these parts of the second record and all others of the first."""
        # Parts that are equal in both records do not change the mixture.
        chosen = frozenset(p for p in self.different if exchanged.get(p, False))
        if chosen not in self.solutions:
            sources = self.choose(chosen)
            found = self.solutions[chosen] = solve_mixture(
                sources, self.pairing, self.records[0].velocity
            )
            if not found.is_solved and not self.warnings:
                self.warnings.append(
                    f"a mixture is solved to a relative residual of {found.relative:.0e} only"
                )
        return self.solutions[chosen]

    def choose(self, chosen: frozenset[str]) -> dict[str, StepRecord]:
        """Return the sources of a mixture; parts that differ in nothing come from the record of the rows."""
        a, b = self.records
        whole = b if self.different and chosen == self.different else a
        return {p: (b if p in chosen else a) if p in self.different else whole for p in PARTS}

    def solve_with_own_start(self) -> Mixture:
        """Return the exact step of the second record from its own velocity."""
        b = self.records[1]
        return solve_mixture(dict.fromkeys(PARTS, b), self.pairing)

    def divide(self, name: str, active: tuple[str, ...]) -> Part:
        """Return the part of an ingredient, and the parts within it."""
        others = [x for x in active if x != name]
        contexts = list(_iterate_contexts(others))
        changes, weights = [], []
        for context, weight in contexts:
            before = self.solve(expand(context)).velocity
            changes.append(self.solve(expand(context | {name: True})).velocity - before)
            weights.append(weight)
        mine = [p for p in INGREDIENTS[name] if p in self.different]
        parts = tuple(self.divide_within(p, mine, contexts) for p in mine) if len(mine) > 1 else ()
        if len(INGREDIENTS[name]) > 1 and not parts:
            parts = (_make_part(mine[0], changes, weights),)
        return _make_part(name, changes, weights, parts)

    def divide_within(
        self, part: str, mine: list[str], contexts: list[tuple[dict[str, bool], float]]
    ) -> Part:
        """Return the part within an ingredient, over the orders of the parts within it."""
        changes, weights = [], []
        for context, outer in contexts:
            for inner, weight in _iterate_contexts([x for x in mine if x != part]):
                before = expand(context) | inner
                velocity = self.solve(before).velocity
                changes.append(self.solve(before | {part: True}).velocity - velocity)
                weights.append(outer * weight)
        return _make_part(part, changes, weights)


def _make_part(
    name: str, changes: list[FloatArray], weights: list[float], parts: tuple[Part, ...] = ()
) -> Part:
    """Return a part from its changes; the first one is alone in a, the last one alone in b."""
    stacked = np.array(changes)
    return Part(name, np.array(weights) @ stacked, stacked, stacked[0], stacked[-1], parts)


def _iterate_contexts(names: list[str]) -> Iterator[tuple[dict[str, bool], float]]:
    """Yield the sets of names exchanged before, smallest first, and the fraction of all orders with this set."""
    n = len(names) + 1
    for size in range(n):
        weight = math.factorial(size) * math.factorial(n - size - 1) / math.factorial(n)
        for chosen in itertools.combinations(names, size):
            yield dict.fromkeys(chosen, True), weight


def expand(context: Mapping[str, bool]) -> dict[str, bool]:
    """Return the exchanged parts of exchanged ingredients; `context` may contain parts."""
    return {p: value for name, value in context.items() for p in INGREDIENTS.get(name, (name,))}


def find_different_parts(a: StepRecord, b: StepRecord, pairing: Pairing) -> frozenset[str]:
    """Return the parts of the step in which two records differ by a bit."""
    different = set()
    has_same_fluid = _are_equal(a.fluid, b.fluid)
    inertial = FLUID if has_same_fluid else ()
    if not a.uses_coriolis is b.uses_coriolis is None:
        inertial = (*inertial, "coriolis_matrix")
    arrays = {
        "mass": ("mass", "coriolis", "gravity_map", *inertial),
        "force": ("force", "gravity", "stiffness_matrix"),
        "damping": ("damping_matrix", "damping_force", *(() if has_same_fluid else FLUID)),
        "actuators": ("actuator_matrix", "actuator_force"),
        "method": ("integrator_matrix", "integrator_force", "velocity_change", "uses_coriolis"),
    }
    for part, names in arrays.items():
        if not all(_are_equal(getattr(a, x), getattr(b, x)) for x in names):
            different.add(part)
    flags = (
        "uses_damping", "uses_fluid", "uses_actuators", "uses_stiffness", "in_problem",
        "implicit_rows",
    )  # fmt: skip
    if any(getattr(a, x) != getattr(b, x) for x in flags):
        different.add("method")
    partners = pairing.partners[0]
    has_all = sorted(partners) == list(range(len(b.blocks)))
    if not has_all:
        alone = pairing.list_unmatched(0) + pairing.list_unmatched(1)
        different |= {"coefficient" if x.role == "friction" else "rows" for x in alone}
        # A row that only one step has may have another softness or friction by its lender.
        different |= {"reference", "compliance", "shape", "coefficient"}
    for x, j in zip(a.blocks, partners, strict=True):
        if j >= 0:
            different |= _find_different_parts_of_block(x, b.blocks[j])
    if a.law != b.law:
        different.add("law")
    return frozenset(different)


def _are_equal(x: FloatArray | None, y: FloatArray | None) -> bool:
    """Return whether two arrays are equal by the bit; a missing one is 0."""
    if x is None or y is None:
        return not any(np.any(z) for z in (x, y) if z is not None)
    return np.array_equal(x, y)


def _find_different_parts_of_block(x: ConstraintBlock, y: ConstraintBlock) -> set[str]:
    """Return the parts of the step in which two blocks differ."""
    different = set()
    if not np.array_equal(x.weight, y.weight):
        different.add("mass")
    k = min(len(x.jacobian), len(y.jacobian))
    if not (
        np.array_equal(x.jacobian[:k], y.jacobian[:k])
        and np.array_equal(x.gap, y.gap)
        and np.array_equal(_fill(x.surface_velocity, x.condim), _fill(y.surface_velocity, y.condim))
        and np.array_equal(_fill(x.bias, k), _fill(y.bias, k))
    ):
        different.add("rows")
    if (x.cone, x.condim) != (y.cone, y.condim) and x.role == "contact":
        different.add("shape")
    k = max(x.condim, y.condim) - 1
    if not np.array_equal(x.friction[:k], y.friction[:k]) or x.loss != y.loss:
        different.add("coefficient")
    return different | compare_softness(x.softness, y.softness)


def _fill(values: FloatArray | None, count: int) -> FloatArray:
    """Return the first `count` values (6,) of some rows; missing ones are 0."""
    filled = np.zeros(6)
    if values is not None:
        known = values[: min(count, 6)]
        filled[: len(known)] = known
    return filled


def compare_softness(x: Softness, y: Softness) -> set[str]:
    """Return which of "reference" and "compliance" differ between two softnesses."""
    if x.rule != y.rule or x.rule == "rates":
        same = x.rule == y.rule
        parts = set()
        if not (
            same and np.array_equal(x.rate, y.rate) and np.array_equal(x.stiffness, y.stiffness)
        ):
            parts.add("reference")
        if not (same and np.array_equal(x.compliance, y.compliance)):
            parts.add("compliance")
        return parts
    parts = set()
    reference = ("solref", "solref_friction", "shortest_time")
    if not all(np.array_equal(getattr(x, n), getattr(y, n)) for n in reference):
        parts.add("reference")
    if not all(
        np.array_equal(getattr(x, n), getattr(y, n)) for n in ("solimp", "impratio", "compliance")
    ):
        parts.add("compliance")
    return parts
