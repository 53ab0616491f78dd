#!/usr/bin/env bash
# truerig 0.1.1 (mujoco 4.0.0), a URDF whose joint has damping, friction and a limit of effort
# Behaviour: truerig converts URDF to MJCF and reports what is lost. For this robot the verdict is PASS with no errors and no
# warnings. The damping is kept, and the friction of 1 N m and the effort of 30 N m are gone, without a line
# about them. MuJoCo's own reader keeps both. A joint released 0.1 rad from upright, which the friction holds against a
# weight of 0.2 N m, falls to its limit of 1 rad in the converted model.
# Output: PASS, 0 errors, 0 warnings; mujoco: damping 0.5, friction 1, effort 30, angle after 5 s 0.12; truerig:
# damping 0.5, friction 0, effort unlimited, angle 1.00

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check mujoco==4.0.0 numpy==2.4.6 truerig==0.1.1
cd "$folder"
cat > robot.urdf << 'END'
<robot name="robot">
  <link name="base"><inertial><mass value="2"/><inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="arm"><inertial><origin xyz="0 0 0.2"/><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="j1" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="30" velocity="4"/><dynamics damping="0.5" friction="1"/></joint>
</robot>
END
venv/bin/truerig convert robot.urdf robot.xml > report
venv/bin/python - << 'END'
import re
import sys
from pathlib import Path

import mujoco

report = Path("report").read_text()
verdict, errors, warnings = re.search(r"verdict: (\w+) +errors=(\d+) +warnings=(\d+)", report).groups()
print(f"{verdict}, {errors} errors, {warnings} warnings")
expected = (verdict, errors, warnings) == ("PASS", "0", "0") and not re.search("friction loss|frictionloss|effort", report)
for name, path, values in (("mujoco", "robot.urdf", (0.5, 1, 30, 0.1)), ("truerig", "robot.xml", (0.5, 0, 0, 1))):
    model = mujoco.MjModel.from_xml_path(path)
    data, joint = mujoco.MjData(model), model.joint("j1")
    data.qpos[0] = 0.1
    while data.time < 5:
        mujoco.mj_step(model, data)
    effort = model.jnt_actfrcrange[joint.id, 1]
    print(f"{name}: damping {joint.damping[0]:g}, friction {joint.frictionloss[0]:g}, effort {effort or 'unlimited'}, "
          f"angle after 5 s {data.qpos[0]:.2f}")
    measured = (joint.damping[0], joint.frictionloss[0], effort, data.qpos[0])
    expected &= all(abs(a - b) < 0.05 for a, b in zip(measured, values))
sys.exit(0 if expected else "the behaviour has changed")
END
