"""The world has no preferred axes: a scene that is turned as a whole moves as before, turned.

Contacts are left out: their tangents are chosen by the axes of the world, and the sweeps over them depend on that.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lavender as lv

TURNS = {
    "90 degrees about z": Rotation.from_rotvec([0, 0, np.pi / 2]),
    "45 degrees about z": Rotation.from_rotvec([0, 0, np.pi / 4]),
    "oblique": Rotation.from_rotvec([0.7, -1.1, 0.4]),
}


def build(turn, joints, solver, **parameters):
    """Build two bodies with different moments of inertia on joints; positions, directions and gravity are turned."""
    scene = lv.Scene(
        solver=solver, dt=1 / 240, gravity=tuple(turn.apply([0, 0, -9.81])), **parameters
    )
    for i, at in enumerate(([0.3, 0.1, -0.2], [0.7, 0.4, -0.5])):
        own = Rotation.from_rotvec([0.3 * i, 0.5, -0.2])
        q = (turn * own).as_quat()
        scene.add_body(
            1.0 + i,
            (0.02, 0.05, 0.06),
            position=tuple(turn.apply(at)),
            quaternion=(q[3], *q[:3]),
            angular_velocity=tuple(turn.apply([0.4, 0.2 - i, 0.3])),
        )
    for joint in joints:
        kind, a, b, *places = joint[:-1]
        more = dict(joint[-1])
        if kind == "distance":
            names = ("anchor_a", "anchor_b")
        else:
            names = ("anchor",)
            if kind == "hinge":
                more["axis"] = tuple(turn.apply([0.2, 1.0, 0.4]))
        scene.add_joint(
            kind,
            a,
            b,
            **{n: tuple(turn.apply(x)) for n, x in zip(names, places, strict=True)},
            **more,
        )
    return lv.Simulation(scene)


RIGID = [("ball", -1, 0, (0, 0, 0), {}), ("ball", 0, 1, (0.5, 0.2, -0.3), {})]
SOFT = {"hertz": 3.0, "damping": 0.1}
JOINTS = {
    "balls": RIGID,
    "hinges": [("hinge", -1, 0, (0, 0, 0), {}), ("hinge", 0, 1, (0.5, 0.2, -0.3), {})],
    "soft ball": [RIGID[0], ("ball", 0, 1, (0.5, 0.2, -0.3), SOFT)],
    "soft hinges": [("hinge", -1, 0, (0, 0, 0), SOFT), ("hinge", 0, 1, (0.5, 0.2, -0.3), SOFT)],
    "strings": [
        ("distance", -1, 0, (0, 0, 0.5), (0.3, 0.1, -0.1), {}),
        ("distance", 0, 1, (0.4, 0.1, -0.2), (0.7, 0.3, -0.5), SOFT),
    ],
}


# 240 steps amplify rounding, 1e-16 of 1 m, by less than 1e6.
@pytest.mark.parametrize("turn", TURNS.values(), ids=TURNS)
@pytest.mark.parametrize("joints", JOINTS.values(), ids=JOINTS)
def test_turned_scene_solved_directly_moves_as_before(joints, turn):
    first, second = (build(r, joints, "direct") for r in (Rotation.identity(), turn))
    for _ in range(240):
        a, b = first.step()[0], second.step()[0]
    np.testing.assert_allclose(turn.apply(a["positions"]), b["positions"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        turn.apply(a["velocities"][:, 3:]), b["velocities"][:, 3:], rtol=0, atol=1e-8
    )
    assert np.abs(a["positions"] - first.reset()[0]["positions"]).max() > 0.1  # m, they have moved


# One joint is solved by sweeps to rounding if its rows are decoupled: a soft joint in any axes.
@pytest.mark.parametrize("turn", TURNS.values(), ids=TURNS)
@pytest.mark.parametrize("kind", ["ball", "hinge"])
def test_turned_soft_joint_solved_by_four_sweeps_moves_as_before(kind, turn):
    joints = [(kind, -1, 0, (0, 0, 0), SOFT)]
    runs = (
        build(r, joints, "sequential_impulses", solver_iterations=4)
        for r in (Rotation.identity(), turn)
    )
    a, b = (sim.run(240)[0] for sim in runs)
    np.testing.assert_allclose(
        turn.apply(a["positions"][:1]), b["positions"][:1], rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("kind", ["ball", "hinge"])
@pytest.mark.parametrize("offset", [0.0, 0.3])
@pytest.mark.parametrize("along", [(1, 0, 0), (0, 0, 1)])
def test_soft_joint_has_its_frequency_wherever_the_centre_lies(kind, offset, along):
    # The block's mass is a matrix, so that the anchors move apart with the period 1/hertz in every direction.
    scene = lv.Scene(dt=1e-3, substeps=1, gravity=0.0)
    push = tuple(0.01 * np.array(along, float))
    scene.add_body(2.0, (0.1, 0.1, 0.1), position=(0, offset, 0), velocity=push)
    axis = {"axis": (0, 1, 0)} if kind == "hinge" else {}
    scene.add_joint(kind, -1, 0, anchor=(0, 0, 0), hertz=1.0, damping=0.0, **axis)
    sim = lv.Simulation(scene)
    apart = []
    for _ in range(4000):
        state = sim.step()[0]
        w, x, y, z = state["quaternions"][0]
        centre = Rotation.from_quat([x, y, z, w]).apply([0, offset, 0])
        apart.append((state["positions"][0] - centre) @ along)
    changes = np.flatnonzero(np.diff(np.sign(apart)))
    period = 2e-3 * (changes[-1] - changes[0]) / (len(changes) - 1)
    assert period == pytest.approx(1.0, rel=5e-3)  # an implicit spring of 1000 steps a period


def test_impulses_of_a_soft_hinge_are_its_force_and_moment():
    # A weight hangs still on a soft hinge with a horizontal axis beside its centre: the force is its weight, and the
    # moment about the side across is weight times lever; sides and axes as for a rigid hinge.
    found = []
    for soft in ({}, {"hertz": 8.0, "damping": 1.0}):
        scene = lv.Scene(substeps=1)
        body = scene.add_body(2.0, (0.1, 0.2, 0.15), position=(0, 0.3, 0))
        scene.add_joint("hinge", -1, body, anchor=(0, 0, 0), axis=(0, 1, 0), **soft)
        found.append(lv.Simulation(scene).run(600)[0]["joint_impulses"] * 120)  # N, N m
    force = 2.0 * 9.81
    np.testing.assert_allclose(found[0][:3], (0, 0, force), atol=1e-3)
    # The soft hinge lets the body sink by g / (2 pi hertz)^2 in its coupled motion, 4 mm and 1 degree.
    np.testing.assert_allclose(found[1], found[0], atol=0.02 * force)


@pytest.mark.parametrize("solver", ["sequential_impulses", "newton"])
def test_pendulum_keeps_its_energy(solver):
    # 2.45 J, from 60 degrees, 240 steps a second: semi-implicit Euler steps of the angle alone err by 0.021 J.
    scene = lv.Scene(solver=solver, dt=1 / 240)
    at = 0.5 * np.array([np.sin(np.pi / 3), 0, -np.cos(np.pi / 3)])
    bob = scene.add_box((0.1, 0.1, 0.1), position=tuple(at))
    scene.add_joint("hinge", -1, bob, anchor=(0, 0, 0), axis=(0, 1, 0))
    sim = lv.Simulation(scene)
    worst = 0.0
    for _ in range(200):
        state = sim.run(12)[0]
        v = state["velocities"][0]
        now = (
            0.5 * v[:3] @ v[:3]
            + 0.5 / 600 * v[3:] @ v[3:]
            + 9.81 * (state["positions"][0, 2] - at[2])
        )
        worst = max(worst, abs(now))
    assert worst <= 0.03  # J


def test_joint_of_a_body_on_a_circle_stays_closed():
    # 10 rad/s at 0.5 m: a step along the tangent leaves the circle by 0.43 mm, of which projection removes a fifth.
    scene = lv.Scene(dt=1 / 240, gravity=0.0)
    motion = {"velocity": (0, 5.0, 0), "angular_velocity": (0, 0, 10.0)}
    body = scene.add_box((0.1, 0.1, 0.1), position=(0.5, 0, 0), **motion)
    scene.add_joint("ball", -1, body, anchor=(0, 0, 0))
    sim = lv.Simulation(scene)
    for _ in range(240):
        state = sim.step()[0]
        angle = 2 * np.arctan2(state["quaternions"][0, 3], state["quaternions"][0, 0])
        gap = state["positions"][0] - 0.5 * np.array([np.cos(angle), np.sin(angle), 0.0])
        assert np.linalg.norm(gap) < 5e-4  # m; 0.36 mm at most
    assert np.linalg.norm(state["velocities"][0, :3]) == pytest.approx(5.0, rel=1e-3)
