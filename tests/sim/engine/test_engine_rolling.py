"""Rolling friction in LavenderSim: the step, its problem, its cache and who refuses it."""

import numpy as np
import pytest

import lavender as lv

G = 9.81


def ball(rolling=0.02, speed=2.0, radius=0.5, **more):
    scene = lv.Scene(rolling_radius=rolling, **more)
    scene.add_plane()
    scene.add_sphere(
        radius,
        position=(0, 0, radius),
        velocity=(speed, 0, 0),
        angular_velocity=(0, speed / radius, 0),
    )
    return lv.Simulation(scene)


def pile(**more):
    scene = lv.Scene(rolling_radius=0.03, substeps=1, **more)
    scene.add_plane()
    for i in range(12):
        scene.add_sphere(0.2, position=(0.11 * i % 0.5, 0.17 * i % 0.4, 0.25 + 0.35 * i))
    scene.add_box((0.4, 0.3, 0.2), position=(1.0, 0.0, 0.3))
    return lv.Simulation(scene)


@pytest.mark.parametrize("patch", [0.0, 0.1])
def test_a_ball_rolls_to_rest_where_the_moment_stops_it(patch):
    sim = ball(patch_radius=patch)
    radius = 0.5
    speed = 2.0
    reach = 0.02
    truth = 7 * radius * speed**2 / (10 * reach * G)
    seen = sim.step()[0]
    assert seen["contacts"]["impulses"].shape == (1, 5 + (patch > 0.0))
    while np.abs(seen["velocities"][1]).max() > 1e-9:
        seen = sim.step()[0]
        assert sim.time < 2.0 * (2.0 * truth / speed)
    # Steps of 1/240 s on an even deceleration: v h of the place.
    assert abs(seen["positions"][1, 0] / truth - 1.0) < 0.01


def test_warm_start_restores_rolling_moments():
    """A resting pile warm-started solves better than a cold one at the same sweeps."""
    warm, cold = pile(warm_start=True), pile(warm_start=False)
    for sim in (warm, cold):
        for _ in range(400):
            sim.step()
    a, b = (
        lv.residual(s.constraint_problem(), s.constraint_problem().start()) for s in (warm, cold)
    )
    guess = warm.constraint_problem().guess
    rows = warm.constraint_problem().cones.rolling_rows
    assert np.abs(guess[rows[rows >= 0]]).max() > 0.0
    assert lv.residual(warm.constraint_problem(), guess).energy < 0.2 * min(a.energy, b.energy)


def test_ball_without_friction_does_not_roll():
    assert not ball(friction=0.0).constraint_problem().cones.has_rolling


def test_ball_without_a_patch_rolls_next_to_balls_with_one():
    scene = lv.Scene(rolling_radius=0.05, substeps=1)
    scene.add_plane(patch_radius=0.1)
    for i, patch in enumerate((0.1, 0.0)):
        scene.add_sphere(
            0.5, position=(2.0 * i, 0, 0.5), angular_velocity=(0, 4.0, 9.0), patch_radius=patch
        )
    sim = lv.Simulation(scene)
    for _ in range(5):
        problem = sim.constraint_problem()
        seen = sim.step()[0]
    sizes = np.diff(problem.cones.ptr)
    assert sorted(sizes.tolist()) == [5, 6]
    impulses = seen["contacts"]["impulses"]
    assert not impulses[sizes == 5, 3].any() and impulses[sizes == 6, 3].all()
    # Where it slips the moment is at its bound.
    np.testing.assert_allclose(
        np.linalg.norm(impulses[:, 4:], axis=1), 0.05 * impulses[:, 0], rtol=1e-9
    )
