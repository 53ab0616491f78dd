#!/usr/bin/env bash
# DART 6.20.0, the rotation of an inertial frame, read by SdfParser and by DartLoader (URDF)
# Behaviour: a link has the principal moments 0.02, 0.03 and 0.04 kg m^2 in an inertial frame that is turned by 90 degrees about x, so
# that the moment about y of the link is 0.04 kg m^2. DartLoader reads this. SdfParser reads the position of the frame and not its
# rotation: 0.03 kg m^2.
# Output: moment about y: URDF 0.040 kg m^2, SDF 0.030 kg m^2; centre of mass: 0.100 m, 0.100 m

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

POSE, TURN = ".1 0 0", "1.5707963267948966 0 0"
MOMENTS = {"ixx": 0.02, "iyy": 0.03, "izz": 0.04, "ixy": 0, "ixz": 0, "iyz": 0}
urdf = (
    f'<robot name="r"><link name="a"><inertial><origin xyz="{POSE}" rpy="{TURN}"/><mass value="1"/><inertia '
    + " ".join(f'{k}="{v}"' for k, v in MOMENTS.items())
    + "/></inertial></link></robot>"
)
sdf = (
    f'<sdf version="1.6"><model name="m"><link name="a"><inertial><pose>{POSE} {TURN}</pose><mass>1</mass><inertia>'
    + "".join(f"<{k}>{v}</{k}>" for k, v in MOMENTS.items())
    + "</inertia></inertial></link></model></sdf>"
)
Path("model.urdf").write_text(urdf)
Path("model.sdf").write_text(sdf)
found = {}
for name, skeleton in (
    ("URDF", dartpy.utils.DartLoader().parseSkeleton(str(Path("model.urdf").resolve()))),
    ("SDF", dartpy.utils.SdfParser.readSkeleton(str(Path("model.sdf").resolve()))),
):
    inertia = skeleton.getBodyNode(0).getInertia()
    found[name] = inertia.getMoment()[1, 1], inertia.getLocalCOM()[0]
    print(f"{name}: moment about y {found[name][0]:.3f} kg m^2, centre of mass {found[name][1]:.3f} m")
same = abs(found["URDF"][0] - 0.04) < 1e-9 and abs(found["SDF"][0] - 0.03) < 1e-9
same = same and all(abs(com - 0.1) < 1e-9 for _, com in found.values())
sys.exit(0 if same else "the behaviour has changed")
END
