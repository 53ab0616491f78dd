"""Steps of `newton`: its first phase on the engine's arrays is the one of `lavender.solve`, bit for bit."""

import dataclasses
import itertools

import numpy as np
import pytest
from newton_steps import NewtonSteps
from random_problems import good
from worked import after

import lavender as lv
from lavender_ext.newton.warm_start import FACTORED

SCENES = [
    ("stack", {"n": 5}),
    ("stack", {"n": 4, "friction": 0.0}),
    ("stack", {"n": 4, "patch_radius": 0.1}),
    ("pyramid", {"base": 5}),
    ("pyramid", {"base": 5, "friction": 0.15}),
    ("ramp", {}),
    ("chain", {"n": 12}),
    ("bridge", {"n": 5}),
    ("four_bar", {}),
    ("newtons_cradle", {"substeps": 1}),
    ("pile", {"n": 12}),
]


def impulses(sim, observation):
    first = len(sim.state.a["joint_impulse"])
    rows = int(sim.state.head[1])
    return np.concatenate(
        [observation["joint_impulses"], sim.state.a["impulse"][first : first + rows]]
    )


@pytest.mark.parametrize(("name", "more"), SCENES)
def test_scene_step_by_newton_has_the_bits_of_solve(name, more):
    sim = lv.Simulation(lv.Scene(name, solver="newton", **more))
    judged = 0
    for step in range(45):
        problem = sim.constraint_problem()
        observation = sim.step()[0]
        if problem.m == 0:
            assert sim.last_solution is None
            continue
        found = lv.solve(problem, "newton", max_iter=sim.solver_iterations)
        told = sim.last_solution
        np.testing.assert_array_equal(
            impulses(sim, observation), found.impulse, err_msg=f"step {step}"
        )
        np.testing.assert_array_equal(told.impulse, found.impulse)
        assert (told.status, dict(told.work), told.message) == (
            found.status,
            dict(found.work),
            found.message,
        )
        assert told.residual.relative == found.residual.relative
        assert told.claim_check == "confirmed"
        assert found.claim_check == "confirmed"
        # what the observation says of the normal rows, to rounding: the judge forms w in another order
        contact = problem.cones.ptr[:-1][problem.cones.kind > 0]
        error = np.abs(found.residual.error[contact]).max(initial=0.0)
        size = np.abs(found.impulse).max() + np.abs(problem.b / problem.d).max()
        assert observation["solver"][5] == pytest.approx(error, abs=1e-12 * size)
        judged += 1
    assert judged >= 15  # the scenes touch something from the first half second on


def test_scene_step_from_a_warm_start_within_tol_returns_it():
    sim = after(100, "pyramid", base=4)
    problem = sim.constraint_problem()
    exact = lv.solve(problem, "newton", tol=1e-10).impulse
    again = lv.solve(problem, "newton", impulse=exact, tol=1e-8)
    np.testing.assert_array_equal(again.impulse, exact)
    assert dict(again.work) == {"factorisations": 0} and again.message == "the start is a solution"


#: One substep of 1/120 s in the order given: contacts on which rounds and polishes alone do not end.
ONE = {"substeps": 1, "order": "given"}


def problem_in(scene, step, **parameters):
    """What `step + 1` steps of a scene lead to, without its warm start."""
    return dataclasses.replace(
        after(step + 1, scene, **parameters).constraint_problem(), guess=None
    )


@pytest.mark.parametrize(
    ("scene", "step", "parameters"),
    [
        ("pyramid", 1, {}),
        ("pyramid", 3, {"friction": 0.2}),
        ("pyramid", 12, {"friction": 0.2}),
        ("card_house", 1, ONE),
        ("card_house", 3, ONE),
        ("table", 3, {"friction": 1.0, **ONE}),
    ],
)
def test_scene_step_by_newton_of_redundant_contacts_at_rest_is_exact(scene, step, parameters):
    problem = problem_in(scene, step, **parameters)
    assert problem.law == "coulomb"
    solution = lv.solve(problem, "newton", tol=1e-8)
    assert good(solution, 1e-8), str(solution)
    assert "sweeps" not in solution.work


@pytest.mark.parametrize("law", ["coulomb", "cone"])
@pytest.mark.parametrize(("step", "friction"), [(45, 0.5), (60, 0.1), (99, 0.5)])
def test_scene_bridge_of_nearly_dependent_hinges_is_solved_by_newton(step, friction, law):
    problem = problem_in("bridge", step, friction=friction, **ONE)
    rows = np.flatnonzero(np.isinf(problem.cones.upper) & np.isinf(problem.cones.lower))
    scale = 1.0 / np.sqrt(problem.d)
    h = problem.dense() * scale[:, None] * scale[None, :]
    joints = rows[rows < problem.cones.ptr[problem.rows.n_joints]]
    smallest = np.linalg.eigvalsh(h[np.ix_(joints, joints)])[0]
    assert smallest < 1e-9  # far below what K K^T keeps beside contacts with W of 1e-10 to 1e10
    solution = lv.solve(
        problem if law == "coulomb" else problem.relaxed("cone"), "newton", tol=1e-8
    )
    assert good(solution, 1e-8), str(solution)


def test_scene_step_by_newton_keeps_the_best_point():
    problem = problem_in("table", 1, friction=1.0)
    budgets = [
        lv.solve(problem, "newton", tol=1e-8, max_iter=n).residual.relative
        for n in (30, 60, 120, 240)
    ]
    assert all(later <= earlier for earlier, later in itertools.pairwise(budgets))


@pytest.mark.parametrize(
    ("scene", "parameters"), [("spinner", {}), ("stack", {"n": 1}), ("stack", {"n": 2})]
)
def test_scene_step_by_newton_with_a_full_factor_reaches_the_tolerance(scene, parameters):
    """The scratch of a substep is allocated before the analysis: it must hold the pattern of a full factor."""
    run = NewtonSteps(scene, warm_start=False, **parameters)
    for _ in range(40):
        values = run.step()
        assert np.isfinite(values).all()
    assert all(run.ended)


def test_scene_step_by_newton_with_more_bodies_than_its_first_workspace_runs():
    """1,596 boxes: the pattern of the factor needs more integers than the order, and the plan says how many."""
    steps = NewtonSteps("pyramid", base=56)
    steps.substeps = 1
    steps.step()
    code, _, factorisations, relative = steps.told
    assert code == FACTORED and factorisations > 0 and relative <= steps.tol


@pytest.mark.parametrize("solver", ["newton", "pgs", "auto"])
def test_scene_step_without_rows_flies_like_the_sweeps_and_builds_no_problem(solver, monkeypatch):
    def fly(name):
        scene = lv.Scene(dt=0.01, substeps=2, solver=name)
        scene.add_plane()
        scene.add_box(
            (0.4, 0.3, 0.1), position=(0, 0, 50.0), velocity=(1, 2, 3), angular_velocity=(3, 1, 2)
        )
        sim = lv.Simulation(scene)
        for _ in range(20):
            observation = sim.step()[0]
        assert sim.last_solution is None
        return observation

    expected = fly("sequential_impulses")
    monkeypatch.setattr("lavender.sim.engine.stepping.build_problem", None)
    found = fly(solver)
    for quantity in ("positions", "quaternions", "velocities"):
        np.testing.assert_array_equal(found[quantity], expected[quantity])


def test_projection_does_not_stop_a_closed_loop():
    """Errors of 1e-6 m that the projection leaves make the redundant rows of a loop resist its motion."""
    fastest = {}
    for solver in ("newton", "sequential_impulses"):
        simulation = lv.Simulation(lv.Scene("four_bar", solver=solver))
        speeds = [np.abs(simulation.step()[0]["velocities"]).max() for _ in range(240)]
        fastest[solver] = max(speeds)
    # Stopped, the loop moved at 0.9 m/s at most; the swing reaches 8 rad/s, and sweeps end within 1 % of it.
    assert fastest["newton"] == pytest.approx(fastest["sequential_impulses"], rel=0.02)
