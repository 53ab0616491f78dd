"""Records of steps: files, refusals, and orders of contacts and velocities."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco", minversion="4.0")
import mujoco
import planted_changes as planted

import lavender as lv


def read(name="gripper", *changes, integrator="Euler", cone="pyramidal"):
    return lv.io.step_from_mujoco(*planted.load(name, integrator, cone, *changes))


@pytest.mark.parametrize("name", planted.OWN)
def test_saved_step_is_read_bit_for_bit(name, tmp_path):
    record = read(name)
    lv.io.save_step(record, tmp_path / "step.npz")
    again = lv.io.load_step(tmp_path / "step.npz")
    found = lv.compare(record, again)
    assert not found.active and not found.difference.any()
    assert str(lv.compare(again)) == str(lv.compare(record))


@pytest.mark.parametrize("name", ["gripper", "ball"])
@pytest.mark.parametrize("change", ["solref", "mu", "mass of one body"])
def test_order_of_contacts_does_not_change_parts(name, change):
    a, b = read(name), read(name, planted.CHANGES[name][change][0])
    order = np.random.default_rng(4).permutation(len(b.blocks))
    moved = replace(b, blocks=tuple(b.blocks[i] for i in order))
    before, after = lv.compare(a, b), lv.compare(a, moved)
    for key in before.parts:
        np.testing.assert_allclose(
            after.parts[key].mean, before.parts[key].mean, rtol=0, atol=1e-10
        )


def test_order_of_velocities_does_not_change_parts():
    a, b = read(), read("gripper", planted.CHANGES["gripper"]["solref"][0])
    order = np.random.default_rng(5).permutation(len(a.names))
    names = tuple(a.names[i] for i in order)
    one, two = (lv.io.permute_velocities(x, order, names) for x in (a, b))
    before, after = lv.compare(a, b), lv.compare(one, two)
    for key in before.parts:
        np.testing.assert_allclose(
            after.parts[key].mean, before.parts[key].mean[order], rtol=0, atol=1e-10
        )


def push_without_rows(force, damping):
    """Compare an arm without constraints with itself under two more forces on its first joint."""
    record = read("arm", cone="elliptic")
    row = np.eye(len(record.names))[0]
    push = record.mass @ row
    pushed = replace(
        record,
        force=record.force + force * push,
        damping_force=record.damping_force + damping * push,
    )
    plain, pushed = (
        replace(x, velocity_after=x.velocity_of([]), acceleration=None, moved_by="forces")
        for x in (replace(record, blocks=()), replace(pushed, blocks=()))
    )
    return lv.compare(plain, pushed), row


def test_causes_that_cancel_are_said_before_a_cause():
    found, _ = push_without_rows(100.0, -99.0)
    assert "they cancel" in str(found).splitlines()[1]


def test_two_equal_causes_are_both_named():
    found, row = push_without_rows(1.0, 1.0)
    assert set(found.list_causes(row)) == {"force", "integrator"}


@pytest.mark.parametrize(("change", "words"), [
    (lambda r: replace(r, dt=0.001), "time step"),
    (lambda r: replace(r, velocity=r.velocity + 0.1), "before the step"),
    (lambda r: replace(r, names=("x", *r.names[1:])), "different names"),
    (lambda r: replace(r, position=r.position + 0.1), "start from the same state"),
])  # fmt: skip
def test_compare_refuses_another_step(change, words):
    record = read()
    with pytest.raises(lv.InputError, match=words):
        lv.compare(record, change(record))


@pytest.mark.parametrize(("call", "words"), [
    (lambda r: lv.compare(1), "a is a int"),
    (lambda r: lv.compare(r, "step.npz"), "b is a str"),
    (lambda r: lv.io.save_step(r, "step.txt"), r"\.npz is needed"),
    (lambda r: lv.io.save_step(1, "step.npz"), "record is a int"),
    (lambda r: lv.io.permute_velocities(r, [0] * len(r.names), r.names), "velocities of the record once"),
    (lambda r: lv.io.load_step(__file__), "is not a step record"),
    (lambda r: lv.io.step_from_mujoco(1, 2), "mujoco.MjModel"),
])  # fmt: skip
def test_wrong_arguments_are_named(call, words):
    with pytest.raises(lv.InputError, match=words):
        call(read())


def test_compare_refuses_another_model():
    with pytest.raises(lv.InputError, match="velocities"):
        lv.compare(read("gripper"), read("arm"))


def test_step_of_runge_kutta_is_refused():
    model, data = planted.load("arm", "Euler", "elliptic")
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    with pytest.raises(lv.CapabilityError, match="RK4"):
        lv.io.step_from_mujoco(model, data)


def test_text_of_equal_steps_says_so():
    record = read()
    assert "equal to rounding" in str(lv.compare(record, record))


def test_text_names_the_settings_that_differ_and_checks_what_to_try():
    a, b = read(), read("gripper", planted.CHANGES["gripper"]["solref"][0])
    text = str(lv.compare(a, b))
    assert "solref 0.02 1 and solref 0.03 0.8" in text
    assert 'solref="0.02 1" (solved: the largest difference falls by 100 %' in text


def test_contact_that_one_model_lacks_has_the_settings_of_its_geoms_there():
    """The peg touches the floor only with the margin; without it, its condim there is known by its geoms."""
    condim = planted.CHANGES["ball"]["condim 3"][0]
    margin = planted.CHANGES["ball"]["margin"][0]
    steps = [
        read("ball", *x, integrator="discrete", cone="elliptic")
        for x in ((), (condim,), (margin,), (condim, margin))
    ]
    none, one, two, both = (x.velocity_after for x in steps)
    found = lv.compare(steps[0], steps[3])
    assert len(steps[3].blocks) > len(steps[0].blocks) and not found.pairing.list_unknown(1)
    expected = 0.5 * ((one - none) + (both - two))
    # MuJoCo turns free bodies without contact by implicit gyroscopic forces.
    np.testing.assert_allclose(found.parts["friction"].mean, expected, rtol=0, atol=1e-5)
    assert np.abs(expected).max() > 0.1


def test_two_steps_of_one_engine_have_different_names():
    a, b = read(), read("gripper", planted.CHANGES["gripper"]["solref"][0])
    assert "first MuJoCo" in str(lv.compare(a, b)) and "second MuJoCo" in str(lv.compare(a, b))
