"""Record a stack of boxes in pymunk, which publishes no impulses of points, and judge its answers.

    python examples/pymunk_record.py [FOLDER]        then: lavender report FOLDER --sweeps

- Normal: the contact point set has it from body a to body b.
- Positions: a step moves bodies first, then finds contacts, so contacts and positions after the step belong together.
- Velocities: v* is the velocity before the step, after damping, plus gravity dt; v+ is the velocity after the step.
- Position correction: outside of the solve, by separate bias velocities, so that the target of a contact is 0.
"""

import importlib.util
import sys
import tempfile

import numpy as np

import lavender as lv

DT, STEPS, SIZE, FRICTION = 1.0 / 60.0, 60, 1.0, 0.5  # s, -, m, -
GRAVITY = np.array([0.0, -9.81, 0.0])  # m/s2, m/s2, rad/s2


def build(n, iterations):
    """Return a space with n boxes on each other, the boxes, and the list that receives the contacts of a step."""
    import pymunk

    space, boxes, contacts = pymunk.Space(), [], []
    space.gravity, space.iterations = (0.0, GRAVITY[1]), iterations
    ground = pymunk.Segment(space.static_body, (-10.0, 0.0), (10.0, 0.0), 0.0)
    ground.friction = FRICTION
    space.add(ground)
    for i in range(n):
        body = pymunk.Body(1.0, SIZE**2 / 6.0)
        body.position = (0.0, (i + 0.5) * SIZE)
        shape = pymunk.Poly.create_box(body, (SIZE, SIZE))
        shape.friction = FRICTION  # Chipmunk multiplies the coefficients of both shapes.
        space.add(body, shape)
        boxes.append(body)
    space.on_collision(post_solve=lambda arbiter, space, data: contacts.append(read_contact(arbiter)))
    return space, boxes, contacts


def read_contact(arbiter):
    """Return bodies, normal, points and friction of a pair of shapes."""
    points = arbiter.contact_point_set
    places = [0.5 * (np.array(p.point_a) + np.array(p.point_b)) for p in points.points]
    return [shape.body for shape in arbiter.shapes], np.array(points.normal), places, arbiter.friction


def record(folder, n=4, iterations=10):
    """Record the steps, and return the largest velocity error and the largest velocity that no impulse explains."""
    space, boxes, contacts = build(n, iterations)
    number = {id(body): i for i, body in enumerate(boxes)}
    worst, left_over = 0.0, 0.0
    with lv.io.Recorder(folder, every=1, solver=f"pymunk, {iterations} iterations", replace=True) as recorder:
        for _ in range(STEPS):
            contacts.clear()
            before = np.array([(*body.velocity, body.angular_velocity) for body in boxes])
            space.step(DT)
            after = np.array([(*body.velocity, body.angular_velocity) for body in boxes])
            position = np.array([body.position for body in boxes])
            free = before * space.damping**DT + DT * GRAVITY
            builder = lv.RowBuilder(np.ones(n), np.full(n, 6.0 / SIZE**2), free, DT, position)
            for pair, normal, places, mu in contacts:
                a, b = (number.get(id(body), -1) for body in pair)
                for k, place in enumerate(places):
                    builder.contact(a, b, place, normal, mu=mu, feature=k)
            if contacts:
                problem = builder.problem()
                velocity = np.zeros((n, 6))
                velocity[:, [0, 1, 5]] = after
                (verdict,) = recorder.add(problem, velocity=velocity)
                worst = max(worst, verdict.velocity_error)
                left_over = max(left_over, lv.io.reconstruct(problem, velocity).left_over)
    return worst, left_over


def main():
    """Record with few and with many iterations."""
    folder = sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp()
    for iterations in (2, 10, 100):
        worst, left_over = record(folder, iterations=iterations)
        print(
            f"{iterations} iterations: velocity error {worst:.1e} m/s; no impulse explains {left_over:.1e} m/s"
        )
    print(f"recorded: {folder}")


if __name__ == "__main__":
    if importlib.util.find_spec("pymunk") is None:
        sys.exit("pymunk is not installed: pip install pymunk")
    main()
