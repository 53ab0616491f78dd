#!/usr/bin/env bash
# Coal 3.0.3, contact patches of a cylinder on a box
# Behaviour: computeContactPatch returns one point for an upright cylinder on a box, and 12 points for the same two
# shapes in the other order. A cone on a box has one point, too. A box on a box has four points.
# Output: cylinder, box: 1; box, cylinder: 12; box, box: 4

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 coal==3.0.3
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import coal
import numpy as np

DEPTH = 0.0005  # m


def count_points(first, first_height, second, second_height):
    places = [coal.Transform3s(np.eye(3), np.array([0.0, 0.0, z])) for z in (first_height, second_height)]
    result, request = coal.CollisionResult(), coal.ContactPatchRequest()
    coal.collide(first, places[0], second, places[1], coal.CollisionRequest(), result)
    patches = coal.ContactPatchResult(request)
    coal.computeContactPatch(first, places[0], second, places[1], result, request, patches)
    return patches.getContactPatch(0).size()


cylinder, floor, box = coal.Cylinder(0.1, 0.2), coal.Box(1.0, 1.0, 1.0), coal.Box(0.2, 0.2, 0.2)
height = 0.1 - DEPTH
counts = (
    count_points(cylinder, height, floor, -0.5),
    count_points(floor, -0.5, cylinder, height),
    count_points(box, height, floor, -0.5),
)
print("cylinder, box: {}; box, cylinder: {}; box, box: {}".format(*counts))
sys.exit(0 if counts == (1, 12, 4) else "the behaviour has changed")
EOF
