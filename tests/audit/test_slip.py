"""The cause of slip of scenes whose answer is known."""

import re
from pathlib import Path

import numpy as np
import pytest
from mujoco_scene import get_state
from mujoco_scene import mj as mujoco

import lavender as lv
from lavender.audit.slip import CAUSES, REMEDY_STEPS, explain_slip
from lavender.audit.slip_states import CAUSE_COLORS, explain_slip_of_states

GRAVITY = 9.81


def block(angle, friction=0.5, option="", condim=3):
    """A box on a slope of this angle [rad], as a plane under tilted gravity."""
    return mujoco.MjModel.from_xml_string(f"""<mujoco>
      <option timestep="0.002" gravity="{GRAVITY * np.sin(angle)} 0 {-GRAVITY * np.cos(angle)}" {option}/>
      <default><geom friction="{friction} 0.005 0.0001" condim="{condim}"/></default>
      <worldbody><geom name="slope" type="plane" size="50 50 .1"/>
      <body pos="0 0 .05"><freejoint/><geom name="box" type="box" size=".2 .2 .05" mass="1"/></body>
      </worldbody></mujoco>""")


def test_causes_have_colours_of_their_own_that_the_style_sheet_defines():
    style = Path(lv.__file__).parent / "report" / "templates" / "style.css"
    text = style.read_text(encoding="utf-8")
    names = [color.removeprefix("var(").removesuffix(")") for color in CAUSE_COLORS]
    assert len(set(names)) == len(CAUSES) == len(names)
    assert all(f"{name}:" in text for name in names)


def dominant(explanation):
    """Return the cause of the fastest contact."""
    return explanation.causes[int(np.argmax(explanation.speeds))]


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_slip_below_the_friction_angle_is_softness_of_friction(cone):
    angle = 0.3  # tan 0.309 < 0.5
    explanation = explain_slip_of_states(
        block(angle, option=f'cone="{cone}"'), steps=600
    ).explanations[0]
    assert set(explanation.causes) == {"softness"}
    assert explanation.rigid_speeds.max() < 1e-6
    total = sum(explanation.parts.values())
    np.testing.assert_allclose(total, explanation.speeds, rtol=1e-9, atol=1e-14)


def test_slip_of_a_creeping_block_has_the_speed_of_the_softened_row():
    """A steady creep v of n equal contacts has b v + R f = 0 on tangent rows, aref = -b v, f = m g sin(angle) / n."""
    angle = 0.2
    model = block(angle, option='cone="elliptic"')
    data = mujoco.MjData(model)
    for _ in range(1500):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    tangent = int(data.contact.efc_address[0]) + 1
    explanation = explain_slip_of_states(model, steps=1501).explanations[0]
    force = GRAVITY * np.sin(angle) / data.ncon
    damping = (
        -data.efc_aref[tangent : tangent + 2]
        @ np.ones(2)
        / (data.efc_vel[tangent : tangent + 2] @ np.ones(2))
    )
    speed = data.efc_R[tangent] * force / damping
    assert explanation.speeds == pytest.approx(np.full(data.ncon, speed), rel=0.02)


def test_slip_above_the_friction_angle_is_sliding_at_the_limit():
    angle, friction = 0.6, 0.5  # tan 0.684 > 0.5
    steps = 150
    explanation = explain_slip_of_states(
        block(angle, friction, 'cone="elliptic"'), steps=steps
    ).explanations[0]
    assert set(explanation.causes) == {"sliding at the friction limit"}
    expected = GRAVITY * (np.sin(angle) - friction * np.cos(angle)) * steps * 0.002
    assert explanation.rigid_speeds == pytest.approx(
        np.full(len(explanation.contacts), expected), rel=0.05
    )


def test_slip_with_one_iteration_is_unfinished_solving():
    model = block(
        0.3, option='cone="elliptic" solver="PGS" iterations="1" tolerance="0" impratio="1000"'
    )
    exact = block(0.3, option='cone="elliptic" impratio="1000"')
    assert dominant(explain_slip_of_states(exact, steps=40).explanations[0]) != "unfinished solving"
    data = mujoco.MjData(exact)
    for _ in range(40):
        mujoco.mj_step(exact, data)
    data.qacc_warmstart[:] = 0.0
    assert (
        dominant(explain_slip_of_states(model, get_state(exact, data)[None]).explanations[0])
        == "unfinished solving"
    )


def test_slip_of_an_unfinished_acceleration_is_the_speed_of_the_corners_after_the_step():
    """CG leaves forces behind the acceleration, and only the acceleration moves the box."""
    model = block(0.3, option='cone="elliptic" solver="CG" iterations="2"')
    data = mujoco.MjData(model)
    for _ in range(20):
        state = get_state(model, data)
        mujoco.mj_step(model, data)
    by_forces = mujoco.MjData(model)
    mujoco.mj_setState(model, by_forces, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    mujoco.mj_forward(model, by_forces)
    explanation = explain_slip_of_states(model, state[None]).explanations[0]
    moved, by_forces = (
        [
            np.linalg.norm(
                v[:2] + np.cross(v[3:], by_forces.contact.pos[k] - by_forces.xpos[1])[:2]
            )
            for k in range(4)
        ]
        for v in (
            data.qvel,
            lv.io.from_mujoco(model, by_forces).velocity(lv.io.mujoco.impulse(model, by_forces)),
        )
    )
    np.testing.assert_allclose(np.sort(explanation.speeds), np.sort(moved), rtol=1e-4)
    assert np.abs(np.sort(by_forces) - np.sort(moved)).max() > 1e-3 * max(moved)


def slide(velocity, cones, friction="coulomb", compliance=None):
    """Build a step of a particle of 1 kg on the ground that falls with 1 m/s and slides with `velocity` (2,) [m/s]."""
    jac = np.eye(3)[[2, 0, 1]]
    free = [*velocity, -1.0]
    return lv.Problem.from_jacobian(
        jac,
        np.eye(3),
        free,
        cones=cones,
        friction=friction,
        compliance=compliance,
        names=["contact 0 (foot, ground)"],
    )


def test_slip_under_the_cone_law_has_the_part_of_the_relaxation():
    # Coulomb: the normal impulse is 1 N s, friction 0.5: 2 - 0.5 = 1.5 m/s remain. The relaxation lifts the particle
    # with v_n = mu v_t, and takes (2 - 0.5) / (1 + 0.25) = 1.2 m/s.
    problem = slide([2.0, 0.0], lv.Cones.contacts(0.5), friction="cone")
    explanation = explain_slip(problem, lv.solve(problem, tol=1e-9).impulse)
    assert explanation.speeds == pytest.approx([1.2])
    assert explanation.parts["convex relaxation"] == pytest.approx([-0.3])
    assert explanation.parts["sliding at the friction limit"] == pytest.approx([1.5])


def test_slip_in_a_box_has_the_part_of_the_shape():
    # A box bounds each tangent by 0.5 N s, a disk their norm: along the diagonal 0.707 or 0.5 m/s are lost.
    problem = slide([1.0, 1.0], lv.Cones.contacts(0.5).shaped("box"))
    explanation = explain_slip(problem, lv.solve(problem, tol=1e-9).impulse)
    assert explanation.speeds == pytest.approx([np.sqrt(0.5)])
    assert explanation.rigid_speeds == pytest.approx([np.sqrt(2.0) - 0.5])
    assert explanation.parts["shape of the cone"] == pytest.approx(
        [np.sqrt(0.5) - (np.sqrt(2.0) - 0.5)]
    )


@pytest.mark.parametrize(
    ("grip", "cause"), [(30.0, "softness"), (6.0, "sliding at the friction limit")]
)
def test_slip_of_a_gripped_box_depends_on_the_grip_force(grip, cause):
    # Two fingers press with `grip` [N] each: friction 2 * 0.5 * grip against a weight of 9.81 N.
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option timestep="0.002" cone="elliptic"/>
      <default><geom friction="0.5 0.005 0.0001"/></default><worldbody>
      <body pos="-.07 0 1"><joint name="left" type="slide" axis="1 0 0"/>
        <geom name="left" type="box" size=".02 .05 .05" mass=".1"/></body>
      <body pos=".07 0 1"><joint name="right" type="slide" axis="-1 0 0"/>
        <geom name="right" type="box" size=".02 .05 .05" mass=".1"/></body>
      <body pos="0 0 1"><freejoint/><geom name="box" type="box" size=".05 .05 .05" mass="1"/></body></worldbody>
      <actuator><motor joint="left" ctrllimited="false"/><motor joint="right" ctrllimited="false"/></actuator>
      <keyframe><key ctrl="{grip} {grip}"/></keyframe></mujoco>""")
    explanation = explain_slip_of_states(model, "keyframes", contacts="box", steps=20).explanations[
        0
    ]
    assert dominant(explanation) == cause


def test_slip_advice_lists_only_settings_that_reduce_simulated_slip():
    soft = explain_slip_of_states(block(0.3, option='cone="elliptic"'), steps=600).explanations[0]
    as_it_is, *others = soft.remedies
    advised = [line.strip().rpartition(": ")[0] for line in soft.advice[1:]]
    helpful = [
        r.setting for r in sorted(others, key=lambda r: r.later) if r.later <= 0.9 * as_it_is.later
    ]
    assert advised == helpful and '<option impratio="10"/>' in advised
    # A larger friction coefficient does not reduce creep, although it is the first idea.
    assert 'friction="1" of slope and box' in {r.setting for r in others} - set(advised)
    stiff = explain_slip_of_states(
        block(0.3, option='cone="elliptic" impratio="10"'), steps=600
    ).explanations[0]
    # The creep of a softened row is proportional to its compliance, which impratio divides; 5 leaves room for the load.
    assert stiff.speeds.max() < soft.speeds.max() / 5.0


def test_slip_remedies_start_from_all_states_with_the_fastest_contact():
    model = block(0.2, friction=0.4, option='cone="elliptic"')
    speeds = np.array([0.5, 1.0, 0.2])
    model.qpos0[2] -= 0.0001  # The box touches the slope in its first step.
    states = {
        "qpos": np.repeat(model.qpos0[None], 3, axis=0),
        "qvel": speeds[:, None] * np.eye(model.nv)[:1],
    }
    explanations = explain_slip_of_states(model, states, steps=1).explanations
    assert [e.n_states for e in explanations] == [0, 3, 0]
    parts = [{k: x[i : i + 1] for k, x in states.items()} for i in range(3)]
    alone = [explain_slip_of_states(model, part, steps=1).explanations[0] for part in parts]
    assert explanations[1].remedies[0].slip == pytest.approx(
        np.mean([e.remedies[0].slip for e in alone])
    )


def conveyor(form, belt=1.0, compliance=0.0, mu=0.5):
    """A box of 1 kg that rests on a belt of 1 m/s and moves with it, by bodies or by J and M."""
    if form == "bodies":
        rows = lv.Rows(
            inv_mass=[1.0],
            inv_inertia=[np.eye(3)],
            v_free=[[1.0, 0.0, -0.1, 0.0, 0.0, 0.0]],
            contact_body=[(-1, 0)],
            normal=[(0.0, 0.0, 1.0)],
            tangent=[(1.0, 0.0, 0.0)],
            arm_a=[(0.0, 0.0, 0.0)],
            arm_b=[(0.0, 0.0, 0.0)],
        )
        return lv.Problem.from_rows(
            rows, mu=mu, target=[0.0, belt, 0.0], compliance=[0.0, compliance, compliance]
        )
    return lv.Problem.from_jacobian(
        np.eye(3)[[2, 0, 1]],
        np.eye(3),
        [1.0, 0.0, -0.1],
        target=[0.0, belt, 0.0],
        cones=lv.Cones.contacts(mu),
        compliance=[0.0, compliance, compliance],
    )


@pytest.mark.parametrize("form", ["bodies", "J and M"])
def test_explain_slip_box_carried_by_conveyor_does_not_slip(form):
    problem = conveyor(form)
    explanation = explain_slip(problem, lv.solve(problem, tol=1e-9).impulse)
    assert explanation.causes == ("no slip",)
    # A belt of 2 m/s slides under the box: 1 m/s minus the friction of 0.5 * 0.1 N s on 1 kg.
    problem = conveyor(form, belt=2.0)
    explanation = explain_slip(problem, lv.solve(problem, tol=1e-9).impulse)
    assert explanation.speeds == pytest.approx([0.95])
    assert explanation.causes == ("sliding at the friction limit",)


@pytest.mark.parametrize("form", ["bodies", "J and M"])
def test_explain_slip_softened_rows_need_surface_velocity(form):
    problem = conveyor(form, belt=1.2, compliance=10.0, mu=5.0)
    impulse = lv.solve(problem, tol=1e-9).impulse
    # v_t = 1.2 - 10 lambda and lambda = v_t - 1: a belt that softness lets slip by 10 / 11 of 0.2 m/s.
    explanation = explain_slip(problem, impulse, surface_velocity=[0.0, 1.2, 0.0])
    assert explanation.speeds == pytest.approx([0.2 * 10 / 11])
    assert explanation.causes == ("softness",)
    assert explanation.rigid_speeds == pytest.approx([0.0], abs=1e-8)
    # Without it, the target is an engine's damping.
    assert explain_slip(problem, impulse).speeds == pytest.approx([1.2 - 0.2 * 10 / 11])


def test_explain_slip_of_states_subtracts_surface_velocity_of_geoms():
    for cone in ("elliptic", "pyramidal"):
        model = mujoco.MjModel.from_xml_string(f"""<mujoco><option timestep="0.002" cone="{cone}"/><worldbody>
          <geom name="belt" type="plane" size="9 9 1" surfacevel="1 0 0 0 0 0"/>
          <body pos="0 0 .05"><freejoint/><geom name="box" type="box" size=".2 .2 .05" mass="1"/></body></worldbody>
          </mujoco>""")
        explanation = explain_slip_of_states(model, steps=1000).explanations[0]
        assert explanation.causes == ("no slip",) * len(explanation.contacts)


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_explain_slip_of_states_remedy_has_the_slip_that_the_typed_setting_gives(cone):
    """Each <option> is pasted into the model, which then continues from the explained state in MuJoCo alone."""
    angle = 0.3
    steps = 100
    state_kind = mujoco.mjtState.mjSTATE_INTEGRATION
    model = block(angle, option=f'cone="{cone}"')
    data = mujoco.MjData(model)
    for _ in range(steps - 1):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    state = get_state(model, data)
    (explanation,) = explain_slip_of_states(model, steps=steps).explanations
    settings = {remedy.setting: remedy for remedy in explanation.remedies}
    assert next(iter(settings)) == "as it is" and 'solref="0.004 1" of all geoms' in settings
    assert ('<option cone="elliptic" noslip_iterations="20"/>' in settings) == (cone == "pyramidal")
    for text, remedy in settings.items():
        if not text.startswith("<option"):
            continue
        option = text.removeprefix("<option ").removesuffix("/>")
        typed = block(angle, option=option if "cone=" in option else f'cone="{cone}" {option}')
        data = mujoco.MjData(typed)
        mujoco.mj_setState(typed, data, state, state_kind)
        means = []
        for _ in range(REMEDY_STEPS + 1):
            mujoco.mj_forward(typed, data)
            jacobians = np.zeros((data.ncon, 3, typed.nv))
            for jacobian, point in zip(jacobians, data.contact.pos, strict=True):
                mujoco.mj_jac(typed, data, jacobian, None, point, 1)
            mujoco.mj_step(typed, data)
            means.append(
                np.linalg.norm((jacobians @ data.qvel)[:, :2], axis=1).mean()
            )  # The normal is z.
        assert remedy.slip == pytest.approx(means[0], rel=1e-6, abs=1e-12), text
        assert remedy.later == pytest.approx(np.mean(means[1:]), rel=1e-6, abs=1e-12), text
    best = min(explanation.remedies, key=lambda remedy: remedy.later)
    assert best.setting in explanation.advice[1]
    assert best.later < 0.3 * explanation.remedies[0].later


def falling_states(model, velocities):
    """Return the states of a box that has settled, with these velocities along x and upwards [m/s]."""
    data = mujoco.MjData(model)
    states = []
    for _ in range(300):
        mujoco.mj_step(model, data)
    for x, up in velocities:
        data.qvel[:] = 0.0
        data.qvel[0], data.qvel[2] = x, up
        states.append(get_state(model, data))
    return np.array(states)


def test_slip_over_time_counts_steps_with_contact_of_all_states():
    model = block(0.0, friction=0.1)
    states = falling_states(model, [(0.5, 0.0), (0.2, 1.0)])
    touches = np.zeros((2, 1 + REMEDY_STEPS), bool)
    speeds = np.zeros((2, 1 + REMEDY_STEPS))
    for own, speed, state in zip(touches, speeds, states, strict=True):
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        for step in range(len(own)):
            mujoco.mj_forward(model, data)
            own[step] = data.ncon > 0
            mujoco.mj_step(model, data)
            speed[step] = abs(data.qvel[0])
    n = int(touches[:, 1:].sum())
    assert 0 < n < 2 * REMEDY_STEPS
    both = explain_slip_of_states(model, {"state": states}).worst
    now = both.remedies[0]
    assert (now.touching, now.kept) == (n / (2 * REMEDY_STEPS), int(touches[:, -1].sum()))
    np.testing.assert_array_equal(np.isfinite(now.speeds), touches.any(axis=0))
    # The box turns by less than 1e-3 rad.
    assert now.later == pytest.approx(speeds[:, 1:][touches[:, 1:]].mean(), rel=1e-2)
    assert both.remedies_table.iloc[0].tolist()[3:] == [f"{n} of 50", f"{now.kept} of 2"]


@pytest.mark.parametrize("seed", range(3))
def test_slip_headline_has_the_pair_and_the_cause_of_the_largest_mean(seed):
    """Boxes in a heap, with few iterations: the means over points and states are taken here."""
    rng = np.random.default_rng(seed)
    boxes = "".join(
        f"""<body pos="{x:.3f} {y:.3f} {0.1 + 0.2 * i:.3f}"><freejoint/><geom name="box{i}" type="box"
        size=".1 .1 .1" friction="{mu:.2f}"/></body>"""
        for i, (x, y, mu) in enumerate(rng.uniform([-0.05, -0.05, 0.1], [0.05, 0.05, 0.9], (3, 3)))
    )
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option iterations="{rng.integers(1, 9)}" gravity="1 0 -9"
      cone="{["elliptic", "pyramidal"][seed % 2]}"/><worldbody><geom name="floor" type="plane" size="0 0 1"/>{boxes}
      </worldbody></mujoco>""")
    result = explain_slip_of_states(
        model, worlds=3, steps=int(rng.integers(20, 80)), spread=0.05, workers=1
    )
    points = [
        (contact.split("(")[1].rstrip(")"), speed, {c: x[k] for c, x in e.parts.items()})
        for e in result.explanations
        for k, (contact, speed) in enumerate(zip(e.contacts, e.speeds, strict=True))
    ]
    pairs = sorted({pair for pair, _, _ in points})
    means = {p: np.mean([speed for pair, speed, _ in points if pair == p]) for p in pairs}
    first = max(pairs, key=means.get)
    parts = {
        cause: np.mean([part[cause] for pair, _, part in points if pair == first])
        for cause in points[0][2]
    }
    cause = max(parts, key=parts.get)
    row = result.table.iloc[0]
    assert row["contact"] == first and row["slip [m/s]"] == pytest.approx(means[first])
    assert row["cause of this part"] == cause
    assert result.verdict.startswith(f"{first}: slips") and f"cause: {cause}" in result.verdict
    page = result.make_page(None)
    assert page.verdict == result.verdict
    told = re.search(r"Largest part: ([a-z ]+), ", " ".join(result.sentences))
    fastest = max(points, key=lambda point: point[1])
    if told is not None and told[1] != max(parts, key=parts.get) and fastest[0] == first:
        assert f"another cause: {cause}" in " ".join(result.sentences)


def test_slip_of_worlds_does_not_depend_on_the_number_of_processes():
    model = block(0.2, option='iterations="3"')
    one, two = (
        explain_slip_of_states(model, worlds=2, steps=40, spread=0.05, seed=7, workers=n)
        for n in (1, 2)
    )
    assert [e.state for e in one.explanations] == [0, 1]
    for a, b in zip(one.explanations, two.explanations, strict=True):
        np.testing.assert_array_equal(a.speeds, b.speeds)
        assert a.remedies == b.remedies
    assert one.forces.equals(two.forces) and len(set(one.forces["state"])) == 2
    # World 0 starts without noise, as without --worlds; the other ones differ.
    alone = explain_slip_of_states(model, steps=40).explanations[0]
    np.testing.assert_array_equal(alone.speeds, one.explanations[0].speeds)
    assert not np.array_equal(alone.speeds, one.explanations[1].speeds)


def test_slip_names_no_setting_twice():
    options = 'noslip_iterations="20" tolerance="1e-12" iterations="10" impratio="2"'
    model = block(0.2, option=options)
    settings = [r.setting for r in explain_slip_of_states(model, steps=5).worst.remedies]
    assert len(settings) == len(set(settings)) >= 4


def test_slip_explanation_prints_the_digits_of_the_command(tmp_path):
    from lavender.report.render import format_cells

    result = explain_slip_of_states(block(0.2), steps=20)
    explanation = result.explanations[0]
    assert format_cells(explanation.table).to_string(index=False) in str(explanation)
    page = result.page.write(tmp_path / "slip")
    assert "slip-over-time" in page.read_text(encoding="utf-8")
    assert mujoco.__version__ in (tmp_path / "slip" / "numbers.json").read_text(encoding="utf-8")


def test_joint_with_dry_friction_that_creeps_is_softness():
    """A joint with 1 N m of dry friction turns under 0.3 N m: v = F R / B with R and B of the friction row."""
    model = mujoco.MjModel.from_xml_string("""<mujoco><option timestep="0.005" gravity="0 0 0"/><worldbody><body>
      <joint name="a" axis="0 0 1" frictionloss="1"/><geom type="box" size=".1 .1 .1" mass="1"/></body></worldbody>
      <actuator><motor joint="a"/></actuator></mujoco>""")
    data = mujoco.MjData(model)
    data.ctrl[0] = 0.3
    for _ in range(400):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    explanation = explain_slip(lv.io.from_mujoco(model, data), lv.io.mujoco.impulse(model, data))
    closed = 0.3 * data.efc_R[0] / data.efc_KBIP[0][1]
    assert explanation.speeds == pytest.approx([closed], rel=1e-6)
    assert explanation.causes == ("softness",) and explanation.units == ("rad/s",)
    assert explanation.friction_use == pytest.approx([0.3], rel=1e-6)
    assert "[rad/s]" in explanation.table.columns[1]


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_problem_of_mujoco_knows_its_pyramids_and_the_speed_of_a_belt(cone):
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option timestep="0.002" cone="{cone}"/><worldbody>
      <geom name="belt" type="plane" size="9 9 1" surfacevel="1 0 0 0 0 0"/>
      <body pos="0 0 .05"><freejoint/><geom name="box" type="box" size=".2 .2 .05" mass="1"/></body></worldbody>
      </mujoco>""")
    data = mujoco.MjData(model)
    for _ in range(600):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    problem, impulse = lv.io.from_mujoco(model, data), lv.io.mujoco.impulse(model, data)
    assert set(explain_slip(problem, impulse).causes) == {"no slip"}
    data.qvel[0] += 0.1  # The data have changed, and the problem alone does not know the belt.
    if cone == "pyramidal":
        with pytest.raises(lv.InputError, match="step_from_mujoco"):
            explain_slip(problem, impulse)
    else:
        assert set(explain_slip(problem, impulse).causes) == {"speed of the surface is not known"}


# Two fingers press a can from both sides; each has a pad, and a back plate that separates when a setting changes.
TWO_GEOMS = """<mujoco><option timestep="0.002"/><worldbody>
<body name="left" pos="-.05 0 1"><joint name="l" type="slide" axis="1 0 0" damping="20"/>
 <geom type="box" size=".01 .01 .01" pos="0.0006 0 0.005" friction="2" solref="0.01 0.5" mass=".1"/>
 <geom type="box" size=".01 .02 .02" friction="1" condim="4" mass=".1"/></body>
<body name="right" pos=".05 0 1"><joint name="r" type="slide" axis="-1 0 0" damping="20"/>
 <geom type="box" size=".01 .01 .01" pos="-0.0006 0 0.005" friction="2" solref="0.01 0.5" mass=".1"/>
 <geom type="box" size=".01 .02 .02" friction="1" condim="4" mass=".1"/></body>
<body name="can" pos="0 0 1"><freejoint/><geom name="can" type="box" size=".03 .02 .02" mass=".25"/></body>
</worldbody><actuator><motor joint="l" gear="30"/><motor joint="r" gear="30"/></actuator></mujoco>"""


def test_slip_follows_two_bodies_whose_geoms_take_turns():
    model = mujoco.MjModel.from_xml_string(TWO_GEOMS)
    data = mujoco.MjData(model)
    data.ctrl[:] = 1.0
    states = []
    for step in range(520):
        mujoco.mj_step(model, data)
        if step >= 400 and step % 40 == 0:
            states.append(get_state(model, data))
    worst = explain_slip_of_states(model, {"state": np.array(states)}, contacts="can").worst
    assert worst.followed in ("can and left", "can and right") and len(worst.remedies) > 4
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    finger, can = (model.body(name).id for name in (worst.followed.split(" and ")[1], "can"))
    for remedy in worst.remedies[:5]:
        changed = mujoco.MjModel.from_xml_string(TWO_GEOMS)
        for name, value in re.findall(r'(\w+)="([^"]+)"', remedy.setting):
            value = {"elliptic": 1, "pyramidal": 0}.get(value, value)
            setattr(changed.opt, name, type(getattr(changed.opt, name))(value))
        touches = []
        for state in states:
            data = mujoco.MjData(changed)
            mujoco.mj_setState(changed, data, state, kind)
            for step in range(1 + REMEDY_STEPS):
                mujoco.mj_forward(changed, data)
                bodies = changed.geom_bodyid[data.contact.geom]
                touches += [any(set(pair) == {finger, can} for pair in bodies.tolist())] * (
                    step > 0
                )
                mujoco.mj_step(changed, data)
        assert remedy.touching == pytest.approx(np.mean(touches)), remedy.setting
    assert "states keep contact" not in "".join(worst.advice)


def test_stop_that_returns_more_than_the_approach_is_softness():
    model = mujoco.MjModel.from_xml_string("""<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody><body>
      <joint name="stop" axis="0 0 1" range="-60 60" limited="true" solreflimit="-200000 -20"/>
      <inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .01"/></body></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0] = np.radians(60.1), 3.0
    mujoco.mj_forward(model, data)
    explanation = explain_slip(lv.io.from_mujoco(model, data), lv.io.mujoco.impulse(model, data))
    assert explanation.contacts == ("upper limit of stop",) and explanation.causes == ("softness",)
    assert not any("normal force" in line for line in explanation.sentences)
    assert 'solreflimit="0.002 1"' in str(explanation.comparison)


def test_a_model_without_slip_has_one_sentence():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 .0999"><freejoint/>'
        '<geom type="box" size=".1 .1 .1"/></body></worldbody></mujoco>'
    )
    result = explain_slip_of_states(model, steps=20)
    assert result.verdict.startswith("No contact slips") and result.sentences == []
    assert result.make_page(None).sentences == []
