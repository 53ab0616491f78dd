#!/usr/bin/env bash
# pymunk 7.3.1, a ball of 2 kg at 3 m/s that meets a floor without bounce, and a box of 2 kg at rest under 10 m/s^2
# Behaviour: Body.kinetic_energy is m v^2, 18 J for the ball, twice its kinetic energy of 9 J. Arbiter.total_ke, the
# energy that a collision loses, has the same factor (18 J). For a box at rest on two points it says 0.0694 J in each step
# of 1/60 s, 2.5 times the 0.0278 J that the impulses take out: it adds up the points as if each acted alone.
# Output: ball: kinetic energy 18.0 of 9.0 J, lost 18.0 of 9.0 J; box at rest: lost 0.0694 of 0.0278 J a step

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check pymunk==7.3.1
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import pymunk


def run(shape, body, gravity, steps, dt):
    space, lost = pymunk.Space(), []
    space.gravity = (0, -gravity)
    space.add(pymunk.Segment(space.static_body, (-10, 0), (10, 0), 0), body, shape)
    space.on_collision(post_solve=lambda arbiter, space, data: lost.append(arbiter.total_ke))
    for _ in range(steps):
        space.step(dt)
    return lost


ball = pymunk.Body(2, 1)
ball.position, ball.velocity = (0, 1), (0, -3)
told = ball.kinetic_energy
lost = max(run(pymunk.Circle(ball, 0.5), ball, 0, 60, 0.01))
box = pymunk.Body(2, pymunk.moment_for_box(2, (1, 1)))
box.position = (0, 0.5)
resting = run(pymunk.Poly.create_box(box, (1, 1)), box, 10, 600, 1 / 60)[-1]
taken = 0.5 * 2 * (10 / 60) ** 2
print(f"ball: kinetic energy {told} of 9.0 J, lost {lost} of 9.0 J; box at rest: lost {resting:.4f} of {taken:.4f} J a step")
sys.exit(0 if told == 18 and abs(lost - 18) < 1e-9 and 2.4 < resting / taken < 2.6 else "the behaviour has changed")
EOF
