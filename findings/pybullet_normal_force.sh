#!/usr/bin/env bash
# PyBullet 3.2.7, the normal forces of getContactPoints with substeps
# Behaviour: a box of 10 N rests on a plane. The normal forces add up to 10 N with one substep per step, and to 10 N
# divided by the number of substeps otherwise.
# Output: 1 substep: 10.00 N, 4 substeps: 2.50 N, 10 substeps: 1.00 N

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 pybullet==3.2.7
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import pybullet

pybullet.connect(pybullet.DIRECT)
sums = {}
for n in (1, 4, 10):
    pybullet.resetSimulation()
    pybullet.setGravity(0, 0, -10)
    pybullet.setPhysicsEngineParameter(numSubSteps=n)
    pybullet.createMultiBody(0, pybullet.createCollisionShape(pybullet.GEOM_PLANE))
    shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[0.1, 0.1, 0.1])
    box = pybullet.createMultiBody(1, shape, basePosition=[0, 0, 0.1])
    for _ in range(240):
        pybullet.stepSimulation()
    sums[n] = sum(point[9] for point in pybullet.getContactPoints(box))
print(", ".join(f"{n} substep{'s' * (n > 1)}: {force:.2f} N" for n, force in sums.items()))
is_same = all(abs(force - 10.0 / n) < 0.01 for n, force in sums.items())
sys.exit(0 if is_same else "the behaviour has changed")
EOF
