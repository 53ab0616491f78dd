"""A tilted box in Pinocchio falls on the ground and comes to rest, stepped with lavender's impulses.

Needs Pinocchio 4: pip install pin. Each step is one problem, which starts from the impulses of the previous step.

    python examples/pinocchio_box.py
"""

import importlib.util
import sys

import numpy as np

import lavender as lv

DT, STEPS, MASS, SIZE = 2e-3, 500, 2.0, 0.2  # s, -, kg, m


def model():
    """Return the box, and a contact with the ground for each lower and upper corner."""
    import pinocchio as pin

    made = pin.Model()
    box = made.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "box")
    made.appendBodyToJoint(box, pin.Inertia.FromBox(MASS, SIZE, SIZE, SIZE), pin.SE3.Identity())
    corners = [np.array([x, y, z]) * 0.5 * SIZE for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    return made, box, corners


def run(steps=STEPS):
    """Return height [m] and speed [m/s] of each step, normal force [N] of the last step, and the largest residual."""
    import pinocchio as pin

    made, box, corners = model()
    data = made.createData()
    q = pin.neutral(made)
    v = np.zeros(made.nv)
    q[2] = 0.25
    q[3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(0.3, 0.2, 0.0)).coeffs()
    heights = []
    speeds = []
    previous = None
    worst = 0.0
    for _ in range(steps):
        pin.forwardKinematics(made, data, q)
        models = []
        for corner in corners:
            place = data.oMi[box].act(corner)
            place[2] = (
                0.0  # the ground point below; z of a contact points from the ground to the box
            )
            models.append(
                pin.PointContactConstraintModel(
                    made,
                    0,
                    pin.SE3(np.eye(3), place),
                    box,
                    pin.SE3(data.oMi[box].rotation.T, corner),
                )
            )
            models[-1].setFriction(0.5)
        problem = lv.io.from_pinocchio(
            made, data, models, [m.createData() for m in models], DT, q=q, v=v, correction=0.1
        )
        previous = lv.solve(
            problem, impulse=previous, tol=1e-8
        )  # the contacts are the same in every step
        worst = max(worst, previous.residual.relative)
        v = problem.velocity(previous.impulse)
        q = pin.integrate(made, q, DT * v)
        heights.append(q[2])
        speeds.append(np.linalg.norm(v))
    force = previous.impulse.reshape(-1, 3)[:, 0].sum() / DT
    return np.array(heights), np.array(speeds), float(force), worst


def main():
    heights, speeds, force, worst = run()
    print(
        f"rests at {1e3 * heights[-1]:.2f} mm with {speeds[-1]:.1e} m/s; the ground carries {force:.2f} N"
    )
    print(
        f"weight {9.81 * MASS:.2f} N; worst relative residual of {len(heights)} steps {worst:.1e}"
    )


if __name__ == "__main__":
    if importlib.util.find_spec("pinocchio") is None:
        sys.exit("pinocchio is not installed: pip install pin")
    main()
