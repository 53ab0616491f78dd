"""Steps of MuJoCo, of newton 1.8 (MuJoCo Warp) and of Genesis 1.4, recorded from equal states, without the engines.

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


#: Model -> options of Genesis 1.4.5 in float64 that were switched, with the ingredient that each one sets.
SWITCHED = {"timeconst": "softness", "Euler": "integrator", "both": "softness integrator"}


def load_genesis(model, name=""):
    return lv.io.load_step(FOLDER / f"{model}_genesis_1.4.5{'_' * bool(name)}{name}.npz")


@pytest.mark.parametrize("model", ["gripper", "arm", "sliding"])
def test_mixture_of_genesis_equals_genesis_with_just_that_switched(model):
    """constraint_timeconst 0.01 and 0.03 s, integrator approximate_implicitfast and Euler."""
    own = load_genesis(model)
    found = lv.compare(own, load_genesis(model, "both"))
    size = max(1.0, np.abs(own.velocity_after).max())
    for name, exchanged in SWITCHED.items():
        bits = tuple(x in exchanged.split() for x in found.active)
        switched = load_genesis(model, name).velocity_after
        # Two exact solutions in float64, of velocities of this size.
        np.testing.assert_allclose(
            found.mixtures[bits].velocity, switched, rtol=0, atol=1e-13 * size
        )
    for name in ("solver", "lost digits", "rest", "state"):
        assert np.abs(found.parts[name].mean).max() < 1e-13 * size
    assert set(found.active) == {"softness", "integrator"}
    assert np.abs(found.parts["softness"].mean).max() > 1e-2


def test_arm_of_genesis_and_mujoco_differs_by_settings_that_the_text_names():
    """Genesis has no limits of ball joints, adds an armature of 0.1 to the elbow, and replaces a missing solref."""
    found = lv.compare(lv.io.load_step(FOLDER / "arm_mujoco_4.0.0.npz"), load_genesis("arm"))
    text = str(found)
    assert "mass of elbow: 0.06996 and 0.17 kg m2" in text
    assert "1 limit only MuJoCo has: limit of wrist" in text
    assert "Genesis uses constraint_timeconst=0.01 where the file gives no solref" in text
    assert "constraint_timeconst=0.02" in found.proposals[0].text
    np.testing.assert_allclose(
        sum(p.mean for p in found.parts.values()), found.difference, rtol=0, atol=1e-12
    )


def test_tumbling_box_of_genesis_follows_the_midpoint_rule():
    """The box has its centre of mass at its joint; the rod beside it does not, and leaves a rest."""
    record = load_genesis("tumble")
    rest = record.velocity_after - record.own_velocity
    assert record.velocity_change is not None and np.abs(record.velocity_change[:6]).max() > 1e-5
    assert np.abs(rest[:6]).max() < 1e-13 < 1e-5 < np.abs(rest[6:]).max()


#: Recorded velocities of an engine with ingredients of the other one: "model/engine/ingredients".
SWITCHED_MODELS = dict(np.load(FOLDER / "switched.npz"))


@pytest.mark.parametrize("key", SWITCHED_MODELS)
def test_mixture_of_two_engines_equals_one_with_settings_of_the_other(key):
    """A hand with a ball, a leg on the ground and a cart with a gear and a weld, of MuJoCo, Genesis and newton.

    Genesis has MuJoCo's solref or integrator; or MuJoCo ("from ...") has the solref, the armature and inverse masses,
    or the integrator of the other engine.
    """
    model, engine, exchanged = key.split("/")
    is_first, name = engine.startswith("from "), engine.split()[-1]
    version = {"genesis": "1.4.5", "newton": "1.8.0"}[name]
    own = lv.io.load_step(FOLDER / f"{model}_mujoco_4.0.0.npz")
    found = lv.compare(own, lv.io.load_step(FOLDER / f"{model}_{name}_{version}.npz"))
    assert set(exchanged.split()) <= set(found.active)
    bits = tuple((x in exchanged.split()) == is_first for x in found.active)
    size = np.abs(SWITCHED_MODELS[key]).max()
    # newton is in float32, whose rounding the bob of the cart, which weighs little, shows most.
    tolerance = {"genesis": 1e-14, "newton": 3e-6}[name] * max(1.0, size)
    velocity = found.mixtures[bits].velocity
    np.testing.assert_allclose(velocity, SWITCHED_MODELS[key], rtol=0, atol=tolerance)
    changed = (found.a if is_first else found.b).velocity_after
    assert np.abs(SWITCHED_MODELS[key] - changed).max() > 1e2 * tolerance
    for left in ("solver", "lost digits", "rest", "state"):
        assert np.abs(found.parts[left].mean).max() < 4.0 * tolerance


def test_equalities_of_other_names_are_matched_by_their_rows():
    """newton gives equalities without names, and Genesis their gaps."""
    own = lv.io.load_step(FOLDER / "cart_mujoco_4.0.0.npz")
    for name in ("newton_1.8.0", "genesis_1.4.5"):
        found = lv.compare(own, lv.io.load_step(FOLDER / f"cart_{name}.npz"))
        assert not found.pairing.list_unmatched(0) and not found.pairing.list_unmatched(1)
        assert "rows" not in {x.part for x in found.facts}
        rows = found.parts.get("rows")
        assert rows is None or np.abs(rows.changes).max() < 2e-5
    text = str(lv.compare(own, lv.io.load_step(FOLDER / "cart_newton_1.8.0.npz")))
    assert "compliance of equality load: 2.54 and 1.799 1/kg, with equal masses" in text


@pytest.mark.parametrize("model", ["hand", "leg", "cart"])
def test_recorded_mujoco_equals_the_installed_version(model):
    pytest.importorskip("mujoco", minversion="3.3")
    from lavender.causes.states import compare_at_states

    stored = FOLDER / f"{model}_mujoco_4.0.0.npz"
    other = FOLDER.parent / "models" / f"{model}.xml"
    (found,) = compare_at_states(stored, other)[0].states
    assert np.abs(found.comparison.difference).max() < 1e-13
    assert not found.comparison.facts
