#!/usr/bin/env bash
# biorbd 1.12.4, a soft contact of a bioMod file: a sphere of 0.1 m on the ground
# Behaviour: muStatic, muDynamic and muViscous of the file change nothing. A sphere that slides at 1 m/s gets 1.2 times the normal
# force as friction with (0.8, 0.5, 0) and with (0, 0, 0) in the file: the built-in 0.8, 0.7 and 0.5 remain. An object made in
# Python has its own coefficients (0.5) until addSoftContact copies it into a model (1.2). The normal force is 0 at touch and grows
# in both directions: a sphere 1 mm above the ground is pushed up with half the force of one 1 mm deep.
# Output: friction / normal force of both files 1.200; object 0.500, after addSoftContact 1.200; normal force 1 mm deep, at touch
# and 1 mm above 0.0861, 0.0000, 0.0472 N

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check biorbd==1.12.4 numpy==2.4.6 scipy==1.17.1
cd "$folder"
venv/bin/python - << 'END'
import sys

import biorbd
import numpy as np

MODEL = """version 4
gravity 0 0 -10
segment ball
 translations xyz
 rotations xyz
 mass 1
 inertia
  0.01 0 0
  0 0.01 0
  0 0 0.01
 com 0 0 0
endsegment
softcontact sphere
 parent ball
 type sphere
 position 0 0 0
 radius 0.1
 stiffness 10000
 damping 1
 muStatic {}
 muDynamic {}
 muViscous {}
endsoftcontact
"""


def wrench(contact, model, depth, speed):
    """Return friction along -x and normal force at the given depth [m] and speed along x [m/s]."""
    place, rate = np.zeros(6), np.zeros(6)
    place[2], rate[0] = 0.1 - depth, speed
    state = biorbd.GeneralizedCoordinates(place), biorbd.GeneralizedVelocity(rate)
    force = contact.computeForceAtOrigin(model, *state).to_array()[3:]
    return -float(force[0]), float(force[2])


def load(*coefficients):
    with open("ball.bioMod", "w") as file:
        file.write(MODEL.format(*coefficients))
    return biorbd.Model("ball.bioMod")


found = {}
for coefficients in (0.8, 0.5, 0), (0, 0, 0):
    model = load(*coefficients)
    friction, normal = wrench(model.softContact(0), model, 0.001, 1)
    found[coefficients] = friction / normal
    print(f"file {coefficients}: friction / normal force {found[coefficients]:.3f}")
sphere = biorbd.SoftContactSphere(biorbd.Vector3d(0, 0, 0), 0.1, 10000, 1, 0.8, 0.5, 0, "own", "ball", 6)
friction, normal = wrench(sphere, model, 0.001, 1)
own = friction / normal
model.addSoftContact(sphere)
friction, normal = wrench(model.softContact(1), model, 0.001, 1)
added = friction / normal
print(f"object with (0.8, 0.5, 0): {own:.3f}, the same after addSoftContact: {added:.3f}")
heights = [wrench(model.softContact(0), model, depth, 0)[1] for depth in (0.001, 0, -0.001)]
print("normal force 1 mm deep, at touch and 1 mm above: " + ", ".join(f"{x:.4f} N" for x in heights))
built_in = all(abs(x - 1.2) < 1e-3 for x in (*found.values(), added))
away = abs(heights[1]) < 1e-9 and 0.4 < heights[2] / heights[0] < 0.7
sys.exit(0 if built_in and abs(own - 0.5) < 1e-3 and away else "the behaviour has changed")
END
