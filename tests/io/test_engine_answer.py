"""What moves the bodies: the judged answer predicts MuJoCo's own next velocity, and its error is that of the motion."""

import copy
import pickle

import numpy as np
import pytest
from mujoco_scene import get_state, mj, state

import lavender as lv
from lavender.io import mujoco as adapter
from lavender.io.engine_motion import EngineMotion
from lavender.problem.engine_record import EngineRecord

# A pressed box, a falling box on top of it, and a hinged arm.
MODEL = """<mujoco><option timestep="0.002" integrator="{integrator}" cone="{cone}" solver="{solver}"
iterations="{iterations}" tolerance="0"><flag eulerdamp="{eulerdamp}"/></option>
<default><joint damping="{damping}"/></default>
<worldbody><geom type="plane" size="5 5 1"/>
<body name="a" pos="0 0 .099"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
<body name="b" pos="0.03 0 .299" euler="0 2 0"><freejoint/><geom type="box" size=".1 .1 .1" mass=".3"/></body>
<body name="c" pos="0.5 0 .15"><joint name="first" axis="0 1 0" {joint}/>
<geom type="capsule" fromto="0 0 0 .2 0 -.1" size=".04"/>
<body name="d" pos=".2 0 -.1"><joint name="second" axis="0 1 .2" range="-10 10" {joint}/>
<geom type="capsule" fromto="0 0 0 .2 0 0" size=".04"/></body></body>
</worldbody>{more}</mujoco>"""
JOINTS = {"armature": 'armature=".01"', "frictionloss": 'frictionloss=".3"'}
MORE = {
    "equality": '<equality><joint joint1="first" joint2="second" polycoef="0 .5 0 0 0"/></equality>',
    "tendon": '<tendon><fixed name="t" limited="true" range="-.1 .1" damping=".2" frictionloss=".1">'
    '<joint joint="first" coef="1"/><joint joint="second" coef="-1"/></fixed></tendon>',
    "weld": '<equality><weld body1="b" body2="d" torquescale=".3"/></equality>',
}
# Integrator, damping of the joints, flag eulerdamp, and what moves the bodies.
INTEGRATORS = {
    "Euler": ("Euler", 0.0, "enable", "acceleration"),
    "damped Euler": ("Euler", 0.3, "enable", "forces"),
    "Euler without eulerdamp": ("Euler", 0.3, "disable", "acceleration"),
    "implicit": ("implicit", 0.3, "enable", "forces"),
    "implicitfast": ("implicitfast", 0.3, "enable", "forces"),
    "discrete": ("discrete", 0.3, "enable", "acceleration"),
}
HAS_DISCRETE = mj is not None and hasattr(mj.mjtIntegrator, "mjINT_DISCRETE")
N_STEPS = 6


def make_model(integrator, cone, solver, feature, iterations):
    kind, damping, eulerdamp, _ = INTEGRATORS[integrator]
    if kind == "discrete" and not HAS_DISCRETE:
        pytest.skip("this MuJoCo has no integrator discrete")
    xml = MODEL.format(
        integrator=kind,
        cone=cone,
        solver=solver,
        iterations=iterations,
        eulerdamp=eulerdamp,
        damping=damping,
        joint=JOINTS.get(feature, ""),
        more=MORE.get(feature, ""),
    )
    return mj.MjModel.from_xml_string(xml)


def iterate_steps(model):
    """Yield the data before each step, after its forward pass, and after the step."""
    data = mj.MjData(model)
    data.qvel[:] = 0.3 * np.random.default_rng(0).standard_normal(model.nv)
    for _ in range(N_STEPS):
        forward, after = mj.MjData(model), mj.MjData(model)
        for copied in (forward, after):
            mj.mj_copyData(copied, model, data)
        mj.mj_forward(model, forward)
        mj.mj_step(model, after)
        if (
            np.abs(forward.qacc).max() > 1e10
        ):  # Two iterations of CG diverge on a weld: MuJoCo restarts.
            return
        yield data, forward, after
        data = after


def get_row_jacobian(model, data):
    return adapter.scaling(model, data)[:, None] * adapter.jacobian(model, data).toarray()


every_model = [
    pytest.mark.parametrize("integrator", INTEGRATORS),
    pytest.mark.parametrize("cone", ["pyramidal", "elliptic"]),
    pytest.mark.parametrize("solver", ["PGS", "CG", "Newton"]),
    pytest.mark.parametrize("feature", [*JOINTS, *MORE]),
]


def test_engine_answer_of_unconverged_solve_predicts_the_next_velocity(
    integrator, cone, solver, feature
):
    model = make_model(integrator, cone, solver, feature, iterations=2)
    for _, forward, after in iterate_steps(model):
        for data in (forward, after):
            answer = adapter.engine_answer(model, data)
            assert answer.moved_by == INTEGRATORS[integrator][3]
            # Sums of at most 20 rows in another order.
            np.testing.assert_allclose(answer.velocity, after.qvel, rtol=1e-9, atol=1e-12)
            record = adapter.from_mujoco(model, data).record
            np.testing.assert_array_equal(record.prediction, answer.velocity)


def test_residual_of_acceleration_is_the_distance_of_row_velocities_from_the_exact_step(
    integrator, cone, solver, feature
):
    if INTEGRATORS[integrator][3] == "forces":
        pytest.skip("forces are judged by their own residual")
    if (integrator, solver, feature) == ("discrete", "PGS", "tendon"):
        pytest.skip(
            "with PGS, the matrix of discrete has no tendons, so that Newton solves another problem"
        )
    model, exact = (
        make_model(integrator, cone, name, feature, n) for name, n in ((solver, 2), ("Newton", 300))
    )
    exact.opt.ls_iterations, exact.opt.ls_tolerance = 300, 1e-10
    n_judged = 0
    for before, forward, after in iterate_steps(model):
        solved = mj.MjData(exact)
        mj.mj_copyData(solved, exact, before)
        mj.mj_step(exact, solved)
        distances = np.abs(get_row_jacobian(model, forward) @ (after.qvel - solved.qvel))
        is_elliptic = forward.efc_type == mj.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC
        slips = np.linalg.norm(distances[is_elliptic].reshape(-1, 3)[:, 1:], axis=1)
        distance = max(distances.max(), slips.max(initial=0.0))
        for data in (forward, after):
            problem = lv.io.from_mujoco(model, data)
            impulse = adapter.impulse(model, data)
            found = lv.residual(problem, impulse)
            if found.at_floor:
                assert distance < 1e-9
            else:
                n_judged += 1
                assert found.moved_by == "acceleration"
                # Both Newton methods stop at about 1e-12 m/s.
                np.testing.assert_allclose(found.velocity, distance, rtol=1e-4, atol=1e-10)
                assert found.velocity <= np.sqrt(2.0) * found.velocity_by_row.max()
    assert n_judged or solver == "Newton"


def test_acceleration_of_an_island_is_compared_with_this_island_alone():
    """The second of two blocks, which land at 100 and 1 m/s, keeps half of its speed."""
    problem = lv.Problem.from_jacobian(
        np.eye(2),
        np.eye(2),
        [-100.0, -1.0],
        cones=lv.Cones.bounded([0.0, 0.0], np.inf),
        compliance=0.1,
    )
    impulse = np.array([100.0, 0.5]) / 1.1
    answer = EngineMotion(impulse, impulse, problem.compliance, "acceleration")
    vars(problem)["record"] = EngineRecord(answer)
    found = lv.residual(problem, impulse)
    assert found.moved_by == "acceleration"
    np.testing.assert_allclose((found.velocity, found.relative), 0.5 / 1.1, rtol=1e-9)


@pytest.mark.parametrize("options", [{"max_iter": 50}, {"history": True}])
def test_solve_from_an_engines_forces_judges_forces_also_if_its_acceleration_is_exact(options):
    problem = lv.Problem.from_jacobian(
        np.eye(2), np.eye(2), [-3.0, -1.0], cones=lv.Cones.bounded([0.0, 0.0], np.inf)
    )
    exact = np.array([3.0, 1.0])
    vars(problem)["record"] = EngineRecord(
        EngineMotion(0.5 * exact, exact, np.ones(2), "acceleration")
    )
    assert lv.residual(problem, 0.5 * exact).relative < 1e-12
    solution = lv.solve(problem, impulse=0.5 * exact, tol=1e-9, **options)
    assert solution.success
    np.testing.assert_allclose(solution.impulse, exact, rtol=1e-9)


for mark in every_model:
    test_engine_answer_of_unconverged_solve_predicts_the_next_velocity = mark(
        test_engine_answer_of_unconverged_solve_predicts_the_next_velocity
    )
    test_residual_of_acceleration_is_the_distance_of_row_velocities_from_the_exact_step = mark(
        test_residual_of_acceleration_is_the_distance_of_row_velocities_from_the_exact_step
    )


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("solver", ["PGS", "Newton"])
def test_from_mujoco_many_judges_and_predicts_as_single_steps(integrator, solver):
    model = make_model(integrator, "elliptic", solver, "tendon", iterations=2)
    states, after, single = [], [], []
    for before, forward, stepped in iterate_steps(model):
        states.append(get_state(model, before))
        after.append(stepped.qvel.copy())
        single.append(
            lv.residual(lv.io.from_mujoco(model, forward), adapter.impulse(model, forward))
        )
    velocity = np.empty((len(states), model.nv))
    imported = lv.io.from_mujoco_many(model, np.array(states), velocity=velocity)
    np.testing.assert_allclose(velocity, after, rtol=1e-9, atol=1e-12)
    many = lv.residual_many(imported.batch, imported.impulse)
    # The blocks of an equality differ, and sums have another order.
    np.testing.assert_allclose(
        many.velocity_error, [x.velocity for x in single], rtol=1e-6, atol=1e-12
    )
    for i, error in enumerate(many.velocity_error):
        assert many[i].velocity == error


def test_a_saved_problem_keeps_the_motion_of_the_engine(tmp_path):
    model = make_model("Euler", "pyramidal", "PGS", "armature", iterations=2)
    for _, data, _ in iterate_steps(model):
        problem = lv.io.from_mujoco(model, data)
        impulse = adapter.impulse(model, data)
        lv.io.save(problem, tmp_path / "step.npz", impulse=impulse)
        stored = lv.io.read(tmp_path / "step.npz")
        found = lv.residual(stored.problem, stored.impulse)
        assert found.moved_by == "acceleration"
        assert found.velocity == lv.residual(problem, impulse).velocity
        # A file without impulses or with others, a copy and a pickle keep the motion, too.
        again = [copy.copy(problem), copy.deepcopy(problem), pickle.loads(pickle.dumps(problem))]
        for given in (None, np.zeros(problem.m)):
            lv.io.save(problem, tmp_path / "step.npz", impulse=given)
            again.append(lv.io.read(tmp_path / "step.npz").problem)
        for other in again:
            assert lv.residual(other, impulse).velocity == found.velocity
            assert lv.residual(other, impulse).moved_by == "acceleration"


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_recorder_warns_of_a_step_that_its_answer_does_not_predict(integrator, tmp_path):
    model = make_model(integrator, "pyramidal", "Newton", "armature", iterations=2)
    data = mj.MjData(model)
    with lv.io.Recorder(tmp_path / "steps", every=1) as recorder:

        def record():
            mj.mj_step(model, data)
            return recorder.add(lv.io.from_mujoco(model, data), adapter.impulse(model, data))[
                0
            ].prediction_gap

        assert [record() for _ in range(3)] == [0.0, 0.0, 0.0]
        problem = lv.io.from_mujoco(model, data)
        impulse = adapter.impulse(model, data)
        mj.mj_step(model, data)  # The data no longer belong to the problem.
        assert np.isnan(recorder.add(problem, impulse)[0].prediction_gap)
        mj.set_mjcb_control(lambda model, data: data.qfrc_applied.__setitem__(0, 5.0))
        try:
            data.qfrc_applied[:] = 0.0
            mj.mj_step(model, data)
        finally:
            mj.set_mjcb_control(None)
        data.qvel[0] += 0.5  # A push of the user after the step.
        problem = lv.io.from_mujoco(model, data)
        impulse = adapter.impulse(model, data)
        with pytest.warns(UserWarning, match="differs by 5.0e-01"):
            assert recorder.add(problem, impulse)[0].prediction_gap == pytest.approx(0.5)


@pytest.mark.parametrize("scale", [0.3, 1.0, 4.0])
def test_rotation_rows_of_a_weld_are_the_angular_velocity_for_every_torque_scale(scale):
    mj = pytest.importorskip("mujoco")
    model = mj.MjModel.from_xml_string(f"""<mujoco><worldbody>
      <body name="a" pos="0 0 1"><freejoint/><geom size=".1"/></body>
      <body name="b" pos="0 .3 1"><freejoint/><geom size=".1"/></body></worldbody>
      <equality><weld body1="a" body2="b" torquescale="{scale}"/></equality></mujoco>""")
    data = mj.MjData(model)
    mj.mj_forward(model, data)
    problem = lv.io.from_mujoco(model, data)
    jac = problem.generalized.jac.toarray()
    np.testing.assert_allclose(np.abs(jac[:, 9:12]), np.eye(6)[:, 3:], atol=1e-12)
    assert [problem.row_unit(k) for k in range(6)] == 3 * [problem.row_unit(0)] + 3 * [
        problem.row_unit(3)
    ]


@pytest.mark.parametrize("iterations", [1, 100])
@pytest.mark.parametrize(("integrator", "off"), [("RK4", False), ("Euler", True)])
def test_motions_of_many_worlds_have_the_numbers_of_single_calls(integrator, off, iterations):
    """The compiled loop judges accelerations, also if the solver stops early; other impulses are judged themselves."""
    model, data = state("elliptic", condim=3)
    kinds = mj.mjtIntegrator
    model.opt.integrator = kinds.mjINT_RK4 if integrator == "RK4" else kinds.mjINT_EULER
    model.opt.disableflags |= int(mj.mjtDisableBit.mjDSBL_EULERDAMP) if off else 0
    model.opt.iterations = iterations
    kind = mj.mjtState.mjSTATE_INTEGRATION
    states = np.empty((24, mj.mj_stateSize(model, kind)))
    for i, of_world in enumerate(states):
        world = mj.MjData(model)
        mj.mj_copyData(world, model, data)
        world.qvel[:] += 0.5 * np.random.default_rng(i).standard_normal(model.nv)
        mj.mj_getState(model, world, of_world, kind)
    batch, impulse = lv.io.from_mujoco_many(model, states)
    changed = np.asarray(impulse).copy()
    changed[batch.rows_of(3)] *= 0.9  # not what moved the bodies
    many = lv.residual_many(batch, changed)
    moved = 0
    for i in range(len(batch)):
        one = lv.residual(batch[i], changed[batch.rows_of(i)])
        found = many[i]
        for name in (
            "relative",
            "energy",
            "velocity",
            "roundoff_floor",
            "above_floor",
            "worst_row",
            "moved_by",
        ):
            assert getattr(found, name) == getattr(one, name), (i, name)
        assert many.verdict[i] == one.verdict
        moved += one.moved_by == "acceleration"
    assert many[3].moved_by == "impulse"
    assert iterations > 1 or moved >= 20
