"""Record the steps of a stack of four boxes in DART for `lavender report`, and judge each.

The normal points from object 2 to object 1.

    python examples/read_dart.py
"""

import importlib.util
import sys

import numpy as np

import lavender as lv


def record(folder):
    """Write the problems of the steps to a folder, and return the velocity errors of DART [m/s]."""
    import dartpy

    dt, gravity = 1 / 60, np.array([0.0, 0.0, -9.81, 0.0, 0.0, 0.0])
    world = dartpy.simulation.World()
    world.setTimeStep(dt)
    world.setGravity(gravity[:3])

    def add_box(name, size, height, is_fixed):
        skeleton = dartpy.dynamics.Skeleton(name)
        if is_fixed:
            joint, body = skeleton.createWeldJointAndBodyNodePair()
            pose = dartpy.math.Isometry3()
            pose.set_translation([0.0, 0.0, height])
            joint.setTransformFromParentBodyNode(pose)
        else:
            _, body = skeleton.createFreeJointAndBodyNodePair()
            body.setInertia(dartpy.dynamics.Inertia(1.0, [0.0, 0.0, 0.0], np.eye(3) / 6))
            skeleton.setPositions([0.0, 0.0, 0.0, 0.02 * height, 0.0, height])
        shape = body.createShapeNode(dartpy.dynamics.BoxShape(size))
        shape.createCollisionAspect()
        shape.createDynamicsAspect()
        shape.getDynamicsAspect().setFrictionCoeff(0.5)
        world.addSkeleton(skeleton)
        return body

    add_box("ground", [18.0, 18.0, 1.0], -0.5, True)
    boxes = [add_box(f"box{i}", [1.0, 1.0, 1.0], i + 0.5, False) for i in range(4)]
    index = {f"box{i}": i for i in range(4)}

    def find_body(collision_object):
        node = collision_object.getShapeFrame().asShapeNode().getBodyNodePtr()
        return index.get(node.getSkeleton().getName(), -1)

    def read_velocities():
        return np.array([(*box.getLinearVelocity(), *box.getAngularVelocity()) for box in boxes])

    errors = []
    with lv.io.Recorder(folder, every=1, solver="DART") as recorder:
        for _ in range(60):
            free = read_velocities() + dt * gravity
            position = [box.getWorldTransform().translation() for box in boxes]
            world.step()
            inv_inertia = np.tile(6 * np.eye(3), (4, 1, 1))
            builder = lv.RowBuilder(np.ones(4), inv_inertia, free, dt, position, baumgarte=0.0)
            result = world.getLastCollisionResult()
            for contact in map(result.getContact, range(result.getNumContacts())):
                b, a = find_body(contact.collisionObject1), find_body(contact.collisionObject2)
                builder.contact(
                    a, b, contact.point, contact.normal, gap=-contact.penetrationDepth, mu=0.5
                )
            (verdict,) = recorder.add(builder.problem(), velocity=read_velocities())
            errors.append(verdict.velocity_error)
    return errors


def main():
    """Record the steps and print the median of their errors."""
    if importlib.util.find_spec("dartpy") is None:
        sys.exit("dartpy is not installed: pip install dartpy")
    errors = record("dart-steps")
    print(f"{len(errors)} steps, median velocity error {np.median(errors):.1e} m/s")


if __name__ == "__main__":
    main()
