#!/usr/bin/env bash
# iDynTree 15.1.0, ModelLoader.loadModelFromString of a URDF with a joint of type floating
# Behaviour: the type is in the URDF specification, and iDynTree does not support it. The errors go to the standard error, the call
# returns True, isValid() is True, and the model has no link, no joint and no mass. A string that is no XML returns False.
# Output: floating: True, isValid True, 0 links, 0.0 kg of 2.0 kg; revolute: True, isValid True, 2 links, 2.0 kg

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 idyntree==15.1.0
cd "$folder"
venv/bin/python - << 'END' 2> /dev/null
import sys

import idyntree.bindings as idyntree

INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
URDF = (
    f'<robot name="r"><link name="a">{INERTIAL}</link><link name="b">{INERTIAL}</link><joint name="j" type="{{}}">'
    '<parent link="a"/><child link="b"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
)
found = {}
for kind in ("floating", "revolute"):
    loader = idyntree.ModelLoader()
    is_loaded = loader.loadModelFromString(URDF.format(kind))
    model = loader.model()
    found[kind] = is_loaded, loader.isValid(), model.getNrOfLinks(), model.getTotalMass()
    print(f"{kind}: {is_loaded}, isValid {found[kind][1]}, {found[kind][2]} links, {found[kind][3]:.1f} kg")
same = found["floating"] == (True, True, 0, 0.0) and found["revolute"] == (True, True, 2, 2.0)
sys.exit(0 if same else "the behaviour has changed")
END
