// Havok (@babylonjs/havok); a hinge is a constraint with five locked axes, a belt a kinematic body.
// Options: idealStep (s, or "dt": the time step; as shipped 1/60), sleep, damping.
import { readFileSync } from "node:fs";
let H = null; // one instance for all scenes
const NONE = [0, 0, 0, 1];

export async function build(module, scene, options) {
  const create = module.default ?? module;
  const folder = process.argv[3] + "/lib/umd/HavokPhysics.wasm";
  H ??= await create({ wasmBinary: readFileSync(folder) });
  const value = ([result, made]) => made;
  const world = value(H.HP_World_Create()), moving = scene.bodies.filter((b) => b.mass > 0);
  H.HP_World_SetGravity(world, scene.gravity);
  if ("idealStep" in options) H.HP_World_SetIdealStepTime(world, options.idealStep === "dt" ? options.dt : options.idealStep);
  const most = H.MaterialCombine.MAXIMUM;
  const add = (shape, position, b) => {
    const body = value(H.HP_Body_Create()), kinds = H.MotionType;
    H.HP_Shape_SetMaterial(shape, [scene.friction, scene.friction, scene.restitution ?? 0, most, most]);
    H.HP_Body_SetShape(body, shape);
    H.HP_Body_SetMotionType(body, !b ? kinds.STATIC : b.kinematic ? kinds.KINEMATIC : kinds.DYNAMIC);
    const [w, x, y, z] = b?.quaternion ?? [1, 0, 0, 0];
    H.HP_Body_SetQTransform(body, [position, [x, y, z, w]]);
    if (b) {
      H.HP_Body_SetMassProperties(body, [[0, 0, 0], b.mass, b.inertia.map((i) => i / b.mass), NONE]);
      H.HP_Body_SetLinearVelocity(body, b.velocity);
      H.HP_Body_SetAngularVelocity(body, b.spin);
      if ("damping" in options) [H.HP_Body_SetLinearDamping, H.HP_Body_SetAngularDamping].forEach((set) => set(body, options.damping));
      if (options.sleep === false) H.HP_Body_SetActivationControl(body, H.ActivationControl.ALWAYS_ACTIVE);
    }
    H.HP_World_AddBody(world, body, false);
    return body;
  };
  const box = (size) => value(H.HP_Shape_CreateBox([0, 0, 0], NONE, size));
  const sphere = (radius) => value(H.HP_Shape_CreateSphere([0, 0, 0], radius));
  if (moving.length < scene.bodies.length) add(box([100, 100, 10]), [0, 0, -5], null);
  const bodies = moving.map((b) => add(b.shape.kind === "box" ? box(b.shape.size) : sphere(b.shape.radius), b.position, b));
  const fixed = scene.joints?.length ? add(box([0.01, 0.01, 0.01]), [0, 0, 100], null) : null;
  for (const j of scene.joints ?? []) {
    const joint = value(H.HP_Constraint_Create()), { LOCKED } = H.ConstraintAxisLimitMode, axes = H.ConstraintAxis;
    const at = (i) => j.anchor.map((x, k) => x - (i < 0 ? [0, 0, 100] : moving[i].position)[k]);
    H.HP_Constraint_SetParentBody(joint, bodies[j.a] ?? fixed);
    H.HP_Constraint_SetChildBody(joint, bodies[j.b]);
    H.HP_Constraint_SetAnchorInParent(joint, at(j.a), j.axis, [j.axis[1], j.axis[2], j.axis[0]]);
    H.HP_Constraint_SetAnchorInChild(joint, at(j.b), j.axis, [j.axis[1], j.axis[2], j.axis[0]]);
    for (const axis of ["LINEAR_X", "LINEAR_Y", "LINEAR_Z", "ANGULAR_Y", "ANGULAR_Z"]) H.HP_Constraint_SetAxisMode(joint, axes[axis], LOCKED);
    if (j.motor) {
      H.HP_Constraint_SetAxisMotorType(joint, axes.ANGULAR_X, H.ConstraintMotorType.VELOCITY);
      H.HP_Constraint_SetAxisMotorTarget(joint, axes.ANGULAR_X, j.motor[0]);
      H.HP_Constraint_SetAxisMotorMaxForce(joint, axes.ANGULAR_X, j.motor[1]);
    }
    H.HP_Constraint_SetEnabled(joint, 1);
  }
  const names = ["Position", "Orientation", "LinearVelocity", "AngularVelocity"];
  return {
    step: () => {
      moving.forEach((b, i) => b.force?.some((x) => x) && H.HP_Body_ApplyImpulse(bodies[i], value(H.HP_Body_GetPosition(bodies[i])), b.force.map((x) => x * options.dt)));
      H.HP_World_Step(world, options.dt);
    },
    state: () => bodies.map((b) => {
      const [x, q, v, w] = names.map((name) => value(H[`HP_Body_Get${name}`](b)));
      return [...x, q[3], ...q.slice(0, 3), ...v, ...w];
    }),
    properties: () => bodies.map((b, i) => {
      const [, mass, inertia] = value(H.HP_Body_GetMassProperties(b));
      const [friction, , restitution] = value(H.HP_Shape_GetMaterial(value(H.HP_Body_GetShape(b))));
      return [mass, ...inertia.map((x) => x * mass), friction, restitution];
    }),
    close: () => H.HP_World_Release(world),
  };
}
