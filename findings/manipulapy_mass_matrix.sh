#!/usr/bin/env bash
# ManipulaPy 1.4.2, URDFToSerialManipulator(...).dynamics of a pendulum with a horizontal axis: 1 kg at a distance c, 0.02 kg m^2
# Behaviour: the mass matrix has m c^2 twice, 0.02 + 2 c^2, and forward_dynamics divides by it: released from the horizontal at
# c = 0.5 m the arm gets 9.4 rad/s^2 instead of 18.2. Gravity is right. A tool of 3 kg on a fixed joint at 1 m counts in neither: 0.52
# of 3.27 kg m^2 and 4.9 of 34.3 N m. No warning: this is the class that the other way to load a URDF recommends in its own warning.
# Output: mass matrix at c = 0, 0.1, 0.5, 1 m: 0.02, 0.04, 0.52, 2.02 of 0.02, 0.03, 0.27, 1.02 kg m^2; with the tool 0.52 of 3.271
# kg m^2 and gravity 4.905 of 34.335 N m; warnings 0

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check ManipulaPy==1.4.2 numpy==2.4.6 scipy==1.17.1
cd "$folder"
venv/bin/python - 2> log.txt << 'END' || { tail -3 log.txt >&2; exit 1; }
import sys
import warnings

import numpy as np
from ManipulaPy.urdf_processor import URDFToSerialManipulator

LINK = """<link name="{}"><inertial><origin xyz="{} 0 0"/><mass value="{}"/>
<inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
ROBOT = """<robot name="robot"><link name="base"/>{}<joint name="hinge" type="revolute"><parent link="base"/><child link="arm"/>
<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="99" velocity="9"/></joint>{}</robot>"""
TOOL = LINK.format("tool", 0, 3, 0.001, 0.001, 0.001) + """<joint name="flange" type="fixed"><origin xyz="1 0 0"/>
<parent link="arm"/><child link="tool"/></joint>"""
GRAVITY, LEVEL = [0.0, 0.0, -9.81], np.zeros(1)
seen = []


def measure(distance, tool=""):
    """Return the moment of inertia, the moment of gravity and the acceleration from rest, at the horizontal."""
    with open("robot.urdf", "w") as file:
        file.write(ROBOT.format(LINK.format("arm", distance, 1, 0.02, 0.02, 0.02), tool))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        dynamics = URDFToSerialManipulator("robot.urdf").dynamics
        inertia = float(dynamics.mass_matrix(LEVEL)[0, 0])
        moment = -float(dynamics.gravity_forces(LEVEL, GRAVITY)[0])
        acceleration = float(dynamics.forward_dynamics(LEVEL, LEVEL, LEVEL, GRAVITY, np.zeros(6))[0])
    seen.extend(caught)
    return inertia, moment, acceleration


same = True
for c in (0, 0.1, 0.5, 1):
    inertia, moment, acceleration = measure(c)
    true = 0.02 + c**2
    print(f"c = {c:g} m: {inertia:.3f} of {true:.3f} kg m^2, gravity {moment:.3f} of {9.81 * c:.3f} N m, acceleration "
          f"{acceleration:.2f} of {9.81 * c / true:.2f} rad/s^2")
    same &= abs(inertia - true - c**2) < 1e-6 and abs(moment - 9.81 * c) < 1e-6
    same &= abs(acceleration * inertia - 9.81 * c) < 1e-6
inertia, moment, _ = measure(0.5, TOOL)
print(f"with the tool: {inertia:.3f} of 3.271 kg m^2, gravity {moment:.3f} of 34.335 N m; warnings {len(seen)}")
same &= abs(inertia - 0.52) < 1e-6 and abs(moment - 4.905) < 1e-6 and not seen
sys.exit(0 if same else "the behaviour has changed")
END
