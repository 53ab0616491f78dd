#!/usr/bin/env bash
# Brax 0.14.2 (jax 0.10.2), a pendulum whose MJCF joint has one of frictionloss, damping, armature and stiffness
# Behaviour: mjcf.loads accepts all four without an error. The pendulum is released from the horizontal. No pipeline uses the
# frictionloss: 10 N m, which would hold its weight of 1.5 N m, change no digit. The pipelines positional and spring use none of
# the four; generalized uses the other three.
# Output: angle after 0.2 s: generalized: none 0.916, frictionloss 0.916, damping 0.029, armature 0.003, stiffness 0.010;
# positional: 0.912 five times; spring: 0.880 five times

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check brax==0.14.2 jax==0.10.2 jaxlib==0.10.2 \
  mujoco==4.0.0 mujoco-mjx==3.17.0
JAX_PLATFORMS=cpu "$folder/venv/bin/python" - << 'END'
import sys

import jax
import jax.numpy as jp
from brax.generalized import pipeline as generalized
from brax.io import mjcf
from brax.positional import pipeline as positional
from brax.spring import pipeline as spring

MODEL = """<mujoco><option timestep="0.002"/><worldbody><body pos="0 0 1"><joint name="h" type="hinge" axis="0 1 0" {}/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/></body></worldbody></mujoco>"""
PROPERTIES = {"none": "", **{k: f'{k}="{v}"' for k, v in (("frictionloss", 10), ("damping", 10), ("armature", 10), ("stiffness", 100))}}


def simulate(pipeline, text):
    system = mjcf.loads(MODEL.format(text))
    step = jax.jit(lambda state: jax.lax.fori_loop(0, 100, lambda _, s: pipeline.step(system, s, jp.zeros(0)), state))
    return float(step(pipeline.init(system, jp.zeros(1), jp.zeros(1))).q[0])


expected = True
for name, pipeline in (("generalized", generalized), ("positional", positional), ("spring", spring)):
    angles = {key: simulate(pipeline, text) for key, text in PROPERTIES.items()}
    print(f"{name}: " + ", ".join(f"{key} {angle:.3f}" for key, angle in angles.items()))
    unused = set(PROPERTIES) if pipeline is not generalized else {"none", "frictionloss"}
    expected &= all((angles[key] == angles["none"]) == (key in unused) for key in angles)
sys.exit(0 if expected else "the behaviour has changed")
END
