#!/usr/bin/env bash
# urdf2mjcf 0.2.39 and its descendant urdf-to-mjcf 0.1.1 (mujoco 4.0.0), a URDF with a root link of 2 kg and an arm of 1 kg
# Behaviour: the inertial element of the root is lost, and MuJoCo weighs its shapes with 1,000 kg/m^3, the collision box and the
# visual box of 0.004 m^3 each: the root has 8 kg. Damping, friction and the limit of effort of the joint are lost, a
# continuous joint gets its lower and upper limits. A mimic joint is lost by urdf2mjcf. Neither warns. MuJoCo's own reader
# keeps all of these (and welds the root to the world, where its mass has no meaning).
# Output: mujoco: root 0 kg, damping 0.5, friction 0.2, effort 30, continuous joint free, 1 mimic; urdf2mjcf: root 8 kg,
# damping 0, friction 0, effort unlimited, continuous joint limited, 0 mimic; urdf-to-mjcf: the same, 1 mimic

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check mujoco==4.0.0 numpy==2.4.6 urdf2mjcf==0.2.39 \
  urdf-to-mjcf==0.1.1
cd "$folder"
cat > robot.urdf << 'END'
<robot name="robot">
  <link name="base"><inertial><mass value="2"/><inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><box size="0.2 0.2 0.1"/></geometry></visual>
    <collision><geometry><box size="0.2 0.2 0.1"/></geometry></collision></link>
  <link name="arm"><inertial><origin xyz="0 0 0.2"/><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="wheel"><inertial><origin xyz="0 0 0"/><mass value="0.1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="twin"><inertial><origin xyz="0 0 0"/><mass value="0.1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="j1" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="30" velocity="4"/><dynamics damping="0.5" friction="0.2"/></joint>
  <joint name="j2" type="continuous"><parent link="arm"/><child link="wheel"/><axis xyz="1 0 0"/>
    <limit lower="-0.5" upper="0.5" effort="10" velocity="4"/></joint>
  <joint name="j3" type="revolute"><parent link="arm"/><child link="twin"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" effort="10" velocity="4"/><mimic joint="j1" multiplier="2" offset="0"/></joint>
</robot>
END
mkdir a b
cp robot.urdf a
cp robot.urdf b
(cd a && ../venv/bin/urdf2mjcf robot.urdf --output robot.xml) > log 2>&1
(cd b && ../venv/bin/urdf-to-mjcf robot.urdf -o robot.xml) > log 2>&1
venv/bin/python - << 'END'
import sys
from pathlib import Path

import mujoco

found = {}
for name, path in (("mujoco", "robot.urdf"), ("urdf2mjcf", "a/robot.xml"), ("urdf-to-mjcf", next(Path("b").rglob("*.xml")))):
    model = mujoco.MjModel.from_xml_path(str(path))
    mass = sum(m for m, i in zip(model.body_mass, range(model.nbody)) if model.body(i).name in ("world", "base"))
    joint = model.joint("j1")
    effort = max(model.jnt_actfrcrange[joint.id, 1], *(model.actuator_forcerange[:, 1] if model.nu else [0.0]), 0.0)
    free = not model.jnt_limited[model.joint("j2").id]
    found[name] = (round(mass, 3), joint.damping[0], joint.frictionloss[0], effort, free, model.neq)
    print(f"{name}: root {mass:.3g} kg, damping {joint.damping[0]:g}, friction {joint.frictionloss[0]:g}, "
          f"effort {effort or 'unlimited'}, continuous joint {'free' if free else 'limited'}, {model.neq} mimic")
expected = {"mujoco": (0, 0.5, 0.2, 30, True, 1), "urdf2mjcf": (8, 0, 0, 0, False, 0), "urdf-to-mjcf": (8, 0, 0, 0, False, 1)}
sys.exit(0 if found == expected else "the behaviour has changed")
END
