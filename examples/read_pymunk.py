"""Record the steps of a stack of four boxes in pymunk for `lavender report`, and judge each.

Bodies move before the solve, so that positions are read after the step. v* includes the damping of the space.

    python examples/read_pymunk.py
"""

import importlib.util
import sys

import numpy as np

import lavender as lv


def record(folder, iterations=10):
    """Write the problems of the steps to a folder, and return the velocity errors of pymunk [m/s]."""
    import pymunk

    dt, gravity, found = 1 / 60, np.array([0.0, -9.81, 0.0]), []
    space = pymunk.Space()
    space.gravity, space.iterations = (0.0, -9.81), iterations
    boxes = [pymunk.Body(1.0, 1 / 6) for _ in range(4)]
    shapes = [pymunk.Poly.create_box(box, (1.0, 1.0)) for box in boxes]
    shapes.append(pymunk.Segment(space.static_body, (-9.0, 0.0), (9.0, 0.0), 0.0))
    space.add(*boxes, *shapes)
    for i, box in enumerate(boxes):
        box.position = 0.02 * i, i + 0.5
    for shape in shapes:
        shape.friction = 0.7

    def read_velocities():
        return np.array([(*box.velocity, box.angular_velocity) for box in boxes])

    def read_contact(arbiter, space, data):
        found.append((arbiter.bodies, arbiter.contact_point_set, arbiter.friction))

    space.on_collision(post_solve=read_contact)
    errors = []
    with lv.io.Recorder(folder, every=1, solver="pymunk") as recorder:
        for _ in range(30):
            found.clear()
            free = read_velocities() * space.damping**dt + dt * gravity
            space.step(dt)
            position = [box.position for box in boxes]
            builder = lv.RowBuilder(np.ones(4), np.full(4, 6.0), free, dt, position)
            for bodies, contact, mu in found:
                a, b = (boxes.index(body) if body in boxes else -1 for body in bodies)
                for i, point in enumerate(contact.points):
                    middle = 0.5 * (np.array(point.point_a) + point.point_b)
                    builder.contact(a, b, middle, contact.normal, mu=mu, feature=i)
            (verdict,) = recorder.add(builder.problem(), velocity=read_velocities())
            errors.append(verdict.velocity_error)
    return errors


def main():
    """Record the steps and print the median of their errors."""
    if importlib.util.find_spec("pymunk") is None:
        sys.exit("pymunk is not installed: pip install pymunk")
    errors = record("pymunk-steps")
    print(f"{len(errors)} steps, median velocity error {np.median(errors):.1e} m/s")


if __name__ == "__main__":
    main()
