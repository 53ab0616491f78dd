#!/usr/bin/env bash
# MJX 3.17.0 (mujoco 4.0.0, jax 0.10.2), integrator Euler, no joint has damping
# Behaviour: with one iteration of CG on two spheres that rest on each other, MuJoCo and MJX find the same qacc, 2 m/s^2,
# and MuJoCo's next velocity is h qacc. MJX moves the upper sphere by 18 times as much: unless the flag eulerdamp is
# disabled, its step takes M^-1 (qfrc_smooth + qfrc_constraint), also without damping, and these forces belong to qacc only
# after convergence. The reported qacc, also that of the data after the step, is not the acceleration of the bodies.
# Output: h qacc and next velocity of the upper sphere: MuJoCo 3.9 and 3.9 mm/s; MJX 3.9 and 71.3, without eulerdamp 3.9 and 3.9

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

xml = '''<mujoco><option iterations="1" solver="CG"><flag eulerdamp="{}"/></option><worldbody>
  <geom type="plane" size="0 0 1"/>
  <body pos="0 0 .099"><freejoint/><geom size=".1"/></body>
  <body pos="0 0 .298"><freejoint/><geom size=".1" density="100"/></body></worldbody></mujoco>'''
UPPER = 8  # The vertical velocity of the upper sphere.
found = {}
for eulerdamp in ("enable", "disable"):
    model = mujoco.MjModel.from_xml_string(xml.format(eulerdamp))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    device_model = mjx.put_model(model)
    after = jax.jit(mjx.step)(device_model, mjx.make_data(device_model))
    for name, d in (("MuJoCo", data), ("MJX", after)):
        found[name, eulerdamp] = [float(1e3 * x) for x in (model.opt.timestep * d.qacc[UPPER], d.qvel[UPPER])]
for (name, eulerdamp), (expected, velocity) in found.items():
    print(f"{name}, eulerdamp {eulerdamp}d: h qacc {expected:.1f} mm/s, next velocity {velocity:.1f} mm/s")
gaps = {case: abs(velocity - expected) for case, (expected, velocity) in found.items()}
is_same = gaps.pop(("MJX", "enable")) > 30.0 and max(gaps.values()) < 0.1
sys.exit(0 if is_same else "the behaviour has changed")
EOF
