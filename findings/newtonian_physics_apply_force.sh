#!/usr/bin/env bash
# newtonian-physics 0.2.0, Body.apply_force and Body.apply_acceleration before World.step
# Behaviour: step begins with clear_forces, so that a force of 20 N applied before each of 60 steps moves a free body of 1 kg by
# nothing, in 2D and in 3D. Only a force field, which step calls itself, reaches the body. apply_acceleration is the opposite: it is
# never cleared, so that one call acts in each later step, and 60 calls add up to 30 times the speed.
# Output: speed after 1 s: apply_force 0.00 (2D), 0.00 (3D), force field 20.00, apply_acceleration once 20.00, in each step 610.00

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check newtonian-physics==0.2.0
cd "$folder"
venv/bin/python - << 'END'
import sys

from pyphysics import Body, Body3D, Box, Box3D, Vec2, Vec3, World, World3D


class Push:
    def apply(self, body, dt):
        body.apply_force(Vec2(20, 0))


def move(before=lambda body, step: None, field=None, flat=True):
    world = World(gravity=Vec2(0, 0)) if flat else World3D(gravity=Vec3(0, 0, 0))
    shape = Box(1, 1) if flat else Box3D(1, 1, 1)
    body = (Body if flat else Body3D)(shape, mass=1.0, damping=0.0)
    world.add(body)
    if field:
        world.add_force_field(field)
    for step in range(60):
        before(body, step)
        world.step(1 / 60)
    return body.velocity.x


found = {
    "apply_force in 2D": move(lambda body, step: body.apply_force(Vec2(20, 0))),
    "apply_force in 3D": move(lambda body, step: body.apply_force(Vec3(20, 0, 0)), flat=False),
    "force field": move(field=Push()),
    "apply_acceleration once": move(lambda body, step: body.apply_acceleration(Vec2(20, 0)) if step == 0 else None),
    "apply_acceleration in each step": move(lambda body, step: body.apply_acceleration(Vec2(20, 0))),
}
for name, speed in found.items():
    print(f"{name}: {speed:.2f} m/s")
expected = 0, 0, 20, 20, 610
same = all(abs(x - y) < 0.01 * max(1, y) for x, y in zip(found.values(), expected))
sys.exit(0 if same else "the behaviour has changed")
END
