"""The position projection enlarges no error of a contact, and removes what is left at the end of the step alone."""

import numpy as np
import pytest

import lavender as lv
from lavender.sim.engine.layout import HEAD


def two_cubes(ratio, *, lowered=0.0, **more):
    """Cubes of 0.5 m, `ratio` kg on 1 kg on a plane, the lower one `lowered` [m] deep, the upper one twice that."""
    scene = lv.Scene(solver="newton", **more)
    scene.add_plane()
    scene.add_box((0.5, 0.5, 0.5), mass=1.0, position=(0, 0, 0.25 - lowered))
    scene.add_box((0.5, 0.5, 0.5), mass=ratio, position=(0, 0, 0.75 - 3 * lowered))
    return lv.Simulation(scene)


@pytest.mark.parametrize("ratio", [30.0, 1000.0])
def test_heavy_cube_at_rest_without_slop_stays_where_it_is(ratio):
    sim = two_cubes(ratio, dt=0.001, slop=0.0)
    start = sim.reset()[0]["positions"]
    for _ in range(3500):
        found = sim.step()[0]["positions"]
    np.testing.assert_allclose(
        found, start, atol=1e-6
    )  # round-off, 1e-9 m measured, which no step amplifies


@pytest.mark.parametrize("ratio", [1.0, 10.0, 100.0, 1000.0])
def test_heavy_cube_that_starts_20_mm_deep_is_raised_and_no_step_makes_a_contact_deeper(ratio):
    sim = two_cubes(ratio, lowered=0.01, dt=1 / 240, slop=0.0)
    depth = [sim.step()[0]["contacts"]["depth"].max() for _ in range(40)]
    assert max(depth) <= 0.02 * (1 + 1e-9)
    assert depth[-1] < 0.015


@pytest.mark.parametrize("solver", ["sequential_impulses", "newton"])
@pytest.mark.parametrize("speed", [0.0, 0.1, 0.5, 0.9, 1.0, 3.0])
def test_projection_of_a_body_that_leaves_is_that_of_a_body_at_rest_where_it_arrives(solver, speed):
    dt, depth = 0.01, 0.01

    def step(depth, speed):
        scene = lv.Scene(solver=solver, dt=dt, gravity=(0, 0, 0), substeps=1)
        scene.add_plane()
        scene.add_sphere(0.1, position=(0, 0, 0.1 - depth), velocity=(0, 0, speed))
        return lv.Simulation(scene).step()[0]["positions"][1, 2]

    assert step(depth, speed) == pytest.approx(step(depth - dt * speed, 0.0), abs=1e-12)


@pytest.mark.parametrize("substeps", [2, 4, 8])
def test_projection_in_a_step_is_that_of_short_steps(substeps):
    """The gap of a ball is exact while it moves along the normal, so that kept contacts know what projection did."""

    def push_out(dt, substeps, steps):
        scene = lv.Scene(dt=dt, substeps=substeps, gravity=(0, 0, 0))
        scene.add_plane()
        for i, depth in enumerate((0.002, 0.004, 0.0075)):
            scene.add_sphere(1.0, position=(3.0 * i, 0, 1.0 - depth))
        sim = lv.Simulation(scene)
        for _ in range(steps):
            found = sim.step()[0]
        return found["positions"], sim.state.head[HEAD["rebuilt"]]

    kept, is_rebuilt = push_out(0.01 * substeps, substeps, 1)
    np.testing.assert_allclose(kept, push_out(0.01, 1, substeps)[0], rtol=0, atol=1e-12)
    assert not is_rebuilt


@pytest.mark.parametrize("angle", [0.01, 0.1])
def test_projection_of_an_angle_does_not_depend_on_the_error_of_the_point(angle):
    """The hinge is at the centre of mass, so that its linear and angular rows do not act on each other."""
    left = []
    for away in (0.0, 0.1, 3.0):
        scene = lv.Scene(dt=0.01, substeps=1, gravity=(0, 0, 0))
        scene.add_box(position=(0, 0, 0))
        scene.add_joint("hinge", -1, 0, anchor=(0, 0, 0), axis=(0, 0, 1))
        sim = lv.Simulation(scene)
        sim.state.a["x"][0, 0] = away
        sim.state.a["q"][0] = np.cos(angle / 2), np.sin(angle / 2), 0, 0
        found = sim.step()[0]
        left.append(2 * np.arcsin(np.linalg.norm(found["quaternions"][0, 1:3])))
        assert abs(found["positions"][0, 0]) < away or away == 0.0
    assert 0.0 < left[0] < angle and left == pytest.approx(left[:1] * 3, rel=1e-9)
