#!/usr/bin/env bash
# yourdfpy 0.0.60, writing a URDF with a mimic joint
# Behaviour: a robot of two joints, the second of which mimics the first, has one degree of freedom. write_xml_string
# leaves the element mimic out, without a warning, so that the written robot has two.
# Output: actuated joints: read ['j1'], written and read again ['j1', 'j2']

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 yourdfpy==0.0.60
cd "$folder"
venv/bin/python - << 'EOF'
import sys
from pathlib import Path

import yourdfpy

inertial = (
    '<inertial><origin xyz="0.3 0 0"/><mass value="1"/>'
    '<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>'
)
limit = '<limit lower="-1" upper="1" effort="5" velocity="3"/>'


def joint(name, kind, parent, child, extra=""):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="0 1 0"/>'
        f"{limit}{extra}</joint>"
    )


links = "".join(f'<link name="{name}">{inertial}</link>' for name in ("base", "a", "b"))
mimic = joint("j2", "revolute", "a", "b", '<mimic joint="j1" multiplier="2" offset="0.1"/>')
Path("first.urdf").write_text(f'<robot name="r">{links}{joint("j1", "revolute", "base", "a")}{mimic}</robot>')
first = yourdfpy.URDF.load("first.urdf")
Path("second.urdf").write_bytes(first.write_xml_string())
second = yourdfpy.URDF.load("second.urdf")
names = [list(robot.actuated_joint_names) for robot in (first, second)]
print(f"actuated joints: read {names[0]}, written and read again {names[1]}")
sys.exit(0 if names == [["j1"], ["j1", "j2"]] else "the behaviour has changed")
EOF
