// Jolt (jolt-physics): planes, boxes and spheres of its own, no sleep, no damping.
const STILL = 0; // object layers: static bodies, and moving bodies
const MOVING = 1;

export async function build(module, scene, options) {
  const J = await module.default();
  const vec = (v) => new J.Vec3(...v);
  const place = (v) => new J.RVec3(...v);
  const settings = new J.JoltSettings();
  const pairs = new J.ObjectLayerPairFilterTable(2);
  pairs.EnableCollision(STILL, MOVING);
  pairs.EnableCollision(MOVING, MOVING);
  const layers = new J.BroadPhaseLayerInterfaceTable(2, 2);
  [STILL, MOVING].forEach((k) => layers.MapObjectToBroadPhaseLayer(k, new J.BroadPhaseLayer(k)));
  settings.mObjectLayerPairFilter = pairs;
  settings.mBroadPhaseLayerInterface = layers;
  settings.mObjectVsBroadPhaseLayerFilter = new J.ObjectVsBroadPhaseLayerFilterTable(layers, 2, pairs, 2);
  const all = new J.JoltInterface(settings);
  const system = all.GetPhysicsSystem();
  const interface_ = system.GetBodyInterface();
  system.SetGravity(vec(scene.gravity));
  const physics = system.GetPhysicsSettings();
  physics.mNumVelocitySteps = options.sweeps;
  system.SetPhysicsSettings(physics);
  const shapes = {
    plane: (s) => new J.PlaneShape(new J.Plane(vec(s.normal), -s.offset)),
    sphere: (s) => new J.SphereShape(s.radius),
    box: (s) => new J.BoxShape(vec(s.size.map((x) => 0.5 * x)), Math.min(0.05, 0.5 * Math.min(...s.size))),
  };
  const bodies = scene.bodies.map((b) => {
    const still = b.mass === 0;
    const [w, x, y, z] = b.quaternion;
    const kind = still ? J.EMotionType_Static : J.EMotionType_Dynamic;
    const made = new J.BodyCreationSettings(
      shapes[b.shape.kind](b.shape), place(still ? [0, 0, 0] : b.position), new J.Quat(x, y, z, w), kind, still ? STILL : MOVING,
    );
    made.mFriction = scene.friction;
    made.mAllowSleeping = false;
    made.mLinearDamping = 0;
    made.mAngularDamping = 0;
    made.mApplyGyroscopicForce = options.gyroscopic;
    if (!still) {
      made.mLinearVelocity = vec(b.velocity);
      made.mAngularVelocity = vec(b.spin);
      made.mOverrideMassProperties = J.EOverrideMassProperties_MassAndInertiaProvided;
      made.mMassPropertiesOverride.mMass = b.mass;
      made.mMassPropertiesOverride.mInertia = J.Mat44.prototype.sScaleVec3(vec(b.inertia));
    }
    const body = interface_.CreateBody(made);
    interface_.AddBody(body.GetID(), J.EActivation_Activate);
    return body;
  });
  const of = (body) => {
    const [x, q, v, s] = [body.GetPosition(), body.GetRotation(), body.GetLinearVelocity(), body.GetAngularVelocity()].map(
      (t) => [t.GetX(), t.GetY(), t.GetZ(), t.GetW?.()],
    );
    return [...x.slice(0, 3), q[3], ...q.slice(0, 3), ...v.slice(0, 3), ...s.slice(0, 3)];
  };
  return {
    step: () => all.Step(options.dt, options.substeps),
    state: () => bodies.flatMap((body, i) => (scene.bodies[i].mass ? of(body) : scene.bodies[i].still)),
  };
}
