#!/usr/bin/env bash
# iDynTree 15.1.0, a URDF with a continuous and a mimic joint
# Behaviour: ModelLoader gives a continuous joint the limits of the element limit, which the URDF specification does
# not, and reads a mimic joint as an independent joint. ModelExporter writes the continuous joint as type revolute with
# these limits, and no element mimic. Neither warns.
# Output: 2 degrees of freedom, limits of the continuous joint -1 to 1; written: revolute, mimic False

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 idyntree==15.1.0
cd "$folder"
venv/bin/python - << 'EOF'
import sys
from pathlib import Path

import idyntree.bindings as idyntree

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
loader = idyntree.ModelLoader()
urdf = f'<robot name="r">{links}{joint("j1", "continuous", "base", "a")}{mimic}</robot>'
assert loader.loadModelFromString(urdf, "urdf")
model = loader.model()
first = model.getJoint(model.getJointIndex("j1"))
exporter = idyntree.ModelExporter()
exporter.init(model)
exporter.exportModelToFile("written.urdf", "urdf")
text = Path("written.urdf").read_text()
limits = first.hasPosLimits(), first.getMinPosLimit(0), first.getMaxPosLimit(0)
kind = "continuous" if "continuous" in text else "revolute"
print(
    f"{model.getNrOfDOFs()} degrees of freedom, limits of the continuous joint {limits[1]:g} to {limits[2]:g}; "
    f"written: {kind}, mimic {'mimic' in text}"
)
is_same = model.getNrOfDOFs() == 2 and limits == (True, -1.0, 1.0) and kind == "revolute" and "mimic" not in text
sys.exit(0 if is_same else "the behaviour has changed")
EOF
