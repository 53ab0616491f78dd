// oimo (OimoPhysics 1); a hinge is a hinge joint, a belt a kinematic body; the ground is a box.
// Options: iterations, sleep.
export async function build(module, scene, options) {
  const O = module.default ?? module;
  const moving = scene.bodies.filter((b) => b.mass > 0);
  const more = "iterations" in options ? { iterations: options.iterations } : {};
  const world = new O.World({ timestep: options.dt, random: false, info: false, gravity: scene.gravity, ...more });
  const material = { friction: scene.friction, restitution: scene.restitution ?? 0 }; // A pair has the geometric mean.
  const ground = { type: "box", size: [200, 200, 2], pos: [0, 0, -1], move: false, density: 1, ...material };
  const fixed = world.add(moving.length < scene.bodies.length ? ground : { ...ground, size: [0.01, 0.01, 0.01], pos: [0, 0, 100] });
  const bodies = moving.map((b) => {
    const box = b.shape.kind === "box", size = box ? b.shape.size : [b.shape.radius];
    const volume = box ? size[0] * size[1] * size[2] : (4 / 3) * Math.PI * size[0] ** 3;
    const body = world.add({ type: box ? "box" : "sphere", size, pos: b.position, move: true, density: b.mass / volume, kinematic: b.kinematic, neverSleep: options.sleep === false, ...material });
    const [w, x, y, z] = b.quaternion;
    body.orientation.set(x, y, z, w);
    body.syncShapes();
    body.linearVelocity.set(...b.velocity);
    body.angularVelocity.set(...b.spin);
    return body;
  });
  for (const j of scene.joints) {
    const at = (i) => j.anchor.map((x, k) => x - (i < 0 ? [fixed.position.x, fixed.position.y, fixed.position.z] : moving[i].position)[k]);
    const motor = j.motor ? { motor: [j.motor[0], j.motor[1]] } : {};
    world.add({ type: "jointHinge", body1: bodies[j.a] ?? fixed, body2: bodies[j.b], pos1: at(j.a), pos2: at(j.b), axe1: j.axis, axe2: j.axis, ...motor });
  }
  let time = 0;
  const list = (v) => [v.x, v.y, v.z];
  return {
    step: () => {
      moving.forEach((b, i) => {
        if (b.force?.some((x) => x)) bodies[i].linearVelocity.addScaledVector(new O.Vec3(...b.force), options.dt / b.mass);
        if (!b.kinematic) return;
        time += options.dt; // A kinematic body has the velocity that follows from its places.
        bodies[i].setPosition(new O.Vec3(...b.position.map((x, k) => x + time * b.velocity[k])));
      });
      world.step();
    },
    state: () => bodies.map((b) => [...list(b.position), b.orientation.w, ...list(b.orientation), ...list(b.linearVelocity), ...list(b.angularVelocity)]),
    properties: () => bodies.map((b) => {
      const e = b.localInertia.elements, s = b.shapes;
      return [b.mass, e[0], e[4], e[8], s.friction, s.restitution];
    }),
  };
}
