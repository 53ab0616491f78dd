"""Pinocchio's constraint models as problems; by finite differences of its own kinematics."""

import numpy as np
import pytest

import lavender as lv

pin = pytest.importorskip(
    "pinocchio", reason="needs Pinocchio 4: pip install 'lavender-contact[pinocchio]'"
)


def robot(seed=0):
    """A free box with an arm: an anchor at its tip, a contact at a corner, limits and friction of the joint."""
    rng = np.random.default_rng(seed)
    model = pin.Model()
    base = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(base, pin.Inertia.FromBox(1.0, 0.2, 0.3, 0.2), pin.SE3.Identity())
    arm = model.addJoint(
        base, pin.JointModelRY(), pin.SE3(np.eye(3), np.array([0.1, 0.0, 0.0])), "arm"
    )
    model.appendBodyToJoint(
        arm, pin.Inertia.FromBox(0.5, 0.3, 0.05, 0.05), pin.SE3(np.eye(3), np.array([0.15, 0, 0]))
    )
    model.lowerPositionLimit[-1], model.upperPositionLimit[-1] = -0.01, 0.5
    model.upperDryFrictionLimit[-1], model.lowerDryFrictionLimit[-1] = 0.7, -0.7
    q = pin.neutral(model)
    q[2] = 0.1
    ground = pin.SE3(np.eye(3), np.array([0.1, 0.1, 0.0]))
    corner = pin.SE3(np.eye(3), np.array([0.1, 0.1, -0.1]))
    # From the ground (0) to the body: z points away from the ground.
    contact = pin.PointContactConstraintModel(model, 0, ground, base, corner)
    contact.setFriction(0.4)
    tip = pin.SE3(np.eye(3), np.array([0.3, 0.0, 0.0]))
    anchor = pin.PointAnchorConstraintModel(
        model, 0, pin.SE3(np.eye(3), np.array([0.4, 0.0, 0.1])), arm, tip
    )
    models = [
        anchor,
        contact,
        pin.JointLimitConstraintModel(model, [arm]),
        pin.JointFrictionConstraintModel(model, [arm]),
    ]
    set_time_step(models, 0.01)
    return model, models, q, 0.3 * rng.normal(size=model.nv)


def set_time_step(models, dt):
    """Set the time step of joint friction, which is 1 s as built by Pinocchio 4.1."""
    for model in models:
        if hasattr(model, "setTimeStep"):
            model.setTimeStep(dt)


def problem_of(model, models, q, v, dt=0.01, **more):
    set_time_step(models, dt)
    return lv.io.from_pinocchio(
        model, model.createData(), models, [m.createData() for m in models], dt, q=q, v=v, **more
    )


def test_from_pinocchio_rows_and_velocity_are_those_of_pinocchio():
    model, models, q, v = robot()
    tau = np.random.default_rng(1).normal(size=model.nv)
    problem = problem_of(model, models, q, v, tau=tau)
    assert (problem.operator, problem.law, problem.m) == ("generalized", "coulomb", 3 + 3 + 2 + 1)
    assert problem.row_name(3) == "PointContact 1, normal"
    data = model.createData()
    np.testing.assert_allclose(
        problem.generalized.v_free, v + 0.01 * pin.aba(model, data, q, v, tau), atol=1e-12
    )
    # J by differences of the two points' places, which Pinocchio's forward kinematics moves.
    h = 1e-6
    jac = problem.jacobian.toarray()
    base, arm = 1, 2

    def places(q):
        pin.forwardKinematics(model, data, q)
        return data.oMi[base].act(np.array([0.1, 0.1, -0.1])), data.oMi[arm].act(
            np.array([0.3, 0.0, 0.0])
        )

    for k in range(model.nv):
        step = np.zeros(model.nv)
        step[k] = h
        ahead = places(pin.integrate(model, q, step))
        behind = places(pin.integrate(model, q, -step))
        corner, tip = ((x - y) / (2.0 * h) for x, y in zip(ahead, behind, strict=True))
        np.testing.assert_allclose(
            jac[3:6, k], corner[[2, 0, 1]], atol=1e-8
        )  # 1e-6 squared, and rounding over it
        np.testing.assert_allclose(jac[0:3, k], tip, atol=1e-8)
    np.testing.assert_array_equal(jac[6:, :6], 0.0)
    np.testing.assert_array_equal(jac[6:, 6], [1.0, -1.0, 1.0])


def test_from_pinocchio_solution_keeps_every_constraint_for_a_step():
    model, models, q, v = robot()
    v[2] = -1.0  # into the ground
    dt = 1e-3
    problem = problem_of(model, models, q, v, dt=dt, compliance=1e-6, friction="cone")
    solution = lv.solve(problem, tol=1e-10).raise_for_status()
    after = pin.integrate(model, q, dt * problem.velocity(solution.impulse))
    data = model.createData()
    pin.forwardKinematics(model, data, after)
    # First order in dt: the points are off by what the step turns, some (dt |v|)^2.
    assert data.oMi[1].act(np.array([0.1, 0.1, -0.1]))[2] > -1e-5
    assert after[-1] > model.lowerPositionLimit[-1] - 1e-5
    np.testing.assert_allclose(
        data.oMi[2].act(np.array([0.3, 0.0, 0.0])), [0.4, 0.0, 0.1], atol=1e-5
    )
    assert abs(solution.impulse[-1]) <= 0.7 * dt * (1.0 + 1e-12)


def test_from_pinocchio_measures_joint_limits_at_q():
    """q away from zero: gaps by hand, J by differences of them."""
    model, _, q, v = robot()
    model.lowerPositionLimit[:], model.upperPositionLimit[:] = -0.3, 0.4
    q = pin.integrate(model, q, np.array([0.1, -0.2, 0.1, 0.2, 0.3, -0.1, 0.25]))

    def gaps(q):
        p = problem_of(model, [pin.JointLimitConstraintModel(model, [1, 2])], q, v, correction=1.0)
        return p, 0.01 * -(p.b + p.jacobian @ p.generalized.v_free)

    problem, found = gaps(q)
    measured = np.append(q[:3], q[-1])  # no limits of the quaternion's four numbers
    np.testing.assert_allclose(found, np.concatenate([measured + 0.3, 0.4 - measured]))
    for k, step in enumerate(1e-6 * np.eye(model.nv)):
        ahead, behind = (gaps(pin.integrate(model, q, x))[1] for x in (step, -step))
        np.testing.assert_allclose(
            problem.jacobian.toarray()[:, k], (ahead - behind) / 2e-6, atol=1e-7
        )


@pytest.mark.parametrize(
    ("kind", "units"),
    [("RX", "r"), ("PZ", "m"), ("RUBX", "r"), ("Spherical", "rrr"), ("FreeFlyer", "mmmrrr")],
)
def test_from_pinocchio_rows_of_joints_and_anchors_have_the_unit_of_their_velocity(kind, units):
    model = pin.Model()
    joint = model.addJoint(0, getattr(pin, f"JointModel{kind}")(), pin.SE3.Identity(), "joint")
    model.appendBodyToJoint(joint, pin.Inertia(1.0, np.zeros(3), np.eye(3)), pin.SE3.Identity())
    model.lowerDryFrictionLimit[:], model.upperDryFrictionLimit[:] = -1.0, 1.0
    friction = pin.JointFrictionConstraintModel(model, [joint])
    frame = pin.FrameAnchorConstraintModel(model, 0, pin.SE3.Identity(), joint, pin.SE3.Identity())
    problem = problem_of(model, [friction, frame], pin.neutral(model), np.zeros(model.nv))
    assert "".join(problem.row_unit(i)[0] for i in range(problem.m)) == units + "mmmrrr"


KINDS = (
    "RX",
    "PZ",
    "RUBX",
    "Spherical",
    "SphericalZYX",
    "Planar",
    "Translation",
    "FreeFlyer",
    "RevoluteUnaligned",
)


def vectors(joint):
    """Positions of a joint that a limit holds: not the numbers of a quaternion, or a cosine and a sine."""
    whole = {"FreeFlyer": 3, "Planar": 2, "RUBX": 0, "Spherical": 0}
    return range(whole.get(joint.shortname().removeprefix("JointModel"), joint.nq))


@pytest.mark.parametrize("seed", range(40))
def test_from_pinocchio_limits_and_friction_hold_in_its_own_dynamics(seed):
    rng = np.random.default_rng(seed)
    model = pin.Model()
    for i, kind in enumerate(rng.choice(KINDS, rng.integers(1, 5))):
        axis = (np.array([0.6, 0.0, 0.8]),) if kind == "RevoluteUnaligned" else ()
        turn = pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3))
        model.addJoint(i, getattr(pin, f"JointModel{kind}")(*axis), turn, f"{kind} {i}")
        model.appendBodyToJoint(i + 1, pin.Inertia.FromBox(1.0, *rng.uniform(0.1, 0.5, 3)), turn)
    q = pin.integrate(model, pin.neutral(model), rng.normal(size=model.nv))
    model.lowerPositionLimit = q - rng.uniform(-0.02, 0.2, model.nq)
    model.upperPositionLimit = model.lowerPositionLimit + rng.uniform(0.0, 0.5, model.nq)
    model.upperDryFrictionLimit = rng.uniform(0.0, 2.0, model.nv)
    model.lowerDryFrictionLimit = -rng.uniform(0.0, 2.0, model.nv)
    v = rng.normal(size=model.nv)
    tau = rng.normal(size=model.nv)
    dt = 0.01
    joints = list(range(1, model.njoints))
    models = [
        pin.JointLimitConstraintModel(model, joints),
        pin.JointFrictionConstraintModel(model, joints),
    ]
    problem = problem_of(model, models, q, v, dt, tau=tau, correction=1.0)
    solution = lv.solve(problem, tol=1e-10, max_iter=20_000).raise_for_status()
    own = solution.impulse
    first = problem.m - model.nv
    # Pinocchio's velocity under these efforts, and what each joint does then.
    effort = tau + problem.jacobian.T @ own / dt
    after = v + dt * pin.aba(model, model.createData(), q, v, effort)
    near = 1e-6 * (1.0 + np.abs(after).max())
    np.testing.assert_allclose(problem.velocity(own), after, atol=near)
    np.testing.assert_array_equal(problem.jacobian.toarray()[first:], np.eye(model.nv))
    lower, upper = dt * model.lowerDryFrictionLimit, dt * model.upperDryFrictionLimit
    # An impulse at its bound may lie a rounding error, 1e-16 of the bound, inside it.
    sticks = (own[first:] > (1.0 - 1e-12) * lower) & (own[first:] < (1.0 - 1e-12) * upper)
    assert np.abs(after[sticks]).max(initial=0.0) <= near
    assert (own[first:] * after <= near).all()  # what slides is braked
    rate = 1e6 * (pin.integrate(model, q, 1e-6 * after) - q)  # of the positions
    places = [j.idx_q + i for j in list(model.joints)[1:] for i in vectors(j)]
    end = (q + dt * rate)[places]
    assert (end - model.lowerPositionLimit[places]).min(initial=0.0) >= -1e-5
    assert (model.upperPositionLimit[places] - end).min(initial=0.0) >= -1e-5


@pytest.mark.parametrize("kind", ["contact", "anchor"])
def test_from_pinocchio_desired_velocity_is_the_target(kind):
    model, models, q, v = robot()
    one = models[1 if kind == "contact" else 0]
    without = problem_of(model, [one], q, v).b
    one.desired_constraint_velocity = np.array([1.0, 2.0, 3.0])
    added = [3.0, 1.0, 2.0] if kind == "contact" else [1.0, 2.0, 3.0]
    np.testing.assert_allclose(problem_of(model, [one], q, v).b - without, added)


def anchored_chain(kind):
    """A chain of four hinges with its tip anchored, a velocity that keeps the anchor, and (dJ/dt) v by kinematics."""
    model = pin.Model()
    parent = 0
    for i in range(4):
        place = pin.SE3(np.eye(3), np.array([0.0, 0.0, -0.5 * (i > 0)]))
        parent = model.addJoint(parent, pin.JointModelRY(), place, f"hinge {i}")
        inertia = pin.Inertia(1.0 + i, np.array([0.0, 0.0, -0.25]), np.diag([0.02, 0.02, 0.01]))
        model.appendBodyToJoint(parent, inertia, pin.SE3.Identity())
    tip = pin.SE3(np.eye(3), np.array([0.0, 0.0, -0.5]))
    data = model.createData()
    rng = np.random.default_rng(1)
    q = rng.normal(size=4)
    pin.forwardKinematics(model, data, q)
    anchor = getattr(pin, f"{kind}AnchorConstraintModel")(
        model, 0, data.oMi[parent] * tip, parent, tip
    )
    pin.computeJointJacobians(model, data, q)
    turn = (data.oMi[parent] * tip).rotation
    jac = (
        turn @ (tip.inverse().action @ pin.getJointJacobian(model, data, parent, pin.LOCAL))[:3]
    )[[0, 2]]
    jac = (
        np.vstack([jac, np.ones((1, 4))]) if kind == "Frame" else jac
    )  # The hinges turn about one axis.
    kernel = np.linalg.svd(jac)[2][len(jac) :]
    v = kernel.T @ rng.normal(size=len(kernel))
    pin.forwardKinematics(model, data, q, v, np.zeros(4))
    spatial, rate = tip.actInv(data.v[parent]), tip.actInv(data.a[parent])
    drift = (turn @ (rate.linear + np.cross(spatial.angular, spatial.linear)))[[0, 2]]
    return model, anchor, q, v, jac, np.append(drift, 0.0) if kind == "Frame" else drift


@pytest.mark.parametrize("kind", ["Point", "Frame"])
@pytest.mark.parametrize("dt", [1e-2, 1e-4])
def test_from_pinocchio_acceleration_level_gives_the_constrained_acceleration(kind, dt):
    model, anchor, q, v, jac, drift = anchored_chain(kind)
    data = model.createData()
    upper = np.triu(pin.crba(model, data, q))
    mass = upper + np.triu(upper, 1).T
    force = -pin.nle(model, data, q, v)
    kkt = np.block([[mass, jac.T], [jac, np.zeros((len(jac), len(jac)))]])
    exact = np.linalg.solve(kkt, np.concatenate([force, -drift]))[:4]

    def accelerate(level):
        problem = problem_of(model, [anchor], q, v, dt, level=level)
        return (problem.velocity(lv.solve(problem, tol=1e-13).impulse) - v) / dt

    np.testing.assert_allclose(accelerate("acceleration"), exact, atol=1e-8 * np.abs(exact).max())
    assert (
        np.abs(accelerate("velocity") - exact).max() > 1e-3 * np.abs(exact).max()
    )  # Its error does not depend on dt.


def test_from_pinocchio_friction_with_another_time_step_names_set_time_step():
    model, models, q, v = robot()
    if not hasattr(models[3], "setTimeStep"):
        pytest.skip("this version of Pinocchio has no time step of joint friction")
    models[3].setTimeStep(1.0)
    with pytest.raises(
        lv.InputError, match=r"time step of 1 s, and dt is 0.01 s: .* setTimeStep\(0.01\)"
    ):
        lv.io.from_pinocchio(
            model, model.createData(), models, [m.createData() for m in models], 0.01, q=q, v=v
        )
