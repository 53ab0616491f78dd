// Jolt (jolt-physics): planes, boxes and spheres of its own; a hinge is a hinge constraint, a belt a kinematic body.
// Options: sweeps, positions (steps of the position solver), substeps, sleep, damping, gyroscopic, slop,
// radius (of edges, m), bounceSpeed, cache (of contacts).
const STILL = 0; // object layers: static bodies, and moving bodies
const MOVING = 1;
let J = null; // one instance for all scenes

export async function build(module, scene, options) {
  J ??= await module.default();
  const vec = (v) => new J.Vec3(...v), place = (v) => new J.RVec3(...v);
  const settings = new J.JoltSettings(), pairs = new J.ObjectLayerPairFilterTable(2);
  pairs.EnableCollision(STILL, MOVING);
  pairs.EnableCollision(MOVING, MOVING);
  const layers = new J.BroadPhaseLayerInterfaceTable(2, 2);
  [STILL, MOVING].forEach((k) => layers.MapObjectToBroadPhaseLayer(k, new J.BroadPhaseLayer(k)));
  settings.mObjectLayerPairFilter = pairs;
  settings.mBroadPhaseLayerInterface = layers;
  settings.mObjectVsBroadPhaseLayerFilter = new J.ObjectVsBroadPhaseLayerFilterTable(layers, 2, pairs, 2);
  const all = new J.JoltInterface(settings), system = all.GetPhysicsSystem(), bodies = system.GetBodyInterface();
  system.SetGravity(vec(scene.gravity));
  const physics = system.GetPhysicsSettings();
  const names = { sweeps: "mNumVelocitySteps", positions: "mNumPositionSteps", slop: "mPenetrationSlop", bounceSpeed: "mMinVelocityForRestitution", cache: "mUseBodyPairContactCache" };
  for (const [key, name] of Object.entries(names)) if (key in options) physics[name] = options[key];
  system.SetPhysicsSettings(physics);
  const shapes = {
    plane: (s) => new J.PlaneShape(new J.Plane(vec(s.normal), -s.offset)),
    sphere: (s) => new J.SphereShape(s.radius),
    box: (s) => new J.BoxShape(vec(s.size.map((x) => 0.5 * x)), options.radius ?? Math.min(0.05, 0.5 * Math.min(...s.size))),
  };
  const make = (b) => {
    const still = b.mass === 0, [w, x, y, z] = b.quaternion;
    const kind = still ? J.EMotionType_Static : b.kinematic ? J.EMotionType_Kinematic : J.EMotionType_Dynamic;
    const at = place(still ? [0, 0, 0] : b.position), q = new J.Quat(x, y, z, w);
    const made = new J.BodyCreationSettings(shapes[b.shape.kind](b.shape), at, q, kind, still ? STILL : MOVING);
    [made.mFriction, made.mRestitution] = [scene.friction, scene.restitution ?? 0];
    if (options.sleep === false) made.mAllowSleeping = false;
    if ("damping" in options) made.mLinearDamping = made.mAngularDamping = options.damping;
    if ("gyroscopic" in options) made.mApplyGyroscopicForce = options.gyroscopic;
    if (!still) {
      [made.mLinearVelocity, made.mAngularVelocity] = [vec(b.velocity), vec(b.spin)];
      made.mOverrideMassProperties = J.EOverrideMassProperties_MassAndInertiaProvided;
      made.mMassPropertiesOverride.mMass = b.mass;
      made.mMassPropertiesOverride.mInertia = J.Mat44.prototype.sScaleVec3(vec(b.inertia));
    }
    const body = bodies.CreateBody(made);
    bodies.AddBody(body.GetID(), J.EActivation_Activate);
    return body;
  };
  scene.bodies.filter((b) => b.mass === 0).forEach(make);
  const moving = scene.bodies.filter((b) => b.mass > 0), made = moving.map(make);
  for (const j of scene.joints ?? []) {
    const hinge = new J.HingeConstraintSettings();
    hinge.mPoint1 = hinge.mPoint2 = place(j.anchor);
    hinge.mHingeAxis1 = hinge.mHingeAxis2 = vec(j.axis);
    hinge.mNormalAxis1 = hinge.mNormalAxis2 = vec([j.axis[1], j.axis[2], j.axis[0]]);
    const joint = J.castObject(hinge.Create(made[j.a] ?? J.Body.prototype.sFixedToWorld, made[j.b]), J.HingeConstraint);
    system.AddConstraint(joint);
    if (!j.motor) continue;
    [joint.GetMotorSettings().mMinTorqueLimit, joint.GetMotorSettings().mMaxTorqueLimit] = [-j.motor[1], j.motor[1]];
    joint.SetMotorState(J.EMotorState_Velocity);
    joint.SetTargetAngularVelocity(j.motor[0]);
  }
  const list = (v) => [v.GetX(), v.GetY(), v.GetZ()];
  const step = () => {
    moving.forEach((b, i) => b.force?.some((x) => x) && made[i].AddForce(vec(b.force)));
    all.Step(options.dt, options.substeps ?? 1);
  };
  const row = (b) => [...list(b.GetPosition()), b.GetRotation().GetW(), ...list(b.GetRotation()), ...list(b.GetLinearVelocity()), ...list(b.GetAngularVelocity())];
  const read = (b, m = b.GetMotionProperties(), inverse = m.GetLocalSpaceInverseInertia()) => [
    1 / m.GetInverseMass(), 1 / inverse.GetAxisX().GetX(), 1 / inverse.GetAxisY().GetY(), 1 / inverse.GetAxisZ().GetZ(),
  ];
  return {
    step,
    state: () => made.map(row),
    properties: () => made.map((b, i) => [...(moving[i].kinematic ? [null, null, null, null] : read(b)), b.GetFriction(), b.GetRestitution()]),
    close: () => J.destroy(all),
  };
}
