"""PyBullet; the friction of a pair is a product, and so is its restitution. A point-to-point joint closes a loop.

Bodies with hinges are links of one multibody. A belt is a prismatic link of 1e6 kg with a motor.
"""

from __future__ import annotations

from typing import Any

import pybullet as p

from benchmarks.score import adapters as tools

#: Options that are arguments of changeDynamics.
OF_BODIES = (
    "collisionMargin",
    "activationState",
    "linearDamping",
    "angularDamping",
    "jointDamping",
)


def build(scene: tools.Scene, options: tools.Options) -> tools.Running:
    """Use `stepSimulation`; options are those of setPhysicsEngineParameter and of changeDynamics."""
    p.connect(p.DIRECT)
    settings = {key: value for key, value in options.items() if key not in ("dt", *OF_BODIES)}
    changes = {key: value for key, value in options.items() if key in OF_BODIES}
    p.setPhysicsEngineParameter(fixedTimeStep=options["dt"], **settings)
    p.setGravity(*scene["gravity"])
    grounds = (
        [(p.createMultiBody(0, p.createCollisionShape(p.GEOM_PLANE)), -1)]
        if tools.has_ground(scene)
        else []
    )
    moving = tools.get_moving(scene)
    tree = tools.make_tree(scene)
    shapes = []
    parts = {}
    for i, b in enumerate(moving):
        size = (
            {"halfExtents": tools.get_half(b)}
            if tools.get_half(b)
            else {"radius": tools.get_radius(b)}
        )
        shapes.append(
            p.createCollisionShape(p.GEOM_BOX if "halfExtents" in size else p.GEOM_SPHERE, **size)
        )
        if i not in [link.body for link in tree]:
            parts[i] = (
                p.createMultiBody(
                    b["mass"], shapes[i], -1, b["position"], tools.shift(b["quaternion"])
                ),
                -1,
            )
            p.resetBaseVelocity(parts[i][0], b["velocity"], b["spin"])
    masses = [1e6 if link.slides else moving[link.body]["mass"] for link in tree]
    starts = [tools.subtract(link.anchor, tools.get_parent_anchor(tree, link)) for link in tree]
    offsets = [tools.subtract(moving[link.body]["position"], link.anchor) for link in tree]
    kinds = [p.JOINT_PRISMATIC if link.slides else p.JOINT_REVOLUTE for link in tree]
    level = [[0, 0, 0, 1]] * len(tree)
    none = [-1] * len(tree)
    made = (
        -1
        if not tree
        else p.createMultiBody(
            0,
            -1,
            linkMasses=masses,
            linkVisualShapeIndices=none,
            linkParentIndices=[k.parent + 1 for k in tree],
            linkCollisionShapeIndices=[shapes[k.body] for k in tree],
            linkPositions=starts,
            linkOrientations=level,
            linkJointTypes=kinds,
            linkInertialFramePositions=offsets,
            linkInertialFrameOrientations=level,
            linkJointAxis=[k.axis for k in tree],
        )
    )
    for k, link in enumerate(tree):
        parts[link.body] = (made, k)
        (speed, force) = link.drive or (0.0, 0.0)
        p.setJointMotorControl2(made, k, p.VELOCITY_CONTROL, targetVelocity=speed, force=force)
        p.resetJointState(made, k, 0.0, speed if link.slides else 0.0)
        for point in link.loops:
            offset = tools.subtract(point, moving[link.body]["position"])
            p.createConstraint(made, k, -1, -1, p.JOINT_POINT2POINT, [0] * 3, offset, point)
    for part in [*parts.values(), *grounds]:
        p.changeDynamics(
            *part, lateralFriction=scene["friction"] ** 0.5, restitution=scene["restitution"] ** 0.5
        )
        if changes:
            p.changeDynamics(*part, **changes)

    def step() -> None:
        for i, b in enumerate(moving):
            if any(b["force"]):
                at = p.getBasePositionAndOrientation(parts[i][0])[0]
                p.applyExternalForce(parts[i][0], -1, b["force"], at, p.WORLD_FRAME)
        p.stepSimulation()

    def get_row(body: int, k: int) -> list[Any]:
        base = p.getBasePositionAndOrientation(body)
        s = (*base, *p.getBaseVelocity(body)) if k < 0 else p.getLinkState(body, k, 1, 1)
        return [*s[0], s[1][3], *s[1][:3], *s[-2], *s[-1]]

    def properties() -> list[Any]:
        infos = (p.getDynamicsInfo(*parts[i]) for i in range(len(moving)))
        return [[r[0], *r[2], r[1] ** 2, r[5] ** 2] for r in infos]

    return tools.Running(
        step,
        lambda: [get_row(*parts[i]) for i in range(len(moving))],
        properties,
        close=p.disconnect,
    )
