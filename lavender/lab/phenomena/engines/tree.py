"""Joints of a scene as a tree, for engines of reduced coordinates: each body has one parent at most."""

from __future__ import annotations

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError
from lavender.sim.scene import Body, Box, Joint, Plane, Scene, Sphere
from lavender.sim.scene.parts import rotation


def parents(scene: Scene, engine: str) -> dict[int, Joint]:
    """Body -> joint to its parent, which stands before it.

    Raises
    ------
    CapabilityError
        A loop, a soft joint, a motor, or a distance joint.
    """
    found: dict[int, Joint] = {}
    for joint in scene.joints:
        if joint.b in found or joint.b <= joint.a:
            raise CapabilityError(f"{joint.name} closes a loop; {engine} takes joints of a tree")
        if joint.kind == "distance" or joint.hertz or joint.motor_speed is not None:
            raise CapabilityError(f"{joint.name}: {engine} takes rigid balls and hinges without a motor")
        found[joint.b] = joint
    if scene.parameters.restitution or any(b.friction is not None or b.restitution for b in scene.bodies):
        raise CapabilityError(f"{engine} takes one friction for all bodies, and no restitution")
    return found


def collision_shape(body: Body, engine: str, static: bool = True) -> Plane | Sphere | Box:
    """What a body is in contacts; CapabilityError of none, and of a static one that is no plane unless `static`."""
    shape = body.shape
    if shape is None or (body.is_static and not static and not isinstance(shape, Plane)):
        raise CapabilityError(f"{body.name} has no shape that {engine} could be given")
    return shape


def relative(parent: Body | None, child: Body) -> tuple[FloatArray, FloatArray]:
    """Place (3,) [m] and quaternion (4,) of a child in its parent's frame; None is the world."""
    if parent is None:
        return child.position, child.quaternion
    place: FloatArray = rotation(parent.quaternion).T @ (child.position - parent.position)
    w, v = parent.quaternion[0], -parent.quaternion[1:]
    s, u = child.quaternion[0], child.quaternion[1:]
    return place, np.concatenate([[w * s - v @ u], w * u + s * v + np.cross(v, u)])


def xyzw(q: FloatArray) -> list[float]:
    """A quaternion (4,) w x y z with w last."""
    return [*map(float, q[1:]), float(q[0])]
