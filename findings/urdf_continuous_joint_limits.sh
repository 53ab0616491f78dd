#!/usr/bin/env bash
# Drake 1.51.1 and MuJoCo 4.0.0, one URDF with a continuous joint and lower and upper limits
# Behaviour: the URDF specification gives a continuous joint no limits. A pendulum is released from the horizontal.
# MuJoCo ignores lower and upper, and the pendulum swings by pi. Drake enforces them, and the pendulum stops at 1 rad.
# Output: MuJoCo 3.14 rad, Drake 1.00 rad

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 mujoco==4.0.0 drake==1.51.1
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import mujoco
from pydrake.all import AddMultibodyPlantSceneGraph, DiagramBuilder, Parser, Simulator

inertial = (
    '<inertial><origin xyz="0.3 0 0"/><mass value="1"/>'
    '<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>'
)
urdf = (
    f'<robot name="r"><link name="base">{inertial}</link><link name="a">{inertial}</link>'
    '<joint name="j" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>'
    '<limit lower="-1" upper="1" effort="5" velocity="3"/></joint></robot>'
)
model = mujoco.MjModel.from_xml_string(urdf)
data, largest = mujoco.MjData(model), {"MuJoCo": 0.0, "Drake": 0.0}
while data.time < 3.0:
    mujoco.mj_step(model, data)
    largest["MuJoCo"] = max(largest["MuJoCo"], abs(data.qpos[0]))

builder = DiagramBuilder()
plant, _ = AddMultibodyPlantSceneGraph(builder, 0.01)
Parser(plant).AddModelsFromString(urdf, "urdf")
plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
plant.Finalize()
simulator = Simulator(builder.Build())
context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
for k in range(1, 301):
    simulator.AdvanceTo(0.01 * k)
    largest["Drake"] = max(largest["Drake"], abs(plant.GetPositions(context)[0]))
print(", ".join(f"{name} {angle:.2f} rad" for name, angle in largest.items()))
sys.exit(0 if largest["MuJoCo"] > 3.0 and largest["Drake"] < 1.1 else "the behaviour has changed")
EOF
