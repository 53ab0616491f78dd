#!/usr/bin/env bash
# cannon-es 0.20.0, a ball of 1 kg that cannot rotate, on a plane with a friction coefficient of 0.5
# Behaviour: the bound of friction is mu m g in newtons, but the solver compares it with an impulse, so that the ball resists a
# lateral force of mu m g / dt: 300 N in place of 5 N with 1/60 s, and twice as much with half of the step. A ball at
# 3 m/s, which friction stops within 0.9 m, stops within 4 mm.
# Output: limit 300 N (dt 1/60), 600 N (dt 1/120), Coulomb 5 N; a slide from 3 m/s ends after 0.004 m, Coulomb 0.900 m

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm install --silent --no-audit --no-fund cannon-es@0.20.0 > /dev/null
cat > run.mjs << 'END'
import * as CANNON from "cannon-es";

function simulate(dt, push, speed) {
  const world = new CANNON.World({ gravity: new CANNON.Vec3(0, 0, -10) });
  world.solver.iterations = 50;
  world.solver.tolerance = 0;
  const material = new CANNON.Material();
  world.addContactMaterial(new CANNON.ContactMaterial(material, material, { friction: 0.5, restitution: 0 }));
  world.addBody(new CANNON.Body({ mass: 0, material, shape: new CANNON.Plane() }));
  const ball = new CANNON.Body({ mass: 1, material, shape: new CANNON.Sphere(0.1), position: new CANNON.Vec3(0, 0, 0.1) });
  ball.linearDamping = ball.angularDamping = 0;
  ball.fixedRotation = true;
  ball.updateMassProperties();
  ball.velocity.x = speed;
  world.addBody(ball);
  for (let i = 0; i < Math.round(1 / dt); i++) {
    ball.applyForce(new CANNON.Vec3(push, 0, 0));
    world.step(dt);
  }
  return { x: ball.position.x, speed: ball.velocity.x };
}

function findLimit(dt) { // N: the largest lateral force at which the ball stays
  let low = 0, high = 1e5;
  for (let i = 0; i < 40; i++) {
    const push = (low + high) / 2;
    if (simulate(dt, push, 0).speed > 0.01) high = push; else low = push;
  }
  return low;
}
const limits = [1 / 60, 1 / 120].map(findLimit), slide = simulate(1 / 60, 0, 3).x;
console.log(`limit ${limits[0].toFixed(0)} N (dt 1/60), ${limits[1].toFixed(0)} N (dt 1/120), Coulomb 5 N; ` +
  `a slide from 3 m/s ends after ${slide.toFixed(3)} m, Coulomb 0.900 m`);
if (Math.abs(limits[0] - 300) > 1 || Math.abs(limits[1] - 600) > 1 || slide > 0.01) {
  console.error("the behaviour has changed");
  process.exit(1);
}
END
node run.mjs
