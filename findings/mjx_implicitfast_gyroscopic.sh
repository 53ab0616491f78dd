#!/usr/bin/env bash
# MuJoCo 4.0.0, MuJoCo Warp 4.0.0 and MJX 3.17.0, a free box that spins, integrator implicitfast
# Behaviour: implicitfast of MuJoCo and of MuJoCo Warp contains the derivative of gyroscopic forces, so that it equals the integrator
# implicit for one free body and loses energy. In MJX it does not, and equals Euler: the box gains energy. put_model gives no warning.
# A box of 0.1 x 0.2 x 0.3 m starts with (1, 20, 1) rad/s without gravity and is simulated for 2 s with steps of 5 ms. MuJoCo 3.17.0
# gives the numbers of 4.0.0.
# Output: energy after 2 s of that at the start: MuJoCo implicitfast 83.2 %, implicit 83.2 %, Euler 122.5 %; MuJoCo Warp implicitfast
# 83.2 %; MJX implicitfast 122.5 %, Euler 122.5 %

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check \
  numpy==2.4.6 mujoco==4.0.0 mujoco-mjx==3.17.0 mujoco-warp==4.0.0 warp-lang==1.19.0 jax==0.10.2 jaxlib==0.10.2
cd "$folder"
export JAX_PLATFORMS=cpu WARP_CACHE_PATH=$folder/warp
venv/bin/python - << 'END' 2> /dev/null | grep '^MuJoCo\|^MJX'
import sys

import jax
import mujoco
import mujoco_warp
import numpy as np
from mujoco import mjx

jax.config.update("jax_enable_x64", True)
STEPS = 400
XML = (
    '<mujoco><option timestep="0.005" gravity="0 0 0" integrator="{}"/><worldbody><body><freejoint/>'
    '<geom type="box" size=".05 .1 .15" mass="1"/></body></worldbody></mujoco>'
)


def start(integrator):
    model = mujoco.MjModel.from_xml_string(XML.format(integrator))
    data = mujoco.MjData(model)
    data.qvel[3:] = 1, 20, 1
    return model, data


def measure(model, velocity):
    """Return the energy [J] as a share of that at the start."""
    inertia = model.body_inertia[1]
    return float(inertia @ np.asarray(velocity)[3:] ** 2) / float(inertia @ np.array([1.0, 20, 1]) ** 2)


def run_mujoco(integrator):
    model, data = start(integrator)
    mujoco.mj_step(model, data, STEPS)
    return measure(model, data.qvel)


def run_mjx(integrator):
    model, data = start(integrator)
    device_model, state = mjx.put_model(model), mjx.put_data(model, data)
    step = jax.jit(mjx.step)
    for _ in range(STEPS):
        state = step(device_model, state)
    return measure(model, state.qvel)


def run_warp(integrator):
    model, data = start(integrator)
    device_model, state = mujoco_warp.put_model(model), mujoco_warp.put_data(model, data)
    for _ in range(STEPS):
        mujoco_warp.step(device_model, state)
    return measure(model, state.qvel.numpy()[0])


share = {("MuJoCo", name): run_mujoco(name) for name in ("implicitfast", "implicit", "Euler")}
share["MuJoCo Warp", "implicitfast"] = run_warp("implicitfast")
share |= {("MJX", name): run_mjx(name) for name in ("implicitfast", "Euler")}
for (engine, integrator), value in share.items():
    print(f"{engine} {integrator}: {value:.1%} of the energy after 2 s")
wanted = 0.832, 0.832, 1.225, 0.832, 1.225, 1.225
sys.exit(0 if np.allclose(list(share.values()), wanted, atol=2e-3) else "the behaviour has changed")
END
