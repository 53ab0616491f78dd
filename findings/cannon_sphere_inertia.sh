#!/usr/bin/env bash
# cannon-es 0.20.0, a sphere of 1 kg and radius 0.1 m, and a box of 0.02 m x 0.3 m x 0.5 m turned by 15 degrees
# Behaviour: Body.updateMassProperties gives every body the moments of inertia of the box that bounds it along the world's axes
# when its first shape is added. The sphere's is 0.00667 kg m^2 in place of 0.00400, although Sphere.calculateLocalInertia
# returns 0.00400; the turned box has another inertia about its own axes than the same box not turned.
# Output: sphere 0.00667, its shape says 0.00400; box 0.02833 0.02087 0.00753, turned by 15 degrees 0.02736 0.02170 0.00934

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm install --silent --no-audit --no-fund cannon-es@0.20.0 > /dev/null
cat > run.mjs << 'END'
import * as CANNON from "cannon-es";

const list = (v) => [v.x, v.y, v.z];
const sphere = new CANNON.Sphere(0.1), ball = new CANNON.Body({ mass: 1, shape: sphere });
const target = new CANNON.Vec3();
sphere.calculateLocalInertia(1, target);
const makeBox = (angle) => new CANNON.Body({
  mass: 1, shape: new CANNON.Box(new CANNON.Vec3(0.01, 0.15, 0.25)),
  quaternion: new CANNON.Quaternion().setFromAxisAngle(new CANNON.Vec3(0, 1, 0), angle),
});
const [level, turned] = [0, Math.PI / 12].map((angle) => list(makeBox(angle).inertia));
const write = (x) => x.toFixed(5);
console.log(`sphere ${write(ball.inertia.x)}, its shape says ${write(target.x)}; ` +
  `box ${level.map(write).join(" ")}, turned by 15 degrees ${turned.map(write).join(" ")}`);
if (Math.abs(ball.inertia.x - 0.02 / 3) > 1e-6 || Math.abs(target.x - 0.004) > 1e-6 || Math.abs(level[1] - turned[1]) < 5e-4) {
  console.error("the behaviour has changed");
  process.exit(1);
}
END
node run.mjs
