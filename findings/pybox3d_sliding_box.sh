#!/usr/bin/env bash
# pybox3d 2026b0, a box of 1 x 0.5 x 1 m pushed along the ground with 3 m/s, friction 0.5 on both bodies, restitution 0
# Behaviour: Coulomb friction stops the box after 0.6 s and 0.92 m, flat on the ground. Here it starts to tumble in the first
# quarter of a second and still moves after three seconds. Neither the time step nor the iterations change this.
# Output: step 1/60, 4 iterations: x 5.30 m, speed 1.63 m/s, highest centre 0.55 m; step 1/1000: x 5.27 m, 1.55 m/s;
# 50 iterations: x 5.38 m, 1.63 m/s

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 pybox3d==2026b0
cd "$folder"
venv/bin/python - << 'EOF'
import sys

from pybox3d import RigidBody, Vec3, World


def slide(time_step, iterations):
    """Let the box rest for a second, push it, and return its path, last speed and highest centre after three seconds."""
    world = World(gravity=(0, -9.81, 0), solver_iterations=iterations)
    ground = RigidBody(Vec3(0, -0.5, 0), Vec3(50, 0.5, 50), mass=0.0)
    box = RigidBody(Vec3(0, 0.25, 0), Vec3(0.5, 0.25, 0.5), mass=2.0)
    for body in (ground, box):
        body.friction, body.restitution = 0.5, 0.0
    world.add_body(ground)
    box = world.add_body(box)
    for _ in range(round(1 / time_step)):
        world.step(time_step)
    box.wake()
    box.linear_velocity = Vec3(3, 0, 0)
    highest = 0.0
    for _ in range(round(3 / time_step)):
        world.step(time_step)
        highest = max(highest, box.position.y)
    return box.position.x, box.linear_velocity.x, highest


same = True
for time_step, iterations in ((1 / 60, 4), (1 / 1000, 4), (1 / 60, 50)):
    x, speed, highest = slide(time_step, iterations)
    print(f"step {time_step:.4f} s, {iterations} iterations: x {x:.2f} m, {speed:.2f} m/s, highest centre {highest:.2f} m")
    same = same and x > 3.0 and speed > 1.0 and highest > 0.4
sys.exit(0 if same else "the behaviour has changed")
EOF
