"""Record the steps of a stack of four boxes in Rapier for `lavender report`, and judge each.

With one substep and one iteration in it. `points` and `solver_contacts` have different orders.

    python examples/read_rapier.py
"""

import importlib.util
import sys

import numpy as np

import lavender as lv


def record(folder, iterations=1):
    """Write the problems of the steps to a folder, and return the velocity errors of Rapier [m/s]."""
    import rapier3d

    dt, gravity = 1 / 60, np.array([0.0, -9.81, 0.0, 0.0, 0.0, 0.0])
    world = rapier3d.PhysicsWorld(gravity=tuple(gravity[:3]))
    settings = world.integration_parameters
    settings.dt = dt
    settings.num_solver_iterations = 1  # substeps
    settings.num_internal_pgs_iterations = iterations
    Collider, Body = rapier3d.Collider, rapier3d.RigidBody
    world.add_collider(Collider.cuboid(9.0, 0.5, 9.0, translation=(0.0, -0.5, 0.0), friction=0.5))
    boxes = []
    for i in range(4):
        collider = Collider.cuboid(0.5, 0.5, 0.5, mass=1.0, friction=0.5)
        body = Body.dynamic(translation=(0.02 * i, i + 0.5, 0.0), can_sleep=False)
        boxes.append(world.add_body(body, colliders=[collider]))

    def read_velocities():
        bodies = [world.rigid_bodies.get(box) for box in boxes]
        return np.array([(*body.linvel, *body.angvel) for body in bodies])

    errors = []
    with lv.io.Recorder(folder, every=1, solver="Rapier") as recorder:
        for _ in range(60):
            free = read_velocities() + dt * gravity
            position = [tuple(world.rigid_bodies.get(box).translation) for box in boxes]
            world.step()
            inv_inertia = np.tile(6 * np.eye(3), (4, 1, 1))  # of cubes, in every orientation
            builder = lv.RowBuilder(np.ones(4), inv_inertia, free, dt, position, baumgarte=0.0)
            for pair in world.narrow_phase.contact_pairs():
                for data in (manifold.data for manifold in pair.manifolds):
                    bodies = data.rigid_body1, data.rigid_body2  # None: the static world
                    a, b = (boxes.index(body) if body in boxes else -1 for body in bodies)
                    for contact in data.solver_contacts:
                        point, gap = tuple(contact.point), contact.dist
                        builder.contact(
                            a,
                            b,
                            point,
                            tuple(data.normal),
                            gap=gap,
                            mu=0.5,
                            feature=contact.contact_id,
                        )
            (verdict,) = recorder.add(builder.problem(), velocity=read_velocities())
            errors.append(verdict.velocity_error)
    return errors


def main():
    """Record the steps and print the median of their errors."""
    if importlib.util.find_spec("rapier3d") is None:
        sys.exit("rapier3d is not installed: pip install rapier3d")
    errors = record("rapier-steps")
    print(f"{len(errors)} steps, median velocity error {np.median(errors):.1e} m/s")


if __name__ == "__main__":
    main()
