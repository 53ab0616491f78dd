"""Steps of MuJoCo 3.17 and of newton 1.8 (MuJoCo Warp), recorded from the same state of a gripper, without the engines.

MuJoCo 3.17 gives the fingers on slide joints another inverse mass than MuJoCo Warp 4.0, and newton uses implicitfast
whatever the file says. MuJoCo was also stepped with the inverse masses of newton, and with these and implicitfast.
"""

from pathlib import Path

import numpy as np
import pytest

import lavender as lv

FOLDER = Path(__file__).parent / "recorded"
# [m/s] newton is in float32; its velocities and forces have roundings of this size.
FLOAT32_TOLERANCE = 1e-6


def load(name):
    return lv.io.load_step(FOLDER / f"gripper_{name}.npz")


@pytest.fixture(scope="module")
def comparison():
    return lv.compare(load("mujoco_3.17.0_Euler"), load("newton_1.8.0"))


@pytest.mark.parametrize(("name", "exchanged"), [
    ("mujoco_3.17.0_weights", {"mass"}),
    ("mujoco_3.17.0_both", {"mass", "integrator"}),
])  # fmt: skip
def test_mixture_of_newton_equals_mujoco_with_just_that_switched(name, exchanged, comparison):
    bits = tuple(x in exchanged for x in comparison.active)
    switched = load(name).velocity_after
    np.testing.assert_allclose(
        comparison.mixtures[bits].velocity, switched, rtol=0, atol=FLOAT32_TOLERANCE
    )
    assert np.abs(switched - comparison.a.velocity_after).max() > 1e3 * FLOAT32_TOLERANCE


def test_recorded_newton_is_explained_by_its_own_problem(comparison):
    for name in ("solver", "lost digits", "rest", "state"):
        assert np.abs(comparison.parts[name].mean).max() < FLOAT32_TOLERANCE
    for name in ("force", "rows", "softness", "friction"):
        assert np.abs(comparison.parts[name].mean).max() < FLOAT32_TOLERANCE
    assert comparison.list_causes(np.eye(8)[0])[0] == "mass"


def test_facts_of_recorded_newton_name_the_inverse_mass_and_the_integrator(comparison):
    facts = {fact.part: fact.text for fact in comparison.facts}
    assert "with equal masses" in facts["mass"]
    assert "Euler and implicitfast" in facts["method"]


def test_align_step_gives_names_and_order_of_another_record():
    record = load("mujoco_3.17.0_Euler")
    order = np.random.default_rng(2).permutation(len(record.names))
    long = tuple(f"gripper/world/{record.names[i]}" for i in order)
    moved = lv.io.permute_velocities(record, order, long)
    again = lv.io.align_step(moved, record)
    assert again.names == record.names
    np.testing.assert_array_equal(again.mass, record.mass)
    assert not lv.compare(record, again).difference.any()
    with pytest.raises(lv.InputError, match="unique"):
        lv.io.align_step(record, lv.io.permute_velocities(record, order, tuple("abcdefgh")))
