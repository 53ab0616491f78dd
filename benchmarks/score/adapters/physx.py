"""PhysX 5 on the CPU by the package sapien; hinges are D6 joints of free bodies."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from benchmarks.score import adapters as tools

warnings.simplefilter("ignore")
import sapien  # noqa: E402
import sapien.physx as px  # noqa: E402


def build(scene: tools.Scene, options: tools.Options) -> tools.Running:
    """Use `PhysxCpuSystem.step`; options are those of set_body_config and set_scene_config, and `free`: no damping."""
    dt = options["dt"]
    moving = tools.get_moving(scene)
    bodies = []
    friction = scene["friction"]
    bounce = {k: options[k] for k in ("bounce_threshold",) if k in options}
    px.set_scene_config(gravity=np.array(scene["gravity"], np.float32), **bounce)
    px.set_body_config(
        **{k: v for k, v in options.items() if k not in ("dt", "free", "bounce_threshold")}
    )
    system = px.PhysxCpuSystem()
    world = sapien.Scene([system])
    material = px.PhysxMaterial(friction, friction, scene["restitution"])
    system.timestep = dt

    def add(component: Any, shape: Any, pose: Any) -> Any:
        component.attach(shape)
        entity = sapien.Entity()
        entity.add_component(component)
        entity.set_pose(pose)
        world.add_entity(entity)
        return component

    if tools.has_ground(scene):
        up = sapien.Pose([0, 0, 0], [0.5**0.5, 0, -(0.5**0.5), 0])
        add(px.PhysxRigidStaticComponent(), px.PhysxCollisionShapePlane(material), up)
    ground = sapien.Entity()
    ground.add_component(px.PhysxRigidStaticComponent())
    world.add_entity(ground)
    for b in moving:
        body = px.PhysxRigidDynamicComponent()
        half = tools.get_half(b)
        radius = tools.get_radius(b)
        sphere = px.PhysxCollisionShapeSphere(radius, material) if radius else None
        shape = sphere or px.PhysxCollisionShapeBox(np.array(half), material)
        add(body, shape, sapien.Pose(b["position"], b["quaternion"]))
        body.set_mass(b["mass"])
        body.set_inertia(np.array(b["inertia"]))
        body.set_cmass_local_pose(sapien.Pose())
        body.set_kinematic(b["kinematic"])
        if "free" in options:
            body.set_linear_damping(0)
            body.set_angular_damping(0)
        if not b["kinematic"]:
            body.set_linear_velocity(b["velocity"])
            body.set_angular_velocity(b["spin"])
        bodies.append(body)
    turn = [
        0.5**0.5,
        0,
        0,
        0.5**0.5,
    ]  # The x axis of the frame of a joint is the y axis of the world.
    for joint in scene["joints"]:
        tie = px.PhysxDriveComponent(bodies[joint["b"]])
        tie.set_parent(bodies[joint["a"]] if joint["a"] >= 0 else ground.components[0])
        tie.set_pose_in_child(
            sapien.Pose(np.subtract(joint["anchor"], moving[joint["b"]]["position"]), turn)
        )
        above = moving[joint["a"]]["position"] if joint["a"] >= 0 else np.zeros(3)
        tie.set_pose_in_parent(sapien.Pose(np.subtract(joint["anchor"], above), turn))
        for limit in (tie.set_limit_x, tie.set_limit_y, tie.set_limit_z, tie.set_limit_cone):
            limit(0, 0)
        if joint["motor"]:  # The torque falls below its limit within 1 % of the speed.
            speed, torque = joint["motor"]
            # The limit of a drive is an impulse.
            tie.set_drive_property_twist(0, 100 * torque / speed, torque * dt, "force")
            tie.set_drive_velocity_target([0, 0, 0], [-speed, 0, 0])  # PhysX turns the other way.
        bodies[joint["b"]].entity.add_component(tie)

    def step() -> None:
        for body, b in zip(bodies, moving, strict=True):
            if b["kinematic"]:
                now = body.entity.pose
                body.set_kinematic_target(
                    sapien.Pose(np.array(now.p) + dt * np.array(b["velocity"]), now.q)
                )
            elif any(b["force"]):
                body.add_force_at_point(b["force"], body.entity.pose.p)
        system.step()

    def get_row(body: Any, b: Any) -> list[Any]:
        pose = body.entity.pose
        v = b["velocity"] if b["kinematic"] else body.linear_velocity
        return [*pose.p, *pose.q, *v, *body.angular_velocity]

    def properties() -> list[Any]:
        rows = [(r, r.collision_shapes[0].physical_material) for r in bodies]
        return [[r.mass, *r.inertia, m.dynamic_friction, m.restitution] for r, m in rows]

    def state() -> list[Any]:
        return [get_row(*pair) for pair in zip(bodies, moving, strict=True)]

    return tools.Running(step, state, properties, close=world.clear)
