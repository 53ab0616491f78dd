#!/usr/bin/env bash
# DART 6.20.0 (dartpy), its new solvers of friction cones with default options, five boxes of 0.5 m on top of each other
# Behaviour: 200 steps of 5 ms from rest. With equal masses Dantzig's pivots keep the top at 2.250 m and NSGS at 2.250 m;
# FBF lets it sink to 2.206 m. If the top box has 100 times the mass, Dantzig keeps 2.250 m, NSGS is at 2.129 m, and with
# FBF the boxes fall through the floor (top 0.31 m). FBF's statistics count no failed solve: all are "accepted at cap".
# Output: 1: dantzig 2.250, nsgs 2.250 (failed 0), fbf 2.206 (failed 0, at cap 200); 100: dantzig 2.250, nsgs 2.129
# (failed 76), fbf 0.310 (failed 0, at cap 200)

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 dartpy==6.20.0
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import dartpy
import numpy as np


def add_box(world, name, size, height, mass, mobile):
    skeleton = dartpy.dynamics.Skeleton(name)
    body = skeleton.createFreeJointAndBodyNodePair()[1]
    shape = dartpy.dynamics.BoxShape(size)
    node = body.createShapeNode(shape)
    node.createCollisionAspect()
    node.createDynamicsAspect().setFrictionCoeff(0.5)
    inertia = dartpy.dynamics.Inertia()
    inertia.setMass(mass)
    inertia.setMoment(shape.computeInertia(mass))
    body.setInertia(inertia)
    skeleton.setMobile(mobile)
    skeleton.setPositions(np.array([0, 0, 0, 0, 0, height]))
    world.addSkeleton(skeleton)
    return skeleton


def run(solver, top):
    world = dartpy.simulation.World()
    world.setTimeStep(0.005)
    world.setGravity([0, 0, -10])
    if solver is not None:
        world.getConstraintSolver().setBoxedLcpSolver(solver)
    add_box(world, "floor", [20, 20, 1], -0.5, 1, False)
    boxes = [add_box(world, f"box {i}", [0.5] * 3, 0.25 + 0.5 * i, 1 if i < 4 else top, True) for i in range(5)]
    for _ in range(200):
        world.step()
    return boxes[-1].getPositions()[5]


heights, failed = {}, {}
for top in (1, 100):
    told = [f"dantzig {run(None, top):.3f}"]
    for name in ("Nsgs", "Fbf"):
        solver = getattr(dartpy.constraint, f"{name}FrictionSolver")()
        heights[name, top] = run(solver, top)
        counts = solver.getStats()
        failed[name, top] = counts.numFailed
        told.append(f"{name.lower()} {heights[name, top]:.3f} (failed {counts.numFailed}, at cap {counts.numAcceptedAtCap})")
    print(f"{top}: " + ", ".join(told))
same = heights["Fbf", 1] < 2.22 and heights["Fbf", 100] < 1 and not failed["Fbf", 1] and not failed["Fbf", 100]
sys.exit(0 if same and heights["Nsgs", 100] < 2.2 else "the behaviour has changed")
EOF
