#!/usr/bin/env bash
# Drake 1.51.1 and MuJoCo 4.0.0, the damping of a URDF joint in one time step
# Behaviour: a hinge of 0.1 kg m^2 turns with 1 rad/s and has the damping d. An implicit step of 10 ms leaves 1 / (1 + h d / I), as
# MuJoCo and Drake with kLagged, kSimilar and kSap. With kTamsi the step is explicit, 1 - h d / I: beyond h d = 2 I it is unstable.
# Output: d = 1, 10, 50 N m s: kTamsi 0.900, 0.000, -4.000 rad/s, the others 0.909, 0.500, 0.167 rad/s

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 mujoco==4.0.0 drake==1.51.1
cd "$folder"
venv/bin/python - << 'END' 2> /dev/null
import sys

import mujoco
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import DiscreteContactApproximation, MultibodyPlant
from pydrake.systems.analysis import Simulator

STEP, INERTIA, DAMPINGS = 0.01, 0.1, (1.0, 10.0, 50.0)  # s, kg m^2, N m s
URDF = (
    '<robot name="r"><link name="base"/><link name="a"><inertial><mass value="1"/>'
    '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j" type="continuous">'
    '<parent link="base"/><child link="a"/><axis xyz="0 1 0"/><dynamics damping="{}"/></joint></robot>'
)


def step_drake(damping, approximation):
    plant = MultibodyPlant(STEP)
    plant.set_discrete_contact_approximation(getattr(DiscreteContactApproximation, approximation))
    Parser(plant).AddModelsFromString(URDF.format(damping), ".urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    simulator = Simulator(plant)
    context = simulator.get_mutable_context()
    plant.SetVelocities(context, [1.0])
    simulator.AdvanceTo(STEP)
    return plant.GetVelocities(context)[0]


def step_mujoco(damping):
    model = mujoco.MjModel.from_xml_string(URDF.format(damping))
    model.opt.timestep = STEP
    data = mujoco.MjData(model)
    data.qvel[:] = 1.0
    mujoco.mj_step(model, data)
    return data.qvel[0]


rows = {"MuJoCo": [step_mujoco(d) for d in DAMPINGS]}
for name in ("kLagged", "kSimilar", "kSap", "kTamsi"):
    rows[name] = [step_drake(d, name) for d in DAMPINGS]
same = True
for name, speeds in rows.items():
    print(f"{name}: " + ", ".join(f"{v:.3f}" for v in speeds) + " rad/s")
    ratios = [STEP * d / INERTIA for d in DAMPINGS]
    expected = [1 - x if name == "kTamsi" else 1 / (1 + x) for x in ratios]
    same = same and all(abs(v - e) < 1e-3 for v, e in zip(speeds, expected))
sys.exit(0 if same else "the behaviour has changed")
END
