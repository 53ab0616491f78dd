"""Records of steps: files, refusals, and orders of contacts and velocities."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco", minversion="4.0")
import mujoco
import planted_changes as planted

import lavender as lv
from lavender.causes.problems import problem_of_record


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


BALL_AND_FREE = """<mujoco><option integrator="{}"/><worldbody>
<body><joint name="ball" type="ball" stiffness="30" damping="0.3"/><geom size="0.1" pos="0.2 0 0"/></body>
<body pos="1 0 1"><joint name="free" type="free" stiffness="20" damping="0.1"/>
<geom size="0.1 0.2 0.3" type="ellipsoid"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "implicit", "discrete"])
@pytest.mark.parametrize(("array", "at", "value", "cause"), [
    ("jnt_stiffness", (0, ...), 60.0, "force"),
    ("jnt_stiffness", (1, ...), 50.0, "force"),
    ("opt.viscosity", (), 1.0, "integrator"),
    ("opt.density", (), 100.0, "integrator"),
])  # fmt: skip
def test_springs_are_forces_and_fluids_are_dampings(integrator, array, at, value, cause):
    def change(model, data):
        data.qpos[:3] += 0.3
        mujoco.mj_integratePos(model, data.qpos, np.linspace(-0.3, 0.3, model.nv), 1.0)
        if on:
            owner, _, name = array.rpartition(".")
            if owner:
                setattr(model.opt, name, value)
            else:
                getattr(model, name)[at] = value

    on = False
    one = read_text(BALL_AND_FREE.format(integrator), change)
    on = True
    found = lv.compare(one, read_text(BALL_AND_FREE.format(integrator), change))
    size = np.abs(found.difference).max()
    assert size > 1e-5
    # MuJoCo's "discrete" turns free bodies by implicit gyroscopic forces, which the springs' matrix changes.
    for name, part in found.parts.items():
        assert name == cause or np.abs(part.mean).max() < 0.01 * size, name


CONNECT = '<connect body1="b" anchor="0.4 0 0.01" solref="0.05 1"/>'
SECOND_CONNECT = '<connect body1="b" anchor="0.1 0 0.02" solref="0.03 1"/>'
WELD = '<weld body1="b" solref="0.1 1"/>'
COUPLING = '<joint joint1="j" joint2="k" polycoef="0.1 1 0 0 0"/>'
ARM = """<mujoco><option integrator="%s"/><worldbody>
<body name="a" pos="0 0 1"><joint name="j" axis="0 1 0"/><geom size="0.05" pos="0.2 0 0"/>
<body name="b" pos="0.4 0 0"><joint name="k" axis="0 1 0"/><geom size="0.05" pos="0.2 0 0"/></body></body>
</worldbody><equality>%s</equality></mujoco>"""


def shift(model, data):
    data.qpos[:] += [0.1, -0.05]


@pytest.mark.parametrize("integrator", ["Euler", "discrete"])
@pytest.mark.parametrize("equality", [CONNECT, WELD, COUPLING])
def test_equality_that_is_off_has_the_weight_of_the_other_masses(integrator, equality):
    def read_arm(factor, is_active):
        def change(model, data):
            shift(model, data)
            model.body_mass[1] *= factor
            model.body_inertia[1] *= factor
            mujoco.mj_setConst(model, mujoco.MjData(model))
            data.eq_active[0] = is_active

        return read_text(ARM % (integrator, equality), change)

    steps = [read_arm(*x) for x in ((1, True), (3, True), (1, False), (3, False))]
    none, mass, off, both = (x.velocity_after for x in steps)
    parts = lv.compare(steps[0], steps[3]).parts
    for name, alone, last in (("mass", mass - none, both - off), ("rows", off - none, both - mass)):
        np.testing.assert_allclose(parts[name].mean, 0.5 * (alone + last), rtol=0, atol=1e-10)
        assert np.abs(alone - last).max() > 1e-4


def test_order_of_equalities_without_names_changes_nothing():
    own = [CONNECT, SECOND_CONNECT, WELD, COUPLING]
    one = read_text(ARM % ("Euler", "".join(own)), shift)
    other = read_text(ARM % ("Euler", "".join(own[::-1])), shift)
    found = lv.compare(one, other)
    assert not found.pairing.list_unmatched(0) and not found.facts
    assert max(np.abs(p.changes).max() for p in found.parts.values()) < 1e-9


@pytest.mark.parametrize("by_actuators", ["false", "true"])
def test_compensated_gravity_belongs_to_masses(by_actuators):
    text = f"""<mujoco><worldbody><body name="a" pos="0 0 1" gravcomp="0.7"><joint name="j" axis="0 1 0"
    actuatorgravcomp="{by_actuators}"/><geom size="0.05" pos="0.2 0 0"/></body></worldbody>
    <actuator><position joint="j" kp="3"/></actuator></mujoco>"""

    def change(model, data):
        data.qpos[:] = 0.4  # The actuator pulls.
        model.body_mass[1] *= factor
        model.body_inertia[1] *= factor

    factor = 1
    light = read_text(text, change)
    factor = 3
    found = lv.compare(light, read_text(text, change))
    assert np.abs(found.difference).max() > 1e-3
    others = [p.changes for name, p in found.parts.items() if name != "mass"]
    assert max(np.abs(x).max() for x in others) < 1e-12


def test_another_ref_is_refused():
    text = """<mujoco><worldbody><body><joint name="j" axis="0 1 0" ref="{}"/><geom size="0.1" pos="1 0 0"/></body>
    </worldbody></mujoco>"""

    def set_position(model, data):
        data.qpos[:] = 0.1

    with pytest.raises(lv.InputError, match=r"ref of j is 0 in a and 0\.349066 in b"):
        lv.compare(*(read_text(text.format(x), set_position) for x in (0, 20)))


def test_data_of_another_model_are_refused():
    one, other = (mujoco.MjModel.from_xml_string(x) for x in (ARM % ("Euler", ""), TILTED_BOX % ""))
    same_size = mujoco.MjModel.from_xml_string(ARM % ("Euler", CONNECT + WELD))
    for model, data in ((one, other), (other, one), (one, same_size)):
        with pytest.raises(lv.InputError, match=r"belong"):
            lv.io.step_from_mujoco(model, mujoco.MjData(data))


def test_causes_that_leave_no_difference_are_said():
    found, _ = push_without_rows(100.0, -100.0)
    text = str(found).splitlines()
    assert "they cancel" in text[1] and "equal to rounding" in text[2]


@pytest.mark.parametrize("solver", ["CG", "PGS"])
def test_solver_that_stops_early_has_lost_no_digits(solver):
    boxes = "".join(
        f'<body pos="0 0 {0.049 + 0.098 * i}"><freejoint/>'
        f'<geom type="box" size=".05 .05 .05" mass="{1 + 5 * i}"/></body>'
        for i in range(3)
    )
    text = f"""<mujoco><option integrator="implicitfast" iterations="1" solver="{solver}"/><worldbody>
    <geom type="plane" size="3 3 .1"/>{boxes}</worldbody></mujoco>"""
    parts = lv.compare(read_text(text)).parts
    assert np.abs(parts["solver"].mean).max() > 1e-3 and not parts["lost digits"].mean.any()


@pytest.mark.parametrize(
    ("integrator", "cone"),
    [
        ("Euler", "pyramidal"),
        ("implicitfast", "elliptic"),
        ("discrete", "elliptic"),
        ("discrete", "pyramidal"),
    ],
)
@pytest.mark.parametrize("name", ["gripper", "sliding", "arm", "tendon", "ball"])
def test_problem_of_a_record_is_the_problem_that_mujoco_solves(name, integrator, cone):
    """Its matrix and right side are those of `from_mujoco`, and MuJoCo's own impulses move it to MuJoCo's velocity."""
    model, data = planted.load(name, integrator, cone)
    record = lv.io.step_from_mujoco(model, data)
    mujoco.mj_forward(model, data)
    own, impulse = lv.io.from_mujoco(model, data), lv.io.mujoco.impulse(model, data)
    step = problem_of_record(record)
    matrix, right = own.dense(), np.abs(own.b).max()
    # Rates and compliances are computed from settings, and M + H from a measured inverse.
    np.testing.assert_allclose(
        step.problem.dense(), matrix, rtol=0, atol=1e-9 * np.abs(matrix).max()
    )
    np.testing.assert_allclose(step.problem.b, own.b, rtol=0, atol=1e-9 * max(1.0, right))
    np.testing.assert_allclose(
        step.velocity_of(impulse), record.velocity_after, rtol=0,
        atol=1e-9 * max(1.0, np.abs(record.velocity_after).max()),
    )  # fmt: skip


@pytest.mark.parametrize("condim", [3, 4])
def test_wheel_under_its_axle_has_causes(condim):
    """The contact hardly moves the wheel, so that MuJoCo's compliance of its rows is 1e-15."""
    text = f"""<mujoco><option tolerance="0" iterations="200"/><worldbody><geom type="plane" size="9 9 .1"/>
    <body pos="0 0 .0495"><joint axis="0 1 0" frictionloss=".1"/><geom size=".05" mass="1" condim="{condim}"/></body>
    </worldbody></mujoco>"""
    found = lv.compare(read_text(text))
    total = sum(p.mean for p in found.parts.values())
    np.testing.assert_allclose(total, found.difference, rtol=0, atol=1e-12)
    assert np.abs(found.parts["softness"].mean).max() > 0.1
    # Rounding of such rows in float64.
    assert np.abs(found.parts["solver"].mean).max() < 1e-6


PRESSED = """<mujoco><option timestep="0.002" cone="elliptic" integrator="{integrator}" tolerance="0" iterations="200"/>
<worldbody><geom type="plane" size="50 5 .1" friction=".5"/><body pos="0 0 {height}" euler="0 0 {turn}">
<joint {joint}/><geom type="{shape}" size="{size}" mass="1" friction=".5" condim="{condim}"/></body></worldbody>
</mujoco>"""


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "discrete"])
@pytest.mark.parametrize("condim", [1, 3, 6])
@pytest.mark.parametrize("turn", [0, 37])
@pytest.mark.parametrize(
    "joint", ['axis="0 1 0"', 'axis="0 1 0" pos="0 0 .3"', 'type="slide" axis="1 0 0"']
)
@pytest.mark.parametrize(
    ("shape", "size", "height"),
    [("sphere", ".1", 0.0999), ("box", ".1 .1 .1", 0.0999), ("cylinder", ".1 .05", 0.0499)],
)
def test_contact_that_hardly_moves_its_body_blames_no_converged_solver(
    shape, size, height, joint, turn, condim, integrator
):
    """Its rows, or its normal, have J near 0 and R of 1e-15: forces of 1e14 N have no digits, accelerations have."""
    text = PRESSED.format(
        shape=shape, size=size, height=height, joint=joint, turn=turn, condim=condim,
        integrator=integrator,
    )  # fmt: skip
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qvel[0] = 1.0
    found = lv.compare(lv.io.step_from_mujoco(model, data))
    parts = {name: np.abs(part.mean).max() for name, part in found.parts.items()}
    # Raised compliances change the exact velocity by 1e-8 of itself.
    assert parts["solver"] < 1e-7 and parts["rest"] < 1e-7
    assert integrator == "implicitfast" or parts["lost digits"] < 1e-7
    total = sum(part.mean for part in found.parts.values())
    np.testing.assert_allclose(total, found.difference, rtol=0, atol=1e-12)


def test_rigid_row_that_moves_nothing_is_no_unsolved_mixture():
    """A slide cannot move along the normal of its contact, so that no impulse satisfies this row."""
    values = {"shape": "sphere", "size": ".1", "height": 0.0999, "turn": 0, "condim": 3}
    text = PRESSED.format(integrator="Euler", joint='type="slide" axis="1 0 0"', **values)
    assert not lv.compare(read_text(text, lambda model, data: None)).warnings


SHORT = """<mujoco><option timestep="0.01" cone="{cone}" integrator="{integrator}" tolerance="0" iterations="200"/>
<worldbody><geom type="plane" size="3 3 .1" solref="{solref}"/>
<body pos="0 0 .0992"><freejoint/><geom type="sphere" size=".1" mass="1" solref="{solref}"/></body>
<body pos="1 0 1"><joint name="j" axis="0 1 0" range="-10 10" limited="true" solreflimit="{solref}" frictionloss="1"
solreffriction="{solref}"/><geom size=".1" pos=".2 0 0"/></body>
<body pos="2 0 1"><joint name="k" axis="0 1 0"/><geom size=".1" pos=".2 0 0"/></body></worldbody>
<equality><joint joint1="k" solref="{solref}"/></equality></mujoco>"""


def read_short(cone, integrator, solref):
    text = SHORT.format(cone=cone, integrator=integrator, solref=solref)

    def turn(model, data):
        data.qpos[-2:] = 0.5, 0.02

    return read_text(text, turn)


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
@pytest.mark.parametrize("solref", ["0.004 1", "0.004 0.4", "0.012 2", "-4e4 -100"])
def test_shortest_time_of_a_solref_belongs_to_the_integrator(cone, solref):
    """Euler's method does not use time constants below two steps; `discrete` has another rule for each kind of row."""
    pair = [read_short(cone, x, solref) for x in ("Euler", "discrete")]
    for record in pair:
        assert {x.softness.rule for x in record.blocks} == {"impedance"}
        roles = {"contact", "limit", "friction", "equality"}
        assert {x.role for x in record.blocks} == roles
        exact = lv.compare(record, record).exact_a
        np.testing.assert_allclose(exact, record.velocity_after, rtol=0, atol=1e-9)
    found = lv.compare(*pair)
    others = [p.mean for name, p in found.parts.items() if name != "integrator"]
    assert np.abs(found.difference).max() > 1e-3 and np.abs(others).max() < 1e-9


SLIDER = """<mujoco><option timestep="0.01" gravity="{pull} 0 0"/><worldbody><body>
<joint name="x" type="slide" axis="1 0 0" frictionloss="{loss}"/><geom type="sphere" size=".1" mass="1"/>
</body></worldbody></mujoco>"""


@pytest.mark.parametrize(("pull", "total"), [(-1.0, -0.02), (1.0, 0.0)])
def test_two_equal_causes_are_both_named_and_cancelling_ones_are_said(pull, total):
    """1 N more dry friction, which a sliding body feels in full, and 1 N of weight on 1 kg: 0.01 m/s each in a step."""
    a, b = (
        read_text(SLIDER.format(pull=x, loss=y), lambda model, data: data.qvel.fill(5.0))
        for x, y in ((0.0, 1.0), (pull, 2.0))
    )
    found = lv.compare(a, b)
    assert found.difference[0] == pytest.approx(total, abs=1e-14)
    assert found.parts["friction"].mean[0] == pytest.approx(-0.01, abs=1e-14)
    assert found.parts["force"].mean[0] == pytest.approx(0.01 * pull, abs=1e-14)
    if total:
        assert set(found.list_causes(np.ones(1))) == {"force", "friction"}
    else:
        assert "they cancel" in str(found)
