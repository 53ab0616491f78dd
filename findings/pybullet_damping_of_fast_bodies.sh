#!/usr/bin/env bash
# PyBullet 3.2.7, the default damping of bodies (linearDamping = angularDamping = 0.04)
# Behaviour: the deceleration is 0.04 (v + |v| v), not 0.04 v. A ball of 1 kg that falls for 5 s has 15.1 m/s, close to its terminal
# speed, where 0.04 v would leave 44.5 m/s and no damping 49.1 m/s. A body that spins with 50 rad/s has 16.2 rad/s after 1 s, not 48.0.
# The shape and the mass do not matter, and linearDamping=0 removes both parts.
# Output: falls for 5 s: 15.11 m/s (0.04 v: 44.46), without damping 49.05; spins with 50 rad/s for 1 s: 16.21 rad/s (0.04 v: 48.04)

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 pybullet==3.2.7
cd "$folder"
venv/bin/python - << 'END'
import math
import sys

import pybullet

STEP = 0.001
pybullet.connect(pybullet.DIRECT)


def run(duration, gravity=0.0, spin=0.0, **damping):
    """Return the vertical speed [m/s] and the spin [rad/s] of a free ball after a time [s]."""
    pybullet.resetSimulation()
    pybullet.setTimeStep(STEP)
    pybullet.setGravity(0, 0, -gravity)
    ball = pybullet.createMultiBody(1, pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.1), basePosition=[0, 0, 500])
    if damping:
        pybullet.changeDynamics(ball, -1, **damping)
    pybullet.resetBaseVelocity(ball, [0, 0, 0], [0, 0, spin])
    for _ in range(round(duration / STEP)):
        pybullet.stepSimulation()
    linear, angular = pybullet.getBaseVelocity(ball)
    return -linear[2], angular[2]


fall = run(5.0, gravity=9.81)[0]
free = run(5.0, gravity=9.81, linearDamping=0, angularDamping=0)[0]
spin = run(1.0, spin=50.0)[1]
linear_fall, linear_spin = 9.81 / 0.04 * (1 - math.exp(-0.2)), 50 * math.exp(-0.04)
share = 50 / 51 * math.exp(-0.04)  # of w / (1 + w), which falls by exp(-0.04 t) if w' = -0.04 (w + w^2)
print(
    f"falls for 5 s: {fall:.2f} m/s (0.04 v: {linear_fall:.2f}), without damping {free:.2f}; "
    f"spins with 50 rad/s for 1 s: {spin:.2f} rad/s (0.04 v: {linear_spin:.2f})"
)
same = abs(fall - 15.11) < 0.02 and abs(free - 49.05) < 0.01 and abs(spin / (share / (1 - share)) - 1) < 2e-3
sys.exit(0 if same else "the behaviour has changed")
END
