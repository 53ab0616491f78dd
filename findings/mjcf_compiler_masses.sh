#!/usr/bin/env bash
# MuJoCo 4.0.0, Drake 1.51.1, Pinocchio 4.1.0 and newton 1.8.0, settings of the compiler element of an MJCF
# Behaviour: a body has an inertial element of 1 kg and geoms of 2 kg (group 0) and 5 kg (group 3). MuJoCo obeys all of these.
# inertiafromgeom: all obey. boundmass: Drake does not. inertiagrouprange: newton alone obeys. settotalmass: none obeys. A geom in a
# frame element: newton alone reads it. Nothing warns.
# Output (MuJoCo, Drake, Pinocchio, newton): 7, 7, 7, 7 kg; 9, 1, 9, 9 kg; 2, 7, 7, 2 kg; 10, 7, 7, 7 kg; 7, 0, 0, 7 kg

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 mujoco==4.0.0 pin==4.1.0 drake==1.51.1 newton==1.8.0
cd "$folder"
venv/bin/python - << 'END' 2> /dev/null
import contextlib
import io
import sys
from pathlib import Path

import mujoco
import newton
import pinocchio
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

INERTIAL = '<inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .01"/>'
GEOMS = '<geom type="box" size=".1 .1 .1" mass="2"/><geom type="box" size=".1 .1 .1" mass="5" group="3"/>'
CASES = {
    'inertiafromgeom="true"': (INERTIAL + GEOMS, (7, 7, 7, 7)),
    'boundmass="9"': (INERTIAL + GEOMS, (9, 1, 9, 9)),
    'inertiagrouprange="0 1"': (GEOMS, (2, 7, 7, 2)),
    'settotalmass="10"': (GEOMS, (10, 7, 7, 7)),
    'angle="radian"': (f'<frame pos="0 0 .1">{GEOMS}</frame>', (7, 0, 0, 7)),
}


def read_masses(text):
    Path("model.xml").write_text(text)
    model = pinocchio.buildModelFromMJCF("model.xml")
    plant = MultibodyPlant(0.001)
    Parser(plant).AddModels("model.xml")
    plant.Finalize()
    builder = newton.ModelBuilder()
    with contextlib.redirect_stdout(io.StringIO()):
        builder.add_mjcf(text)
    return (
        mujoco.MjModel.from_xml_string(text).body_mass[1],
        plant.GetBodyByName("b").get_mass(plant.CreateDefaultContext()),
        (model[0] if isinstance(model, tuple) else model).inertias[1].mass,
        builder.body_mass[0],
    )


same = True
for setting, (content, expected) in CASES.items():
    text = (
        f'<mujoco model="m"><compiler {setting}/><worldbody><body name="b"><joint name="j" axis="0 1 0"/>{content}</body>'
        "</worldbody></mujoco>"
    )
    masses = read_masses(text)
    name = "geoms in a frame" if "frame" in content else setting
    print(f"{name}: " + ", ".join(f"{mass:.0f}" for mass in masses) + " kg")
    same = same and all(abs(a - b) < 1e-3 for a, b in zip(masses, expected))
sys.exit(0 if same else "the behaviour has changed")
END
