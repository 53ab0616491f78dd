#!/usr/bin/env bash
# MuJoCo 4.0.0 and Drake 1.51.1, one MJCF with a motor of gear 50, armature 0.01 and a control of 1, clamped to 2
# Behaviour: the joint gets 50 N m in MuJoCo and 1 N m in Drake, and its limit is 100 N m in MuJoCo and 2 N m in Drake. Drake
# keeps the gear ratio for the inertia of the rotor only, which it divides by the square, so that both mass matrices are equal.
# No warning mentions the gear.
# Output: gear 50: 0.0300 and 0.0300 kg m^2; after 0.1 s 166.67 rad/s in MuJoCo and 3.33 rad/s in Drake; effort limit 2 N m in Drake

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 mujoco==4.0.0 drake==1.51.1
cd "$folder"
venv/bin/python - << 'END' 2> warnings.txt
import sys

import mujoco
import numpy as np
from pydrake.all import MultibodyPlant, Parser, Simulator

MJCF = (
    '<mujoco model="m"><option gravity="0 0 0"/><worldbody><body name="b"><joint name="j" axis="0 1 0" armature=".01"/>'
    '<inertial pos="0 0 0" mass="1" diaginertia=".02 .02 .02"/></body></worldbody>'
    '<actuator><motor name="a" joint="j" gear="{}" ctrlrange="-2 2" ctrllimited="true"/></actuator></mujoco>'
)
same = True
for gear in (1, 50):
    text = MJCF.format(gear)
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.timestep = 0.001
    data = mujoco.MjData(model)
    data.ctrl[0] = 1.0
    mujoco.mj_step(model, data, 100)
    inertia = 1.0 / np.linalg.inv(np.array([[data.M[0]]]))[0, 0] if hasattr(data, "M") else data.qM[0]

    plant = MultibodyPlant(0.001)
    Parser(plant).AddModelsFromString(text, "xml")
    plant.Finalize()
    simulator = Simulator(plant)
    context = simulator.get_mutable_context()
    plant.get_actuation_input_port().FixValue(context, [1.0])
    simulator.AdvanceTo(0.1)
    mass = plant.CalcMassMatrix(context)[0, 0]
    speed = plant.GetVelocities(context)[0]
    limit = plant.get_joint_actuator(plant.GetJointActuatorIndices()[0]).effort_limit()
    print(
        f"gear {gear}: {inertia:.4f} and {mass:.4f} kg m^2; after 0.1 s {data.qvel[0]:.2f} rad/s in MuJoCo and {speed:.2f} rad/s in "
        f"Drake; effort limit {limit:g} N m in Drake"
    )
    same = same and np.isclose(mass, 0.03) and np.isclose(speed, 10 / 3) and np.isclose(data.qvel[0], gear * 10 / 3)
    same = same and limit == 2.0
sys.exit(0 if same else "the behaviour has changed")
END
if grep -qi gear warnings.txt; then
  echo "a warning mentions the gear" >&2
  exit 1
fi
