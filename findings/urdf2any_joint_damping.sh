#!/usr/bin/env bash
# urdf2any 0.3.0 (mujoco 4.0.0), one URDF with joint damping 2 N s/m as MJCF and as USD
# Behaviour: the readme says that one configuration gives the same robot in both formats. With the default position drive (damping 1)
# the MJCF has the damping of the URDF and of the drive, 3 N s/m; the stage has the drive alone, 1 N s/m. With a velocity drive,
# --joint-damping is not used: the drive's damping is --joint-stiffness, 100 by default. Only passive joints have the same 2 N s/m.
# Output: damping of mjcf and usd [N s/m]: position drive 3, 1; velocity drive with --joint-damping 4: 102, 100; none: 2, 2

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 \
    urdf2any==0.3.0 usd-core==26.11 mujoco==4.0.0
cd "$folder"
cat > robot.urdf << 'END'
<robot name="robot"><link name="base"/><link name="arm"><inertial><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="base"/><child link="arm"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="1000" velocity="9"/><dynamics damping="2"/></joint></robot>
END
convert() {
    for format in xml usda; do
        venv/bin/urdf2any robot.urdf -o "$1.$format" --fix-base "${@:2}" > log.txt
    done
}
convert position
convert velocity --joint-target-type velocity --joint-damping 4
convert none --joint-target-type none
venv/bin/python - << 'END'
import sys

import mujoco
from pxr import Usd


def read_mjcf(name):
    """Return the force that opposes a speed of 1 m/s at the drive's target."""
    model = mujoco.MjModel.from_xml_path(f"{name}.xml")
    data = mujoco.MjData(model)
    data.qvel[0] = 1
    mujoco.mj_forward(model, data)
    return -float(data.qfrc_passive[0] + data.qfrc_actuator[0])


def read_usd(name):
    """Return the sum of everything in the stage that is named damping."""
    stage = Usd.Stage.Open(f"{name}.usda")
    attributes = [attribute for prim in stage.Traverse() for attribute in prim.GetAuthoredAttributes()]
    return float(sum(attribute.Get() for attribute in attributes if "damping" in attribute.GetName().lower()))


found = {name: (read_mjcf(name), read_usd(name)) for name in ("position", "velocity", "none")}
for name, (mjcf, usd) in found.items():
    print(f"{name}: mjcf {mjcf:g} N s/m, usd {usd:g} N s/m")
same = found == {"position": (3.0, 1.0), "velocity": (102.0, 100.0), "none": (2.0, 2.0)}
sys.exit(0 if same else "the behaviour has changed")
END
