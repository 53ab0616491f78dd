"""`Simulation.set_velocity`: the next step starts from the new velocity, and nothing before it changes."""

import numpy as np
import pytest
from test_engine_bits import trajectory

import lavender as lv

LINEAR, ANGULAR = (0.3, -0.2, 1.5), (0.4, 2.0, -0.1)  # m/s, rad/s


def boxes(velocity=(0.0, 0.0, 0.0), angular_velocity=(0.0, 0.0, 0.0), **parameters):
    """Three boxes on the ground; the middle one has a velocity and a name of its own."""
    scene = lv.Scene(**parameters)
    scene.add_plane()
    for i in range(3):
        moving = {"velocity": velocity, "angular_velocity": angular_velocity} if i == 1 else {}
        scene.add_box(
            (1.0, 1.0, 0.5), position=(0.0, 0.0, 0.25 + 0.5 * i), name=f"box {i}", **moving
        )
    return scene


@pytest.mark.parametrize("body", [2, "box 1"])
@pytest.mark.parametrize(
    "parameters",
    [{}, {"solver": "newton"}, {"restitution": 0.5}],
    ids=lambda parameters: str(*parameters.values()),
)
def test_set_velocity_gives_the_bits_of_a_scene_that_begins_with_it(parameters, body):
    sim = lv.Simulation(boxes(**parameters))
    sim.set_velocity(body, LINEAR)
    sim.set_velocity(body, angular_velocity=ANGULAR)  # the linear part stays
    twin = lv.Simulation(boxes(LINEAR, ANGULAR, **parameters))
    assert trajectory(sim, 30) == trajectory(twin, 30)


@pytest.mark.parametrize("solver", ["sequential_impulses", "newton"])
def test_set_velocity_keeps_published_arrays(solver):
    sim = lv.Simulation(boxes(solver=solver), report_residual=True)
    trajectory(sim, 5)
    published = sim.residual(), str(sim.last_solution and sim.last_solution.residual), sim.time
    before = sim.snapshot()
    sim.set_velocity("box 2", LINEAR, ANGULAR)
    assert (
        sim.residual(),
        str(sim.last_solution and sim.last_solution.residual),
        sim.time,
    ) == published
    after = sim.snapshot()
    assert np.flatnonzero(before.real != after.real).size == 6
    assert (before.index == after.index).all() and (before.keys == after.keys).all()


def test_set_velocity_does_not_continue_an_ended_simulation():
    sim = lv.Simulation(boxes())
    sim.set_velocity(2, (1e60, 0.0, 0.0))
    while not sim.step()[2]:
        pass
    with pytest.raises(lv.LavenderError, match="not finite"):
        sim.set_velocity(2, LINEAR)
