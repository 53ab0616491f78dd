#!/usr/bin/env bash
# Box3D (robox3d 0.1.0), the impulses of a box of 10 N at rest on a box, steps of 10 ms
# Behaviour: normalImpulse of b3ManifoldPoint is that of the last substep. totalNormalImpulse is not the impulse of the step, the weight
# times the time step, but twice that with each number of substeps. The sum over the points with 1, 2, 4 and 8 substeps:
# Output: normalImpulse 0.1000, 0.0500, 0.0250, 0.0125 N s; totalNormalImpulse 0.2000 N s each; weight times step 0.1000 N s

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check robox3d==0.1.0 numpy==2.4.6
cd "$folder"
venv/bin/python - << 'END' 2> /dev/null
import sys

from robox3d import World
from robox3d._ffi import ffi, lib

STEP, COUNTS = 0.01, (1, 2, 4, 8)  # s


def rest(substeps):
    """Return the sums of both impulses [N s] of a box that has come to rest."""
    world = World(gravity=(0.0, 0.0, -10.0), substeps=substeps)
    ground = world.create_body(position=(0.0, 0.0, -0.5), kind="static")
    ground.add_box((9.0, 9.0, 0.5))
    box = world.create_body(position=(0.0, 0.0, 0.5))
    box.add_box((0.5, 0.5, 0.5), density=1.0)
    for _ in range(200):
        world.step(STEP)
    capacity = lib.b3Body_GetContactCapacity(box.id)
    contacts = ffi.new("b3ContactData[]", capacity)
    count = lib.b3Body_GetContactData(box.id, contacts, capacity)
    manifolds = [contacts[i].manifolds[k] for i in range(count) for k in range(contacts[i].manifoldCount)]
    points = [manifold.points[i] for manifold in manifolds for i in range(manifold.pointCount)]
    return sum(p.normalImpulse for p in points), sum(p.totalNormalImpulse for p in points)


same = True
for substeps in COUNTS:
    last, total = rest(substeps)
    print(f"{substeps} substeps: normalImpulse {last:.4f}, totalNormalImpulse {total:.4f} of 0.1000 N s")
    same = same and abs(last - 0.1 / substeps) < 1e-4 and abs(total - 0.2) < 1e-4
sys.exit(0 if same else "the behaviour has changed")
END
