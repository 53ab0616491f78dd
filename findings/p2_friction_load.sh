#!/usr/bin/env bash
# p2-es 1.2.3, a box of 1 kg on a plane with a friction coefficient of 0.5, pressed down by 90 N beside its weight of 10 N
# Behaviour: friction is bounded by mu m g of the body (5 N), not by mu times the force between the surfaces (50 N). A lateral
# force of 20 N accelerates the pressed box by 15 m/s^2, as if nothing pressed it. Without the load, 4 N holds and 6 N slides.
# Output: speed after 1 s: load 0 N, push 4 N: 0.00; load 0 N, push 6 N: 1.02; load 90 N, push 20 N: 15.02 m/s (Coulomb 0)

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm install --silent --no-audit --no-fund p2-es@1.2.3 > /dev/null
cat > run.mjs << 'END'
import * as p2 from "p2-es";

function simulate(load, push) {
  const world = new p2.World({ gravity: [0, -10] });
  world.solver.iterations = 50;
  world.solver.tolerance = 0;
  const material = new p2.Material();
  world.addContactMaterial(new p2.ContactMaterial(material, material, { friction: 0.5, restitution: 0 }));
  const plane = new p2.Plane(), shape = new p2.Box({ width: 1, height: 0.2 });
  plane.material = shape.material = material;
  const ground = new p2.Body({ mass: 0 }), box = new p2.Body({ mass: 1, position: [0, 0.1] });
  ground.addShape(plane);
  box.addShape(shape);
  box.damping = box.angularDamping = 0;
  world.addBody(ground);
  world.addBody(box);
  for (let i = 0; i < 240; i++) {
    box.applyForce([push, -load]);
    world.step(1 / 240);
  }
  return box.velocity[0];
}
const cases = [[0, 4], [0, 6], [90, 20]], speeds = cases.map(([load, push]) => simulate(load, push));
console.log("speed after 1 s: " + cases.map(([load, push], i) =>
  `load ${load} N, push ${push} N: ${speeds[i].toFixed(2)}`).join("; ") + " m/s (Coulomb 0)");
if (Math.abs(speeds[0]) > 0.01 || Math.abs(speeds[1] - 1) > 0.1 || Math.abs(speeds[2] - 15) > 0.1) {
  console.error("the behaviour has changed");
  process.exit(1);
}
END
node run.mjs
