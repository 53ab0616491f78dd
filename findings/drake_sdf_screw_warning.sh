#!/usr/bin/env bash
# Drake 1.51.1, an SDF file with a screw joint
# Behaviour: the parser warns that <thread_pitch> is deprecated and then "Ignoring unsupported SDFormat element in joint:
# thread_pitch", but the element acts: 10 is a pitch of -2 pi / 10 m per turn. <screw_thread_pitch>, in m per turn, gives no warning.
# Output: thread_pitch 10: one turn moves -0.628 m, 1 warning that it is ignored; screw_thread_pitch 0.01: one turn moves 0.010 m, 0

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 drake==1.51.1
cd "$folder"
cat > screw.py << 'END'
import sys

import numpy as np
from pydrake.all import MultibodyPlant, Parser

LINK = '<link name="{0}"><inertial><mass>1</mass><inertia><ixx>.02</ixx><iyy>.02</iyy><izz>.02</izz></inertia></inertial></link>'
SDF = (
    '<sdf version="1.9"><model name="m">' + LINK.format("a") + LINK.format("b") + '<joint name="w" type="fixed"><parent>world</parent>'
    '<child>a</child></joint><joint name="j" type="screw"><parent>a</parent><child>b</child><axis><xyz>0 0 1</xyz></axis>{}</joint>'
    "</model></sdf>"
)
plant = MultibodyPlant(0.001)
Parser(plant).AddModelsFromString(SDF.format(sys.argv[1]), "sdf")
plant.Finalize()
context = plant.CreateDefaultContext()
plant.SetPositions(context, [2 * np.pi])
print(f"{plant.EvalBodyPoseInWorld(context, plant.GetBodyByName('b')).translation()[2]:.3f}")
END
old=$(venv/bin/python screw.py "<thread_pitch>10</thread_pitch>" 2> old.txt)
new=$(venv/bin/python screw.py "<screw_thread_pitch>0.01</screw_thread_pitch>" 2> new.txt)
ignored_old=$(grep -c "Ignoring unsupported SDFormat element in joint: thread_pitch" old.txt || true)
ignored_new=$(grep -c "Ignoring" new.txt || true)
echo "thread_pitch 10: one turn moves $old m, $ignored_old warning that it is ignored; screw_thread_pitch 0.01: one turn moves $new m, $ignored_new"
[ "$old $ignored_old $new $ignored_new" = "-0.628 1 0.010 0" ]
