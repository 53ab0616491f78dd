"""Probes of Drake's contact approximations; see `engine_facts`."""

import numpy as np
from engine_facts import fact

DRAKE = "Drake", "pydrake", "1.51.1"
FRICTION = 0.5


def step_drake(name, dt, n, velocity=(0.0, 0.0, 0.0), kick=(0.0, 0.0, 0.0)):
    """Step a box of 1 kg on four small spheres that touch the ground.

    Parameters
    ----------
    name : str
        Contact approximation.
    dt : float, s
    n : int
        Number of steps.
    velocity : (3,) m/s
        Velocity at the start.
    kick : (3,) m/s
        Velocity added before the last step.

    Returns
    -------
    tuple
        Depth [m] below the start, velocity (3,) [m/s] before the last step with the kick, and after it, and the
        forces (c, 3) [N] of the contacts.
    """
    from pydrake.all import (
        AddMultibodyPlantSceneGraph,
        CoulombFriction,
        DiagramBuilder,
        DiscreteContactApproximation,
        HalfSpace,
        RigidTransform,
        Simulator,
        SpatialInertia,
        Sphere,
    )

    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, dt)
    plant.set_discrete_contact_approximation(getattr(DiscreteContactApproximation, name))
    friction = CoulombFriction(FRICTION, FRICTION)
    plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform(), HalfSpace(), "ground", friction
    )
    body = plant.AddRigidBody("box", SpatialInertia.SolidBoxWithMass(1.0, 0.2, 0.2, 0.2))
    for k, corner in enumerate(
        np.array([(x, y, -0.08) for x in (-0.08, 0.08) for y in (-0.08, 0.08)])
    ):
        plant.RegisterCollisionGeometry(
            body, RigidTransform(corner), Sphere(0.02), f"foot {k}", friction
        )
    plant.SetDefaultFloatingBaseBodyPose(body, RigidTransform([0.0, 0.0, 0.1]))
    plant.Finalize()
    simulator = Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant.SetVelocities(context, np.concatenate([np.zeros(3), velocity]))
    simulator.Initialize()
    simulator.AdvanceTo((n - 1) * dt)
    before = np.array(plant.GetVelocities(context)) + np.concatenate([np.zeros(3), kick])
    plant.SetVelocities(context, before)
    simulator.AdvanceTo(n * dt)
    results = plant.get_contact_results_output_port().Eval(context)
    forces = [
        results.point_pair_contact_info(i).contact_force()
        for i in range(results.num_point_pair_contacts())
    ]
    depth = 0.1 - plant.EvalBodyPoseInWorld(context, body).translation()[2]
    return depth, before[3:], np.array(plant.GetVelocities(context))[3:], np.array(forces)


@fact(
    *DRAKE,
    "rest depth",
    "A resting body penetrates more with kSap, in proportion to the time step, than with kLagged, kSimilar and kTamsi: "
    "a box of 1 kg on four small spheres by 0.28 mm with steps of 10 ms, and by 0.005 mm with the others.",
    "The problem is rigid: its `correction` is 0 by default, so this depth is not pushed out.",
)
def drake_rests_deeper_with_sap():
    others = [
        step_drake(name, dt, round(2.0 / dt))[0]
        for name in ("kLagged", "kSimilar", "kTamsi")
        for dt in (0.01, 0.001)
    ]
    long, short = step_drake("kSap", 0.01, 200)[0], step_drake("kSap", 0.001, 2000)[0]
    return max(others) < 1e-5 < 2e-5 < short < long / 8.0 and long < 1e-3


@fact(
    *DRAKE,
    "sliding with kSap and kSimilar",
    "Both solve the convex relaxation of Coulomb's law. A resting box with friction 0.5 that gets 2 m/s along the "
    "ground leaves it with 0.73 to 0.79 m/s, with steps of 10 ms and of 1 ms. With kLagged and kTamsi, it slides.",
    '`from_drake` builds the same relaxation with `friction="cone"`. Under the default law, the judge finds an error '
    "of 0.76 m/s in this step of kSap.",
)
def drake_boxes_hop_with_sap():
    def compute_upward_velocity(name, dt):
        return step_drake(name, dt, round(0.3 / dt), kick=(2.0, 0.0, 0.0))[2][2]

    hops = [
        compute_upward_velocity(name, dt) for name in ("kSap", "kSimilar") for dt in (0.01, 0.001)
    ]
    others = [compute_upward_velocity(name, 0.01) for name in ("kLagged", "kTamsi")]
    return np.allclose(hops, 0.76, atol=0.04) and max(np.abs(others)) < 0.01


@fact(
    *DRAKE,
    "friction with kLagged",
    "The bound of friction is computed from the state before the step. A box with friction 0.5 that slides with 2 m/s "
    "and begins to touch the ground gets 1.4 times its normal impulse as friction, and topples. With the others, it "
    "gets 0.5 times.",
    "The judge finds the error of these impulses.",
)
def drake_friction_exceeds_its_bound_with_kLagged():
    ratios = []
    for name in ("kLagged", "kTamsi", "kSap"):
        _, before, after, _ = step_drake(name, 0.01, 2, velocity=(2.0, 0.0, 0.0))
        impulse = after - before + np.array([0.0, 0.0, 9.81 * 0.01])
        ratios.append(abs(impulse[0]) / impulse[2])
    return ratios[0] > 1.2 and np.allclose(ratios[1:], FRICTION, atol=0.01)


def make_drake_plant(dt=0.01):
    """Return a builder, its plant and the plant's scene graph."""
    from pydrake.all import AddMultibodyPlantSceneGraph, DiagramBuilder

    builder = DiagramBuilder()
    return builder, *AddMultibodyPlantSceneGraph(builder, dt)


def simulate_drake(builder, plant, duration, actuation=None):
    """Finalize a plant, simulate its diagram and return the context of the plant."""
    from pydrake.all import Simulator

    plant.Finalize()
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    if actuation is not None:
        plant.get_actuation_input_port().FixValue(context, actuation)
    simulator = Simulator(diagram, root)
    simulator.AdvanceTo(duration)
    return simulator, context


@fact(
    *DRAKE,
    "`penetration_allowance`",
    "It changes nothing by default, because `point_stiffness` of SceneGraph's configuration, 1e6 N/m, has priority.",
    "The problem is rigid, and contains neither of them.",
)
def drake_ignores_the_penetration_allowance():
    from pydrake.all import CoulombFriction, HalfSpace, RigidTransform, SpatialInertia, Sphere

    depths = []
    for allowance, stiffness in ((None, None), (0.1, None), (None, 1e4)):
        builder, plant, scene_graph = make_drake_plant()
        friction = CoulombFriction(FRICTION, FRICTION)
        plant.RegisterCollisionGeometry(
            plant.world_body(), RigidTransform(), HalfSpace(), "ground", friction
        )
        body = plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        plant.RegisterCollisionGeometry(body, RigidTransform(), Sphere(0.1), "ball", friction)
        plant.SetDefaultFloatingBaseBodyPose(body, RigidTransform([0.0, 0.0, 0.1]))
        if allowance is not None:
            plant.set_penetration_allowance(allowance)
        if stiffness is not None:
            config = scene_graph.get_config()
            config.default_proximity_properties.point_stiffness = stiffness
            scene_graph.set_config(config)
        _simulator, context = simulate_drake(builder, plant, 1.0)
        depths.append(0.1 - plant.EvalBodyPoseInWorld(context, body).translation()[2])
    return depths[0] == depths[1] < depths[2] / 50.0


@fact(
    *DRAKE,
    "effort limit",
    "The limit of a joint actuator clamps its input also without gains of a controller: 10 N become 2 N.",
    "`from_drake` reads the net actuation, after the clamp.",
)
def drake_clamps_feed_forward():
    from pydrake.all import PrismaticJoint, SpatialInertia

    builder, plant, _ = make_drake_plant(0.001)
    body = plant.AddRigidBody("body", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    joint = plant.AddJoint(
        PrismaticJoint("joint", plant.world_frame(), body.body_frame(), [1, 0, 0])
    )
    plant.AddJointActuator("motor", joint, 2.0)
    _simulator, context = simulate_drake(builder, plant, 1.0, [10.0])
    return np.isclose(plant.GetVelocities(context)[0], 2.0, rtol=1e-6)


@fact(
    *DRAKE,
    "reaction of a joint",
    "The reaction contains the moment of the joint's limit, about its free axis.",
    "The moment of a limit is the impulse of its own row, divided by the time step.",
)
def drake_reactions_contain_limits():
    from pydrake.all import FixedOffsetFrame, RevoluteJoint, RigidTransform, SpatialInertia

    builder, plant, _ = make_drake_plant(0.001)
    body = plant.AddRigidBody("body", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    arm = plant.AddFrame(
        FixedOffsetFrame("arm", body.body_frame(), RigidTransform([-0.3, 0.0, 0.0]))
    )
    plant.AddJoint(RevoluteJoint("joint", plant.world_frame(), arm, [0, 1, 0], -0.001, 0.001))
    _simulator, context = simulate_drake(builder, plant, 1.0)
    (reaction,) = plant.get_reaction_forces_output_port().Eval(context)
    return np.isclose(abs(reaction.rotational()[1]), 0.3 * 9.81, rtol=1e-3)


@fact(
    *DRAKE,
    "damping of joints",
    "A step is implicit in the damping of a joint with kSap, kSimilar and kLagged, and explicit with kTamsi: beyond "
    "h d = 2 I the joint is unstable.",
    "v\\* of `from_drake` is the plant's own.",
)
def drake_damps_joints_explicitly_with_tamsi():
    from pydrake.all import DiscreteContactApproximation, MultibodyPlant, Parser, Simulator

    urdf = (
        '<robot name="r"><link name="base"/><link name="a"><inertial><mass value="1"/>'
        '<inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="j" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>'
        '<dynamics damping="50"/></joint></robot>'
    )
    speeds = []
    for name in ("kSap", "kSimilar", "kLagged", "kTamsi"):
        plant = MultibodyPlant(0.01)
        plant.set_discrete_contact_approximation(getattr(DiscreteContactApproximation, name))
        Parser(plant).AddModelsFromString(urdf, "urdf")
        plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
        plant.Finalize()
        simulator = Simulator(plant)
        plant.SetVelocities(simulator.get_mutable_context(), [1.0])
        simulator.AdvanceTo(0.01)
        speeds.append(plant.GetVelocities(simulator.get_context())[0])
    return np.allclose(speeds, [1 / 6] * 3 + [-4.0], atol=1e-3)


@fact(
    *DRAKE,
    "depth of joint limits",
    "5 N m press a hinge of 0.02 kg m² 1.3e-7 rad past its limit with kSap, kSimilar and kLagged, in steps "
    "of 1 ms, and 0.025 rad, 2e5 times as far, with kTamsi.",
    "The problem is one of velocities: a limit that has been passed is an error only with `correction=1`.",
)
def drake_limits_are_soft_with_tamsi():
    from pydrake.all import DiscreteContactApproximation, MultibodyPlant, Parser, Simulator

    mjcf = (
        '<mujoco model="m"><compiler angle="radian"/><option gravity="0 0 0"/><worldbody><body name="b">'
        '<joint name="j" axis="0 1 0" range="-.5 .5"/><inertial pos="0 0 0" mass="1" diaginertia=".02 .02 .02"/></body>'
        '</worldbody><actuator><motor name="a" joint="j"/></actuator></mujoco>'
    )
    depths = []
    for name in ("kSap", "kSimilar", "kLagged", "kTamsi"):
        plant = MultibodyPlant(0.001)
        plant.set_discrete_contact_approximation(getattr(DiscreteContactApproximation, name))
        Parser(plant).AddModelsFromString(mjcf, "xml")
        plant.Finalize()
        simulator = Simulator(plant)
        context = simulator.get_mutable_context()
        plant.get_actuation_input_port().FixValue(context, [5.0])
        simulator.AdvanceTo(2.0)
        depths.append(plant.GetPositions(context)[0] - 0.5)
    return max(depths[:3]) < 2e-7 and abs(depths[3] - 0.025) < 1e-4
