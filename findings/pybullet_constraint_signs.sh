#!/usr/bin/env bash
# PyBullet 3.2.7, the sign of getConstraintState
# Behaviour: a body of 10 N hangs below a fixed body. The force of a point-to-point constraint is +10 N along z, and
# that of a fixed constraint -10 N, with the same parent and child.
# Output: JOINT_POINT2POINT 10.00 N, JOINT_FIXED -10.00 N

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
forces = {}
for kind in ("JOINT_POINT2POINT", "JOINT_FIXED"):
    pybullet.resetSimulation()
    pybullet.setGravity(0, 0, -10)
    shape = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.1)
    upper = pybullet.createMultiBody(0, shape, basePosition=[0, 0, 1])
    lower = pybullet.createMultiBody(1, shape, basePosition=[0, 0, 0.5])
    arms = [0, 0, -0.25], [0, 0, 0.25]
    constraint = pybullet.createConstraint(upper, -1, lower, -1, getattr(pybullet, kind), [0, 0, 0], *arms)
    for _ in range(240):
        pybullet.stepSimulation()
    forces[kind] = pybullet.getConstraintState(constraint)[2]
print(", ".join(f"{kind} {force:.2f} N" for kind, force in forces.items()))
is_same = abs(forces["JOINT_POINT2POINT"] - 10.0) < 0.01 and abs(forces["JOINT_FIXED"] + 10.0) < 0.01
sys.exit(0 if is_same else "the behaviour has changed")
EOF
