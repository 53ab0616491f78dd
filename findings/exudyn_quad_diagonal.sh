#!/usr/bin/env bash
# EXUDYN 1.13.6, a sphere on a quad of CreateSphereQuadContact
# Behaviour: a quad is two triangles, each with its own contact. A resting sphere of 1 kg above the common diagonal
# touches both, and penetrates by half of m g / k. Elsewhere on the quad, it penetrates by m g / k.
# Output: depth in m g / k: 0.50 on the diagonal, 1.00 elsewhere

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 exudyn==1.13.6
cd "$folder"
venv/bin/python - << 'EOF' 2> /dev/null
import sys

import exudyn
from exudyn.utilities import InertiaSphere, SensorBody

STIFFNESS, DURATION, STEP = 1e4, 1.0, 5e-4  # N/m, s, s


def measure_depth(x):
    """Return the depth [m] of a sphere at (x, 0) after it has come to rest."""
    system = exudyn.SystemContainer().AddSystem()
    ground = system.CreateGround(referencePosition=[0, 0, 0])
    inertia = InertiaSphere(1.0, 0.1)
    sphere = system.CreateRigidBody(referencePosition=[x, 0, 0.1], inertia=inertia, gravity=[0, 0, -9.81])
    corners = [[-5, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0]]
    system.CreateSphereQuadContact(
        itemNumbers=[sphere, ground], sphereRadius=0.1, quadPoints=corners, contactStiffness=STIFFNESS,
        contactDamping=20.0, frictionProportionalZone=1e-3,
    )
    kind = exudyn.OutputVariableType.Position
    sensor = system.AddSensor(SensorBody(bodyNumber=sphere, storeInternal=True, outputVariableType=kind))
    system.Assemble()
    settings = exudyn.SimulationSettings()
    settings.timeIntegration.endTime = DURATION
    settings.timeIntegration.numberOfSteps = int(DURATION / STEP)
    settings.solutionSettings.writeSolutionToFile = False
    system.SolveDynamic(settings)
    return 0.1 - system.GetSensorStoredData(sensor)[-1, 3]


ratios = [measure_depth(x) / (9.81 / STIFFNESS) for x in (0.0, 1.0)]
print("depth in m g / k: {:.2f} on the diagonal, {:.2f} elsewhere".format(*ratios))
sys.exit(0 if abs(ratios[0] - 0.5) < 0.05 and abs(ratios[1] - 1.0) < 0.05 else "the behaviour has changed")
EOF
