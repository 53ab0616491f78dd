#!/usr/bin/env bash
# PyBullet 3.2.7, loadMJCF and loadSDF
# Behaviour: a box of 0.2 x 0.1 x 0.04 m with mass="2" in an MJCF has 0.8 kg, its volume by 1,000 kg/m^3. The range of its joint is
# read only with limited="true", which MuJoCo does not need. In an SDF, the pose of a joint is not read: the axis 0.5 m beside the
# centre of a link is in the origin of the link.
# Output: mass 0.80 kg of 2.00 kg, range 1.0 to 0.0 rad (no limit); after half a turn the link is at 0.00 m of 1.00 m

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 pybullet==3.2.7
cd "$folder"
venv/bin/python - << 'END' 2> /dev/null
import math
import sys
from pathlib import Path

import pybullet

MJCF = (
    '<mujoco model="m"><compiler angle="radian"/><worldbody><body name="b"><joint name="j" type="hinge" axis="0 1 0" '
    'range="-.5 1"/><geom type="box" size=".1 .05 .02" mass="2"/></body></worldbody></mujoco>'
)
INERTIA = "<ixx>1</ixx><iyy>1</iyy><izz>1</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz>"
INERTIAL = f"<inertial><mass>1</mass><inertia>{INERTIA}</inertia></inertial>"
SDF = (
    f'<sdf version="1.6"><model name="m"><link name="a">{INERTIAL}</link><link name="b">{INERTIAL}</link><joint name="j" '
    'type="revolute"><pose>.5 0 0 0 0 0</pose><parent>a</parent><child>b</child><axis><xyz>0 0 1</xyz>'
    "<limit><lower>-9</lower><upper>9</upper></limit></axis></joint></model></sdf>"
)
Path("model.xml").write_text(MJCF)
Path("model.sdf").write_text(SDF)
pybullet.connect(pybullet.DIRECT)
body = pybullet.loadMJCF("model.xml")[0]
count = pybullet.getNumJoints(body)
mass = sum(pybullet.getDynamicsInfo(body, i)[0] for i in range(-1, count))
hinge = next(i for i in range(count) if pybullet.getJointInfo(body, i)[2] == pybullet.JOINT_REVOLUTE)
lower, upper = pybullet.getJointInfo(body, hinge)[8:10]
print(f"mass {mass:.2f} kg of 2.00 kg, range {lower:.1f} to {upper:.1f} rad (no limit) of -0.5 to 1.0 rad")
body = pybullet.loadSDF("model.sdf")[0]
pybullet.resetJointState(body, 0, math.pi)
x = pybullet.getLinkState(body, 0)[4][0]
print(f"after half a turn about an axis at 0.5 m the link is at {abs(x):.2f} m of 1.00 m")
same = abs(mass - 0.8) < 1e-6 and lower > upper and abs(x) < 1e-6
sys.exit(0 if same else "the behaviour has changed")
END
