// Rapier (@dimforge/rapier3d-compat): half-spaces; a hinge is a revolute joint, a belt a kinematic body.
// Options: iterations (substeps), inner (iterations of each), sleep, allowedError, frequency (of contacts, in 1/dt).
const xyz = ([x, y, z]) => ({ x, y, z });
const turn = ([w, x, y, z]) => ({ w, x, y, z });
const minus = (a, b) => xyz(a.map((x, i) => x - b[i]));

export async function build(module, scene, options) {
  const R = module.default ?? module;
  await R.init();
  const world = new R.World(xyz(scene.gravity));
  world.timestep = options.dt;
  if (options.iterations) world.numSolverIterations = options.iterations;
  if (options.inner) world.integrationParameters.numInternalPgsIterations = options.inner;
  if (options.allowedError) world.integrationParameters.normalizedAllowedLinearError = options.allowedError;
  if (options.frequency) world.integrationParameters.contact_natural_frequency = options.frequency / options.dt;
  const ground = world.createRigidBody(R.RigidBodyDesc.fixed());
  const shapes = {
    plane: (s) => new R.ColliderDesc(new R.HalfSpace(xyz(s.normal))).setTranslation(...s.normal.map((x) => x * s.offset)),
    sphere: (s) => R.ColliderDesc.ball(s.radius),
    box: (s) => R.ColliderDesc.cuboid(...s.size.map((x) => 0.5 * x)),
  };
  const moving = scene.bodies.filter((b) => b.mass > 0), colliders = [];
  const make = (b) => {
    const shape = shapes[b.shape.kind](b.shape).setFriction(scene.friction).setRestitution(scene.restitution ?? 0);
    if (b.mass === 0) return world.createCollider(shape, ground);
    const kind = b.kinematic ? R.RigidBodyDesc.kinematicVelocityBased() : R.RigidBodyDesc.dynamic();
    kind.setTranslation(...b.position).setRotation(turn(b.quaternion)).setLinvel(...b.velocity).setAngvel(xyz(b.spin));
    const made = world.createRigidBody(options.sleep === false ? kind.setCanSleep(false) : kind);
    shape.setMassProperties(b.mass, xyz([0, 0, 0]), xyz(b.inertia), turn([1, 0, 0, 0]));
    colliders.push(world.createCollider(shape, made));
    if (b.force?.some((x) => x)) made.addForce(xyz(b.force), true);
    return made;
  };
  scene.bodies.filter((b) => b.mass === 0).forEach(make);
  const bodies = moving.map(make), zero = [0, 0, 0];
  for (const j of scene.joints ?? []) {
    const [first, second] = [j.a, j.b].map((i) => minus(j.anchor, i < 0 ? zero : moving[i].position));
    const joint = world.createImpulseJoint(R.JointData.revolute(first, second, xyz(j.axis)), bodies[j.a] ?? ground, bodies[j.b], true);
    joint.setContactsEnabled(false);
    if (j.motor) { joint.configureMotorModel(R.MotorModel.ForceBased); joint.configureMotorVelocity(j.motor[0], 100 * j.motor[1] / j.motor[0]); joint.setMotorMaxForce(j.motor[1]); }
  }
  const list = (v) => [v.x, v.y, v.z];
  return {
    step: () => world.step(),
    state: () => bodies.map((b) => [...list(b.translation()), b.rotation().w, ...list(b.rotation()), ...list(b.linvel()), ...list(b.angvel())]),
    properties: () => bodies.map((b, i) => [b.mass(), ...list(b.principalInertia()), colliders[i].friction(), colliders[i].restitution()]),
    close: () => world.free(),
  };
}
