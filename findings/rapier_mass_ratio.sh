#!/usr/bin/env bash
# Rapier (Python, rapier3d) 0.36.1, a heavy box on a light one
# Behaviour: contacts are soft in proportion to the masses of both bodies. A box of 100 kg on a box of 1 kg, both 0.2 m
# high, comes to rest with the two boxes 28 mm in each other, and the impulses of the contacts are the weights. With
# equal masses the depth is below 1 mm.
# Output: equal masses: 0.6 mm; mass ratio 100: 28.4 mm, impulse on the light box 10.00 N s of 10.00 N s

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 rapier3d==0.36.1
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import rapier3d as rapier

DT = 0.01  # s


def make_world():
    world = rapier.PhysicsWorld(gravity=(0.0, -10.0, 0.0))
    world.integration_parameters.dt = DT
    return world


def stack_boxes(mass):
    world = make_world()
    world.add_collider(rapier.Collider.cuboid(50.0, 1.0, 50.0, translation=(0.0, -1.0, 0.0)))
    bodies = []
    for k, m in enumerate((1.0, mass)):
        box = rapier.Collider.cuboid(0.1, 0.1, 0.1, mass=m)
        place = (0.0, 0.1 + 0.2 * k, 0.0)
        bodies.append(world.add_body(rapier.RigidBody.dynamic(translation=place, can_sleep=False), colliders=[box]))
    for _ in range(400):
        world.step()
    lower, upper = (world.rigid_bodies[body].translation.y for body in bodies)
    impulses = [abs(pair.total_impulse().y) for pair in world.narrow_phase.contact_pairs()]
    return 1000.0 * (0.2 - (upper - lower)), min(impulses)


equal, _ = stack_boxes(1.0)
depth, impulse = stack_boxes(100.0)
print(
    f"equal masses: {equal:.1f} mm; mass ratio 100: {depth:.1f} mm, "
    f"impulse on the light box {impulse:.2f} N s of {100.0 * 10.0 * DT:.2f} N s"
)
sys.exit(0 if equal < 2.0 and depth > 15.0 and abs(impulse - 10.0) < 0.1 else "the behaviour has changed")
EOF
