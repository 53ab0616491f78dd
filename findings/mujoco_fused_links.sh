#!/usr/bin/env bash
# MuJoCo 3.10.0 (June 2026; 3.3.7, 3.7.0 and 3.9.0 do the same) and 4.0.0 (3.11.0 too), a URDF arm with a tool on a fixed joint
# Behaviour: the tool of 3 kg is at (1, 0, 0) m with its centre of mass in its origin. By default MuJoCo fuses it with the arm.
# 3.10.0 turns the place of the tool by the principal axes of the tool's own inertia, sorted by size: with ixx >= iyy >= izz it is
# right, and with izz of 1.1 and ixx, iyy of 1 g m^2 the tool is at (0, 0, 1) m. The moment of the weight about the joint is then 4.9
# instead of 34.3 N m. A centre of mass beside the tool's origin does not turn with the tool's rpy. With fusestatic="false" and in
# 4.0.0 all is right. No warning.
# Output: moment for ixx, iyy, izz of (1, 1, 1) g m^2: 34.3; (1.1, 1, 1): 34.3; (1, 1, 1.1): 4.9; (1, 1.1, 1): 4.9; with ixy 0.1: 25.7
# of 34.3 N m each; tool turned by 0.5 rad: 34.3 of 31.5 N m; 4.0.0: all right

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
for version in 3.10.0 4.0.0; do
  "$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check --target "$folder/$version" \
    "mujoco==$version" numpy==2.4.6
done
cd "$folder"
cat > weigh.py << 'END'
import sys

import mujoco

ROBOT = """<robot name="robot"><mujoco><compiler fusestatic="{5}"/></mujoco><link name="base"/><link name="arm"><inertial>
<origin xyz="0.5 0 0"/><mass value="1"/><inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="99" velocity="9"/></joint><link name="tool"><inertial><origin xyz="0 {4} 0"/><mass value="3"/>
<inertia ixx="{0}e-3" iyy="{1}e-3" izz="{2}e-3" ixy="{3}e-3" ixz="0" iyz="0"/></inertial></link><joint name="flange" type="fixed">
<origin xyz="1 0 0" rpy="0 0 {6}"/><parent link="arm"/><child link="tool"/></joint></robot>"""


def weigh(*inertia, shift=0.0, angle=0.0, fuse="true"):
    """Return the moment of the weight about the hinge in N m, and the centre of mass of the last body in m."""
    model = mujoco.MjModel.from_xml_string(ROBOT.format(*inertia, shift, fuse, angle))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return -float(data.qfrc_bias[0]), model.body_ipos[-1].round(3).tolist()


old = mujoco.__version__ == "3.10.0"
same = old or mujoco.__version__ == "4.0.0"
for inertia, expected in (((1, 1, 1, 0), 34.335), ((1.1, 1, 1, 0), 34.335), ((1, 1, 1.1, 0), 4.905), ((1, 1.1, 1, 0), 4.905),
                          ((1, 1, 1, 0.1), 25.715)):
    moment, centre = weigh(*inertia)
    apart, _ = weigh(*inertia, fuse="false")
    print(f"{mujoco.__version__}: ixx, iyy, izz, ixy = {inertia} g m^2: fused {moment:.3f} N m, centre of mass {centre}; "
          f"apart {apart:.3f} N m")
    same &= abs(moment - (expected if old else 34.335)) < 1e-3 and abs(apart - 34.335) < 1e-3
moment, apart = weigh(1, 1, 1, 0, shift=0.2, angle=0.5)[0], weigh(1, 1, 1, 0, shift=0.2, angle=0.5, fuse="false")[0]
print(f"{mujoco.__version__}: tool turned by 0.5 rad: fused {moment:.3f}, apart {apart:.3f} N m")
same &= abs(moment - (34.335 if old else 31.513)) < 1e-3 and abs(apart - 31.513) < 1e-3
sys.exit(0 if same else "the behaviour has changed")
END
for version in 3.10.0 4.0.0; do
  PYTHONPATH="$folder/$version" venv/bin/python weigh.py
done
