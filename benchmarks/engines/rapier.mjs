// Rapier (@dimforge/rapier3d-compat): half-spaces, no sleep.
const xyz = ([x, y, z]) => ({ x, y, z });
const turn = ([w, x, y, z]) => ({ w, x, y, z });

export async function build(module, scene, options) {
  const R = module.default ?? module;
  await R.init();
  const world = new R.World(xyz(scene.gravity));
  world.timestep = options.dt;
  world.numSolverIterations = options.iterations;
  const ground = world.createRigidBody(R.RigidBodyDesc.fixed());
  const shapes = {
    plane: (s) => new R.ColliderDesc(new R.HalfSpace(xyz(s.normal))).setTranslation(...s.normal.map((x) => x * s.offset)),
    sphere: (s) => R.ColliderDesc.ball(s.radius),
    box: (s) => R.ColliderDesc.cuboid(...s.size.map((x) => 0.5 * x)),
  };
  const bodies = scene.bodies.map((b) => {
    const shape = shapes[b.shape.kind](b.shape).setFriction(scene.friction);
    if (b.mass === 0) {
      world.createCollider(shape, ground);
      return null;
    }
    const made = world.createRigidBody(
      R.RigidBodyDesc.dynamic()
        .setTranslation(...b.position)
        .setRotation(turn(b.quaternion))
        .setLinvel(...b.velocity)
        .setAngvel(xyz(b.spin))
        .setCanSleep(false),
    );
    shape.setMassProperties(b.mass, xyz([0, 0, 0]), xyz(b.inertia), turn([1, 0, 0, 0]));
    world.createCollider(shape, made);
    return made;
  });
  const of = (body, k) => {
    const [x, q, v, s] = [body.translation(), body.rotation(), body.linvel(), body.angvel()];
    return [x.x, x.y, x.z, q.w, q.x, q.y, q.z, v.x, v.y, v.z, s.x, s.y, s.z];
  };
  return {
    step: () => world.step(),
    state: () => bodies.flatMap((body, i) => (body ? of(body) : scene.bodies[i].still)),
  };
}
