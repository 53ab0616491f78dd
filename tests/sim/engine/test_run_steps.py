"""`Simulation.run`: many steps in one call are the same steps, also where one of them ends the run."""

import numpy as np
import pytest
from worked import after

import lavender as lv


def state_of(simulation):
    s = simulation.snapshot()
    return s.steps, s.failed, s.lost, s.real.tobytes(), s.index.tobytes(), s.keys.tobytes()


# 300 substeps a step are more than one compiled call does; a pile grows its buffers in the middle of a run.
@pytest.mark.parametrize(
    "name, n, parameters",
    [
        ("stack", 7, {"dt": 1 / 60, "substeps": 4}),
        ("stack", 2, {"substeps": 300}),
        ("pile", 90, {"n": 40}),
        ("four_bar", 40, {}),
        ("stack", 5, {"solver": "newton"}),
        ("stack", 5, {"solver": "pgs", "solver_options": {"tol": 0}, "substeps": 2}),
    ],
)
def test_run_gives_the_bits_of_single_steps(name, n, parameters):
    single = lv.Simulation(lv.Scene(name, **parameters), report_residual=True)
    many = lv.Simulation(lv.Scene(name, **parameters), report_residual=True)
    for _ in range(n):
        expected = single.step()
    found = many.run(n)
    assert state_of(many) == state_of(single)
    assert found[4] == expected[4] and found[1:4] == expected[1:4]
    for key in ("positions", "velocities", "solver"):
        assert found[0][key].tobytes() == expected[0][key].tobytes()


@pytest.mark.parametrize("solver", ["sequential_impulses", "newton"])
def test_run_ends_at_the_step_that_loses_a_body(solver):
    scene = lv.Scene("ramp", gravity=1e60, solver=solver)
    single = lv.Simulation(scene)
    many = lv.Simulation(scene)
    with np.errstate(over="ignore", invalid="ignore"):  # a state about to be lost
        while not single.step()[2]:
            pass
        terminated, _, info = many.run(10_000)[2:]
    assert terminated and info["lost_body"] == "box 1"
    assert info["step"] == many.steps == single.steps


def test_run_that_raises_keeps_the_complete_steps():
    # A tolerance that two iterations do not reach once the box lies on the ground.
    options = {"solver": "pgs", "solver_iterations": 2, "on_failure": "raise"}
    simulation = lv.Simulation(lv.Scene("stack", n=8, warm_start=False, **options))
    simulation.state.a["x"][1:, 2] += 0.05  # no contact in the first steps
    with pytest.raises(lv.SolveFailed):
        simulation.run(50)
    assert 0 < simulation.steps < 50
    assert simulation.snapshot().steps == simulation.steps


def test_run_from_a_snapshot_continues_with_the_same_bits():
    simulation = after(20, "pile", n=30)
    other = lv.Simulation(simulation.scene)
    other.restore(simulation.snapshot())
    found = other.run(30)[0]
    expected = simulation.run(30)[0]
    for key in ("positions", "quaternions", "velocities", "solver"):
        assert found[key].tobytes() == expected[key].tobytes()


@pytest.mark.parametrize("n", [0, -1, 2.5, "3", True])
def test_run_refuses_other_numbers_of_steps(n):
    with pytest.raises(lv.InputError, match="n is"):
        lv.Simulation("stack").run(n)
