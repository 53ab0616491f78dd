#!/usr/bin/env bash
# ovphysx 0.7.0 (PhysX on the processor), four boxes of 1, 2, 3 and 4 kg on top of each other, the lightest below
# Behaviour: rows of one read are not in the order of another. RIGID_BODY has the boxes from the last of the file to the
# first, CONTACT_SENSOR from the first to the last: paired by index, the forces belong to other bodies. Each group has a
# list of the paths of its rows, so pair rows by path.
# Output: masses [4.0, 3.0, 2.0, 1.0] kg; net contact forces [10, 20, 30, 40] N (10 m/s^2 times the mass of the body)

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 ovphysx==0.7.0.74035321 \
  ovstage==0.3.0.1791986420 warp-lang==1.19.0 physx-usd-schemas==25.11.2.72696984 newton-usd-schemas==0.6.0
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import numpy as np
import ovphysx
import ovstage
from ovphysx.samples.python_samples.schema_support import physx_schema_paths
from ovphysx.types import SimObjectType

SCENE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "World"
{
    def PhysicsScene "scene" ( prepend apiSchemas = ["PhysxSceneAPI"] )
    {
        vector3f physics:gravityDirection = (0, 0, -1)
        float physics:gravityMagnitude = 10
        bool physxScene:enableGPUDynamics = 0
        uniform token physxScene:broadphaseType = "MBP"
    }
    def Plane "ground" ( prepend apiSchemas = ["PhysicsCollisionAPI"] )
    {
        uniform token axis = "Z"
    }
BOXES
}
"""
BOX = """    def Cube "box_MASS" (
        prepend apiSchemas = [
            "PhysicsRigidBodyAPI", "PhysxRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsMassAPI", "PhysxContactReportAPI"
        ]
    )
    {
        double size = 1
        float physics:mass = MASS
        float physxContactReport:threshold = 0
        float physxRigidBody:sleepThreshold = 0
        double3 xformOp:translate = (0, 0, HEIGHT)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
"""
boxes = "".join(BOX.replace("MASS", str(i + 1)).replace("HEIGHT", str(i + 0.5)) for i in range(4))
with open("scene.usda", "w", encoding="utf-8") as file:
    file.write(SCENE.replace("BOXES", boxes))
paths = [*map(str, physx_schema_paths()), str(ovphysx.newton_schema_root())]
ovstage.population.register_usd_schemas(paths)
stage = ovstage.Stage("stack")
ovstage.population.open_usd(stage, "scene.usda", ordinal=1, domains=ovstage.PopulationDomain.ALL)
stage.advance_write_floor(ordinal=1).wait()
engine = ovphysx.PhysX()
engine.wait_task(engine.attach_ovstage(stage, read_ordinal=1))
for _ in range(120):
    engine.step_sync(1 / 120)


def read(kind, attribute):
    (group,) = engine.read_sync(kind, [attribute]).groups
    return np.array(group.tensors[0].numpy()).reshape(4, -1)


masses = read(SimObjectType.RIGID_BODY, "mass")[:, 0]
forces = read(SimObjectType.CONTACT_SENSOR, "netNormalContactForce")[:, 2]
print(f"masses {masses.tolist()} kg; net contact forces {forces.round().astype(int).tolist()} N")
same = masses.tolist() == [4, 3, 2, 1] and abs(forces / 10 - [1, 2, 3, 4]).max() < 0.1
sys.exit(0 if same else "the behaviour has changed")
EOF
