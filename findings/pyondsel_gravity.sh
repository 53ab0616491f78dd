#!/usr/bin/env bash
# pyondsel 0.0.3 (OndselSolver, of FreeCAD's Assembly workbench), a pendulum of 1 kg and 1 m on a hinge, released from the horizontal
# Behaviour: the model has masses, inertias and gravity, and solve returns a trajectory without an error. Without a motion at the hinge
# the pendulum stays horizontal for the whole second, whatever gravity is: the solve is kinematic, and a free joint keeps its start.
# Output: gravity 0, 10, 1000 m/s^2: largest angle 0.000, 0.000, 0.000 rad (a pendulum at 10 m/s^2 turns by 2.98 rad in 1 s)

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check pyondsel==0.0.3
cd "$folder"
cat > swing.py << 'END'
import math
import sys

from pyondsel.model.asmt_model import AsmtModel
from pyondsel.model.joint import Joint
from pyondsel.model.marker import Marker
from pyondsel.model.motion import Motion
from pyondsel.model.part import Part
from pyondsel.model.simulation import Simulation


def swing(gravity, turns=None):
    model = AsmtModel(name="Rig", gravity=(0.0, -gravity, 0.0))
    model.add_ground_marker(Marker("pivot"))
    arm = Part("arm", mass=1.0, moments_of_inertia=(0.001, 0.02, 0.02), mass_center=(1.0, 0.0, 0.0))
    model.add_part(arm).add_marker(Marker("hub"))
    model.add_joint(Joint("hinge", "revolute", model.ground_path("pivot"), model.part_path("arm", "hub")))
    if turns:
        model.add_motion(Motion.constant_speed("drive", "hinge", turns_per_time=turns))
    model.simulation = Simulation(t_start=0.0, t_end=1.0, frames=20)
    trajectory = model.solve()
    return max(abs(angles[2]) for angles in trajectory.parts["/Rig/arm"].bryant_angles)


if __name__ == "__main__":
    found = [swing(gravity) for gravity in (0.0, 10.0, 1000.0)]
    driven = swing(10.0, 0.25)
    print("gravity 0, 10, 1000 m/s^2: largest angle", ", ".join(f"{x:.3f}" for x in found), "rad")
    print(f"driven by a quarter of a turn: {driven:.3f} rad")
    same = max(found) < 1e-6 and abs(driven - math.pi / 2) < 1e-3
    sys.exit(0 if same else "the behaviour has changed")
END
venv/bin/python swing.py
