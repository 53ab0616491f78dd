"""Drake's discrete MultibodyPlant; hinges are native, a belt is a prismatic joint with 1e6 kg."""

from __future__ import annotations

import logging
import warnings
from typing import Any

import numpy as np

from benchmarks.score import adapters as tools

warnings.simplefilter("ignore")
import pydrake.all as drake  # noqa: E402

logging.getLogger("drake").setLevel(logging.ERROR)

#: Of DefaultProximityProperties.
SHIPPED_MODULUS = 1e7  # Pa
SHIPPED_STIFFNESS = 1e6  # N/m


def build(scene: tools.Scene, options: tools.Options) -> tools.Running:
    """Use `AdvanceTo`.

    Options are `approximation`, `stiction` [m/s], `penetration` of a point contact by its weight [m], `hydroelastic`, a
    mesh resolution, and `modulus` [Pa].
    """
    if scene["restitution"]:
        raise tools.CannotExpress(
            "no restitution coefficient, only dissipation or a relaxation time"
        )
    if len(tools.make_tree(scene)) < len(scene["joints"]):
        raise tools.CannotExpress("the adapter closes no loops")
    moving = tools.get_moving(scene)
    links = {link.body: link for link in tools.make_tree(scene)}
    builder = drake.DiagramBuilder()
    plant, _ = drake.AddMultibodyPlantSceneGraph(builder, time_step=options["dt"])
    plant.mutable_gravity_field().set_gravity_vector(scene["gravity"])
    if "approximation" in options:
        plant.set_discrete_contact_approximation(
            getattr(drake.DiscreteContactApproximation, options["approximation"])
        )
    if "stiction" in options:
        plant.set_stiction_tolerance(options["stiction"])
    stiffness = None
    if "penetration" in options:  # of the heaviest body's weight
        weight = np.linalg.norm(scene["gravity"]) * max(b["mass"] for b in moving)
        stiffness = max(weight / options["penetration"], SHIPPED_STIFFNESS)

    def add_shape(body: Any, shape: Any, name: str, size: float, rigid: bool) -> None:
        made = drake.ProximityProperties()
        fine = options.get("hydroelastic")
        friction = drake.CoulombFriction(scene["friction"], scene["friction"])
        drake.AddContactMaterial(point_stiffness=stiffness, friction=friction, properties=made)
        if fine and rigid:
            drake.AddRigidHydroelasticProperties(size, made)
        elif fine:
            drake.AddCompliantHydroelasticProperties(
                size * fine, options.get("modulus", SHIPPED_MODULUS), made
            )
        plant.RegisterCollisionGeometry(body, drake.RigidTransform(), shape, name, made)

    def add_frame(name: str, body: Any, offset: Any) -> Any:
        return plant.AddFrame(
            drake.FixedOffsetFrame(name, body, drake.RigidTransform(np.array(offset, float)))
        )

    if tools.has_ground(scene):
        add_shape(plant.world_body(), drake.HalfSpace(), "ground", 1.0, True)
    bodies: list[Any] = []
    joints = []
    for i, b in enumerate(moving):
        unit = drake.UnitInertia(*(np.array(b["inertia"]) / b["mass"]))
        mass = 1e6 if b["kinematic"] else b["mass"]
        bodies.append(plant.AddRigidBody(f"b{i}", drake.SpatialInertia(mass, np.zeros(3), unit)))
        half, radius, link = tools.get_half(b), tools.get_radius(b), links.get(i)
        shape = drake.Box(*(2.0 * np.array(half))) if half else drake.Sphere(radius)
        add_shape(bodies[i], shape, f"g{i}", 2.0 * min(half) if half else radius, b["kinematic"])
        if link:
            above = moving[link.parent]["position"] if link.parent >= 0 else np.zeros(3)
            parent = bodies[link.parent] if link.parent >= 0 else plant.world_body()
            first = add_frame(f"p{i}", parent, np.subtract(link.anchor, above))
            second = add_frame(f"c{i}", bodies[i], np.subtract(link.anchor, b["position"]))
            kind = drake.PrismaticJoint if link.slides else drake.RevoluteJoint
            joint = plant.AddJoint(kind(f"j{i}", first, second, np.array(link.axis)))
            joints.append((joint, link))
            if (
                link.drive and not link.slides
            ):  # The torque falls below its limit within 1 % of the speed.
                gains = drake.PdControllerGains(p=1e-9, d=100 * link.drive[1] / link.drive[0])
                plant.AddJointActuator(f"m{i}", joint, link.drive[1]).set_controller_gains(gains)
    plant.Finalize()
    simulator = drake.Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    pushes = []
    for i, (body, b) in enumerate(zip(bodies, moving, strict=True)):
        if i not in links:
            pose = drake.RigidTransform(drake.Quaternion(b["quaternion"]), b["position"])
            plant.SetFreeBodyPose(context, body, pose)
            motion = drake.SpatialVelocity(b["spin"], b["velocity"])
            plant.SetFreeBodySpatialVelocity(context, body, motion)
        if any(b["force"]):
            push = drake.ExternallyAppliedSpatialForce()
            push.body_index = body.index()
            push.F_Bq_W = drake.SpatialForce(np.zeros(3), np.array(b["force"]))
            pushes.append(push)
    if pushes:
        plant.get_applied_spatial_force_input_port().FixValue(context, pushes)
    for joint, link in joints:
        if link.slides:
            joint.set_translation_rate(context, (link.drive or (0.0,))[0])
        elif link.drive:
            port = plant.get_desired_state_input_port(joint.model_instance())
            port.FixValue(context, [0.0, link.drive[0]])
    simulator.Initialize()
    time = [0]

    def step() -> None:
        time[0] += 1
        simulator.AdvanceTo(time[0] * options["dt"])

    def state() -> list[Any]:
        rows = []
        for body in bodies:
            pose, v = body.EvalPoseInWorld(context), body.EvalSpatialVelocityInWorld(context)
            turn = pose.rotation().ToQuaternion().wxyz()
            rows.append([*pose.translation(), *turn, *v.translational(), *v.rotational()])
        return rows

    def properties() -> list[Any]:
        inertias = [body.CalcSpatialInertiaInBodyFrame(context) for body in bodies]
        return [
            [m.get_mass(), *m.CalcRotationalInertia().get_moments(), None, None] for m in inertias
        ]

    return tools.Running(step, state, properties)
