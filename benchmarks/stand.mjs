// One tower in Rapier or Jolt: node stand.mjs '{"engine": "rapier", "boxes": 6, "dt": 0.0166, ...}' prints one JSON line.
// The packages are looked for in the folder of the command. y is up.
import { createRequire } from "node:module";
import { pathToFileURL } from "node:url";
import { join } from "node:path";

const asked = JSON.parse(process.argv[2]);
const require = createRequire(join(process.cwd(), "package.json"));
const load = (name) => import(pathToFileURL(require.resolve(name)).href);

async function rapier() {
  const found = await load("@dimforge/rapier3d-compat");
  const R = found.default ?? found;
  await R.init();
  const world = new R.World({ x: 0, y: -9.81, z: 0 });
  world.timestep = asked.dt;
  if (asked.sweeps !== null) {
    world.numSolverIterations = asked.sweeps;
  }
  const ground = world.createRigidBody(R.RigidBodyDesc.fixed().setTranslation(0, -0.5, 0));
  world.createCollider(R.ColliderDesc.cuboid(50, 0.5, 50).setFriction(asked.friction), ground);
  const boxes = [];
  for (let i = 0; i < asked.boxes; i++) {
    const body = world.createRigidBody(R.RigidBodyDesc.dynamic().setTranslation(0, i + 0.5, 0).setCanSleep(false));
    world.createCollider(R.ColliderDesc.cuboid(0.5, 0.5, 0.5).setFriction(asked.friction).setDensity(1), body);
    boxes.push(body);
  }
  return {
    name: "rapier",
    sweeps: world.numSolverIterations,
    step: () => world.step(),
    centres: () => boxes.map((b) => Object.values(b.translation())),
  };
}

async function jolt() {
  const J = await (await load("jolt-physics")).default();
  const settings = new J.JoltSettings();
  const pairs = new J.ObjectLayerPairFilterTable(2);
  pairs.EnableCollision(0, 1);
  pairs.EnableCollision(1, 1);
  const layers = new J.BroadPhaseLayerInterfaceTable(2, 2);
  layers.MapObjectToBroadPhaseLayer(0, new J.BroadPhaseLayer(0));
  layers.MapObjectToBroadPhaseLayer(1, new J.BroadPhaseLayer(1));
  settings.mObjectLayerPairFilter = pairs;
  settings.mBroadPhaseLayerInterface = layers;
  settings.mObjectVsBroadPhaseLayerFilter = new J.ObjectVsBroadPhaseLayerFilterTable(layers, 2, pairs, 2);
  const all = new J.JoltInterface(settings);
  const system = all.GetPhysicsSystem();
  const bodies = system.GetBodyInterface();
  const physics = system.GetPhysicsSettings();
  if (asked.sweeps !== null) {
    physics.mNumVelocitySteps = asked.sweeps;
    system.SetPhysicsSettings(physics);
  }
  const add = (half, y, kind, layer) => {
    const shape = new J.BoxShape(new J.Vec3(...half), 0.05);
    const made = new J.BodyCreationSettings(shape, new J.RVec3(0, y, 0), new J.Quat(0, 0, 0, 1), kind, layer);
    made.mFriction = asked.friction;
    made.mAllowSleeping = false;
    made.mLinearDamping = 0;
    made.mAngularDamping = 0;
    if (layer === 1) {
      made.mOverrideMassProperties = J.EOverrideMassProperties_CalculateInertia;
      made.mMassPropertiesOverride.mMass = 1;
    }
    const body = bodies.CreateBody(made);
    bodies.AddBody(body.GetID(), J.EActivation_Activate);
    return body;
  };
  add([50, 0.5, 50], -0.5, J.EMotionType_Static, 0);
  const boxes = [];
  for (let i = 0; i < asked.boxes; i++) {
    boxes.push(add([0.5, 0.5, 0.5], i + 0.5, J.EMotionType_Dynamic, 1));
  }
  return {
    name: "jolt",
    sweeps: physics.mNumVelocitySteps,
    step: () => all.Step(asked.dt, 1),
    centres: () => boxes.map((b) => [b.GetPosition().GetX(), b.GetPosition().GetY(), b.GetPosition().GetZ()]),
  };
}

const engine = await { rapier, jolt }[asked.engine]();
const every = Math.max(1, Math.round(asked.look / asked.dt));
const looks = Math.max(1, Math.round(asked.seconds / (every * asked.dt)));
const far = (now, then) => Math.max(...now.map((p, i) => Math.hypot(...p.map((x, k) => x - then[i][k]))));
const first = engine.centres();
let start = null;
let drift = 0;
let stood = asked.seconds;
let spent = 0;
let steps = 0;
for (let look = 0; look < looks; look++) {
  const begin = process.cpuUsage();
  for (let i = 0; i < every; i++) {
    engine.step();
  }
  const used = process.cpuUsage(begin);
  spent += 1e-6 * (used.user + used.system);
  steps += every;
  const time = steps * asked.dt;
  const now = engine.centres();
  const away = now.map((p, i) => [p[0], Math.min(p[1], first[i][1]), p[2]]);
  if (!(far(away, first) <= asked.fell)) {
    stood = time;
    break;
  }
  if (time >= asked.settle - 1e-9) {
    start ??= now;
    drift = Math.max(drift, far(now, start));
  }
}
console.log(
  JSON.stringify({ engine: engine.name, sweeps: engine.sweeps, substeps: 1, stood, drift, cost: spent / steps }),
);
process.exit(0);
