#!/usr/bin/env bash
# omi-physics 0.4.0, a box of 1 kg at rest on a floor, both of a material with staticFriction 0.9 and dynamicFriction 0.2
# Behaviour: the box is pushed under 10 m/s^2. Static friction would hold it up to 9 N. It holds 1.9 N and slides from 2.1 N on,
# with F - 2 N, as with a static coefficient of 0.2: the coefficient of the glTF schema is stored, and at rest the dynamic one decides.
# Output: speed after 1 s: 1.9 N: 0.00, 2.1 N: 0.10, 8.0 N: 6.00 m/s (Coulomb with 0.9: 0, 0, 0)

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check omi-physics==0.4.0 numpy==2.4.6
cd "$folder"
venv/bin/python - << 'END'
import sys

from omi_physics import PhysicsWorld
from omi_physics.model import Collider, Gravity, Material, Motion, Shape


def push(force, static):
    world = PhysicsWorld(gravity=Gravity(gravity=10.0), fixed_dt=1 / 60, sleep_enabled=False)
    material = world.add_material(Material(staticFriction=static, dynamicFriction=0.2))
    floor, box = world.add_shape(Shape.box((100, 1, 100))), world.add_shape(Shape.box((1, 0.5, 1)))
    world.add_body(Motion(type="static"), Collider(shape=floor, physicsMaterial=material), position=(0, -0.5, 0))
    body = world.add_body(Motion(mass=1.0), Collider(shape=box, physicsMaterial=material), position=(0, 0.25, 0))
    for _ in range(60):
        world.set_force(body, (force, 0, 0))
        world.step(1 / 60)
    return float(world.linear_velocity[body][0])


forces = 1.9, 2.1, 8.0
found = [push(force, 0.9) for force in forces]
print("staticFriction 0.9:", ", ".join(f"{f} N: {v:.2f}" for f, v in zip(forces, found)), "m/s")
equal = [push(force, 0.2) for force in forces]
print("staticFriction 0.2:", ", ".join(f"{f} N: {v:.2f}" for f, v in zip(forces, equal)), "m/s")
same = found == equal and abs(found[0]) < 0.01 and abs(found[1] - 0.1) < 0.05 and abs(found[2] - 6) < 0.2
sys.exit(0 if same else "the behaviour has changed")
END
