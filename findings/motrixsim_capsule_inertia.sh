#!/usr/bin/env bash
# MotrixSim 0.10.1 and MuJoCo 4.0.0, one MJCF body with one geom and no inertial element
# Behaviour: mass, centre of mass and the inertia of spheres, boxes, cylinders and ellipsoids agree. The inertia of a capsule does
# not: it is as if the two ends and the cylinder each had the whole mass, and L^2/2 stood for L^2/4 (L is the length of the cylinder).
# A capsule of radius 0.05 m and length 1 m has 6.3 times its inertia across the axis and 1.8 times along it, and a motor speeds it up
# 6.3 times too slowly. No warning.
# Output: inertia across and along the axis in MotrixSim, MuJoCo, by the formula: 3.0185, 0.0113; 0.4779, 0.0062; 0.4779, 0.0062
# kg m^2; speed after 0.1 s with 1 N m: 0.0331, 0.2093 rad/s; the other shapes agree within 1e-5

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check motrixsim==0.10.1 mujoco==4.0.0 numpy==2.4.6
cd "$folder"
venv/bin/python - << 'END'
import math
import sys

import motrixsim
import mujoco
import numpy as np

WORLD = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body name="body">
<joint name="hinge" type="hinge" axis="0 1 0"/><geom mass="5" {}/></body></worldbody>
<actuator><motor joint="hinge"/></actuator></mujoco>"""


def run_mujoco(xml):
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.ctrl[:] = 1
    mujoco.mj_step(model, data, 50)
    return model.body_mass[1], model.body_inertia[1], float(data.qvel[0])


def run_motrixsim(xml):
    model = motrixsim.load_mjcf_str(xml)
    data = motrixsim.SceneData(model)
    link = model.get_link(0)
    data.actuator_ctrls = np.ones(1, np.float32)
    for _ in range(50):
        model.step(data)
    return link.mass, np.ravel(link.get_inertia_override(data))[:3], float(np.ravel(data.dof_vel)[0])


def capsule_inertia(mass, radius, length):
    """Return the inertia across and along the axis."""
    cylinder, ball = math.pi * radius**2 * length, 4 / 3 * math.pi * radius**3
    cylinder, ball = mass * cylinder / (cylinder + ball), mass * ball / (cylinder + ball)
    across = cylinder * (3 * radius**2 + length**2) / 12 + ball * (0.4 * radius**2 + length**2 / 4 + 3 / 8 * length * radius)
    return across, cylinder * radius**2 / 2 + 0.4 * ball * radius**2


same = True
for name, size in (("sphere", "0.1"), ("box", "0.1 0.2 0.3"), ("cylinder", "0.1 0.2"), ("ellipsoid", "0.1 0.2 0.3")):
    shape = f'type="{name}" size="{size}"'
    ours, theirs = run_motrixsim(WORLD.format(shape)), run_mujoco(WORLD.format(shape))
    print(f"{shape}: inertia {ours[1].round(4)} and {theirs[1].round(4)} kg m^2, speed {ours[2]:.4f} and {theirs[2]:.4f} rad/s")
    same &= np.allclose(np.sort(ours[1]), np.sort(theirs[1]), rtol=1e-5) and abs(ours[2] / theirs[2] - 1) < 1e-4
for radius, length in ((0.01, 0.4), (0.1, 0.4), (0.05, 1.0)):
    xml = WORLD.format(f'type="capsule" size="{radius} {length / 2}"')
    ours, theirs = run_motrixsim(xml), run_mujoco(xml)
    across, along = capsule_inertia(5, radius, length)
    print(f"capsule {radius} m, {length} m: mass {ours[0]:.3f} and {theirs[0]:.3f} kg; "
          f"inertia across {ours[1][0]:.4f} and {theirs[1][0]:.4f}, formula {across:.4f}; "
          f"along {ours[1][2]:.5f} and {theirs[1][2]:.5f}, formula {along:.5f} kg m^2; "
          f"speed {ours[2]:.4f} and {theirs[2]:.4f}, 0.1 / inertia {0.1 / across:.4f} rad/s")
    same &= abs(ours[0] - 5) < 1e-5 and np.allclose(theirs[1], (across, across, along), rtol=1e-9)
    same &= abs(ours[1][2] / (0.9 * 5 * radius**2) - 1) < 1e-4 and ours[1][0] > 4 * across
    twice = 5 * ((3 * radius**2 + length**2) / 12 + 0.4 * radius**2 + length**2 / 2 + 3 / 8 * length * radius)
    same &= abs(ours[1][0] / twice - 1) < 1e-4 and abs(ours[2] * ours[1][0] - 0.1) < 1e-4
sys.exit(0 if same else "the behaviour has changed")
END
