#!/usr/bin/env bash
# nvidia-srl-usd-to-urdf 1.0.3, one robot in a USD stage in metres, one in centimetres (USD's default), one in grams
# Behaviour: a stage states its units as metersPerUnit and kilogramsPerUnit, a URDF is in metres and kilograms. usd_to_urdf writes the
# numbers of the stage: in centimetres the arm is 50 m long, its inertia 10,000 times too large beside a right mass, the slide 20 m
# long and the effort 300,000 N m; in grams the mass is 2,000 kg. Angles are converted. It ends with 0, and no line names a unit.
# Output: m: arm at 0.5, mass 2, ixx 0.01, effort 30, slide to 0.2; cm: 50, 2, 100, 300000, 20; g: 0.5, 2000, 10, 30000, 0.2

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check nvidia-srl-usd-to-urdf==1.0.3 numpy==1.26.4
cd "$folder"
cat > write.py << 'END'
from pxr import Gf, Usd, UsdGeom, UsdPhysics


def write(name, length, mass):
    stage = Usd.Stage.CreateNew(f"{name}.usda")
    UsdGeom.SetStageMetersPerUnit(stage, 1 / length)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1 / mass)
    UsdGeom.SetStageUpAxis(stage, "Z")
    root = UsdGeom.Xform.Define(stage, "/robot").GetPrim()
    stage.SetDefaultPrim(root)
    UsdPhysics.ArticulationRootAPI.Apply(root)
    for link, position in {"base": (0, 0, 0), "arm": (0, 0, 0.5), "slider": (0.3, 0, 0.5)}.items():
        body = UsdGeom.Xform.Define(stage, f"/robot/{link}")
        body.AddTranslateOp().Set(Gf.Vec3d(*position) * length)
        UsdPhysics.RigidBodyAPI.Apply(body.GetPrim())
        api = UsdPhysics.MassAPI.Apply(body.GetPrim())
        api.CreateMassAttr(2.0 * mass)
        api.CreateCenterOfMassAttr(Gf.Vec3f(0.1, 0, 0) * length)
        api.CreateDiagonalInertiaAttr(Gf.Vec3f(0.01, 0.02, 0.03) * mass * length**2)
        api.CreatePrincipalAxesAttr(Gf.Quatf(1))
        shape = UsdGeom.Cube.Define(stage, f"/robot/{link}/shape")
        shape.CreateSizeAttr(0.2 * length)
        UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
    hinge = UsdPhysics.RevoluteJoint.Define(stage, "/robot/hinge")
    slide = UsdPhysics.PrismaticJoint.Define(stage, "/robot/slide")
    joints = (hinge, "base", "arm", (0, 0, 0.5), "Y", -90, 45), (slide, "arm", "slider", (0.3, 0, 0), "X", 0, 0.2 * length)
    for joint, parent, child, position, axis, lower, upper in joints:
        joint.CreateBody0Rel().SetTargets([f"/robot/{parent}"])
        joint.CreateBody1Rel().SetTargets([f"/robot/{child}"])
        joint.CreateAxisAttr(axis)
        joint.CreateLocalPos0Attr(Gf.Vec3f(*position) * length)
        joint.CreateLocalPos1Attr(Gf.Vec3f(0))
        joint.CreateLocalRot0Attr(Gf.Quatf(1))
        joint.CreateLocalRot1Attr(Gf.Quatf(1))
        joint.CreateLowerLimitAttr(lower)
        joint.CreateUpperLimitAttr(upper)
    UsdPhysics.DriveAPI.Apply(hinge.GetPrim(), "angular").CreateMaxForceAttr(30.0 * mass * length**2)
    stage.GetRootLayer().Save()


write("m", 1, 1)
write("cm", 100, 1)
write("g", 1, 1000)
END
venv/bin/python write.py
for name in m cm g; do venv/bin/usd_to_urdf $name.usda -o $name.urdf > $name.log 2>&1; done
venv/bin/python - << 'END'
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

found = {}
for name in ("m", "cm", "g"):
    robot = ET.parse(f"{name}.urdf").getroot()
    hinge, slide = ([j for j in robot.findall("joint") if part in j.get("name")][0] for part in ("hinge", "slide"))
    arm = [link for link in robot.findall("link") if "arm" in link.get("name")][0].find("inertial")
    found[name] = tuple(
        float(x)
        for x in (hinge.find("origin").get("xyz").split()[2], arm.find("mass").get("value"),
                  arm.find("inertia").get("ixx"), hinge.find("limit").get("effort"), slide.find("limit").get("upper"))
    )
    print(f"{name}: arm at {found[name][0]:g}, mass {found[name][1]:g}, ixx {found[name][2]:g}, "
          f"effort {found[name][3]:g}, slide to {found[name][4]:g}")
named = any(word in Path(f"{n}.log").read_text().lower() for n in found for word in ("unit", "warn", "meter"))
expected = {"m": (0.5, 2, 0.01, 30, 0.2), "cm": (50, 2, 100, 300000, 20), "g": (0.5, 2000, 10, 30000, 0.2)}
same = all(abs(x - y) < 1e-4 * y for n in found for x, y in zip(found[n], expected[n]))
sys.exit(0 if same and not named else "the behaviour has changed")
END
