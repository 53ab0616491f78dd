#!/usr/bin/env bash
# Pinocchio 4.1.0 and MuJoCo 4.0.0, attributes of geoms and joints that an MJCF gives in a class of defaults
# Behaviour: Pinocchio takes type, size and density of a geom, and axis, range and armature of a joint, from the class. It does not take
# mass and pos of the geom and pos of the joint: the box of 3 kg at 0.1 m has 8 kg (the default density) at 0, and the joint is in
# the origin of the body. Written at the elements themselves, all are read. No message.
# Output: elements: 3.0 kg, com 0.1 m, M 0.08 kg m^2, both; class: MuJoCo the same, Pinocchio 8.0 kg, com 0.0 m, M 0.0533 kg m^2

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 mujoco==4.0.0 pin==4.1.0
cd "$folder"
venv/bin/python - << 'END'
import sys
from pathlib import Path

import mujoco
import numpy as np
import pinocchio

GEOM, JOINT = 'type="box" size=".1 .1 .1" mass="3" pos=".1 0 0"', 'axis="0 1 0" pos="0 0 .1"'


def build(in_class):
    defaults = f'<default><default class="c"><geom {GEOM}/><joint {JOINT}/></default></default>' if in_class else ""
    joint, geom = ('class="c"', 'class="c"') if in_class else (JOINT, GEOM)
    return f'<mujoco model="m">{defaults}<worldbody><body name="b"><joint name="j" {joint}/><geom {geom}/></body></worldbody></mujoco>'


def read_mujoco(text):
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    matrix = np.zeros((1, 1))
    mujoco.mj_fullM(model, data, matrix)
    return model.body_mass[1], model.body_ipos[1, 0], matrix[0, 0]


def read_pinocchio(text):
    Path("model.xml").write_text(text)
    model = pinocchio.buildModelFromMJCF("model.xml")
    model = model[0] if isinstance(model, tuple) else model
    inertia = model.inertias[1]
    matrix = pinocchio.crba(model, model.createData(), pinocchio.neutral(model))
    return inertia.mass, inertia.lever[0], matrix[0, 0]


found = {}
for in_class in (False, True):
    for name, read in (("MuJoCo", read_mujoco), ("Pinocchio", read_pinocchio)):
        found[in_class, name] = np.array(read(build(in_class)))
        mass, lever, matrix = found[in_class, name]
        print(f"{'class' if in_class else 'elements'}, {name}: {mass:.1f} kg, com {lever:.1f} m, M {matrix:.4f} kg m^2")
right = found[False, "MuJoCo"]
same = all(np.allclose(found[key], right, atol=1e-6) for key in found if key != (True, "Pinocchio"))
same = same and np.allclose(found[True, "Pinocchio"], (8.0, 0.0, 8.0 * 0.08 / 12), atol=1e-3)
sys.exit(0 if same else "the behaviour has changed")
END
