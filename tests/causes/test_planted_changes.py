"""Each change that is planted in a model has its own name as cause, with the size that MuJoCo itself shows."""

import itertools

import numpy as np
import pytest

pytest.importorskip("mujoco", minversion="4.0")
import planted_changes as planted

import lavender as lv

MODES = list(
    itertools.product(("Euler", "implicitfast", "implicit", "discrete"), ("elliptic", "pyramidal"))
)
MAX_OTHER_PART = (
    1e-7  # [-] Largest part of another cause: rounding of H, which is the inverse of an inverse.
)
# [-] The same of "discrete", which integrates the rotation of a body by another rule if a change of rows frees it.
MAX_DISCRETE_PART = 1e-4
# [m/s, rad/s] Smallest change with a cause: MuJoCo's solver leaves up to 1e-11 at tolerance 0.
MIN_CHANGE = 1e-9
# [-] Of the changes, and absolute: two exact solutions and the inverses of up to 15 velocities differ by roundings.
TOLERANCE = 1e-8
# The forces of a fluid on other inertias are not known: with a change of masses, all of it is named `integrator`.
FLUID = {"density", "viscosity", "wind"}
PAIRS_OF_MODEL = 3  # Drawn pairs of each model and mode.


class Steps:
    """Steps of one model with changes, each read once."""

    def __init__(self, name, integrator, cone):
        self.where = name, integrator, cone
        self.known = {}

    def read(self, *names):
        key = frozenset(names)
        if key not in self.known:
            changes = [planted.CHANGES[self.where[0]][name][0] for name in names]
            model, data = planted.load(*self.where, *changes)
            self.known[key] = lv.io.step_from_mujoco(model, data)
        return self.known[key]


@pytest.mark.parametrize(("integrator", "cone"), MODES)
@pytest.mark.parametrize("name", planted.OWN)
def test_compare_of_one_planted_change_names_its_cause_with_its_size(name, integrator, cone):
    steps = Steps(name, integrator, cone)
    base, seen = steps.read(), 0
    for change, (_, cause) in planted.CHANGES[name].items():
        found = lv.compare(base, steps.read(change))
        size = np.abs(found.difference).max()
        if size < MIN_CHANGE:
            continue
        seen += 1
        parts = {key: part.mean for key, part in found.parts.items()}
        total = sum(parts.values())
        np.testing.assert_allclose(total, found.difference, rtol=0, atol=1e-14, err_msg=change)
        others = [np.abs(x).max() for key, x in parts.items() if key != cause]
        limit = MAX_DISCRETE_PART if integrator == "discrete" else MAX_OTHER_PART
        assert max(others) <= limit * size, (change, parts)
        row = np.eye(len(total))[np.argmax(np.abs(found.difference))]
        assert found.list_causes(row)[0] == cause, change
        assert not found.warnings, change
    assert seen >= 7


@pytest.mark.parametrize(("integrator", "cone"), MODES)
@pytest.mark.parametrize("name", planted.OWN)
def test_compare_of_two_planted_changes_has_the_parts_of_four_steps_of_mujoco(
    name, integrator, cone
):
    steps = Steps(name, integrator, cone)
    changes = planted.CHANGES[name]
    pairs = [
        pair for pair in itertools.combinations(changes, 2)
        if changes[pair[0]][1] != changes[pair[1]][1] and "noslip" not in pair
        and not (FLUID & set(pair) and "mass" in {changes[x][1] for x in pair})
    ]  # fmt: skip
    order = np.random.default_rng(len(pairs)).permutation(len(pairs))[:PAIRS_OF_MODEL]
    for first, second in (pairs[i] for i in order):
        none, one, two, both = (
            steps.read(*names).velocity_after
            for names in ((), (first,), (second,), (first, second))
        )
        found = lv.compare(steps.read(), steps.read(first, second))
        size = max(np.abs(both - none).max(), np.abs(one - none).max(), np.abs(two - none).max())
        for name_of_change, alone, last in (
            (first, one - none, both - two),
            (second, two - none, both - one),
        ):
            part = found.parts.get(changes[name_of_change][1])
            zero = np.zeros_like(none)
            mean = zero if part is None else part.mean
            limit = MAX_DISCRETE_PART * size if integrator == "discrete" else 0.0
            limit = max(limit, TOLERANCE)
            np.testing.assert_allclose(
                mean, 0.5 * (alone + last), rtol=0, atol=limit, err_msg=f"{first} and {second}"
            )
            low, high = (zero, zero) if part is None else (part.changes.min(0), part.changes.max(0))
            for change in (alone, last):
                assert (change >= low - limit).all(), (first, second)
                assert (change <= high + limit).all(), (first, second)
