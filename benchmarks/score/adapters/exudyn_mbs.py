"""Exudyn's implicit solver of bodies and joints; a further hinge of a body is a point in its plane.

Its contacts are springs whose stiffness has no default, so scenes with contacts are not expressed.
"""

from __future__ import annotations

from typing import Any

import exudyn as exu
import numpy as np
from exudyn.utilities import RigidBodyInertia, RotationMatrix2EulerParameters

from benchmarks.score import adapters as tools

CONTACTLESS = ("tumble", "pendulum", "four-bar", "motor")


def build(scene: tools.Scene, options: tools.Options) -> tools.Running:
    """Use the steps of `MainSolverImplicitSecondOrder`; options are paths of simulation settings."""
    if scene["name"] not in CONTACTLESS:
        raise tools.CannotExpress("contacts are springs whose stiffness has no default")
    if any(joint["motor"] for joint in scene["joints"]):
        raise tools.CannotExpress("the adapter has no motor with a limit of its torque")
    system = exu.SystemContainer().AddSystem()
    ground = system.CreateGround()
    moving = tools.get_moving(scene)
    bodies = []
    for b in moving:
        _, x, y, z = b["quaternion"]
        if (x, y, z) != (0.0, 0.0, 0.0):
            raise tools.CannotExpress("the adapter sets no initial orientation")
        bodies.append(
            system.CreateRigidBody(
                referencePosition=b["position"],
                initialVelocity=b["velocity"],
                initialAngularVelocity=b["spin"],
                inertia=RigidBodyInertia(mass=b["mass"], inertiaTensor=np.diag(b["inertia"])),
                gravity=scene["gravity"],
            )
        )
    hinged: list[Any] = []  # bodies that have a hinge
    for joint in scene["joints"]:
        first = bodies[joint["a"]] if joint["a"] >= 0 else ground
        pair = [first, bodies[joint["b"]]]
        if (
            pair[1] in hinged
        ):  # Two components of the point: the third follows from the other hinges.
            across = [int(abs(x) < 0.5) for x in joint["axis"]]
            system.CreateSphericalJoint(
                bodyNumbers=pair,
                position=joint["anchor"],
                useGlobalFrame=True,
                constrainedAxes=across,
            )
            continue
        hinged.append(pair[1])
        system.CreateRevoluteJoint(
            bodyNumbers=pair, position=joint["anchor"], axis=joint["axis"], useGlobalFrame=True
        )
    system.Assemble()
    settings = exu.SimulationSettings()
    # More steps than are made: the solver shortens those at its end.
    settings.timeIntegration.numberOfSteps = 4 * round(scene["seconds"] / options["dt"])
    settings.timeIntegration.endTime = settings.timeIntegration.numberOfSteps * options["dt"]
    settings.timeIntegration.verboseMode = 0
    settings.solutionSettings.writeSolutionToFile = False
    for path, value in options.items():
        if path != "dt":
            *parts, last = path.split(".")
            target = settings
            for part in parts:
                target = getattr(target, part)
            setattr(target, last, value)
    solver = exu.MainSolverImplicitSecondOrder()
    solver.InitializeSolver(system, settings)
    solver.it.currentStepSize = options["dt"]

    def step() -> None:
        solver.UpdateCurrentTime(system, settings)
        solver.InitializeStep(system, settings)
        if not solver.DiscontinuousIteration(system, settings):
            raise RuntimeError("Newton's method of Exudyn does not converge")
        solver.FinishStep(system, settings)

    def state() -> list[Any]:
        kinds = exu.OutputVariableType
        rows = []
        for body in bodies:
            read = [
                system.GetObjectOutputBody(body, kind, [0.0] * 3)
                for kind in (
                    kinds.Position,
                    kinds.RotationMatrix,
                    kinds.Velocity,
                    kinds.AngularVelocity,
                )
            ]
            rows.append(
                [
                    *read[0],
                    *RotationMatrix2EulerParameters(np.reshape(read[1], (3, 3))),
                    *read[2],
                    *read[3],
                ]
            )
        return rows

    def properties() -> list[Any]:
        rows = []
        for body in bodies:
            mass = system.GetObjectParameter(body, "physicsMass")
            inertia = system.GetObjectParameter(body, "physicsInertia")
            rows.append([mass, *inertia[:3], None, None])
        return rows

    return tools.Running(
        step, state, properties, close=lambda: solver.FinalizeSolver(system, settings)
    )
