"""Record the steps of a stack of four boxes in PyBullet for `lavender report`, and judge each.

The normal points from B to A. Contacts are read after the step, at the positions before it. The solve removes 8 % of a
penetration.

    python examples/read_pybullet.py
"""

import importlib.util
import sys

import numpy as np

import lavender as lv


def record(folder, iterations=10):
    """Write the problems of the steps to a folder, and return the velocity errors of PyBullet [m/s]."""
    import pybullet

    dt, gravity = 1 / 60, np.array([0.0, 0.0, -9.81, 0.0, 0.0, 0.0])
    pybullet.connect(pybullet.DIRECT)
    pybullet.resetSimulation()
    pybullet.setGravity(*gravity[:3])
    pybullet.setPhysicsEngineParameter(fixedTimeStep=dt, numSolverIterations=iterations)
    pybullet.createMultiBody(0.0, pybullet.createCollisionShape(pybullet.GEOM_PLANE))
    cube = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[0.5] * 3)
    boxes = [
        pybullet.createMultiBody(1.0, cube, basePosition=[0.02 * i, 0.0, i + 0.5]) for i in range(4)
    ]
    for box in boxes:
        pybullet.changeDynamics(box, -1, linearDamping=0.0, angularDamping=0.0)

    def read_velocities():
        return np.array([np.concatenate(pybullet.getBaseVelocity(box)) for box in boxes])

    errors = []
    with lv.io.Recorder(folder, every=1, solver="pybullet") as recorder:
        for _ in range(30):
            free = read_velocities() + dt * gravity
            position = [pybullet.getBasePositionAndOrientation(box)[0] for box in boxes]
            pybullet.stepSimulation()
            inv_inertia = np.tile(
                6 * np.eye(3), (4, 1, 1)
            )  # A cube has the same inertia in every orientation.
            builder = lv.RowBuilder(np.ones(4), inv_inertia, free, dt, position, baumgarte=0.08)
            for point in pybullet.getContactPoints():
                b, a = (boxes.index(body) if body in boxes else -1 for body in point[1:3])
                builder.contact(a, b, point[5], point[7], gap=point[8], mu=0.25)
            (verdict,) = recorder.add(builder.problem(), velocity=read_velocities())
            errors.append(verdict.velocity_error)
    return errors


def main():
    """Record the steps and print the median of their errors."""
    if importlib.util.find_spec("pybullet") is None:
        sys.exit("pybullet is not installed: pip install pybullet")
    errors = record("pybullet-steps")
    print(f"{len(errors)} steps, median velocity error {np.median(errors):.1e} m/s")


if __name__ == "__main__":
    main()
