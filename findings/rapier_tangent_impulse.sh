#!/usr/bin/env bash
# Rapier (JavaScript, @dimforge/rapier3d-compat) 0.21.0, impulses of contacts in the world's contact manifolds
# Behaviour: a box of 1 kg with a friction coefficient of 0.5 sticks to a floor while gravity has a lateral component
# of 2 m/s^2. The normal impulses add up to weight times time step, and both tangential impulses of each point are 0.
# Output: lateral speed 0.0000 m/s, normal impulse 0.0981 N s, tangential impulse 0.0000 N s of 0.0200 N s

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm install --silent --no-audit --no-fund @dimforge/rapier3d-compat@0.21.0 > /dev/null
cat > run.mjs << 'END'
import RAPIER from "@dimforge/rapier3d-compat";

await RAPIER.init();
const world = new RAPIER.World({ x: 2.0, y: -9.81, z: 0.0 });
world.timestep = 0.01;
const floor = world.createCollider(RAPIER.ColliderDesc.cuboid(50, 1, 50).setTranslation(0, -1, 0).setFriction(0.5));
const body = world.createRigidBody(RAPIER.RigidBodyDesc.dynamic().setTranslation(0, 0.1, 0).setCanSleep(false));
const box = world.createCollider(RAPIER.ColliderDesc.cuboid(0.1, 0.1, 0.1).setMass(1.0).setFriction(0.5), body);
for (let i = 0; i < 100; i++) world.step();
let normal = 0.0, tangential = 0.0;
world.contactPair(floor, box, (manifold) => {
  for (let i = 0; i < manifold.numContacts(); i++) {
    normal += manifold.contactImpulse(i);
    tangential += Math.hypot(manifold.contactTangentImpulseX(i), manifold.contactTangentImpulseY(i));
  }
});
const speed = Math.abs(body.linvel().x);
console.log(`lateral speed ${speed.toFixed(4)} m/s, normal impulse ${normal.toFixed(4)} N s, ` +
  `tangential impulse ${tangential.toFixed(4)} N s of 0.0200 N s`);
if (speed > 1e-4 || Math.abs(normal - 0.0981) > 1e-4 || tangential > 1e-6) {
  console.error("the behaviour has changed");
  process.exit(1);
}
END
node run.mjs
