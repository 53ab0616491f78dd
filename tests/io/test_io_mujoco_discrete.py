"""Steps of MuJoCo's integrator "discrete", whose constraint problem contains dampings and stiffnesses beside M."""

import numpy as np
import pytest
from mujoco_scene import get_state, mj

import lavender as lv
from lavender.io import mujoco as adapter

if not hasattr(mj.mjtIntegrator, "mjINT_DISCRETE"):
    pytest.skip('this MuJoCo has no integrator "discrete"', allow_module_level=True)

MODEL = """<mujoco><option timestep="0.002" integrator="discrete" tolerance="1e-12" iterations="300" {options}/>
<worldbody><geom type="plane" size="2 2 .1"/>{bodies}<site name="ceiling" pos="0 0 1"/></worldbody>{more}</mujoco>"""
ARM = """<body pos=".5 0 .1"><joint name="shoulder" axis="0 1 0" {first}/>
<geom type="capsule" size=".03" fromto="0 0 0 .3 0 -.2" mass="1"/><site name="tip" pos=".3 0 0"/>
<body pos=".3 0 -.1"><joint name="elbow" {second}/><geom size=".1" pos=".1 0 0"/></body></body>"""
FLEX = """<geom size=".1" pos="0 0 .1"/><flexcomp name="sheet" type="grid" count="{count}" spacing=".06 .06 .06"
pos="0 0 .23" radius=".005" dim="{dim}" mass=".2" dof="{dof}"><contact selfcollide="none" condim="3" {contact}/>
<elasticity young="3e4" poisson="0.2" damping="0.01" {elasticity}/></flexcomp>"""
BALL = '<body pos=".8 0 .09"><freejoint/><geom size=".1"/></body>'


def make_sheet(elastic="both", contact=""):
    return FLEX.format(
        count="4 4 1",
        dim=2,
        dof="full",
        contact=contact,
        elasticity=f'thickness="4e-3" elastic2d="{elastic}"',
    )


def make_arm(first="", second='axis="0 1 0"'):
    return ARM.format(first=first, second=second)


TENDONS = """<tendon><spatial name="rope" stiffness="100" damping="3"><site site="ceiling"/><site site="tip"/></spatial>
<fixed name="belt" damping="4" stiffness="3"><joint joint="shoulder" coef="1"/><joint joint="elbow" coef="-2"/></fixed>
</tendon>"""
ACTUATORS = """<actuator><position joint="shoulder" kp="100" kv="3"/><velocity joint="elbow" kv="3"/></actuator>"""
MODELS = {
    "damped hinge": MODEL.format(options="", bodies=make_arm('damping=".3"'), more=""),
    "stiff ball joint": MODEL.format(
        options="",
        bodies=make_arm('stiffness="20"', 'type="ball" stiffness="10" damping="1"'),
        more="",
    ),
    "fluid": MODEL.format(options='density="1000" viscosity="1"', bodies=make_arm(), more=""),
    "tendons": MODEL.format(options="", bodies=make_arm(), more=TENDONS),
    "actuators": MODEL.format(options="", bodies=make_arm(), more=ACTUATORS),
    "PGS": MODEL.format(
        options='solver="PGS"', bodies=make_arm('damping=".3"'), more=TENDONS + ACTUATORS
    ),
    "stretched sheet": MODEL.format(options="", bodies=make_sheet("stretch"), more=""),
    "bent sheet": MODEL.format(options="", bodies=make_sheet("bend"), more=""),
    "passive contact": MODEL.format(
        options="", bodies=make_sheet(contact='passive="true"') + BALL, more=""
    ),
    "trilinear solid": MODEL.format(
        options="",
        bodies=FLEX.format(count="3 3 3", dim=3, dof="trilinear", contact="", elasticity=""),
        more="",
    ),
}


def make_states(text, steps=120, every=6):
    """Return the model and the states before steps with constraint rows, under random controls."""
    model = mj.MjModel.from_xml_string(text)
    data = mj.MjData(model)
    rng = np.random.default_rng(0)
    states = []
    for k in range(steps):
        data.ctrl[:] = 0.2 * rng.normal(size=model.nu)
        state = get_state(model, data)
        mj.mj_step(model, data)
        if data.nefc and k % every == 0:
            states.append(state)
    assert states
    return model, np.array(states)


def forward(model, state):
    data = mj.MjData(model)
    mj.mj_setState(model, data, state, mj.mjtState.mjSTATE_INTEGRATION)
    mj.mj_forward(model, data)
    return data


@pytest.mark.parametrize("name", MODELS)
def test_from_mujoco_of_a_discrete_step_has_the_matrix_that_mujoco_responds_with(name):
    # The matrix is measured from outside: a unit force changes qacc_smooth by a column of its inverse.
    model, states = make_states(MODELS[name])
    data = forward(model, states[-1])
    problem = lv.io.from_mujoco(model, data)
    smooth = data.qacc_smooth.copy()
    columns = np.empty((model.nv, model.nv))
    for i in range(model.nv):
        data.qfrc_applied[:] = 0.0
        data.qfrc_applied[i] = 1.0
        mj.mj_forward(model, data)
        columns[:, i] = data.qacc_smooth - smooth
    # MuJoCo solves to 1e-12 of the force, and the difference of two solves has that of the larger one.
    assert np.abs(problem.generalized.mass.toarray() @ columns - np.eye(model.nv)).max() < 1e-7


@pytest.mark.parametrize("name", MODELS)
def test_from_mujoco_of_a_discrete_step_is_solved_by_mujocos_own_answer(name):
    model, states = make_states(MODELS[name])
    for state in states[-5:]:
        data = forward(model, state)
        problem = lv.io.from_mujoco(model, data)
        # PGS stops when a sweep improves its objective by 1e-12; Newton's method reaches rounding.
        limit = 1e-8 if name == "PGS" else 1e-11
        assert lv.residual(problem, adapter.impulse(model, data)).relative < limit
        found = lv.solve(problem, "newton", tol=1e-10)
        assert found.success
        error = np.abs(adapter.acceleration(model, data, found.impulse) - data.qacc).max()
        assert error < 1e-8 * np.abs(data.qacc).max()


def test_from_mujoco_of_a_discrete_step_with_damping_that_does_not_act_yet_has_its_matrix():
    # At rest and without gravity both sides of M qacc_smooth = qfrc_smooth are 0, with any matrix.
    box = """<body pos="0 0 .099"><joint type="slide" axis="0 0 1" damping="200"/>
    <geom type="box" size=".1 .1 .1"/></body>"""
    model = mj.MjModel.from_xml_string(MODEL.format(options='gravity="0 0 0"', bodies=box, more=""))
    data = mj.MjData(model)
    mj.mj_forward(model, data)
    problem = lv.io.from_mujoco(model, data)
    assert problem.generalized.mass.toarray()[0] == pytest.approx(data.M + 0.002 * 200.0)
    assert lv.residual(problem, adapter.impulse(model, data)).relative < 1e-12
    found = lv.solve(problem, "newton", tol=1e-12)
    assert adapter.acceleration(model, data, found.impulse) == pytest.approx(data.qacc, rel=1e-9)
    assert data.qacc[0] > 0.1  # m/s2: the contact acts


@pytest.mark.parametrize("name", MODELS)
def test_from_mujoco_many_of_discrete_steps_equals_from_mujoco(name):
    model, states = make_states(MODELS[name])
    imported = lv.io.from_mujoco_many(model, states, threads=2)
    for i, state in enumerate(states):
        problem = lv.io.from_mujoco(model, forward(model, state))
        world = imported.batch[i]
        mass = problem.generalized.mass.toarray()
        assert world.generalized.mass.toarray() == pytest.approx(
            mass, abs=1e-14 * np.abs(mass).max()
        )
        assert world.b == pytest.approx(problem.b, abs=1e-12 * np.abs(problem.b).max())


def test_from_mujoco_of_a_flex_without_stored_stiffness_raises():
    # Conjugate gradients multiply by the bending stiffness without storing it.
    model = mj.MjModel.from_xml_string(
        MODEL.format(options='solver="CG"', bodies=make_sheet("bend") + BALL, more="")
    )
    data = mj.MjData(model)
    mj.mj_forward(
        model, data
    )  # The sheet falls as a whole, so that its stiffness does not act on qacc_smooth.
    for convert in (
        lambda: lv.io.from_mujoco(model, data),
        lambda: lv.io.from_mujoco_many(model, np.r_[data.qpos, data.qvel][None]),
    ):
        with pytest.raises(lv.CapabilityError, match=r'flex sheet.*efm_K.*solver="Newton"'):
            convert()


def test_from_mujoco_of_discrete_data_that_were_changed_names_the_arrays():
    model, states = make_states(MODELS["actuators"])
    data = forward(model, states[-1])
    data.qacc_smooth[0] *= 1.001
    with pytest.raises(lv.CapabilityError, match=r"efm_as.*mj_forward"):
        lv.io.from_mujoco(model, data)


def test_from_mujoco_of_a_discrete_step_does_not_depend_on_the_iterations_of_mujoco():
    model, states = make_states(MODELS["tendons"])
    exact = lv.io.from_mujoco(model, forward(model, states[-1]))
    model.opt.iterations = (
        1  # MuJoCo then computes qacc_smooth with one iteration, too, and warns of it.
    )
    data = forward(model, states[-1])
    assert data.warning[int(mj.mjtWarning.mjWARN_INERTIA)].number
    early = lv.io.from_mujoco(model, data)
    assert early.b == pytest.approx(exact.b, abs=1e-11 * np.abs(exact.b).max())
    assert early.generalized.v_free == pytest.approx(exact.generalized.v_free, abs=1e-11)
