#!/usr/bin/env bash
# matter-js 0.20.0, a box of 60 x 20 px without rotation that slides on a static floor at 5 px a step
# Behaviour: with the friction coefficient 0.1 on both bodies and frictionStatic 0, Coulomb friction stops the box after 450 px
# (the weight is 0.278 px a step^2). Here it stops within two steps, after 7 px, and a coefficient of 0.5 hardly changes it.
# Output: distance with friction 0.1: 7 px, 0.5: 6 px; Coulomb 450 and 90 px

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm install --silent --no-audit --no-fund matter-js@0.20.0 > /dev/null
cat > run.mjs << 'END'
import Matter from "matter-js";

function measureDistance(friction) {
  const engine = Matter.Engine.create({ positionIterations: 50, velocityIterations: 50 });
  const floor = Matter.Bodies.rectangle(0, 50, 20000, 100, { isStatic: true, friction, restitution: 0 });
  const box = Matter.Bodies.rectangle(0, -10, 60, 20, {
    friction, frictionAir: 0, frictionStatic: 0, restitution: 0, inertia: Infinity,
  });
  Matter.Composite.add(engine.world, [floor, box]);
  for (let i = 0; i < 60; i++) Matter.Engine.update(engine, 1000 / 60); // comes to rest on the floor
  Matter.Body.setVelocity(box, { x: 5, y: 0 });
  const start = box.position.x;
  for (let i = 0; i < 240; i++) Matter.Engine.update(engine, 1000 / 60);
  return box.position.x - start;
}
const low = measureDistance(0.1), high = measureDistance(0.5);
console.log(`distance with friction 0.1: ${low.toFixed(0)} px, 0.5: ${high.toFixed(0)} px; Coulomb 450 and 90 px`);
if (low > 12 || high > 12) {
  console.error("the behaviour has changed");
  process.exit(1);
}
END
node run.mjs
