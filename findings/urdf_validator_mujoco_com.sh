#!/usr/bin/env bash
# urdf-validator 1.6.0 (mujoco 4.0.0), urdf_validate --deep on a URDF with a base of 10 kg and an arm of 2 + 1 kg
# Behaviour: the tool computes the centre of mass of the robot itself, and right: (0.173, 0, 0.231) m. With --deep it compares this
# with MuJoCo, whose reader welds the root link to the world and leaves its 10 kg out, and warns of a distance of 96 cm. The same
# robot with a massless link before the base has no warning: the two agree.
# Output: base is the root: warned, ours [0.173, 0.0, 0.231] MuJoCo [0.75, 0.0, 1.0]; base below a link without mass: not warned

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check urdf-validator==1.6.0 mujoco==4.0.0 numpy==2.4.6
cd "$folder"
mkdir reports
venv/bin/python - << 'END'
LINK = """<link name="{}"><inertial><origin xyz="{} 0 0"/><mass value="{}"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{}" type="revolute"><parent link="{}"/><child link="{}"/><origin xyz="{}"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="60" velocity="4"/></joint>"""
body = LINK.format("base", 0, 10) + LINK.format("upper", 0.5, 2) + LINK.format("lower", 0.25, 1)
body += JOINT.format("j1", "base", "upper", "0 0 1") + JOINT.format("j2", "upper", "lower", "1 0 0")
turn = '<link name="ground"/>' + JOINT.format("turn", "ground", "base", "0 0 0")
for name, text in (("root", body), ("below", body + turn)):
    open(f"{name}.urdf", "w").write(f'<robot name="robot">{text}</robot>')
END
for name in root below; do venv/bin/urdf_validate $name.urdf --deep --output-dir reports > $name.log 2>&1 || true; done
venv/bin/python - << 'END'
import sys
from pathlib import Path

logs = {name: Path(f"{name}.log").read_text() for name in ("root", "below")}
lines = {name: [line for line in text.splitlines() if "COM: ours" in line] for name, text in logs.items()}
for name in logs:
    print(name + ":", lines[name][0].split("COM:")[1].strip() if lines[name] else "not warned")
right = all("0.173" in text and "0.231" in text for text in logs.values())
same = right and lines["root"] and "[0.75, 0.0, 1.0]" in lines["root"][0] and not lines["below"]
sys.exit(0 if same else "the behaviour has changed")
END
