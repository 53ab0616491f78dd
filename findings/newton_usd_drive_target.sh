#!/usr/bin/env bash
# newton 1.8.0 (ModelBuilder.add_usd), a joint with a drive whose target position is outside the joint's limits
# Behaviour: the target is replaced by the middle of the limits, neither kept nor clamped, with no warning: with limits of -0.2 and
# 0.4 m, targets of 0.5 m and of -0.5 m both become 0.1 m; with -20 and 40 degrees, 90 degrees become 10. A target of 0, which is that
# of a drive that only damps a joint, becomes 30 degrees if the limits are 20 and 40. A target inside, or with one limit, is kept.
# Output: prismatic [-0.2, 0.4] m: 0.3 -> 0.3, 0.5 -> 0.1, -0.5 -> 0.1; [-0.2, inf] m: 0.5 -> 0.5; revolute [-20, 40] degrees: 30 ->
# 30, 90 -> 10; [20, 40] degrees: 0 -> 30; warnings 0

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check \
  numpy==2.4.6 newton==1.8.0 warp-lang==1.19.0 usd-core==26.11 newton-usd-schemas==0.6.0
cd "$folder"
export WARP_CACHE_PATH=$folder/warp
venv/bin/python - << 'END' 2> warnings.txt | grep '\->'
import math
import sys
import warnings

import newton
from pxr import Gf, Usd, UsdGeom, UsdPhysics

CASES = (
    ("Prismatic", -0.2, 0.4, 0.3, 0.3),
    ("Prismatic", -0.2, 0.4, 0.5, 0.1),
    ("Prismatic", -0.2, 0.4, -0.5, 0.1),
    ("Prismatic", -0.2, None, 0.5, 0.5),
    ("Revolute", -20, 40, 30, 30),
    ("Revolute", -20, 40, 90, 10),
    ("Revolute", 20, 40, 0, 30),
)
same = True
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    for kind, lower, upper, target, wanted in CASES:
        stage = Usd.Stage.CreateInMemory()
        UsdGeom.SetStageUpAxis(stage, "Z")
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        UsdPhysics.Scene.Define(stage, "/scene")
        UsdPhysics.ArticulationRootAPI.Apply(UsdGeom.Xform.Define(stage, "/robot").GetPrim())
        body = UsdGeom.Xform.Define(stage, "/robot/body").GetPrim()
        UsdPhysics.RigidBodyAPI.Apply(body)
        mass = UsdPhysics.MassAPI.Apply(body)
        mass.CreateMassAttr(1.0)
        mass.CreateDiagonalInertiaAttr(Gf.Vec3f(0.1, 0.1, 0.1))
        joint = getattr(UsdPhysics, f"{kind}Joint").Define(stage, "/robot/joint")
        joint.CreateBody1Rel().SetTargets(["/robot/body"])
        joint.CreateAxisAttr("Z")
        joint.CreateLowerLimitAttr(lower)
        if upper is not None:
            joint.CreateUpperLimitAttr(upper)
        drive = UsdPhysics.DriveAPI.Apply(joint.GetPrim(), "angular" if kind == "Revolute" else "linear")
        drive.CreateStiffnessAttr(10.0)
        drive.CreateTargetPositionAttr(target)
        builder = newton.ModelBuilder()
        builder.add_usd(stage)
        found = builder.finalize().joint_target_q.numpy()[0]
        found = math.degrees(found) if kind == "Revolute" else float(found)
        print(f"{kind.lower()} [{lower}, {'inf' if upper is None else upper}]: {target} -> {found:.3g}")
        same = same and abs(found - wanted) < 1e-4
told = [str(w.message) for w in caught if "target" in str(w.message).lower() or "limit" in str(w.message).lower()]
print(f"-> warnings {len(told)}")
sys.exit(0 if same and not told else "the behaviour has changed")
END
if grep -qi "target" warnings.txt; then
  cat warnings.txt >&2
  exit 1
fi
