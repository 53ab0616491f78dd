// ammo.js (Bullet 2); the friction of a pair is a product, and so is its restitution. A belt is a kinematic body.
// Options: margin (m, of boxes), sleep, damping. The memory of old scenes is not returned.
let A = null;

export async function build(module, scene, options) {
  A ??= await (typeof module.default === "function" ? module.default() : module.default);
  const vec = (v) => new A.btVector3(...v), moving = scene.bodies.filter((b) => b.mass > 0);
  const configuration = new A.btDefaultCollisionConfiguration(), solver = new A.btSequentialImpulseConstraintSolver();
  const pairs = new A.btCollisionDispatcher(configuration);
  const world = new A.btDiscreteDynamicsWorld(pairs, new A.btDbvtBroadphase(), solver, configuration);
  world.setGravity(vec(scene.gravity));
  const made = [];
  const add = (shape, mass, b) => {
    const transform = new A.btTransform(), [w, x, y, z] = b?.quaternion ?? [1, 0, 0, 0];
    transform.setIdentity();
    transform.setOrigin(vec(b?.position ?? [0, 0, 0]));
    transform.setRotation(new A.btQuaternion(x, y, z, w));
    const state = new A.btDefaultMotionState(transform), inertia = vec(mass ? b.inertia : [0, 0, 0]);
    const body = new A.btRigidBody(new A.btRigidBodyConstructionInfo(mass, state, shape, inertia));
    body.setFriction(Math.sqrt(scene.friction));
    body.setRestitution(Math.sqrt(scene.restitution ?? 0));
    if (b) [body.setLinearVelocity(vec(b.velocity)), body.setAngularVelocity(vec(b.spin))];
    if (mass && "damping" in options) body.setDamping(options.damping, options.damping);
    if (mass && options.sleep === false) body.setActivationState(4);
    if (b?.kinematic) [body.setCollisionFlags(2), body.setActivationState(4)];
    world.addRigidBody(body);
    made.unshift(body, state, shape);
    return body;
  };
  if (moving.length < scene.bodies.length) add(new A.btStaticPlaneShape(vec([0, 0, 1]), 0), 0, null);
  const bodies = moving.map((b) => {
    const box = b.shape.kind === "box";
    const shape = box ? new A.btBoxShape(vec(b.shape.size.map((s) => 0.5 * s))) : new A.btSphereShape(b.shape.radius);
    if (box && "margin" in options) shape.setMargin(options.margin);
    return add(shape, b.kinematic ? 0 : b.mass, b);
  });
  const fixed = scene.joints?.length ? add(new A.btSphereShape(0.001), 0, null) : null;
  for (const j of scene.joints ?? []) {
    const at = (i) => vec(j.anchor.map((x, k) => x - (i < 0 ? 0 : moving[i].position[k]))), axis = vec(j.axis);
    const hinge = new A.btHingeConstraint(bodies[j.a] ?? fixed, bodies[j.b], at(j.a), at(j.b), axis, axis, false);
    if (j.motor) hinge.enableAngularMotor(true, -j.motor[0], j.motor[1] * options.dt); // of the first body
    world.addConstraint(hinge, true);
  }
  const place = new A.btTransform();
  place.setIdentity();
  let time = 0;
  const list = (v) => [v.x(), v.y(), v.z()];
  return {
    step: () => {
      time += options.dt;
      moving.forEach((b, i) => {
        if (b.force?.some((x) => x)) bodies[i].applyCentralForce(vec(b.force));
        if (!b.kinematic) return;
        place.setOrigin(vec(b.position.map((x, k) => x + time * b.velocity[k])));
        bodies[i].getMotionState().setWorldTransform(place); // the body's velocity follows from its places
      });
      world.stepSimulation(options.dt, 0);
    },
    state: () => bodies.map((b) => {
      const t = b.getWorldTransform(), q = t.getRotation();
      return [...list(t.getOrigin()), q.w(), ...list(q), ...list(b.getLinearVelocity()), ...list(b.getAngularVelocity())];
    }),
    properties: () => bodies.map(() => [null, null, null, null, null, null]), // not in this build
    close: () => [...made, world, pairs, solver, configuration].forEach((x) => A.destroy(x)),
  };
}
