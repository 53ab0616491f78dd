#!/usr/bin/env bash
# DART 6.20.0 (MjcfParser) and MuJoCo 4.0.0, one MJCF
# Behaviour: DART does not read diaginertia and does not compute inertias of geoms: each body has 1 kg m^2 about each axis. Ranges in
# degrees (the default of MJCF) become limits in rad, a joint without range is limited to 0, and a body with freejoint is fixed.
# Output: inertia about the joint: MuJoCo 0.110 kg m^2, DART 1.090 kg m^2; limits: 1.047 rad, 60.000 rad; without range: 0.000 rad;
# degrees of freedom of the free body: 6, 0

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 mujoco==4.0.0 dartpy==6.20.0
cd "$folder"
venv/bin/python - << 'END' 2> /dev/null
import sys
from pathlib import Path

import dartpy
import mujoco
import numpy as np

INERTIAL = '<inertial pos=".3 0 0" mass="1" diaginertia=".01 .02 .025"/><geom type="box" size=".1 .05 .02"/>'
TEXT = (
    f'<mujoco model="m"><worldbody><body name="a"><joint name="j" type="hinge" axis="0 1 0" range="-30 60"/>{INERTIAL}</body>'
    f'<body name="b" pos="0 2 0"><joint name="k" type="hinge" axis="0 1 0"/>{INERTIAL}</body>'
    f'<body name="c" pos="0 0 2"><freejoint/>{INERTIAL}</body></worldbody></mujoco>'
)
model = mujoco.MjModel.from_xml_string(TEXT)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
matrix = np.zeros((model.nv, model.nv))
mujoco.mj_fullM(model, data, matrix)
Path("model.xml").write_text(TEXT)
world = dartpy.utils.MjcfParser.readWorld(str(Path("model.xml").resolve()))
limited, unlimited, free = (world.getSkeleton(i) for i in range(3))
inertia, limit, none = limited.getMassMatrix()[0, 0], limited.getPositionUpperLimits()[0], unlimited.getPositionUpperLimits()[0]
print(f"inertia about the joint: MuJoCo {matrix[0, 0]:.3f} kg m^2, DART {inertia:.3f} kg m^2")
print(f"limits: MuJoCo {model.jnt_range[0, 1]:.3f} rad, DART {limit:.3f} rad; joint without range: DART {none:.3f} rad")
print(f"degrees of freedom of the free body: MuJoCo 6, DART {free.getNumDofs()}")
same = abs(matrix[0, 0] - 0.11) < 1e-6 and abs(inertia - 1.09) < 1e-6 and abs(limit - 60.0) < 1e-6
sys.exit(0 if same and none == 0.0 and free.getNumDofs() == 0 else "the behaviour has changed")
END
