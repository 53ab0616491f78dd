#!/usr/bin/env bash
# Havok 1.3.14 (@babylonjs/havok), a rotor of 0.01 kg m^2 on a hinge whose velocity motor has the target 5 rad/s and the largest
# torque 0.1 N m, and nothing else
# Behaviour: stepped with 1/60 s it reaches 5 rad/s. With shorter steps its speed stays at that of the 19th step, 0.79 rad/s with
# 1/240 s and 0.19 rad/s with 1/1000 s, whatever the time: it is deactivated while its motor accelerates it, and still reports that
# speed. With ActivationControl.ALWAYS_ACTIVE it reaches 5 rad/s.
# Output: default: 1/60 s 5.00, 1/240 s 0.79, 1/1000 s 0.19 rad/s; always active: 5.00, 5.00, 5.00 rad/s

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm install --silent --no-audit --no-fund @babylonjs/havok@1.3.14 > /dev/null
cat > run.mjs << 'END'
import { readFileSync } from "node:fs";
import init from "@babylonjs/havok";

const H = await init({ wasmBinary: readFileSync("node_modules/@babylonjs/havok/lib/esm/HavokPhysics.wasm") });
const level = [0, 0, 0, 1];

function add(world, kind, size) {
  const [, body] = H.HP_Body_Create();
  H.HP_Body_SetShape(body, H.HP_Shape_CreateBox([0, 0, 0], level, [size, size, size])[1]);
  H.HP_Body_SetMotionType(body, kind);
  H.HP_World_AddBody(world, body, false);
  return body;
}

function measureSpeed(dt, active) { // rad/s after 2 s
  const [, world] = H.HP_World_Create();
  H.HP_World_SetGravity(world, [0, 0, 0]);
  const base = add(world, H.MotionType.STATIC, 0.01), rotor = add(world, H.MotionType.DYNAMIC, 0.2);
  H.HP_Body_SetMassProperties(rotor, [[0, 0, 0], 1.5, [1 / 150, 1 / 150, 1 / 150], level]);
  H.HP_Body_SetAngularDamping(rotor, 0);
  if (active) H.HP_Body_SetActivationControl(rotor, H.ActivationControl.ALWAYS_ACTIVE);
  const [, hinge] = H.HP_Constraint_Create(), axes = H.ConstraintAxis;
  H.HP_Constraint_SetParentBody(hinge, base);
  H.HP_Constraint_SetChildBody(hinge, rotor);
  H.HP_Constraint_SetAnchorInParent(hinge, [0, 0, 0], [1, 0, 0], [0, 1, 0]);
  H.HP_Constraint_SetAnchorInChild(hinge, [0, 0, 0], [1, 0, 0], [0, 1, 0]);
  for (const axis of ["LINEAR_X", "LINEAR_Y", "LINEAR_Z", "ANGULAR_Y", "ANGULAR_Z"]) {
    H.HP_Constraint_SetAxisMode(hinge, axes[axis], H.ConstraintAxisLimitMode.LOCKED);
  }
  H.HP_Constraint_SetAxisMotorType(hinge, axes.ANGULAR_X, H.ConstraintMotorType.VELOCITY);
  H.HP_Constraint_SetAxisMotorTarget(hinge, axes.ANGULAR_X, 5);
  H.HP_Constraint_SetAxisMotorMaxForce(hinge, axes.ANGULAR_X, 0.1);
  H.HP_Constraint_SetEnabled(hinge, 1);
  for (let i = 0; i < Math.round(2 / dt); i++) H.HP_World_Step(world, dt);
  return H.HP_Body_GetAngularVelocity(rotor)[1][0];
}

const rates = [60, 240, 1000], measure = (active) => rates.map((rate) => measureSpeed(1 / rate, active));
const shipped = measure(false), mended = measure(true), write = (x) => x.toFixed(2);
console.log(`default: ${rates.map((rate, i) => `1/${rate} s ${write(shipped[i])}`).join(", ")} rad/s; ` +
  `always active: ${mended.map(write).join(", ")} rad/s`);
if (Math.abs(shipped[0] - 5) > 0.1 || shipped[1] > 1 || shipped[2] > 0.3 || mended.some((x) => Math.abs(x - 5) > 0.1)) {
  console.error("the behaviour has changed");
  process.exit(1);
}
END
node run.mjs
