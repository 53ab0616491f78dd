#!/usr/bin/env bash
# oxiphysics 0.1.2, PhysicsWorld: bodies of each shape that fall on a fixed body of each shape
# Behaviour: spheres, boxes and capsules can be added, and only a sphere meets a sphere. In each of the other eight pairs the falling
# body passes through, contact_count stays 0, and nothing warns. The ball of the class's own quick start, on a ground of a box, falls
# through this ground.
# Output: pairs that met: ['sphere on sphere']; the ball of the quick start after 3 s: y = -34.4

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check oxiphysics==0.1.2 numpy==2.4.6
cd "$folder"
venv/bin/python - << 'END'
import sys

import oxiphysics
from oxiphysics import RigidBodyConfig


def add_shape(body, kind, size):
    if kind == "sphere":
        body.add_sphere(radius=size)
    elif kind == "box":
        body.add_box(hx=size, hy=size, hz=size)
    else:
        body.add_capsule(radius=size, half_height=size)
    return body


def drop(kind, ground):
    world = oxiphysics.PhysicsWorld(gy=-9.81)
    world.add_rigid_body(add_shape(RigidBodyConfig.static_body(y=-1.0), ground, 1.0))
    ball = world.add_rigid_body(add_shape(RigidBodyConfig.dynamic(mass=1.0, y=1.3), kind, 0.5))
    for _ in range(240):
        world.step(1 / 120)
    return world.get_position(ball)[1]


kinds = "sphere", "box", "capsule"
met = [f"{kind} on {ground}" for ground in kinds for kind in kinds if drop(kind, ground) > -5]
print("pairs that met:", met)
world = oxiphysics.PhysicsWorld(gy=-9.81)
ball = world.add_rigid_body(add_shape(RigidBodyConfig.dynamic(mass=1.0, y=10.0), "sphere", 0.5))
ground = RigidBodyConfig.static_body()
ground.add_box(hx=50.0, hy=0.1, hz=50.0)
world.add_rigid_body(ground)
for _ in range(180):
    world.step(1 / 60)
height = world.get_position(ball)[1]
print(f"the ball of the quick start after 3 s: y = {height:.1f}")
sys.exit(0 if met == ["sphere on sphere"] and height < -30 else "the behaviour has changed")
END
