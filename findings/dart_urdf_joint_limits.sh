#!/usr/bin/env bash
# DART 6.20.0, one URDF with limits of a revolute joint and a mimic joint
# Behaviour: DartLoader reads lower and upper, but does not enforce them: a pendulum with an upper limit of 1 rad that is
# released from the horizontal swings by pi. The mimic joint is a servo whose speed is limited by velocity, which does
# not limit other joints: with 3 rad/s it deviates by 2.95 rad from its equation, with 300 rad/s by
# 0.08 rad, and 0.1 rad at the start.
# Output: pendulum 3.14 rad of 1.00 rad; mimic error 2.95 rad with 3 rad/s, 0.08 rad with 300 rad/s

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 dartpy==6.20.0
cd "$folder"
venv/bin/python - << 'END' 2> /dev/null
import sys
from pathlib import Path

import dartpy

INERTIAL = (
    '<inertial><origin xyz="0.3 0 0"/><mass value="1"/>'
    '<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def step(bound, velocity, has_mimic):
    """Return the largest angle of the first joint and the largest error of the mimic joint within 1.5 s."""
    limit = f'<limit lower="{-bound}" upper="{bound}" effort="500" velocity="{velocity}"/>'
    second = (
        f'<link name="b">{INERTIAL}</link><joint name="j2" type="revolute"><parent link="a"/><child link="b"/>'
        f'<axis xyz="0 1 0"/>{limit}<mimic joint="j1" multiplier="2" offset="0.1"/></joint>'
    )
    Path("robot.urdf").write_text(
        f'<robot name="r"><link name="base">{INERTIAL}</link><link name="a">{INERTIAL}</link>'
        f'<joint name="j1" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>{limit}</joint>'
        f'{second if has_mimic else ""}</robot>'
    )
    robot = dartpy.utils.DartLoader().parseSkeleton(str(Path("robot.urdf").resolve()))
    robot.getJoint(0).setActuatorType(dartpy.dynamics.ActuatorType.LOCKED)  # The free joint of the base.
    world = dartpy.simulation.World()
    world.setTimeStep(0.001)
    world.addSkeleton(robot)
    largest = error = 0.0
    for _ in range(1500):
        world.step()
        q = robot.getPositions()
        largest = max(largest, abs(q[6]))
        error = max(error, abs(q[7] - 2.0 * q[6] - 0.1)) if has_mimic else 0.0
    return largest, error


swing = step(1.0, 300.0, False)[0]
slow, fast = step(9.0, 3.0, True)[1], step(9.0, 300.0, True)[1]
print(f"pendulum {swing:.2f} rad of 1.00 rad; mimic error {slow:.2f} rad with 3 rad/s, {fast:.2f} rad with 300 rad/s")
sys.exit(0 if swing > 3.0 and slow > 2.0 and fast < 0.11 else "the behaviour has changed")
END
