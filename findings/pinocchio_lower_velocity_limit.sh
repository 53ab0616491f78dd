#!/usr/bin/env bash
# Pinocchio 4.1.0 (pin), limits of a URDF joint with velocity="2" and effort="5"
# Behaviour: model.lowerEffortLimit is -5, but model.lowerVelocityLimit is +2, as upperVelocityLimit, so that the interval of allowed
# velocities is [2, 2], and [inf, inf] for a continuous joint without limits.
# Output: effort [-5, 5], velocity [2, 2]; continuous: effort [-inf, inf], velocity [inf, inf]

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 pin==4.1.0
cd "$folder"
venv/bin/python - << 'END'
import math
import sys

import pinocchio

LINK = '<link name="{}"><inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
URDF = (
    '<robot name="r"><link name="base"/>' + LINK.format("a") + LINK.format("b") + '<joint name="j" type="revolute"><parent link="base"/>'
    '<child link="a"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="5" velocity="2"/></joint><joint name="k" type="continuous">'
    '<parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint></robot>'
)
model = pinocchio.buildModelFromXML(URDF)
found = []
for i, name in enumerate(("revolute", "continuous")):
    effort = model.lowerEffortLimit[i], model.upperEffortLimit[i]
    velocity = model.lowerVelocityLimit[i], model.upperVelocityLimit[i]
    found.append((effort, velocity))
    print("{}: effort [{:g}, {:g}], velocity [{:g}, {:g}]".format(name, *effort, *velocity))
wanted = [((-5, 5), (2, 2)), ((-math.inf, math.inf), (math.inf, math.inf))]
sys.exit(0 if found == wanted else "the behaviour has changed")
END
