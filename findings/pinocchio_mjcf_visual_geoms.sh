#!/usr/bin/env bash
# Pinocchio 4.1.0 and MuJoCo 4.0.0, an MJCF with a geom that does not collide, and a joint with limited="false"
# Behaviour: in MuJoCo every geom of a body without inertial has mass, also one with contype and conaffinity 0. Pinocchio takes such
# a geom as visual and leaves its mass out. A range with limited="false" is no limit in MuJoCo, and one in Pinocchio. No message.
# Output: mass 4.0 kg and 2.0 kg; limit of the joint: none and 1.0 rad

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
import pinocchio

TEXT = (
    '<mujoco model="m"><compiler angle="radian"/><worldbody><body name="b">'
    '<joint name="j" axis="0 1 0" limited="false" range="-.5 1"/><geom type="box" size=".1 .05 .02" mass="2"/>'
    '<geom type="box" size=".1 .05 .02" mass="2" contype="0" conaffinity="0"/></body></worldbody></mujoco>'
)
model = mujoco.MjModel.from_xml_string(TEXT)
Path("model.xml").write_text(TEXT)
other = pinocchio.buildModelFromMJCF("model.xml")
other = other[0] if isinstance(other, tuple) else other
print(f"mass: MuJoCo {model.body_mass[1]:.1f} kg, Pinocchio {other.inertias[1].mass:.1f} kg")
print(f"limited: MuJoCo {bool(model.jnt_limited[0])}, upper limit in Pinocchio {other.upperPositionLimit[0]:.1f} rad")
same = abs(model.body_mass[1] - 4.0) < 1e-9 and not model.jnt_limited[0]
same = same and abs(other.inertias[1].mass - 2.0) < 1e-9 and abs(other.upperPositionLimit[0] - 1.0) < 1e-9
sys.exit(0 if same else "the behaviour has changed")
END
