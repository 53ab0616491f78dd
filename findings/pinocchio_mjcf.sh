#!/usr/bin/env bash
# Pinocchio 4.1.0, MJCF
# Behaviour: in a file in degrees (the default), the range of a slide joint, in metres, is multiplied by pi/180. Only
# the first body of the world is read, without a warning, and the gravity of the file is replaced by 9.81 m/s^2.
# Output: MuJoCo: 2 joints, slide -1 to 2 m, gravity -3; Pinocchio: 1 joint, slide -0.01745 to 0.03491 m, gravity -9.81

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 mujoco==4.0.0 pin==4.1.0
cd "$folder"
venv/bin/python - << 'EOF'
import sys
from pathlib import Path

import mujoco
import numpy as np
import pinocchio

Path("model.xml").write_text('''<mujoco model="m"><option gravity="0 0 -3"/><worldbody>
  <body name="one"><joint name="s" type="slide" axis="1 0 0" range="-1 2" limited="true"/>
    <geom type="sphere" size=".1" mass="1"/></body>
  <body name="two"><joint name="h" type="hinge"/><geom type="sphere" size=".1" mass="2"/></body>
</worldbody></mujoco>''')
other, model = mujoco.MjModel.from_xml_path("model.xml"), pinocchio.buildModelFromMJCF("model.xml")
low, high = model.lowerPositionLimit[0], model.upperPositionLimit[0]
print(
    f"MuJoCo: {other.njnt} joints, slide {other.jnt_range[0, 0]:g} to {other.jnt_range[0, 1]:g} m, "
    f"gravity {other.opt.gravity[2]:g}; Pinocchio: {model.njoints - 1} joint, slide {low:.4g} to {high:.4g} m, "
    f"gravity {model.gravity.linear[2]:g}"
)
is_same = model.njoints == 2 and np.allclose([low, high], np.deg2rad([-1.0, 2.0])) and model.gravity.linear[2] == -9.81
sys.exit(0 if is_same else "the behaviour has changed")
EOF
