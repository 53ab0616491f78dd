#!/usr/bin/env bash
# Coal 3.0.3, penetration depths of two meshes
# Behaviour: two cubes of 1 m are triangle meshes (BVHModelOBBRSS). The upper one is shifted by 0.1 m and 0.05 m and
# overlaps the lower one by 5 mm. collide reports depths of single pairs of triangles, the largest 0.95 m. The signed
# distance of the same two cubes as boxes is -5 mm.
# Output: meshes: depths -0.95 to -0.005 m; boxes: -0.005 m

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 coal==3.0.3
cd "$folder"
venv/bin/python - << 'EOF'
import itertools
import sys

import coal
import numpy as np

corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
triangles = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
             (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]


def make_mesh():
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(triangles), len(corners))
    for triangle in triangles:
        mesh.addTriangle(*corners[list(triangle)])
    mesh.endModel()
    return mesh


def list_depths(lower, upper):
    request, result = coal.CollisionRequest(), coal.CollisionResult()
    request.num_max_contacts = 100
    place = coal.Transform3s(np.eye(3), np.array([0.1, 0.05, 0.995]))
    count = coal.collide(lower, coal.Transform3s(np.eye(3), np.zeros(3)), upper, place, request, result)
    return [result.getContact(i).penetration_depth for i in range(count)]


meshes = list_depths(make_mesh(), make_mesh())
(box,) = list_depths(coal.Box(1.0, 1.0, 1.0), coal.Box(1.0, 1.0, 1.0))
print(f"meshes: depths {min(meshes):.3g} to {max(meshes):.3g} m; boxes: {box:.3g} m")
sys.exit(0 if min(meshes) < -0.5 and abs(box + 0.005) < 1e-6 else "the behaviour has changed")
EOF
