"""Record the steps of a stack of four boxes in Box2D for `lavender report`, and judge each.

Contacts are read in `PreSolve`: the arrays of a world manifold live only as long as it does.

    python examples/read_box2d.py
"""

import importlib.util
import sys

import numpy as np

import lavender as lv


def record(folder, iterations=10):
    """Write the problems of the steps to a folder, and return the velocity errors of Box2D [m/s]."""
    import Box2D

    dt, gravity, boxes, found = 1 / 60, np.array([0.0, -9.81, 0.0]), [], {}

    class Listener(Box2D.b2ContactListener):
        def PreSolve(self, contact, old_manifold):
            world = contact.worldManifold  # its arrays live only as long as it does
            points = [tuple(point) for point in world.points[: contact.manifold.pointCount]]
            found[contact.fixtureA, contact.fixtureB] = (
                points,
                tuple(world.normal),
                contact.friction,
            )

    listener = Listener()
    world = Box2D.b2World(gravity=(0.0, -9.81), contactListener=listener)
    world.CreateStaticBody(position=(0.0, -0.5)).CreatePolygonFixture(box=(9.0, 0.5), friction=0.5)
    for i in range(4):
        boxes.append(world.CreateDynamicBody(position=(0.02 * i, i + 0.5)))
        boxes[i].CreatePolygonFixture(box=(0.5, 0.5), density=1.0, friction=0.5)

    def read_velocities():
        return np.array([(*box.linearVelocity, box.angularVelocity) for box in boxes])

    errors = []
    with lv.io.Recorder(folder, every=1, solver="Box2D") as recorder:
        for _ in range(30):
            found.clear()
            free = read_velocities() + dt * gravity
            position = [tuple(box.worldCenter) for box in boxes]
            world.Step(dt, iterations, 3)
            builder = lv.RowBuilder(np.ones(4), np.full(4, 6.0), free, dt, position)
            for fixtures, (points, normal, mu) in found.items():
                a, b = (
                    boxes.index(fixture.body) if fixture.body in boxes else -1
                    for fixture in fixtures
                )
                for i, point in enumerate(points):
                    builder.contact(a, b, point, normal, mu=mu, feature=i)
            (verdict,) = recorder.add(builder.problem(), velocity=read_velocities())
            errors.append(verdict.velocity_error)
    return errors


def main():
    """Record the steps and print the median of their errors."""
    if importlib.util.find_spec("Box2D") is None:
        sys.exit("Box2D is not installed: pip install Box2D")
    errors = record("box2d-steps")
    print(f"{len(errors)} steps, median velocity error {np.median(errors):.1e} m/s")


if __name__ == "__main__":
    main()
