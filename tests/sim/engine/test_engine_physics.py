"""The engine against closed forms, conservation laws, and the convergence laws of its own sweeps."""

import numpy as np
import pytest

import lavender as lv
from lavender.sim.scene.parts import convert_to_rotation_matrix

G = 9.81


def run(sim, steps):
    for _ in range(steps):
        observation, _, terminated, *_ = sim.step()
        assert not terminated
    return observation


def test_a_projectile_follows_the_integrator_exactly_and_physics_to_first_order():
    errors = []
    for n in (100, 200):
        scene = lv.Scene(dt=1.0 / n, substeps=1)
        scene.add_sphere(position=(0, 0, 5), velocity=(3, 0, 4))
        x = run(lv.Simulation(scene), n)["positions"][0]
        # Semi-implicit Euler over 1 s: z = z0 + v0 - g h^2 n (n + 1) / 2.
        assert x == pytest.approx([3.0, 0.0, 9.0 - G / n**2 * n * (n + 1) / 2], abs=1e-12)
        errors.append(abs(x[2] - (9.0 - 0.5 * G)))
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=1e-9)


def test_scene_of_two_spheres_bounces_elastically():
    scene = lv.Scene(gravity=0.0, restitution=1.0, friction=0.0)
    scene.add_sphere(0.5, 1.0, position=(-1, 0.1, 0), velocity=(2, 0, 0))
    scene.add_sphere(0.4, 3.0, position=(1, -0.2, 0.3), velocity=(-1, 0.2, 0))
    sim = lv.Simulation(scene)
    mass = np.array([1.0, 3.0])

    def sums(v):
        return np.array([0.5 * mass @ (v**2).sum(axis=1), *(mass @ v)])

    before = sums(sim.reset()[0]["velocities"][:, :3])
    observation = run(sim, 120)
    assert np.linalg.norm(observation["velocities"][0, :3] - [2, 0, 0]) > 1.0  # they met
    np.testing.assert_allclose(sums(observation["velocities"][:, :3]), before, rtol=0, atol=1e-14)


def test_scene_restitution_gives_its_speed_and_slow_contacts_do_not_bounce():
    for e, threshold, expected in ((0.5, 0.1, 0.5), (0.5, 10.0, 0.0), (1.0, 0.1, 1.0)):
        scene = lv.Scene(restitution=e, gravity=0.0, restitution_threshold=threshold)
        scene.add_plane()
        scene.add_sphere(0.5, position=(0, 0, 1), velocity=(0, 0, -2))
        v = run(lv.Simulation(scene), 60)["velocities"][1, 2]
        assert v == pytest.approx(2.0 * expected, abs=1e-12)


@pytest.mark.parametrize("e", [1.0, 0.5])
def test_scene_restitution_under_gravity_returns_the_speed_before_the_step_in_fifty_bounces(e):
    """Each bounce returns e times the speed of the step before; with e = 1 the ball never climbs."""
    scene = lv.Scene(
        restitution=e, friction=0.0, dt=1.0 / 240.0, substeps=1, restitution_threshold=0.0, slop=0.0
    )
    scene.add_plane()
    scene.add_sphere(0.5, position=(0, 0, 1.5))
    sim = lv.Simulation(scene)
    before = 0.0
    speeds = []
    while len(speeds) < 50:
        after = float(run(sim, 1)["velocities"][1, 2])
        if before < 0.0 < after:
            assert after == pytest.approx(-e * before, rel=1e-9, abs=1e-14)
            speeds.append(after)
        before = after
    if e == 1.0:
        np.testing.assert_allclose(speeds, speeds[0], rtol=1e-9)
        assert speeds[0] < np.sqrt(2.0 * 9.81)


@pytest.mark.parametrize("kind", ["collisions", "joints"])
def test_a_closed_system_keeps_its_momentum(kind):
    scene = lv.Scene(gravity=0.0, friction=0.5, position_iterations=0)
    rng = np.random.default_rng(4)
    if kind == "collisions":
        for i in range(6):
            scene.add_box(
                rng.uniform(0.4, 0.8, 3),
                position=(i * 0.8, 0, 0),
                velocity=(3 - i, 0.1 * i, 0),
                quaternion=rng.normal(size=4),
            )
    else:
        a = scene.add_box((1, 0.2, 0.3), position=(0, 0, 0), angular_velocity=(1, 2, 3))
        b = scene.add_box((0.5, 0.6, 0.3), 2.0, position=(1, 0, 0), velocity=(0, 1, 0))
        scene.add_joint("distance", a, b, anchor_a=(0.5, 0, 0), anchor_b=(0.8, 0.1, 0))
    sim = lv.Simulation(scene)

    def momentum(o):
        linear, angular = np.zeros(3), np.zeros(3)
        for b, x, q, v in zip(
            scene.bodies, o["positions"], o["quaternions"], o["velocities"], strict=True
        ):
            r = convert_to_rotation_matrix(q)
            linear += b.mass * v[:3]
            angular += np.cross(x, b.mass * v[:3]) + r @ b.inertia @ r.T @ v[3:]
        return np.concatenate([linear, angular])

    before = momentum(sim.reset()[0])
    contacts = 0
    for _ in range(240):
        last = run(sim, 1)
        contacts += int(last["solver"][2])
    after = momentum(last)
    assert contacts > 0 or kind != "collisions"
    # Rounding of a few hundred additions near 10 kg m^2/s.
    np.testing.assert_allclose(after, before, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(last["quaternions"], axis=1), 1.0, atol=1e-15)


def test_scene_motor_turns_its_joint_within_its_torque():
    sim = lv.Simulation(lv.Scene("four_bar", motor=2.0, solver_iterations=64))
    speed = np.linalg.norm(run(sim, 240)["velocities"][0, 3:])
    assert speed == pytest.approx(2.0, rel=1e-3)
    weak = lv.Simulation(lv.Scene("four_bar", motor=50.0, torque=3.0))
    impulses = run(weak, 5)["joint_impulses"]
    assert impulses[5] == pytest.approx(
        3.0 / 240.0, rel=1e-12
    )  # torque times the substep, at its bound


def slope(angle, turned, shape, **more):
    """Speed [m/s] down a slope after a second, the first tangent `turned` from the way down."""
    g, mu = 9.81, 0.5
    down = g * np.sin(angle)
    scene = lv.Scene(
        gravity=(down * np.cos(turned), down * np.sin(turned), -g * np.cos(angle)),
        friction=mu,
        friction_shape=shape,
        **more,
    )
    scene.add_plane()
    scene.add_box((1.0, 1.0, 0.2), position=(0.0, 0.0, 0.1))
    sim = lv.Simulation(scene)
    for _ in range(120):
        observation = sim.step()[0]
    return float(np.linalg.norm(observation["velocities"][1, :2]))


@pytest.mark.parametrize("more", [{}, {"solver": "newton"}])
def test_a_box_grips_more_on_the_diagonal(more):
    g = 9.81
    mu = 0.5
    root = np.sqrt(2.0)
    for turned, grip in ((0.0, mu), (np.pi / 4, root * mu)):
        below = np.arctan(grip) - 0.01
        above = np.arctan(grip) + 0.05
        assert slope(below, turned, "box", **more) < 1e-3
        speed = g * (np.sin(above) - grip * np.cos(above)) * 1.0
        assert slope(above, turned, "box", **more) == pytest.approx(speed, rel=0.02)
    assert slope(np.arctan(mu) + 0.05, np.pi / 4, "disk", **more) > 0.3
