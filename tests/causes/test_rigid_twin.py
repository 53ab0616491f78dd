"""One engine against the rigid laws: closed forms of the rigid step, and parts that engines' own options confirm."""

import numpy as np
import pytest

import lavender as lv
from lavender.causes.smaller_steps import COUNT

mj = pytest.importorskip("mujoco", minversion="4.0")

HINGE = """<mujoco><option timestep="0.002" gravity="0 0 0" {option}/><worldbody><body>
<joint name="j" axis="0 0 1" frictionloss="100" damping="100"/><geom type="cylinder" size=".1 .05" mass="1"/>
</body></worldbody></mujoco>"""
INCLINE = """<mujoco><option timestep="0.002" gravity="3.355 0 -9.218" {option}/><worldbody>
<geom type="plane" size="5 5 .1" friction=".6"/>
<body pos="0 0 .1"><freejoint name="box"/><geom type="box" size=".1 .1 .1" mass="1" friction=".6"/></body>
</worldbody></mujoco>"""
SLIDE = """<mujoco><option timestep="0.01" {option}/><worldbody><geom type="plane" size="50 5 .1" friction=".5"/>
<body pos="0 0 .0999"><joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
<geom type="box" size=".1 .1 .1" mass="1" friction=".5"/></body></worldbody></mujoco>"""
STOP = """<mujoco><option timestep="0.0005" gravity="0 0 0" {option}/><worldbody><body>
<joint name="j" axis="0 0 1" range="-60 60" limited="true" solreflimit="{stiffness} {damping}"/>
<inertial pos="0 0 0" mass="1" diaginertia="{inertia} {inertia} {inertia}"/></body></worldbody></mujoco>"""
BELT = """<mujoco><option timestep="0.002" cone="elliptic"/><worldbody>
<geom type="box" size="50 5 .1" pos="0 0 -.1" friction=".5" surfacevel="1 0 0 0 0 0"/>
<body pos="0 0 .1"><freejoint name="box"/><geom type="box" size=".1 .1 .1" mass="1" friction=".5"/></body>
</worldbody></mujoco>"""
# [-] Velocities of the twin: its rows have 1e-9 of the compliance of the bodies.
TWIN_TOLERANCE = 5e-9


def read(xml, velocity=None, position=None, steps=0, **values):
    """Return the step of a model from a state."""
    model = mj.MjModel.from_xml_string(xml.format(**{"option": ""} | values))
    data = mj.MjData(model)
    if velocity is not None:
        data.qvel[0] = velocity
    if position is not None:
        data.qpos[0] = position
    for _ in range(steps):
        mj.mj_step(model, data)
    return lv.io.step_from_mujoco(model, data)


def get_stop(inertia):
    """Return the values of a stop with the restitution of a published report."""
    return {"inertia": inertia, "stiffness": -500.0 / inertia, "damping": -0.5 / inertia}


@pytest.mark.parametrize(("step", "column", "rigid", "cause"), [
    (lambda: read(HINGE, 1.0), 0, 0.0, {"integrator", "softness"}),
    (lambda: read(HINGE, 1.0, option='noslip_iterations="10"'), 0, 0.0, {"integrator", "softness"}),
    (lambda: read(INCLINE, steps=300), 0, 0.0, {"softness"}),
    (lambda: read(INCLINE, steps=300, option='solver="PGS" iterations="3"'), 0, 0.0, {"softness"}),
    (lambda: read(SLIDE, 6.0), 0, 6.0 - 0.5 * 9.81 * 0.01, {"friction"}),
    (lambda: read(SLIDE, 6.0), 1, 0.0, {"friction"}),
    (lambda: read(STOP, 2.0, np.radians(60.05), **get_stop(1e-4)), 0, 0.0, {"softness", "integrator"}),
    (lambda: read(STOP, 2.0, np.radians(60.05), **get_stop(1e-2)), 0, 0.0, {"softness"}),
])  # fmt: skip
def test_compare_with_rigid_laws_has_closed_form_and_names_causes(step, column, rigid, cause):
    found = lv.compare(step())
    assert found.exact_a[column] == pytest.approx(rigid, abs=TWIN_TOLERANCE * max(1.0, abs(rigid)))
    row = np.eye(len(found.difference))[column]
    assert set(found.list_causes(row)) == cause
    total = sum(part.mean for part in found.parts.values())
    np.testing.assert_allclose(total, found.difference, rtol=0, atol=1e-14)


def test_parts_of_hinge_with_damping_are_the_published_ones():
    """Integrator 0.139 or 0.976 and softness 0.759 or -0.078 rad/s by the order: a single order would mislead."""
    found = lv.compare(read(HINGE, 1.0))
    assert found.parts["integrator"].measure(np.ones(1)) == pytest.approx(
        (0.5574, 0.139, 0.976), abs=5e-4
    )
    assert found.parts["softness"].measure(np.ones(1)) == pytest.approx(
        (0.3404, -0.0778, 0.759), abs=5e-4
    )
    noslip = lv.compare(read(HINGE, 1.0, option='noslip_iterations="10"'))
    assert noslip.parts["noslip"].mean[0] == pytest.approx(0.09705, abs=5e-5)
    assert abs(noslip.parts["solver"].mean[0]) < 1e-12


@pytest.mark.parametrize(("xml", "velocity"), [(HINGE, 1.0), (SLIDE, 6.0)])
def test_integrator_part_alone_equals_discrete_of_mujoco(xml, velocity):
    found = lv.compare(read(xml, velocity))
    discrete = read(xml, velocity, option='integrator="discrete"')
    own = found.b.velocity_after - found.parts["integrator"].alone_in_b
    np.testing.assert_allclose(own, discrete.velocity_after, rtol=0, atol=1e-12)


def test_solver_part_equals_the_difference_of_a_converged_solver():
    values = {"steps": 300, "option": 'solver="PGS" iterations="3"'}
    model = mj.MjModel.from_xml_string(INCLINE.format(option=values["option"]))
    data = mj.MjData(model)
    for _ in range(300):
        mj.mj_step(model, data)
    found = lv.compare(lv.io.step_from_mujoco(model, data))
    model.opt.solver, model.opt.iterations, model.opt.tolerance = mj.mjtSolver.mjSOL_NEWTON, 100, 0
    converged = lv.io.step_from_mujoco(model, data)
    expected = found.b.velocity_after - converged.velocity_after
    np.testing.assert_allclose(found.parts["solver"].mean, expected, rtol=0, atol=1e-12)
    assert np.abs(expected).max() > 1e-4


def test_box_at_the_speed_of_a_belt_has_no_cause():
    found = lv.compare(read(BELT, steps=600))
    assert found.exact_a[0] == pytest.approx(1.0, abs=1e-6)
    assert not [q for q in found.list_quantities() if q.name == "box x"]


def test_lost_digits_of_forces_are_a_cause_of_their_own():
    """The forces of a balanced lever on its stop have no digits, and implicitfast moves the lever by them."""
    xml = """<mujoco><option timestep="0.002" integrator="implicitfast" tolerance="0" iterations="300"/><worldbody>
    <geom type="box" size=".05 .05 .02" pos=".2 0 -.035"/><body><joint type="hinge" axis="0 1 0" damping=".01"/>
    <geom type="box" size=".3 .03 .02" mass=".2"/></body></worldbody></mujoco>"""
    found = lv.compare(read(xml, 0.05, steps=3))
    assert abs(found.parts["lost digits"].mean[0]) > 1e-4
    assert found.parts["solver"].mean[0] == 0.0
    assert "acceleration" in str(found) or abs(found.parts["lost digits"].mean[0]) < 0.1 * abs(
        found.difference[0]
    )


FALL = """<mujoco><option timestep="0.01" gravity="0 0 -10"/><worldbody><geom type="plane" size="5 5 .1"/>
<body pos="0 0 .101"><joint name="z" type="slide" axis="0 0 1"/><geom type="sphere" size=".1" mass="2"/></body>
</worldbody></mujoco>"""
DAMPED = """<mujoco><option timestep="0.02" gravity="0 0 0"/><worldbody>
<body><joint name="damped" axis="0 0 1" damping=".3"/>
<inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .1"/></body>
<body pos="1 0 0"><joint name="spring" axis="1 0 0" type="slide" stiffness="100"/>
<geom type="sphere" size=".1" mass="1"/></body></worldbody></mujoco>"""


def compare_with_smaller_steps(xml, velocity):
    """Return the comparison of a step, and what the engine itself does in the smaller steps."""
    model = mj.MjModel.from_xml_string(xml)
    data = mj.MjData(model)
    data.qvel[:] = velocity
    found = lv.compare(lv.io.step_from_mujoco(model, data), simulation=(model, data))
    np.testing.assert_array_equal(data.qvel, velocity)
    model.opt.timestep /= COUNT
    for _ in range(COUNT):
        mj.mj_step(model, data)
    np.testing.assert_allclose(
        sum(p.mean for p in found.parts.values()), found.difference, rtol=0, atol=1e-14
    )
    own = found.b.velocity_after - data.qvel
    np.testing.assert_allclose(found.parts["time step"].alone_in_b, own, rtol=0, atol=1e-15)
    return found


def test_impact_that_one_step_misses_is_the_time_step():
    """A ball 1 mm above the floor falls at 1 m/s: it lands within the step of 10 ms, which has no contact."""
    found = compare_with_smaller_steps(FALL, [-1.0])
    assert found.b.n_rows == 0
    assert found.parts["time step"].mean[0] == pytest.approx(-1.1, abs=TWIN_TOLERANCE)
    assert found.list_causes(np.ones(1)) == ["time step"]
    assert found.proposals[0].text == "timestep=0.000625"


def test_time_step_of_damping_and_spring_has_closed_forms():
    """Implicit Euler divides by 1 + h d / I; semi-implicit Euler of a spring has a matrix of determinant 1."""
    found = compare_with_smaller_steps(DAMPED, [2.0, 3.0])
    h, k, rate = 0.02, 100.0, 0.3 / 0.1

    def advance(h):
        return np.array([[1.0 - h * h * k, h], [-h * k, 1.0]])

    spring = [np.linalg.matrix_power(advance(h / n), n)[1, 1] * 3.0 for n in (1, COUNT)]
    damped = [2.0 / (1.0 + h * rate / n) ** n for n in (1, COUNT)]
    expected = [damped[0] - damped[1], spring[0] - spring[1]]
    np.testing.assert_allclose(found.parts["time step"].mean, expected, rtol=0, atol=1e-12)
    exact = np.array([2.0 * np.exp(-h * rate), 3.0 * np.cos(10.0 * h)])
    left = np.abs(found.a.velocity_after - exact) / np.abs(found.b.velocity_after - exact)
    assert (left < 1.2 / COUNT).all()  # Both methods have the first order.


def test_simulation_of_another_state_or_of_two_records_is_refused():
    model = mj.MjModel.from_xml_string(FALL)
    data = mj.MjData(model)
    record = lv.io.step_from_mujoco(model, data)
    with pytest.raises(lv.InputError, match="two records"):
        lv.compare(record, record, simulation=(model, data))
    data.qvel[0] = 0.5
    with pytest.raises(lv.InputError, match="another state"):
        lv.compare(record, simulation=(model, data))
