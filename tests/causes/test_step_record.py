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


TILTED_BOX = """
<mujoco><worldbody>%s<geom type="plane" size="3 3 0.1" friction="0.3"/>
  <body pos="0 0 0.0505"><freejoint name="box"/>
    <geom type="box" size="0.05 0.05 0.05" mass="1" euler="0 4 0" friction="0.3"/></body>
</worldbody></mujoco>"""
MARKER = '<body pos="3 0 3"><geom size="0.01" contype="0" conaffinity="0"/></body>'


def read_text(text, change=lambda model, data: None):
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qvel[:6] = np.resize([0.3, 0.1, -0.2, 0.1, 0.2, 0.3], model.nv)[:6]
    change(model, data)
    return lv.io.step_from_mujoco(model, data)


def test_positions_follow_the_order_of_velocities():
    bodies = [f'<body name="{x}" pos="{i} 0 0"><freejoint name="free {x}"/><geom size="0.1"/></body>'
              for i, x in enumerate("ab")]  # fmt: skip
    hinge = '<body pos="0 3 0"><joint name="hinge" ref="40"/><geom size="0.1" pos="1 0 0"/></body>'
    text = "<mujoco><worldbody>%s</worldbody></mujoco>"

    def stop(model, data):
        data.qvel[:] = 0.0

    a = read_text(text % (bodies[0] + hinge + bodies[1]), stop)
    b = read_text(text % (bodies[1] + bodies[0] + hinge), stop)
    order = [b.names.index(x) for x in a.names]
    moved = lv.io.permute_velocities(b, order, a.names)
    np.testing.assert_array_equal(moved.position, a.position)
    assert not lv.compare(a, moved).difference.any()
    back = lv.io.permute_velocities(moved, np.argsort(order), b.names)
    np.testing.assert_array_equal(back.position, b.position)
    unknown = lv.io.permute_velocities(replace(b, position_owner=None), order, a.names)
    assert unknown.position is None and not lv.compare(a, unknown).difference.any()


def test_body_without_rows_changes_no_part():
    """The marker renumbers the bodies and geoms without a name; it touches nothing and is not seen in the motion."""
    found = lv.compare(read_text(TILTED_BOX % ""), read_text(TILTED_BOX % MARKER))
    assert not found.pairing.list_unmatched(0) and not found.pairing.list_unmatched(1)
    # Both solutions of MuJoCo are equal; the inverses of six velocities differ by rounding.
    assert max(np.abs(p.changes).max() for p in found.parts.values()) < 1e-9


def test_contact_that_one_model_lacks_has_the_settings_of_its_geoms_behind_a_marker():
    def widen(model, data):
        model.geom_margin[:] = 0.01
        model.geom_friction[:, 0] = 0.3

    one = read_text(TILTED_BOX % "")
    other = read_text(TILTED_BOX % MARKER, widen)
    found = lv.compare(one, other)
    alone = found.pairing.list_unmatched(1)
    assert alone and np.abs(found.parts["friction"].changes).max() < 1e-9
    assert all(found.pairing.make_unmatched(one, x).friction[0] == 0.3 for x in alone)


def override(model, data):
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_OVERRIDE)
    model.opt.o_solref[:] = 0.05, 1.0
    model.opt.o_solimp[:] = 0.8, 0.9, 0.002, 0.4, 3.0
    model.opt.o_friction[:] = 0.2, 0.25, 0.01, 0.0, 0.001


@pytest.mark.parametrize("change", [lambda model, data: None, override])
def test_made_contact_has_the_settings_that_mujoco_gives_it(change):
    """The rule of geoms, or MuJoCo's override of it, against the contacts that MuJoCo makes."""
    record = read_text(TILTED_BOX % "", change)
    assert record.blocks
    for block in record.blocks:
        made = lv.compare(record, record).pairing.make_unmatched(record, block)
        assert made.condim == block.condim
        np.testing.assert_array_equal(made.friction, block.friction)
        for name in ("solref", "solref_friction", "solimp"):
            # A mean of two equal numbers, rounded.
            np.testing.assert_allclose(
                getattr(made.softness, name), getattr(block.softness, name), rtol=1e-15
            )


def test_margin_of_the_override_changes_rows_only():
    def widen(model, data):
        override(model, data)
        model.opt.o_margin = 0.01

    found = lv.compare(read_text(TILTED_BOX % "", override), read_text(TILTED_BOX % "", widen))
    assert found.pairing.list_unmatched(1) and np.abs(found.difference).max() > 0.1
    for name in ("softness", "friction"):
        assert name not in found.parts or np.abs(found.parts[name].changes).max() < 1e-9


def test_each_position_has_its_own_tolerance():
    record = read_text(TILTED_BOX % "")
    axes = np.eye(7)
    far = record.position + (1000.0 + 1e-3 * np.pi) * axes[0]
    near = far + 1e-5 * axes[2]
    with pytest.raises(lv.InputError, match="position 2 is"):
        lv.compare(replace(record, position=far), replace(record, position=near))
    # float32 rounds the first position by up to 3e-5 m.
    rounded = far.astype(np.float32).astype(float)
    assert np.abs(rounded - far).max() > 1e-6
    lv.compare(replace(record, position=far), replace(record, position=rounded))


def test_both_quaternions_of_a_rotation_are_one_state():
    def turn(sign):
        def change(model, data):
            data.qpos[3:7] = sign * np.array([0.0, 0.6, 0.0, 0.8])

        return read_text(TILTED_BOX % "", change)

    one, other = turn(1.0), turn(-1.0)
    assert np.abs(lv.compare(one, other).difference).max() < 1e-9  # Rounding.
    wrong = replace(other, position=other.position * [1, 1, 1, 1, -1, 1, 1])
    with pytest.raises(lv.InputError, match="start from the same state"):
        lv.compare(one, wrong)
