"""Joints of a scene as a tree, for engines in reduced coordinates: each body has at most one parent."""

from __future__ import annotations

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError
from lavender.sim.scene import Body, Box, Joint, Plane, Scene, Sphere
from lavender.sim.scene.parts import convert_to_rotation_matrix


def map_bodies_to_parent_joints(scene: Scene, engine: str) -> dict[int, Joint]:
    """Return {body: joint to its parent}; a parent has a smaller index than its children.

    Raises
    ------
    CapabilityError
        The scene has a loop, a soft joint, a motor or a distance joint; restitution, or different friction of bodies.
    """
    joint_of: dict[int, Joint] = {}
    for joint in scene.joints:
        if joint.b in joint_of or joint.b <= joint.a:
            raise CapabilityError(
                f"{joint.name} closes a loop, or its body b does not have a larger number than body a; "
                f"{engine} accepts only joints of a tree"
            )
        if joint.kind == "distance" or joint.hertz or joint.motor_speed is not None:
            raise CapabilityError(
                f"{joint.name} is a distance joint, a soft joint or has a motor; {engine} accepts only "
                "rigid ball joints and hinges without a motor"
            )
        joint_of[joint.b] = joint
    if scene.parameters.restitution or any(b.friction is not None or b.restitution for b in scene.bodies):
        raise CapabilityError(
            f"the scene has restitution, or friction of single bodies; {engine} accepts only one friction "
            "for all bodies, and no restitution"
        )
    return joint_of


def get_collision_shape(body: Body, engine: str, static: bool = True) -> Plane | Sphere | Box:
    """Return the collision shape of a body.

    Raise CapabilityError if the body has no shape. If `static` is false, raise it also for a static body that
    is not a plane.
    """
    shape = body.shape
    if shape is None or (body.is_static and not static and not isinstance(shape, Plane)):
        raise CapabilityError(
            f"{body.name} has no collision shape, or a static one that is not a plane; {engine} needs "
            "another shape of this body"
        )
    return shape


def compute_relative_pose(parent: Body | None, child: Body) -> tuple[FloatArray, FloatArray]:
    """Compute position (3,) [m] and quaternion (4,) of a child in its parent's frame; None is the world."""
    if parent is None:
        return child.position, child.quaternion
    position: FloatArray = convert_to_rotation_matrix(parent.quaternion).T @ (
        child.position - parent.position
    )
    w, v = parent.quaternion[0], -parent.quaternion[1:]
    s, u = child.quaternion[0], child.quaternion[1:]
    return position, np.concatenate([[w * s - v @ u], w * u + s * v + np.cross(v, u)])


def reorder_to_xyzw(q: FloatArray) -> list[float]:
    """Reorder a quaternion (4,) w x y z to x y z w."""
    return [*map(float, q[1:]), float(q[0])]
