#!/usr/bin/env bash
# OpenSim 4.6, SmoothSphereHalfSpaceForce with its default smoothing, a sphere of 1 kg and 0.1 m that comes to rest on the ground
# Behaviour: a contact that is a hundred times stiffer should sink in less. With a stiffness of 1e4 and 1e5 N/m^2 the sphere rests
# 35 mm and 7 mm deep, with 1e6 it hovers 1.0 mm above the ground, with 1e7 7.9 mm: the force depends on the size of the
# distance, and the smoothing factor only weakens it above the ground. hertz_smoothing 3000 in place of 300 leaves the sphere of 1e7
# 0.5 mm above the ground.
# Output: stiffness 1e+04: -35.43 mm, 1e+05: -7.06 mm, 1e+06: 1.04 mm, 1e+07: 7.93 mm

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check opensim==4.6 numpy==2.4.6
cd "$folder"
venv/bin/python - << 'END'
import sys

import numpy as np
import opensim

opensim.Logger.setLevelString("error")


def rest(stiffness, start, smoothing=300):
    """Return the height [mm] of the lowest point after 4 s, and the speed [mm/s]; start is the height [m] at first."""
    model = opensim.Model()
    model.setGravity(opensim.Vec3(0, -10, 0))
    zero, upwards = opensim.Vec3(0), opensim.Vec3(0, 0, np.pi / 2)
    ball = opensim.Body("ball", 1, zero, opensim.Inertia(0.004, 0.004, 0.004))
    joint = opensim.SliderJoint("up", model.getGround(), zero, upwards, ball, zero, upwards)
    sphere = opensim.ContactSphere(0.1, zero, ball, "sphere")
    ground = opensim.ContactHalfSpace(zero, opensim.Vec3(0, 0, -np.pi / 2), model.getGround(), "ground")
    force = opensim.SmoothSphereHalfSpaceForce("contact", sphere, ground)
    force.set_stiffness(stiffness)
    force.set_dissipation(2)
    force.set_hertz_smoothing(smoothing)
    model.addBody(ball)
    model.addJoint(joint)
    model.addContactGeometry(sphere)
    model.addContactGeometry(ground)
    model.addForce(force)
    state = model.initSystem()
    joint.getCoordinate().setValue(state, 0.1 + start)
    manager = opensim.Manager(model)
    manager.setIntegratorAccuracy(1e-6)
    state.setTime(0)
    manager.initialize(state)
    state = manager.integrate(4)
    coordinate = joint.getCoordinate()
    return 1000 * (coordinate.getValue(state) - 0.1), 1000 * coordinate.getSpeedValue(state)


same = True
for stiffness, expected in (1e4, -35.43), (1e5, -7.06), (1e6, 1.04), (1e7, 7.93):
    ends = [rest(stiffness, start) for start in (0.01, -0.002)]  # from above and from inside the ground
    print(f"stiffness {stiffness:.0e}: " + ", ".join(f"{height:.2f} mm" for height, speed in ends))
    same = same and all(abs(height - expected) < 0.05 and abs(speed) < 0.1 for height, speed in ends)
height = rest(1e7, 0.01, 3000)[0]
print(f"stiffness 1e+07, hertz_smoothing 3000: {height:.2f} mm")
sys.exit(0 if same and 0 < height < 2 else "the behaviour has changed")
END
