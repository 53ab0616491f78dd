#!/usr/bin/env bash
# MuJoCo 4.0.0, Pinocchio 4.1.0, Drake 1.51.1 and newton 1.8.0, an MJCF body with one geom: a box by fromto, or with shell inertia
# Behaviour: a box of size 0.05 m from (0, 0, 0) to (0.4, 0, 0) m with 500 kg/m^3 has 2 kg in MuJoCo and Pinocchio. Drake gives the
# body no mass at all, newton makes it a cube of 0.1 m with 0.5 kg in its origin. With shellinertia and density 100 (kg/m^2 of
# surface) the box of 0.2 x 0.1 x 0.04 m has 6.4 kg in MuJoCo; Drake and newton fill it with 100 kg/m^3, Pinocchio refuses it.
# Output: fromto: 2.0, 2.0, 0.0, 0.5 kg; shell: 6.40, refused, 0.08, 0.08 kg

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

MODEL = '<mujoco model="m"><worldbody><body name="b"><joint name="j" axis="0 1 0"/><geom type="box" {}/></body></worldbody></mujoco>'
GEOMS = {
    "fromto": 'size=".05" fromto="0 0 0 .4 0 0" density="500"',
    "shell": 'size=".1 .05 .02" density="100" shellinertia="true"',
}
RIGHT = {"fromto": (2.0, 2.0, 0.0, 0.5), "shell": (6.4, None, 0.08, 0.08)}


def read_pinocchio(text):
    Path("model.xml").write_text(text)
    try:
        model = pinocchio.buildModelFromMJCF("model.xml")
    except ValueError:
        return None
    return (model[0] if isinstance(model, tuple) else model).inertias[1].mass


def read_drake(text):
    Path("drake.xml").write_text(text)
    plant = MultibodyPlant(0.001)
    Parser(plant).AddModels("drake.xml")
    plant.Finalize()
    return plant.GetBodyByName("b").get_mass(plant.CreateDefaultContext())


def read_newton(text):
    builder = newton.ModelBuilder()
    with contextlib.redirect_stdout(io.StringIO()):
        builder.add_mjcf(text)
    return builder.body_mass[0]


same = True
for name, geom in GEOMS.items():
    text = MODEL.format(geom)
    masses = mujoco.MjModel.from_xml_string(text).body_mass[1], read_pinocchio(text), read_drake(text), read_newton(text)
    print(f"{name}: " + ", ".join("refused" if m is None else f"{m:.2f} kg" for m in masses))
    same = same and all((a is None) == (b is None) and (a is None or abs(a - b) < 1e-3) for a, b in zip(masses, RIGHT[name]))
sys.exit(0 if same else "the behaviour has changed")
END
