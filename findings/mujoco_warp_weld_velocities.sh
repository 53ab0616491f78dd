#!/usr/bin/env bash
# MuJoCo Warp 4.0.0 (mujoco 4.0.0, warp-lang 1.19.0, on a processor), a weld of two bodies that turn together
# Behaviour: rows of welds and connects contain the centripetal acceleration, but MuJoCo Warp computes it from the body
# velocities of the pass before. Two calls of `forward` with the same qpos, qvel and qacc_warmstart give other
# accelerations; the second one is MuJoCo's, whose two calls agree. `step` uses the first: a pair that gets 20 rad/s by
# assigning qvel moves straight on in the first step.
# Output: acceleration of the first body 54.0 and 54.0 m/s^2 in MuJoCo, 0.0 and 54.0 in MuJoCo Warp

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 mujoco==4.0.0 mujoco-warp==4.0.0 \
    warp-lang==1.19.0
cd "$folder"
WARP_CACHE_PATH="$folder/kernels" venv/bin/python - << 'EOF'
import sys

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp

warp.config.quiet = True
xml = '''<mujoco><option gravity="0 0 0"/><worldbody>
  <body name="a" pos="-.15 0 1"><freejoint/><geom size=".05"/></body>
  <body name="b" pos=".15 0 1"><freejoint/><geom size=".05"/></body>
</worldbody><equality><weld body1="a" body2="b"/></equality></mujoco>'''
model = mujoco.MjModel.from_xml_string(xml)
# Both turn about the middle between them: v = omega x r.
velocity = np.array([0, -3, 0, 0, 0, 20, 0, 3, 0, 0, 0, 20], np.float32)
data = mujoco.MjData(model)
device_model, device_data = mjw.put_model(model), mjw.put_data(model, data, nworld=1)
data.qvel[:] = velocity
device_data.qvel.assign(velocity[None])
found = {"MuJoCo": [], "MuJoCo Warp": []}
for _ in range(2):
    mujoco.mj_forward(model, data)
    mjw.forward(device_model, device_data)
    found["MuJoCo"].append(np.array(data.qacc))
    found["MuJoCo Warp"].append(device_data.qacc.numpy()[0].copy())
for name, pair in found.items():
    print(name, ", ".join(f"{np.linalg.norm(a[:3]):.1f} m/s^2" for a in pair))
(first, second), (stale, fresh) = found.values()
is_same = np.allclose(first, second) and np.allclose(fresh, second, atol=0.1) and np.abs(stale - second).max() > 20.0
sys.exit(0 if is_same else "the behaviour has changed")
EOF
