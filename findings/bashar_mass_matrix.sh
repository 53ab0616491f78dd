#!/usr/bin/env bash
# bashar 2.0.0, BasharSystem(...).dynamics of a pendulum read from a URDF: 1 kg at 0.5 m, 0.02 kg m^2 about the centre of mass
# Behaviour: mass_matrix leaves gravity in: each column is the moment for a unit acceleration and that of the weight. With the axis
# +y the pendulum has -4.635 instead of 0.27 kg m^2, and forward_dynamics, released from the horizontal, turns it upwards with 1.06
# rad/s^2 instead of down with 18.2. With the axis -y it is 5.175 kg m^2. The matrix of two links is not symmetric. Axes without a
# moment of the weight, gravity_forces and inverse_dynamics are right. No warning.
# Output: mass matrix and acceleration for the axis +y: -4.635 of 0.270 kg m^2, -1.058 of 18.167 rad/s^2; -y: 5.175, -0.948 of
# -18.167; z: 0.270, 0; two links: [[-17.08, -18.85], [-4.135, -4.635]] of [[2.54, 0.77], [0.77, 0.27]] kg m^2; warnings 0

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check bashar==2.0.0 numpy==2.4.6
cd "$folder"
venv/bin/python - > lines.txt << 'END' || { cat lines.txt; exit 1; }
import sys
import warnings

import numpy as np
from bashar.api import BasharSystem, compile_profile

LINK = """<link name="{}"><inertial><origin xyz="0.5 0 0"/><mass value="1"/>
<inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="hinge_{1}" type="revolute"><origin xyz="{2} 0 0"/><parent link="{0}"/><child link="{1}"/><axis xyz="{3}"/>
<limit lower="-3" upper="3" effort="99" velocity="9"/></joint>"""


def read(*parts):
    """Return the dynamics of a robot of these links and joints."""
    with open("robot.urdf", "w") as file:
        file.write('<robot name="robot"><link name="base"/>' + "".join(parts) + "</robot>")
    assert compile_profile("robot.urdf", "robot", output_dir="profiles")
    return BasharSystem("profiles/robot.json").dynamics


same = True
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    for axis, inertia, moment in (("0 1 0", 0.27, -4.905), ("0 -1 0", 0.27, 4.905), ("0 0 1", 0.27, 0), ("1 0 0", 0.02, 0)):
        dynamics = read(LINK.format("arm"), JOINT.format("base", "arm", 0, axis))
        matrix, weight = dynamics.mass_matrix([0.0])[0, 0], dynamics.gravity_forces([0.0])[0]
        acceleration = dynamics.forward_dynamics([0.0], [0.0], [0.0])[0]
        torque = dynamics.inverse_dynamics([0.0], [0.0], [2.0])[0]
        print(f"found: axis {axis}: mass matrix {matrix:.3f} of {inertia:.3f} kg m^2, gravity {weight:.3f} of {moment:.3f} N m, "
              f"acceleration {acceleration:.3f} of {-moment / inertia:.3f} rad/s^2; inverse dynamics for 2 rad/s^2 {torque:.3f} of "
              f"{2 * inertia + moment:.3f} N m")
        same &= abs(matrix - inertia - moment) < 1e-9 and abs(weight - moment) < 1e-9
        same &= abs(acceleration + moment / matrix) < 1e-9 and abs(torque - 2 * inertia - moment) < 1e-9
    dynamics = read(LINK.format("arm"), LINK.format("hand"), JOINT.format("base", "arm", 0, "0 1 0"),
                    JOINT.format("arm", "hand", 1, "0 1 0"))
    matrix, weight = dynamics.mass_matrix([0.0, 0.0]), dynamics.gravity_forces([0.0, 0.0])
    true = np.array([[2.54, 0.77], [0.77, 0.27]])
    print(f"found: two links: mass matrix {matrix.round(3).tolist()} of {true.tolist()} kg m^2; warnings {len(caught)}")
    same &= np.allclose(matrix, true + weight[:, None], atol=1e-9) and np.allclose(weight, (-19.62, -4.905)) and not caught
sys.exit(0 if same else "the behaviour has changed")
END
grep "^found" lines.txt | cut -c 8-
