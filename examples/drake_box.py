"""A box falls on the ground in Drake and rests: SAP's solution judged by the rigid law, compared with lavender's.

Needs Drake: pip install drake. SAP's contacts are softer than Coulomb's law; the residual shows how much.

    python examples/drake_box.py
"""

import importlib.util
import sys

import numpy as np

import lavender as lv

DT, STEPS, MASS, SIZE = 2e-3, 200, 2.0, 0.2  # s, -, kg, m


def plant():
    """Return a diagram with a box on four small spheres, its plant and the box."""
    from pydrake.geometry import HalfSpace, Sphere
    from pydrake.math import RigidTransform
    from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
    from pydrake.multibody.tree import SpatialInertia
    from pydrake.systems.framework import DiagramBuilder

    builder = DiagramBuilder()
    made, _ = AddMultibodyPlantSceneGraph(builder, time_step=DT)
    made.SetUseSampledOutputPorts(False)  # sampled ports would return the previous step's contacts
    friction = CoulombFriction(0.5, 0.5)
    made.RegisterCollisionGeometry(
        made.world_body(), RigidTransform(), HalfSpace(), "ground", friction
    )
    box = made.AddRigidBody("box", SpatialInertia.SolidBoxWithMass(MASS, SIZE, SIZE, SIZE))
    for x in (-0.5, 0.5):
        for y in (-0.5, 0.5):
            corner = RigidTransform([x * SIZE, y * SIZE, -0.5 * SIZE])
            made.RegisterCollisionGeometry(box, corner, Sphere(0.01), f"corner {x} {y}", friction)
    made.Finalize()
    return builder.Build(), made, box


def run(steps=STEPS):
    """Return for each step with contacts: both residuals, largest velocity difference [m/s]; and the last force [N]."""
    from pydrake.math import RigidTransform
    from pydrake.systems.analysis import Simulator

    diagram, made, box = plant()
    simulator = Simulator(diagram)
    context = made.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    made.SetFreeBodyPose(context, box, RigidTransform([0.0, 0.0, 0.5 * SIZE + 0.012]))
    found = []
    for i in range(steps):
        simulator.AdvanceTo(i * DT)
        problem = lv.io.from_drake(made, context)
        own = lv.io.drake.impulse(made, context)
        if problem.m:
            solution = lv.solve(problem, tol=1e-9)
            apart = np.abs(problem.velocity(solution.impulse) - problem.velocity(own)).max()
            theirs = lv.residual(problem, own).relative
            found.append((theirs, solution.residual.relative, apart))
    force = own.reshape(-1, 3)[:, 0].sum() / DT
    return np.array(found), float(force)


def main():
    found, force = run()
    theirs, ours, apart = np.median(found, axis=0)
    print(
        f"{len(found)} steps with contacts; median residual of SAP's impulses {theirs:.1e}, of ours {ours:.1e}"
    )
    print(f"velocities differ by {apart:.1e} m/s in the median, {found[:, 2].max():.1e} at worst")
    print(f"at rest SAP carries {force:.2f} N of {9.81 * MASS:.2f} N")


if __name__ == "__main__":
    if importlib.util.find_spec("pydrake") is None:
        sys.exit("pydrake is not installed: pip install drake")
    main()
