"""Closed forms and conservation laws of the engine's step, bits under units of mass, and the eight published values."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from worked import energy

import lavender as lv

G = 9.81


def run(scene, steps):
    sim = lv.Simulation(scene)
    for _ in range(steps):
        seen, _, lost, _, _ = sim.step()
        assert not lost
    return sim, seen


def test_soft_joint_under_a_weight_stretches_by_the_closed_form():
    hertz = 2.0
    scene = lv.Scene(dt=1 / 480)
    ball = scene.add_sphere(0.1, 2.0, position=(0, 0, 0))
    scene.add_joint("distance", -1, ball, anchor_a=(0, 0, 1.0), hertz=hertz, damping=1.0)
    _, seen = run(scene, 1440)
    assert -seen["positions"][0][2] == pytest.approx(G / (2 * math.pi * hertz) ** 2, rel=0.01)
    assert np.abs(seen["velocities"]).max() < 1e-3


@pytest.mark.parametrize("seed", range(2))
def test_thrown_bodies_gain_no_energy_and_do_not_pass_through_the_ground(seed):
    rng = np.random.default_rng(seed)
    scene = lv.Scene(dt=1 / 240, friction=rng.uniform())
    scene.add_plane()
    for i in range(8):
        more = {
            "position": (*rng.uniform(-0.6, 0.6, 2), 1.0 + 1.5 * i),
            "mass": 10.0 ** rng.uniform(-1, 1),
        }
        more |= {
            "velocity": rng.normal(scale=2.0, size=3),
            "angular_velocity": rng.normal(scale=3.0, size=3),
        }
        if rng.integers(2):
            scene.add_sphere(rng.uniform(0.1, 0.4), **more)
        else:
            turned = rng.normal(size=4)
            scene.add_box(
                rng.uniform(0.2, 0.8, 3), quaternion=turned / np.linalg.norm(turned), **more
            )
    sim = lv.Simulation(scene)
    start = energy(scene, sim.reset()[0])
    for _ in range(600):
        seen, _, lost, _, _ = sim.step()
        assert not lost
        assert energy(scene, seen) < 1.001 * start
    assert seen["positions"][1:, 2].min() > 0.05


@pytest.mark.parametrize("name", ["card_house", "bridge", "chain"])
def test_motion_has_the_same_bits_for_every_unit_of_mass(name):
    """Units of mass are powers of four, whose square roots are exact."""
    own = lv.Scene(name)
    seen = run(own, 20)[1]
    for unit in (2.0**-40, 2.0**12, 2.0**40):
        other = lv.Scene(name)
        other.bodies[:] = [
            replace(b, mass=unit * b.mass, inertia=unit * b.inertia) for b in own.bodies
        ]
        scaled = run(other, 20)[1]
        for key in ("positions", "quaternions", "velocities"):
            assert seen[key].tobytes() == scaled[key].tobytes(), key
        assert (unit * seen["joint_impulses"]).tobytes() == scaled["joint_impulses"].tobytes()


@pytest.mark.parametrize("shape", ["sphere", "box"])
def test_scene_body_slower_than_the_documented_bound_does_not_pass_a_wall(shape):
    """The bound on the motion of a substep is half of the body's thickness plus the margin, at any initial distance."""
    h = 1 / 240
    margin = 0.01
    passed = {
        0.3: 0,
        0.98: 0,
        1.9: 0,
    }  # Fractions of the bound; above 1 nothing is promised, and some pass.
    for share, size, wall in product(passed, (0.02, 0.2), (0.001, 0.1, None)):
        far = share * (0.5 * size + margin)  # m per substep
        for phase in (0.0, 0.2, 0.4, 0.6, 0.8, 0.999):
            scene = lv.Scene(dt=h, substeps=1, gravity=0.0, margin=margin)
            if wall is None:
                scene.add_plane()
            else:
                scene.add_box((2, 2, wall), position=(0, 0, -wall / 2), static=True)
            place = {
                "position": (0.01, 0.02, 0.5 * size + margin + phase * far),
                "velocity": (0, 0, -far / h),
            }
            if shape == "sphere":
                scene.add_sphere(size / 2, **place)
            else:
                scene.add_box((size,) * 3, **place)
            sim = lv.Simulation(scene)
            for _ in range(12):
                seen = sim.step()[0]
                speed = np.linalg.norm(seen["velocities"][1][:3])
                assert speed <= far / h * (1 + 1e-9), "a wall at rest adds no speed"
            passed[share] += bool(seen["positions"][1][2] <= 0.0)
    assert passed[0.3] == passed[0.98] == 0 < passed[1.9]
