#!/usr/bin/env bash
# MuJoCo 4.0.0, MjSpec.attach of a model whose compiler element changes masses
# Behaviour: a body of 2 kg has 10 kg with settotalmass="10", and 9 kg with boundmass="9". Attached to another model and compiled,
# settotalmass is lost without a message (2 kg), and boundmass is kept (9 kg), but to_xml of the same spec does not write it: read
# again, the file has 2 kg.
# Output: settotalmass: alone 10 kg, attached 2 kg, saved and read 2 kg; boundmass: alone 9 kg, attached 9 kg, saved and read 2 kg

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 mujoco==4.0.0
cd "$folder"
venv/bin/python - << 'END' 2> /dev/null
import sys

import mujoco

CHILD = (
    '<mujoco><compiler {}/><worldbody><body name="b"><joint name="j" axis="0 1 0"/><geom type="box" size=".1 .1 .1" mass="2"/>'
    "</body></worldbody></mujoco>"
)
PARENT = '<mujoco><worldbody><frame name="f"/></worldbody></mujoco>'
found = {}
for setting in ('settotalmass="10"', 'boundmass="9"'):
    child, parent = mujoco.MjSpec.from_string(CHILD.format(setting)), mujoco.MjSpec.from_string(PARENT)
    alone = mujoco.MjModel.from_xml_string(CHILD.format(setting)).body_mass[1]
    parent.attach(child, prefix="x-", frame=parent.frame("f"))
    attached = parent.compile().body_mass[1]
    again = mujoco.MjModel.from_xml_string(parent.to_xml()).body_mass[1]
    found[setting] = [round(float(mass), 6) for mass in (alone, attached, again)]
    print("{}: alone {:g} kg, attached {:g} kg, saved and read {:g} kg".format(setting, *found[setting]))
same = list(found.values()) == [[10, 2, 2], [9, 9, 2]]
sys.exit(0 if same else "the behaviour has changed")
END
