#!/usr/bin/env bash
# motrixsim 0.10.1 beside MuJoCo 4.0.0, an MJCF slide joint of 1 kg that a position servo holds against gravity
# Behaviour: a limit of 4.905 N, half of the weight, lets the mass fall with half of gravity. Written as forcerange of the actuator
# motrixsim keeps it; written as actuatorfrcrange of the joint, where MuJoCo's reader of URDF writes the effort, it is not used:
# the servo holds. Other attributes that motrixsim does not support (density, viscosity) are named in a warning, this is not.
# Output: height after 1 s: forcerange: mujoco -2.48, motrixsim -2.47; actuatorfrcrange: mujoco -2.48, motrixsim -0.01; warned False

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check motrixsim==0.10.1 mujoco==4.0.0 numpy==2.4.6
cd "$folder"
cat > run.py << 'END'
import sys

MODEL = """<mujoco><option timestep="0.002" gravity="0 0 -9.81"/><worldbody><body pos="0 0 1">
<joint name="j" type="slide" axis="0 0 1" {}/><geom type="sphere" size="0.05" mass="1"/></body></worldbody>
<actuator><position joint="j" kp="1000" kv="100" {}/></actuator></mujoco>"""
engine, attribute = sys.argv[1:]
limit = attribute + '="-4.905 4.905"'
text = MODEL.format(*((limit, "") if attribute == "actuatorfrcrange" else ("", limit)))
if engine == "mujoco":
    import mujoco

    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 500)
    print(data.qpos[0])
else:
    import motrixsim

    model = motrixsim.load_mjcf_str(text)
    data = motrixsim.SceneData(model)
    for _ in range(500):
        motrixsim.step(model, data)
    print(data.dof_pos[0])
END
for attribute in forcerange actuatorfrcrange; do
  for engine in mujoco motrixsim; do venv/bin/python run.py $engine $attribute > "$engine-$attribute" 2> log || exit 1; done
done
cat log >> motrixsim-actuatorfrcrange
venv/bin/python - << 'END'
import sys
from pathlib import Path


def read(name):
    lines = [line for line in Path(name).read_text().splitlines() if line.strip().lstrip("-").replace(".", "").isdigit()]
    return float(lines[-1])


found = {(e, a): read(f"{e}-{a}") for a in ("forcerange", "actuatorfrcrange") for e in ("mujoco", "motrixsim")}
warned = "actuatorfrcrange" in Path("log").read_text() or "actuator_frc" in Path("log").read_text()
for attribute in ("forcerange", "actuatorfrcrange"):
    print(f"{attribute}: mujoco {found['mujoco', attribute]:.2f}, motrixsim {found['motrixsim', attribute]:.2f}")
print("warned", warned)
falls = all(abs(x + 2.475) < 0.02 for key, x in found.items() if key != ("motrixsim", "actuatorfrcrange"))
sys.exit(0 if falls and abs(found["motrixsim", "actuatorfrcrange"]) < 0.02 and not warned else "the behaviour has changed")
END
