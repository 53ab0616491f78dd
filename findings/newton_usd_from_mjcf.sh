#!/usr/bin/env bash
# newton 1.8.0 (mujoco 3.17.0), a MuJoCo model read directly and through the USD stage of mujoco-usd-converter 0.8.0
# Behaviour: the stage has all three rigid bodies, and without an equality newton reads them all. With a weld or connect
# between the free body and the arm, add_usd leaves the free body and the equality out (a warning names an unresolved target):
# 6 of 8 degrees of freedom and its mass are missing, and its shape stays fixed in the world. Limits of joints that keep
# MuJoCo's default solref (0.02, 1) become (1.387, 0.019) for the hinge and (8, 0.0079) for the slide, 70 and 400 times the
# time constant; the actuator force range of the slide is lost. add_mjcf keeps all of it.
# Output: mjcf: mass 4.8 kg, 8 degrees of freedom, limits 0.02, 0.02, force range 3; usd without equality: 4.8 kg, 8, limits
# 1.387, 8.0, force range 1e+06; usd with a weld: 4.0 kg, 2; usd with a connect: 4.0 kg, 2

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/convert"
"$folder/convert/bin/pip" install --quiet --no-compile --disable-pip-version-check mujoco-usd-converter==0.8.0
"${PYTHON:-python3}" -m venv "$folder/read"
"$folder/read/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 newton==1.8.0 newton-usd-schemas==0.6.0 \
    mujoco==3.17.0 mujoco-warp==3.17.0 usd-core warp-lang==1.19.0
cd "$folder"
for equality in none weld connect; do
    case $equality in
        none) element='' ;;
        weld) element='<weld body1="hand" body2="ball"/>' ;;
        connect) element='<connect body1="hand" body2="ball" anchor="0 0 0"/>' ;;
    esac
    cat > $equality.xml << EOF
<mujoco model="$equality"><worldbody>
  <body name="arm" pos="0 0 .5">
    <joint name="turn" type="hinge" axis="0 1 0" range="-30 40"/><geom type="box" size=".1 .1 .1" mass="2"/>
    <body name="hand" pos=".4 0 0">
      <joint name="reach" type="slide" axis="1 0 0" range="-.1 .2" actuatorfrcrange="-3 3"/>
      <geom type="box" size=".1 .1 .1" mass="2"/>
    </body>
  </body>
  <body name="ball" pos="2 0 .2"><freejoint/><geom type="sphere" size=".2" mass=".8"/></body>
</worldbody><equality>$element</equality></mujoco>
EOF
done
convert/bin/python - << 'EOF'
from mujoco_usd_converter import Converter

for name in ("none", "weld", "connect"):
    Converter().convert(f"{name}.xml", name)
EOF
WARP_CACHE_PATH="$folder/kernels" read/bin/python - << 'EOF'
import sys
import warnings

warnings.simplefilter("ignore")
import newton
import warp

warp.config.quiet = True


def read(kind, name):
    """Return the total mass, degrees of freedom, time constants of two limits and the force range of the slide."""
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.add_mjcf(f"{name}.xml") if kind == "mjcf" else builder.add_usd(f"{name}/{name}.usda")
    model = newton.solvers.SolverMuJoCo(builder.finalize(device="cpu"), use_mujoco_cpu=True).mj_model
    limits = [round(float(x), 3) for x in model.jnt_solref[:2, 0]]
    return round(float(model.body_mass.sum()), 3), model.nv, limits, float(model.jnt_actfrcrange[1, 1])


cases = ("mjcf", "weld"), ("usd", "none"), ("usd", "weld"), ("usd", "connect")
found = {case: read(*case) for case in cases}
for (kind, name), (mass, nv, limits, force) in found.items():
    print(f"{kind}, equality {name}: {mass} kg, {nv} degrees of freedom, limits {limits} s, force range {force:g} N")
same = (
    found["mjcf", "weld"] == (4.8, 8, [0.02, 0.02], 3.0)
    and found["usd", "none"][:2] == (4.8, 8)
    and min(found["usd", "none"][2]) > 1.0
    and found["usd", "none"][3] > 1e5
    and all(found["usd", name][:2] == (4.0, 2) for name in ("weld", "connect"))
)
sys.exit(0 if same else "the behaviour has changed")
EOF
