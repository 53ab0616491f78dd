#!/usr/bin/env bash
# FCL (python-fcl 0.7.0.11), the position of a contact of a sphere and a capsule
# Behaviour: a sphere and a capsule of radius 0.1 m have their axes 0.195 m apart, so that they overlap by 5 mm at
# 0.0975 m. The reported position is 5 mm from the axis of the capsule, about one radius inside. Depth and normal are
# right, and the position of two spheres is right.
# Output: capsule: position 0.005 m, depth 0.005 m; sphere: position 0.0975 m, depth 0.005 m

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 python-fcl==0.7.0.11
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import fcl
import numpy as np


def collide(shape):
    sphere = fcl.CollisionObject(fcl.Sphere(0.1), fcl.Transform(np.eye(3), np.array([0.195, 0.0, 0.0])))
    other = fcl.CollisionObject(shape, fcl.Transform())
    result = fcl.CollisionResult()
    fcl.collide(sphere, other, fcl.CollisionRequest(enable_contact=True), result)
    (contact,) = result.contacts
    return contact.pos[0], contact.penetration_depth


capsule, sphere = collide(fcl.Capsule(0.1, 0.4)), collide(fcl.Sphere(0.1))
print("capsule: position {:.3g} m, depth {:.3g} m; sphere: position {:.3g} m, depth {:.3g} m".format(*capsule, *sphere))
is_same = abs(capsule[0] - 0.005) < 1e-6 and abs(capsule[1] - 0.005) < 1e-6 and abs(sphere[0] - 0.0975) < 1e-6
sys.exit(0 if is_same else "the behaviour has changed")
EOF
