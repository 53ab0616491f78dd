// Steps of Jolt (npm install jolt-physics@1.1.0) as lines of JSON: positions, velocities and contacts before the solve, velocities after it.
// node jolt_step.mjs [velocity iterations] > jolt-steps.jsonl; examples/read_jolt.py judges them.
import initJolt from "jolt-physics/wasm-compat";

const J = await initJolt();
const settings = new J.JoltSettings(), layers = new J.ObjectLayerPairFilterTable(2);
const broad = new J.BroadPhaseLayerInterfaceTable(2, 2);
for (const layer of [0, 1]) {
  layers.EnableCollision(layer, 1);
  broad.MapObjectToBroadPhaseLayer(layer, new J.BroadPhaseLayer(layer));
}
settings.mObjectLayerPairFilter = layers;
settings.mBroadPhaseLayerInterface = broad;
settings.mObjectVsBroadPhaseLayerFilter = new J.ObjectVsBroadPhaseLayerFilterTable(broad, 2, layers, 2);
const jolt = new J.JoltInterface(settings), system = jolt.GetPhysicsSystem();
const bodies = system.GetBodyInterface();
const physics = system.GetPhysicsSettings();
physics.mNumVelocitySteps = Number(process.argv[2] ?? 10);
system.SetPhysicsSettings(physics);

function addBox(half, y, x, isStatic) {
  const shape = new J.BoxShape(new J.Vec3(...half), 0.0);
  const motion = isStatic ? J.EMotionType_Static : J.EMotionType_Dynamic;
  const made = new J.BodyCreationSettings(shape, new J.RVec3(x, y, 0), new J.Quat(0, 0, 0, 1), motion, isStatic ? 0 : 1);
  made.mFriction = 0.5;
  made.mLinearDamping = made.mAngularDamping = 0; // the defaults are 0.05
  made.mAllowSleeping = false;
  made.mOverrideMassProperties = J.EOverrideMassProperties_CalculateInertia;
  made.mMassPropertiesOverride.mMass = 1;
  const body = bodies.CreateBody(made);
  bodies.AddBody(body.GetID(), J.EActivation_Activate);
  return body;
}

addBox([9, 0.5, 9], -0.5, 0, true);
const boxes = [0, 1, 2, 3].map((i) => addBox([0.5, 0.5, 0.5], i + 0.5, 0.02 * i, false));
const index = new Map(boxes.map((body, i) => [body.GetID().GetIndex(), i]));
const array = (v) => [v.GetX(), v.GetY(), v.GetZ()];
let contacts = [];
function read(first, second, manifold, settings) {
  const [a, b] = [first, second].map((body) => index.get(J.wrapPointer(body, J.Body).GetID().GetIndex()) ?? -1);
  manifold = J.wrapPointer(manifold, J.ContactManifold);
  const mu = J.wrapPointer(settings, J.ContactSettings).mCombinedFriction;
  const normal = array(manifold.mWorldSpaceNormal), points = [];
  for (let i = 0; i < manifold.mRelativeContactPointsOn1.size(); i++) {
    const [p, q] = [manifold.GetWorldSpaceContactPointOn1(i), array(manifold.GetWorldSpaceContactPointOn2(i))];
    const one = array(p);
    points.push({ point: one.map((x, k) => (x + q[k]) / 2), gap: one.reduce((s, x, k) => s + (q[k] - x) * normal[k], 0) });
  }
  contacts.push({ a, b, mu, normal, points });
}
const listener = new J.ContactListenerJS();
listener.OnContactValidate = () => J.ValidateResult_AcceptAllContactsForThisBodyPair;
listener.OnContactAdded = listener.OnContactPersisted = read; // called during the step, before the solve
listener.OnContactRemoved = () => {};
system.SetContactListener(listener);

const velocities = () => boxes.map((b) => [...array(b.GetLinearVelocity()), ...array(b.GetAngularVelocity())]);
const positions = () => boxes.map((b) => array(b.GetPosition()));
for (let step = 0; step < 30; step++) {
  contacts = [];
  const before = { position: positions(), velocity: velocities() };
  jolt.Step(1 / 60, 1);
  console.log(JSON.stringify({ ...before, after: velocities(), contacts }));
}
