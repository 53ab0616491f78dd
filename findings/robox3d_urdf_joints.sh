#!/usr/bin/env bash
# robox3d 0.1.0, load_urdf: a pendulum whose URDF joint has damping, friction, a limit, or that mimics another joint
# Behaviour: the limit of a revolute joint holds, and a continuous joint ignores its limits, as the URDF specification says. Damping
# of 5 N m s, friction of 20 N m (the weight is 4.9 N m) and mimic change nothing, and no warning names them. The documentation of
# load_urdf does not list what is left out.
# Output: angle after 1 s: plain 0.651, damping 0.651, friction 0.651, limit 0.301, continuous with a limit 2.960; mimic: 0.301 and
# 0.651 of two equal angles; warnings 0

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check robox3d==0.1.0 numpy==2.4.6
cd "$folder"
venv/bin/python - << 'END'
import logging
import sys
import warnings

import robox3d

INERTIAL = """<inertial><origin xyz="0.5 0 0"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>"""
ROBOT = """<robot name="robot"><link name="base"/><link name="one">{0}</link><link name="two">{0}</link>
<joint name="j1" type="{1}"><parent link="base"/><child link="one"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="{2}" effort="100" velocity="3"/>{3}</joint>
<joint name="j2" type="revolute"><parent link="base"/><child link="two"/><origin xyz="0 1 0"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="100" velocity="3"/>{4}</joint></robot>"""
messages = []
handler = logging.Handler()
handler.emit = messages.append
logging.getLogger().addHandler(handler)


def swing(kind="revolute", upper=2, first="", second=""):
    with open("robot.urdf", "w") as file:
        file.write(ROBOT.format(INERTIAL, kind, upper, first, second))
    world = robox3d.World()
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        robot = robox3d.load_urdf(world, "robot.urdf")
    messages.extend(seen)
    for _ in range(120):
        world.step(1 / 120)
    angles = [round(float(x), 3) for x in robot.positions()]
    world.destroy()
    return angles


found = {
    "plain": swing(),
    "damping": swing(first='<dynamics damping="5"/>'),
    "friction": swing(first='<dynamics friction="20"/>'),
    "limit": swing(upper=0.3),
    "continuous with a limit": swing("continuous", 0.3),
    "mimic": swing(upper=0.3, second='<mimic joint="j1"/>'),
}
for name, angles in found.items():
    print(f"{name}: {angles}")
print("warnings", len(messages))
same = found["plain"] == found["damping"] == found["friction"]
stops = abs(found["limit"][0] - 0.3) < 0.01 and found["continuous with a limit"][0] > 2
apart = abs(found["mimic"][1] - found["mimic"][0]) > 0.3
sys.exit(0 if same and stops and apart and not messages else "the behaviour has changed")
END
