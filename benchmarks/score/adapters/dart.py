"""DART; hinges are native, a ball joint closes a loop, a belt is a prismatic joint with a velocity actuator."""

from __future__ import annotations

from typing import Any

import dartpy as dart
import numpy as np

from benchmarks.score import adapters as tools


def build(scene: tools.Scene, options: tools.Options) -> tools.Running:
    """Use `World.step`; options are `detector`, `split` impulses, `solver`, a class, and those of the class."""
    world = dart.simulation.World()
    moving = tools.get_moving(scene)
    links = {k.body: k for k in tools.make_tree(scene)}
    world.setTimeStep(options["dt"])
    world.setGravity(np.array(scene["gravity"]))
    solver = world.getConstraintSolver()
    nodes = []
    commands = []
    if "detector" in options:
        solver.setCollisionDetector(getattr(dart.collision, options["detector"])())
    if "split" in options:
        solver.setSplitImpulseEnabled(True)
    if "solver" in options:
        method = getattr(dart.constraint, options["solver"])()
        more = {k: v for k, v in options.items() if k not in ("dt", "detector", "split", "solver")}
        if more:
            values = method.getOptions()
            for key, value in more.items():
                setattr(values, key, value)
            method.setOptions(values)
        solver.setBoxedLcpSolver(method)

    def add_shape(node: Any, half: Any, radius: float) -> None:
        shape = (
            dart.dynamics.BoxShape(2.0 * np.array(half))
            if half
            else dart.dynamics.SphereShape(radius)
        )
        made = node.createShapeNode(shape)
        made.createCollisionAspect()
        aspect = made.createDynamicsAspect()
        aspect.setFrictionCoeff(scene["friction"])  # The smaller coefficient of a pair counts.
        aspect.setRestitutionCoeff(
            scene["restitution"] ** 0.5
        )  # The restitution of a pair is the product.

    def move(vector: Any) -> Any:
        transform = dart.math.Isometry3()
        transform.set_translation(np.array(vector, float))
        return transform

    if tools.has_ground(scene):
        ground = dart.dynamics.Skeleton("ground")
        joint, node = ground.createWeldJointAndBodyNodePair()
        joint.setTransformFromParentBodyNode(move((0, 0, -1)))
        add_shape(node, (100, 100, 1), 0.0)
        world.addSkeleton(ground)
    for i, b in enumerate(moving):
        link = links.get(i)
        parent = nodes[link.parent] if link and link.parent >= 0 else None
        skeleton = parent.getSkeleton() if parent else dart.dynamics.Skeleton(f"b{i}")
        kind = "Free" if link is None else "Prismatic" if link.slides else "Revolute"
        create = getattr(skeleton, f"create{kind}JointAndBodyNodePair")
        joint, node = create(parent) if parent else create()
        node.setInertia(dart.dynamics.Inertia(b["mass"], np.zeros(3), np.diag(b["inertia"])))
        add_shape(node, tools.get_half(b), tools.get_radius(b))
        if link is None:
            w, x, y, z = b["quaternion"]
            size = np.linalg.norm([x, y, z])
            turn = 2 * np.arctan2(size, w) * np.array([x, y, z]) / (size or 1.0)
            joint.setPositions(np.array([*turn, *b["position"]], float))
            local = dart.math.expMapRot(turn).T
            joint.setVelocities(np.concatenate([local @ b["spin"], local @ b["velocity"]]))
        else:
            above = moving[link.parent]["position"] if parent else np.zeros(3)
            joint.setTransformFromParentBodyNode(move(np.subtract(link.anchor, above)))
            joint.setTransformFromChildBodyNode(move(np.subtract(link.anchor, b["position"])))
            joint.setAxis(np.array(link.axis))
            if link.drive:
                kinds = dart.dynamics.ActuatorType
                joint.setActuatorType(kinds.VELOCITY if link.slides else kinds.SERVO)
                joint.setForceUpperLimit(0, link.drive[1])
                joint.setForceLowerLimit(0, -link.drive[1])
                if link.slides:
                    joint.setVelocity(0, link.drive[0])
                commands.append((joint, link.drive[0]))
            for point in link.loops:
                solver.addConstraint(dart.constraint.BallJointConstraint(node, np.array(point)))
        if not parent:
            world.addSkeleton(skeleton)
        nodes.append(node)

    def step() -> None:
        for joint, speed in commands:
            joint.setCommand(0, speed)
        for node, b in zip(nodes, moving, strict=True):
            if any(b["force"]):
                node.addExtForce(np.array(b["force"]))
        world.step()

    def state() -> list[Any]:
        rows = []
        for n in nodes:
            t = n.getWorldTransform()
            q = t.quaternion()
            v, w = np.ravel(n.getLinearVelocity()), np.ravel(n.getAngularVelocity())
            rows.append([*np.ravel(t.translation()), q.w(), q.x(), q.y(), q.z(), *v, *w])
        return rows

    def properties() -> list[Any]:
        pairs = [(n.getInertia(), n.getShapeNode(0).getDynamicsAspect()) for n in nodes]
        materials = [(a.getFrictionCoeff(), a.getRestitutionCoeff() ** 2) for _, a in pairs]
        masses = [(m.getMass(), *np.diag(m.getMoment())) for m, _ in pairs]
        return [[*m, *material] for m, material in zip(masses, materials, strict=True)]

    return tools.Running(step, state, properties)
