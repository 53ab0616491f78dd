#!/usr/bin/env bash
# MuJoCo 4.0.0 and Genesis 1.4.5 (genesis-world, gs.morphs.MJCF), springs of one MJCF
# Behaviour: Genesis reads the stiffness of a joint and drops springref: the spring rests where the joint is at the start (at ref), not
# at springref, whose default is 0. Stiffness of a fixed tendon, gravcomp of a body and the margin of a joint's range do nothing, either.
# Damping acts as in MuJoCo. The only message is that an actuator of the tendon's joint was not parsed, which the file does not have.
# Output, speed [rad/s] after one step of 2 ms, MuJoCo and Genesis: no spring 0.027 and 0.027; springref 0.5: 0.108 and 0.027; ref 0.7:
# -0.087 and 0.027; tendon 0.081 and 0.027; gravcomp 0.000 and 0.027; damping 0.026 and 0.026; margin 0.05: rests at 0.050 and 0.100 rad

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 mujoco==4.0.0 torch==2.13.0
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check genesis-world==1.4.5 mujoco==4.0.0
cd "$folder"
export HOME=$folder
venv/bin/python - << 'END' 2> /dev/null | grep '^joint\|^told'
import contextlib
import io
import sys

import genesis
import mujoco
import numpy as np

JOINTS = {
    "plain": "",
    "damping": 'damping="2"',
    "springref": 'stiffness="30" springref=".5"',
    "ref": 'stiffness="30" ref=".7"',
    "string": "",
    "gravcomp": "",
    "margin": 'range="-2 .1" margin=".05" limited="true"',
}
bodies = "".join(
    f'<body pos="{3 * i} 0 2"{" gravcomp=" + chr(34) + "1" + chr(34) if name == "gravcomp" else ""}><joint name="{name}" axis="0 1 0" '
    f'armature=".1" {text}/><inertial pos=".5 0 0" mass="1" diaginertia=".02 .02 .02"/></body>'
    for i, (name, text) in enumerate(JOINTS.items())
)
with open("model.xml", "w") as file:
    file.write(
        f'<mujoco><compiler angle="radian"/><option timestep="0.002"/><worldbody>{bodies}</worldbody><tendon><fixed name="t" '
        'stiffness="50" springlength=".2"><joint joint="string" coef="1"/></fixed></tendon></mujoco>'
    )
model = mujoco.MjModel.from_xml_path("model.xml")
data = mujoco.MjData(model)
said = io.StringIO()
with contextlib.redirect_stdout(said):
    genesis.init(backend=genesis.cpu, precision="64", logging_level="warning")
    scene = genesis.Scene(show_viewer=False, sim_options=genesis.options.SimOptions(dt=0.002))
    robot = scene.add_entity(genesis.morphs.MJCF(file="model.xml"))
    scene.build()
order = [robot.get_joint(name).dofs_idx_local[0] for name in JOINTS]
mujoco.mj_step(model, data)
scene.step()
first = data.qvel.copy(), robot.get_dofs_velocity().numpy()[order]
mujoco.mj_step(model, data, 1000)
for _ in range(1000):
    scene.step()
rest = data.qpos[-1], float(robot.get_qpos().numpy()[order[-1]])
for name, ours, theirs in zip(JOINTS, *first):
    print(f"joint {name}: {ours:.3f} and {theirs:.3f} rad/s after one step")
print(f"joint margin: rests at {rest[0]:.3f} and {rest[1]:.3f} rad")
text = said.getvalue().lower()
told = [word for word in ("springref", "tendon", "gravcomp", "margin", "actuator for joint `string`") if word in text]
print(f"told: {', '.join(told)}")
same = np.allclose(first[0], (0.02651, 0.02623, 0.10759, -0.0870, 0.10, 0, 0.02651), atol=3e-2) and abs(first[0][4]) > 0.05
same = same and np.allclose(first[1], (0.02651, 0.02623, 0.02651, 0.02651, 0.02651, 0.02651, 0.02651), atol=1e-4)
same = same and abs(rest[0] - 0.05) < 2e-3 and abs(rest[1] - 0.1) < 2e-3 and told == ["actuator for joint `string`"]
sys.exit(0 if same else "the behaviour has changed")
END
