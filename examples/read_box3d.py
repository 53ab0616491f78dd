"""Record the steps of a stack of four boxes in Box3D for `lavender report`, and judge each.

robox3d ships Box3D with its C interface. A contact is listed for both of its bodies.

    python examples/read_box3d.py
"""

import importlib.util
import sys

import numpy as np

import lavender as lv


def record(folder, substeps=4):
    """Write the problems of the steps to a folder, and return the velocity errors of Box3D [m/s]."""
    import robox3d
    from robox3d._ffi import ffi, lib

    dt, gravity = 1 / 60, np.array([0.0, 0.0, -9.81, 0.0, 0.0, 0.0])
    world = robox3d.World(gravity=gravity[:3], substeps=substeps)
    ground = world.create_body(position=(0.0, 0.0, -0.5), kind="static")
    ground.add_box((9.0, 9.0, 0.5), friction=0.5)
    boxes = [world.create_body(position=(0.02 * i, 0.0, i + 0.5)) for i in range(4)]
    for box in boxes:
        box.add_box((0.5, 0.5, 0.5), density=1.0, friction=0.5)

    def find_body(body):
        return next((i for i, box in enumerate(boxes) if box.id.index1 == body.index1), -1)

    def read_velocities():
        return np.array([(*box.linear_velocity, *box.angular_velocity) for box in boxes])

    def read_contacts(body):
        """Yield the bodies of each contact that `body` is the second of, the normal and the points."""
        capacity = lib.b3Body_GetContactCapacity(body.id)
        contacts = ffi.new("b3ContactData[]", max(capacity, 1))
        for contact in contacts[0 : lib.b3Body_GetContactData(body.id, contacts, capacity)]:
            a, b = (
                find_body(lib.b3Shape_GetBody(shape))
                for shape in (contact.shapeIdA, contact.shapeIdB)
            )
            if b == find_body(body.id):  # A contact is listed for both of its bodies.
                for manifold in contact.manifolds[0 : contact.manifoldCount]:
                    normal = manifold.normal.x, manifold.normal.y, manifold.normal.z
                    yield a, b, normal, manifold.points[0 : manifold.pointCount]

    errors = []
    with lv.io.Recorder(folder, every=1, solver="Box3D") as recorder:
        for _ in range(60):
            free = read_velocities() + dt * gravity
            position = [np.array(box.position) for box in boxes]
            world.step(dt)
            inv_inertia = np.tile(6 * np.eye(3), (4, 1, 1))
            builder = lv.RowBuilder(np.ones(4), inv_inertia, free, dt, position, baumgarte=0.0)
            for a, b, normal, points in (
                contact for box in boxes for contact in read_contacts(box)
            ):
                for point in points:
                    arm = point.anchorB.x, point.anchorB.y, point.anchorB.z
                    gap = point.separation
                    builder.contact(
                        a,
                        b,
                        position[b] + arm,
                        normal,
                        gap=gap,
                        mu=0.5,
                        feature=point.featureId % 65536,
                    )
            (verdict,) = recorder.add(builder.problem(), velocity=read_velocities())
            errors.append(verdict.velocity_error)
    return errors


def main():
    """Record the steps and print the median of their errors."""
    if importlib.util.find_spec("robox3d") is None:
        sys.exit("robox3d is not installed: pip install robox3d")
    errors = record("box3d-steps")
    print(f"{len(errors)} steps, median velocity error {np.median(errors):.1e} m/s")


if __name__ == "__main__":
    main()
