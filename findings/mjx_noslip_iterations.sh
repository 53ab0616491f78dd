#!/usr/bin/env bash
# MJX 3.17.0 (mujoco 4.0.0), noslip_iterations
# Behaviour: a box on a plane is pushed with 0.3 of its weight. MuJoCo's 20 noslip iterations reduce its creep from
# 8e-4 m/s to below 1e-6 m/s. MJX accepts the setting without a warning, and the creep does not change.
# Output: MuJoCo 7.8e-04 and 6.8e-09 m/s, MJX 7.6e-04 and 7.6e-04 m/s

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 jax==0.10.2 mujoco==4.0.0 mujoco-mjx==3.17.0
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import jax
import mujoco
from mujoco import mjx

xml = '''<mujoco><option timestep="0.004" cone="elliptic" gravity="3 0 -9.81" noslip_iterations="{}"/><worldbody>
  <geom type="plane" size="0 0 1"/>
  <body pos="0 0 0.0999"><freejoint/><geom type="box" size=".1 .1 .1"/></body></worldbody></mujoco>'''
speeds = {"MuJoCo": [], "MJX": []}
for n in (0, 20):
    model = mujoco.MjModel.from_xml_string(xml.format(n))
    data, device_model = mujoco.MjData(model), mjx.put_model(model)
    device_data, step = mjx.make_data(device_model), jax.jit(mjx.step)
    for _ in range(200):
        mujoco.mj_step(model, data)
        device_data = step(device_model, device_data)
    speeds["MuJoCo"].append(abs(float(data.qvel[0])))
    speeds["MJX"].append(abs(float(device_data.qvel[0])))
print(", ".join(f"{name} {a:.1e} and {b:.1e} m/s" for name, (a, b) in speeds.items()))
is_same = speeds["MuJoCo"][1] < 1e-6 < 1e-4 < speeds["MJX"][1] == speeds["MJX"][0]
sys.exit(0 if is_same else "the behaviour has changed")
EOF
