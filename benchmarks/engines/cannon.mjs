// cannon-es; a hinge is a HingeConstraint, a belt a kinematic body.
// Options: iterations, tolerance, quatNormalizeSkip, sleep, damping, frequency (of contacts, in 1/dt).
export async function build(C, scene, options) {
  const vec = (v) => new C.Vec3(...v), material = new C.Material(), moving = scene.bodies.filter((b) => b.mass > 0);
  const world = new C.World({ gravity: vec(scene.gravity) });
  if ("iterations" in options) Object.assign(world.solver, { iterations: options.iterations, tolerance: options.tolerance });
  if ("quatNormalizeSkip" in options) world.quatNormalizeSkip = options.quatNormalizeSkip;
  const values = { friction: scene.friction, restitution: scene.restitution ?? 0 };
  if ("frequency" in options) { // the stiffness that gives the heaviest body this frequency, at least the shipped one
    const heaviest = Math.max(...moving.map((b) => b.mass)), stiffness = heaviest * (2 * Math.PI * options.frequency / options.dt) ** 2;
    values.contactEquationStiffness = values.frictionEquationStiffness = Math.max(1e7, stiffness);
  }
  world.addContactMaterial(new C.ContactMaterial(material, material, values));
  const free = "damping" in options ? { linearDamping: options.damping, angularDamping: options.damping } : {};
  const ground = new C.Body({ mass: 0, material });
  if (moving.length < scene.bodies.length) ground.addShape(new C.Plane());
  world.addBody(ground);
  const bodies = moving.map((b) => {
    const [w, x, y, z] = b.quaternion, type = b.kinematic ? C.Body.KINEMATIC : C.Body.DYNAMIC;
    const shape = b.shape.kind === "box" ? new C.Box(vec(b.shape.size.map((s) => 0.5 * s))) : new C.Sphere(b.shape.radius);
    const start = { position: vec(b.position), quaternion: new C.Quaternion(x, y, z, w), velocity: vec(b.velocity) };
    const mass = b.kinematic ? 0 : b.mass;
    const body = new C.Body({ mass, type, shape, material, ...start, angularVelocity: vec(b.spin), ...free });
    if (options.sleep === false) body.allowSleep = false;
    body.inertia.set(...b.inertia); // it gives every body that of its bounding box
    body.invInertia.set(...b.inertia.map((x) => (mass ? 1 / x : 0)));
    body.updateInertiaWorld(true);
    world.addBody(body);
    return body;
  });
  for (const j of scene.joints ?? []) {
    const at = (i) => vec(j.anchor.map((x, k) => x - (i < 0 ? 0 : moving[i].position[k])));
    const ends = { pivotA: at(j.a), pivotB: at(j.b), axisA: vec(j.axis), axisB: vec(j.axis), collideConnected: false };
    const hinge = new C.HingeConstraint(bodies[j.a] ?? ground, bodies[j.b], ends);
    world.addConstraint(hinge);
    if (!j.motor) continue;
    hinge.enableMotor();
    hinge.setMotorSpeed(-j.motor[0]); // its speed is that of the first body
    hinge.setMotorMaxForce(j.motor[1]);
  }
  const list = (v) => [v.x, v.y, v.z];
  return {
    step: () => {
      moving.forEach((b, i) => b.force?.some((x) => x) && bodies[i].applyForce(vec(b.force)));
      world.step(options.dt);
    },
    state: () => bodies.map((b) => [...list(b.position), b.quaternion.w, ...list(b.quaternion), ...list(b.velocity), ...list(b.angularVelocity)]),
    properties: () => bodies.map((b) => [b.mass, ...list(b.inertia), values.friction, values.restitution]),
  };
}
