#!/usr/bin/env bash
# peclet-dem 1.1.0, a sphere that slides onto a plane with 1 m/s, friction 0.5, and ends up rolling
# Behaviour: friction turns sliding into rolling at 5/7 of the speed, whatever the radius and the mass. With shape radius 0.05 the
# sphere rolls with 0.714 m/s. The same sphere as shape radius 0.5 with set_global_scale or set_scales 0.1 rolls with 0.024 m/s: the
# scale changes the radius, but mass and inertia stay those of the shape. With scale 0.01, as in the example of the readme, the
# sphere stops and does not turn, and with scale 2 it rolls with 0.909 m/s.
# Output: radius 0.05 as shape: 0.714, as global scale 0.1: 0.024, as scale 0.1: 0.024, global scale 0.01: 0.000, global scale 2: 0.909

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check peclet-dem==1.1.0 numpy==2.4.6
cd "$folder"
OMP_NUM_THREADS=1 OMP_PROC_BIND=false venv/bin/python - << 'END'
import sys

import numpy as np
from peclet import dem


def roll(shape, everything=1.0, own=1.0):
    """Return speed and radius times angular velocity after 0.6 s."""
    radius = shape * everything * own
    simulation = dem.Simulation(capacity=4)
    simulation.initialize_shape("sphere", shape)
    simulation.set_global_scale(everything)
    simulation.set_domain(extent=(40, 40, 8), origin=(-1, -20, -1), periodic=(False, False, False))
    simulation.add_plane(point=(0, 0, 0), normal=(0, 0, 1))
    simulation.set_positions(np.array([[0, 0, radius]], np.float32))
    simulation.set_scales(np.array([own], np.float32))
    simulation.set_velocities(np.array([[1, 0, 0]], np.float32))
    simulation.set_gravity((0, 0, -10))
    simulation.set_material_params(restitution_normal=0.0, friction=0.5)
    simulation.set_solver_iterations(pos=10, vel=8)
    simulation.set_dt(1e-4)
    simulation.step(6000)
    return float(simulation.get_velocities()[0][0]), float(simulation.get_angular_velocities()[0][1]) * radius


cases = {
    "radius 0.05 as shape": ((0.05,), 5 / 7),
    "radius 0.05 as global scale 0.1": ((0.5, 0.1), 0.0244),
    "radius 0.05 as scale 0.1": ((0.5, 1.0, 0.1), 0.0244),
    "radius 0.005 as global scale 0.01": ((0.5, 0.01), 0.0),
    "radius 1 as global scale 2": ((0.5, 2.0), 0.909),
}
same = True
for name, (arguments, expected) in cases.items():
    speed, rim = roll(*arguments)
    print(f"{name}: {speed:.3f} m/s, rim {rim:.3f} m/s")
    same = same and abs(speed - expected) < 2e-3 and abs(rim - speed) < 2e-3
sys.exit(0 if same else "the behaviour has changed")
END
