"""`RowBuilder` gives the rows that LavenderSim records, from poses and joints in world coordinates, to rounding."""

import numpy as np
from scipy.spatial.transform import Rotation

import lavender as lv


def make_scene():
    """Return a scene with every kind of joint, rigid and soft, a motor, and a box on the ground."""
    scene = lv.Scene(substeps=1)
    ground = scene.add_plane()
    first = scene.add_box(position=(0.0, 0.0, 3.0))
    second = scene.add_box(position=(1.5, 0.2, 3.0))
    scene.add_box(position=(6.0, 0.0, 0.499))
    scene.add_joint("ball", -1, first, anchor=(0.0, 0.1, 4.0))
    scene.add_joint(
        "hinge",
        first,
        second,
        anchor=(0.7, 0.0, 3.0),
        axis=(0.2, 1.0, 0.1),
        motor_speed=1.0,
        motor_torque=2.0,
    )
    scene.add_joint("hinge", ground, second, anchor=(1.6, 0.0, 3.0), axis=(0.0, 1.0, 0.0))
    scene.add_joint(
        "distance", first, second, anchor_a=(0.0, 0.0, 3.4), anchor_b=(1.4, 0.1, 3.3), length=1.3
    )
    scene.add_joint(
        "distance",
        -1,
        second,
        anchor_a=(3.0, 0.0, 4.0),
        anchor_b=(2.0, 0.0, 3.3),
        hertz=3.0,
        damping=0.4,
    )
    return scene


def rebuild(sim, state, recorded, h):
    """Build the same joints and contacts by a builder; no correction of errors, as in LavenderSim's rigid rows."""
    rows = recorded.rows
    moving = state["body_of"].tolist()
    builder = lv.RowBuilder(
        rows.inv_mass, rows.inv_inertia, rows.v_free, h, state["x"][moving], baumgarte=0.0
    )

    def world(body, local, offset=True):
        if body < 0:
            return np.asarray(local)
        return state["rot"][body] @ local + offset * state["x"][body]

    for i, joint in enumerate(sim.scene.joints):
        pair = rows.joint_body[i]
        points = world(joint.a, joint.anchor_a), world(joint.b, joint.anchor_b)
        if joint.kind == "ball":
            builder.ball(*pair, *points)
        elif joint.kind == "hinge":
            axes = world(joint.a, joint.axis_a, False), world(joint.b, joint.axis_b, False)
            builder.hinge(*pair, points[0], axes[0], points[1], axes[1])
            if joint.motor_torque:
                builder.motor(
                    *pair, axes[0], speed=joint.motor_speed, max_torque=joint.motor_torque
                )
        elif joint.hertz == 0.0:
            builder.distance(*pair, *points, joint.length)
        else:
            row = rows.joint_ptr[i]
            inverse_mass = recorded.d[row] - recorded.compliance[row]  # J M^-1 J^T
            omega = 2 * np.pi * joint.hertz
            builder.spring(
                *pair,
                *points,
                joint.length,
                stiffness=omega**2 / inverse_mass,
                damping=2 * joint.damping * omega / inverse_mass,
            )
    for i, pair in enumerate(rows.contact_body):
        mu = recorded.cones.mu[rows.n_joints + i]
        builder.contact(
            *pair,
            state["point"][i],
            rows.normal[i],
            gap=state["gap"][i],
            mu=mu,
            tangent=rows.tangent[i],
        )
    return builder.problem()


def second_derivative(sim, state, rows, joint, i, step=1e-3):
    """Return d^2 C/dt^2 of the linear rows of a joint whose bodies keep their velocities, by central differences."""

    def anchor(body, dynamic, local, t):
        if body < 0:
            return np.asarray(local)
        v = rows.v_free[dynamic] if dynamic >= 0 else np.zeros(6)
        turn = Rotation.from_rotvec(t * v[3:]).as_matrix()
        return state["x"][body] + t * v[:3] + turn @ (state["rot"][body] @ local)

    def error(t):
        a, b = (
            anchor(body, dynamic, local, t)
            for body, dynamic, local in zip(
                (joint.a, joint.b),
                rows.joint_body[i],
                (joint.anchor_a, joint.anchor_b),
                strict=True,
            )
        )
        return np.linalg.norm(b - a) if joint.kind == "distance" else b - a

    return (error(step) - 2 * error(0.0) + error(-step)) / step**2


def test_row_builder_rebuilds_the_rows_of_a_scene():
    scene = make_scene()
    sim = lv.Simulation(scene)
    for _ in range(12):
        sim.step()
    recorded = sim.constraint_problem()
    assert recorded.rows.n_contacts >= 4 and recorded.rows.n_joints == 5
    prepared = sim.state.copy()
    prepared.kernel.prepare_substep()
    built = rebuild(sim, prepared.a, recorded, scene.parameters.dt)
    assert built.m == recorded.m
    exact = {"rtol": 0.0, "atol": 1e-12}
    # The two sides of a hinge may be rotated about its axis: rows 3 and 4 of each hinge are compared by their span.
    rotation = np.eye(built.m)
    rows = recorded.rows
    ours = built.rows.jacobian(built.cones).toarray()
    theirs = rows.jacobian(recorded.cones).toarray()
    for i, joint in enumerate(scene.joints):
        if joint.kind == "hinge":
            at = slice(rows.joint_ptr[i] + 3, rows.joint_ptr[i] + 5)
            rotation[at, at] = theirs[at] @ np.linalg.pinv(ours[at])
            np.testing.assert_allclose(rotation[at, at] @ rotation[at, at].T, np.eye(2), **exact)
    np.testing.assert_allclose(rotation @ ours, theirs, **exact)
    # LavenderSim's joints follow their bodies on circles: their targets have a term of second order, and the spring
    # has it in the error at the end of the step. Differences over 1 ms find it to 1e-6 of its size, below 0.1 m/s.
    h = scene.parameters.dt
    expected = rotation @ built.b
    for i, joint in enumerate(scene.joints):
        at = slice(rows.joint_ptr[i], rows.joint_ptr[i] + (1 if joint.kind == "distance" else 3))
        share = 1.0
        if joint.hertz:
            omega = 2 * np.pi * joint.hertz
            share = h * omega**2 / (2 * joint.damping * omega + h * omega**2)
        expected[at] -= share * 0.5 * h * second_derivative(sim, prepared.a, rows, joint, i)
    assert np.abs(expected - rotation @ built.b).max() > 1e-6
    np.testing.assert_allclose(expected, recorded.b, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(built.compliance, recorded.compliance, **exact)
    np.testing.assert_allclose(built.cones.lower[:18], recorded.cones.lower[:18], **exact)
    np.testing.assert_allclose(built.cones.upper[:18], recorded.cones.upper[:18], **exact)
    ours, theirs = (lv.solve(p, tol=1e-11).impulse for p in (built, recorded))
    velocity = recorded.velocity(theirs)
    np.testing.assert_allclose(built.velocity(ours), velocity, rtol=0.0, atol=1e-7)
