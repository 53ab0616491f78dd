"""Scenes: what they are made of, what they refuse, and the gallery."""

import math

import numpy as np
import pytest

import lavender as lv
from lavender.sim.engine.layout import SIZE
from lavender.sim.scene import Box, Plane, Sphere
from lavender.sim.scene.parts import convert_to_rotation_matrix


def test_scene_of_one_box_gives_the_documented_observation():
    scene = lv.Scene(dt=0.01)
    assert (scene.add_plane(), scene.add_box((1, 1, 1), mass=2.0, position=(0, 0, 0.5))) == (0, 1)
    observation, reward, terminated, truncated, info = lv.Simulation(scene).step()
    assert (reward, terminated, truncated) == (0.0, False, False)
    assert info == {"time": 0.01, "step": 1, "failed_solves": 0, "order": "alternating"}
    assert set(observation) == {
        "positions",
        "quaternions",
        "velocities",
        "contacts",
        "joint_impulses",
        "solver",
    }
    assert set(observation["contacts"]) == {
        "pair",
        "point",
        "normal",
        "tangent",
        "depth",
        "impulses",
    }
    # 2 kg held over the last of the three substeps of 10 ms
    assert observation["contacts"]["impulses"][:, 0].sum() == pytest.approx(
        2.0 * 9.81 * 0.01 / 3, rel=1e-3
    )


@pytest.mark.parametrize(
    ("name", "more", "bodies", "contacts", "rows"),
    [
        ("stack", {"friction": 0.0}, 7, 24, 24),
        ("stack", {}, 7, 24, 72),
        ("stack", {"patch_radius": 0.1}, 7, 24, 96),
        ("pyramid", {"base": 10}, 56, 400, 1200),
        ("table", {}, 11, 72, 216),
        ("heavy_on_light", {}, 3, 8, 24),
        ("ramp", {}, 2, 4, 12),
        ("spinner", {}, 2, 1, 4),
        ("chain", {"n": 7}, 7, 0, 21),
        ("bridge", {"n": 4, "load": 0.0}, 4, 0, 25),
        ("four_bar", {}, 3, 0, 20),
        ("four_bar", {"motor": 1.0}, 3, 0, 21),
    ],
)
def test_scene_observation_has_the_sizes_of_its_docstrings(name, more, bodies, contacts, rows):
    scene = lv.Scene(name, **more)
    problem = lv.Simulation(scene).constraint_problem()
    assert (scene.n_bodies, problem.rows.n_contacts, problem.m) == (bodies, contacts, rows)


def test_scene_without_friction_or_spin_allocates_no_rows():
    def size(**more):
        scene = lv.Scene(**more)
        scene.add_plane()
        scene.add_sphere(position=(0, 0, 0.5))
        return lv.Simulation(scene).state

    smooth = size(friction=0.0)
    rough = size()
    spin = size(patch_radius=0.1)
    rows = SIZE["rows_per_contact"]
    assert [s.size[rows] for s in (smooth, rough, spin)] == [1, 3, 4]
    assert smooth.nbytes < rough.nbytes < spin.nbytes
    for name in ("tangent", "coupling", "rot", "jac", "joint_impulse"):
        assert smooth.a[name].size == 0
    assert rough.a["tangent"].size > 0
    # a friction parameter on a body that touches nothing brings no rows
    scene = lv.Scene(friction=0.0)
    scene.add_plane()
    scene.add_sphere()
    scene.add_body(friction=1.0)
    assert lv.Simulation(scene).state.size[rows] == 1


def test_scene_contacts_have_only_the_rows_of_their_friction():
    scene = lv.Scene(friction=0.0, patch_radius=0.2, substeps=1)
    scene.add_plane(friction=0.5)
    scene.add_sphere(
        position=(0, 0, 0.5), friction=0.5, velocity=(1, 0, 0), angular_velocity=(0, 0, 3)
    )
    scene.add_sphere(position=(2, 0, 0.5))
    scene.add_sphere(position=(4, 0, 0.5), friction=0.2, patch_radius=0.0)
    sim = lv.Simulation(scene)
    problem = sim.constraint_problem()
    assert np.diff(problem.cones.ptr).tolist() == [4, 1, 3]
    assert problem.cones.mu.tolist() == [0.5, 0.0, math.sqrt(0.1)]
    impulses = sim.step()[0]["contacts"]["impulses"]
    assert impulses.shape == (3, 4)
    assert impulses[0, 2] != 0.0 and impulses[0, 3] != 0.0  # sliding along x, spinning
    assert np.all(impulses[1, 1:] == 0.0) and impulses[2, 3] == 0.0
    expected = lv.solve(problem, "sequential_impulses", tol=0, max_iter=16).impulse
    np.testing.assert_array_equal(
        np.concatenate([impulses[0], impulses[1, :1], impulses[2, :3]]), expected
    )


#: Calls of a scene with a ball and a plane, or of no scene, and words of their errors.
REFUSED = [
    (lambda s: s.add_box(mass=0.0), "mass"),
    (lambda s: s.add_box((1, 0, 1)), "positive"),
    (lambda s: s.add_sphere(0.0), "radius"),
    (lambda s: s.add_plane((0, 0, 0)), "direction"),
    (lambda s: s.add_plane(position=(0, 0, 1)), "position"),
    (lambda s: s.add_body(quaternion=(0, 0, 0, 0)), "quaternion"),
    (lambda s: s.add_body(shape="box"), "a Plane, Sphere or Box"),
    (lambda s: s.add_body(shape=Sphere(-1.0), inertia=(1, 1, 1)), "radius"),
    (lambda s: s.add_body(shape=Box((1.0, np.nan, 1.0)), inertia=(1, 1, 1)), "size .* finite"),
    (lambda s: s.add_body(shape=Box((1.0, -1.0, 1.0))), "positive edges"),
    (lambda s: s.add_body(shape=Plane((0.0, 0.0, 1.0), np.nan)), "offset"),
    (lambda s: s.add_body(shape=Plane((0.0, 0.0, 0.0), 0.0)), "direction"),
    (lambda s: s.add_body(inertia=(1, 1, 0)), "positive"),
    (lambda s: s.add_body(inertia=(1, 2.1, 1)), "at most the sum of the others"),
    (lambda s: s.add_body(inertia=(1, 1, 1e-15)), "positive"),
    (lambda s: s.add_body(inertia=[[1, 2, 0], [0, 1, 0], [0, 0, 1]]), "symmetric"),
    (lambda s: s.add_body(inertia=[[1, 2, 0], [2, 1, 0], [0, 0, 1]]), "positive"),
    (lambda s: s.add_body(static=True, velocity=(1, 0, 0)), "static"),
    (lambda s: s.add_body(friction=-0.1), "friction"),
    (lambda s: s.add_body(restitution=1.1), "restitution"),
    (lambda s: s.add_joint("ball", 0, 7, anchor=(0, 0, 0)), "body of ball 0 .* is 7"),
    (lambda s: s.add_joint("ball", 0, -2, anchor=(0, 0, 0)), "body of .* is -2"),
    (lambda s: s.add_joint("ball", 0, 0, anchor=(0, 0, 0)), "two bodies"),
    (lambda s: s.add_joint("ball", -1, 1, anchor=(0, 0, 0)), "dynamic"),
    (lambda s: s.add_joint("ball", 0, -1), "anchor"),
    (lambda s: s.add_joint("ball", 0, -1, anchor=(0, 0, 0), axis=(0, 0, 1)), "axis"),
    (lambda s: s.add_joint("hinge", 0, -1, anchor=(0, 0, 0)), "axis"),
    (lambda s: s.add_joint("hinge", 0, -1, anchor=(0, 0, 0), axis=(0, 0, 0)), "direction"),
    (
        lambda s: s.add_joint("hinge", 0, -1, anchor=(0, 0, 0), axis=(0, 0, 1), motor_speed=1.0),
        "motor",
    ),
    (
        lambda s: s.add_joint("ball", 0, -1, anchor=(0, 0, 0), motor_speed=1.0, motor_torque=1.0),
        "motor",
    ),
    (lambda s: s.add_joint("distance", 0, -1), "anchor"),
    (lambda s: s.add_joint("distance", 0, -1, anchor_a=(0, 0, 0), anchor_b=(0, 0, 0)), "length 0"),
    (lambda s: s.add_joint("ball", 0, -1, anchor=(0, 0, 0), hertz=-1), "hertz"),
    (lambda s: s.add_joint("slider", 0, -1), "joint 'slider'"),
    *(
        (lambda s, more=more: lv.Scene("stack", **more), words)
        for more, words in (
            ({"dt": 0.0}, "dt"),
            ({"substeps": 0}, "substeps"),
            ({"friction": -1.0}, "friction"),
            ({"restitution": 2.0}, "restitution"),
            ({"rolling_radius": -0.1}, "rolling_radius"),
            ({"max_substep": 0.0}, "max_substep"),
            ({"max_substep": 1e-60}, "substeps"),
            ({"dt": 1e60}, "substeps"),
            ({"friction_shape": "square"}, "friction_shape"),
            ({"solver": "pgz"}, "did you mean 'pgs'"),
            ({"order": "bottomup"}, "bottom_up"),
            ({"on_failure": "ignore"}, "on_failure"),
            ({"solver_options": {"omega": 1}}, "solver_options"),
            ({"solver": "pgs", "order": "reverse"}, "solver_options"),
            ({"solver_options": 3, "solver": "pgs"}, "mapping"),
            ({"gravity": -9.81}, r"downward acceleration.* give 9.81"),
            ({"frction": 1.0}, "did you mean 'friction'"),
            ({"n": 0}, "n is 0"),
        )
    ),
    (lambda s: lv.Scene(["stack"]), r"unknown scene \['stack'\]"),
    (lambda s: lv.Scene("stac"), "did you mean 'stack'"),
    (lambda s: lv.Scene("chain", tipmass=1.0), "tip_mass"),
    (lambda s: lv.Scene("pile", kind="sphere"), "spheres"),
    (lambda s: lv.Scene(n=3), "unknown"),
    (lambda s: lv.Simulation(lv.Scene()), "no bodies"),
    (lambda s: lv.Simulation(3), r"lavender.Scene is needed"),
    (lambda s: lv.Simulation("stack").step([1, 2]), "has no actions"),
]


@pytest.mark.parametrize(("call", "words"), REFUSED)
def test_scene_with_a_wrong_part_or_parameter_raises_and_adds_nothing(call, words):
    scene = lv.Scene()
    scene.add_sphere(name="ball")
    scene.add_plane()
    with pytest.raises(lv.LavenderError, match=words):
        call(scene)
    assert (scene.n_bodies, scene.n_joints) == (2, 0)
    assert lv.Scene("stack", dt=1e6, substeps=3).parameters.substeps == 3  # because it is given


@pytest.mark.parametrize(
    ("solver", "velocity", "spin"),  # of the second, rows whose impulses are far from all others
    [
        ("sequential_impulses", (1e60, 0, 0), 0),
        ("pgs", (1e60, 0, -1e55), 1e55),
        ("newton", (1e60, 0, 0), 0),
    ],
)
def test_step_with_a_lost_state_names_its_body_and_ends_the_simulation(solver, velocity, spin):
    scene = lv.Scene(solver=solver)
    scene.add_plane()
    scene.add_sphere(position=(0, 0, 0.5), name="fine")
    scene.add_sphere(
        position=(5, 0, 0.5), velocity=velocity, angular_velocity=(0, spin, 0), name="gone"
    )
    sim = lv.Simulation(scene)
    before = sim.snapshot()
    for _ in range(400):
        *_, terminated, _, info = sim.step()
        if terminated:
            break
    assert terminated and info["lost_body"] == "gone"
    with pytest.raises(lv.LavenderError, match="'gone' is not finite"):
        sim.step()
    sim.restore(before)
    assert not sim.step()[2]


def test_scene_shapes_have_their_textbook_inertia():
    scene = lv.Scene()
    scene.add_box((1, 2, 3), 12.0)
    scene.add_sphere(2.0, 5.0)
    np.testing.assert_allclose(scene.bodies[0].inertia, np.diag([13.0, 10.0, 5.0]), rtol=1e-15)
    np.testing.assert_allclose(scene.bodies[1].inertia, np.eye(3) * 8.0, rtol=1e-15)


def test_scene_joint_anchors_are_at_their_given_places():
    scene = lv.Scene()
    a = scene.add_box(position=(1, 0, 0), quaternion=(1, 1, 0, 0))
    b = scene.add_box(position=(0, 2, 0), quaternion=(0, 1, 2, 3))
    scene.add_joint("hinge", a, b, anchor=(0.5, 0.5, 0.5), axis=(1, 2, 3))
    j = scene.joints[0]
    for i, anchor, axis in ((a, j.anchor_a, j.axis_a), (b, j.anchor_b, j.axis_b)):
        body = scene.bodies[i]
        r = convert_to_rotation_matrix(body.quaternion)
        np.testing.assert_allclose(body.position + r @ anchor, [0.5, 0.5, 0.5], atol=1e-15)
        np.testing.assert_allclose(r @ axis, np.array([1, 2, 3]) / np.sqrt(14), atol=1e-15)
    sim = lv.Simulation(scene)
    sim.prepare_substep()
    np.testing.assert_allclose(sim.state.a["joint_error"], 0.0, atol=1e-15)


def test_scene_changed_later_does_not_change_earlier_simulations():
    scene = lv.Scene("stack", n=2)
    sim = lv.Simulation(scene)
    scene.add_sphere(0.3, position=(5.0, 0.0, 3.0))
    before = sim.snapshot()
    assert len(sim.reset()[0]["positions"]) == 3
    sim.restore(before)
    changed = scene.with_parameters(slop=2e-3)
    changed.add_joint("ball", -1, 3, anchor=(5.0, 0.0, 3.0))
    assert (scene.n_bodies, changed.n_bodies, changed.bodies[3]) == (4, 4, scene.bodies[3])
    assert len(lv.Simulation(scene).step()[0]["positions"]) == 4
    with pytest.raises(lv.InputError, match="by number"):
        changed.with_parameters(n=5)


def test_registered_scene_builder_makes_a_scene_like_the_gallery(monkeypatch):
    from lavender.sim.scene import scene as table

    monkeypatch.setattr(table, "SCENES", dict(table.SCENES))
    monkeypatch.setattr(table, "DEFAULTS", dict(table.DEFAULTS))

    @table.named_scene(friction=0.2, dt=0.01)
    def plank(scene, size=2.0):
        scene.add_plane()
        scene.add_box((size, size, 0.1), position=(0, 0, 0.05))

    scene = lv.Scene("plank", size=3.0, dt=0.02)
    assert (scene.parameters.friction, scene.parameters.dt) == (0.2, 0.02)
    assert scene.bodies[1].shape.size == (3.0, 3.0, 0.1)
    lv.Simulation(scene).reset(seed=4)
    with pytest.raises(lv.UnknownName, match="size"):
        lv.Scene("plank", sise=3.0)
    with pytest.raises(lv.InputError, match="registered already"):
        table.named_scene()(plank)
    with pytest.raises(lv.UnknownName, match="frction"):
        table.named_scene(frction=0.2)

    def clash(scene, friction=1.0):
        pass

    def bare(scene, n):
        pass

    for build in (clash, bare):
        with pytest.raises(lv.InputError, match="parameter"):
            table.named_scene()(build)
