// planck (Box2D 2.4 in TypeScript) in the plane x, z; a hinge is a revolute joint, a belt a kinematic body.
// Options: velocity, position (iterations), slop (m), bounceSpeed (m/s), sleep.
import { project } from "./plane.mjs";

export async function build(module, scene, options) {
  const P = module.World ? module : module.default, flat = project(scene), moving = scene.bodies.filter((b) => b.mass > 0);
  if ("slop" in options) P.Settings.linearSlop = options.slop;
  else P.Settings.linearSlop = 0.005; // as shipped: settings are of the process
  P.Settings.velocityThreshold = options.bounceSpeed ?? 1; // as shipped 1
  const to = (v) => { const [x, y] = flat.to(v); return new P.Vec2(x, y); };
  const world = new P.World({ gravity: to(scene.gravity), allowSleep: options.sleep ?? true });
  const material = { friction: scene.friction, restitution: scene.restitution ?? 0, density: 1 };
  const ground = world.createBody();
  if (moving.length < scene.bodies.length) ground.createFixture({ shape: new P.Box(100, 1, new P.Vec2(0, -1)), ...material });
  const bodies = moving.map((b) => {
    const [w, , y] = b.quaternion, box = b.shape.kind === "box", half = (b.shape.size ?? []).map((x) => 0.5 * x);
    const place = { position: to(b.position), angle: -2 * Math.atan2(y, w), linearVelocity: to(b.velocity) };
    const body = world.createBody({ type: b.kinematic ? "kinematic" : "dynamic", ...place });
    body.createFixture({ shape: box ? new P.Box(half[0], half[2]) : new P.Circle(b.shape.radius), ...material });
    body.setMassData({ mass: b.mass, center: new P.Vec2(0, 0), I: b.inertia[1] });
    return body;
  });
  for (const j of scene.joints) {
    const motor = j.motor ? { enableMotor: true, motorSpeed: -j.motor[0], maxMotorTorque: j.motor[1] } : {};
    world.createJoint(new P.RevoluteJoint(motor, bodies[j.a] ?? ground, bodies[j.b], to(j.anchor)));
  }
  const list = (v) => [v.x, v.y];
  return {
    step: () => {
      moving.forEach((b, i) => b.force?.some((x) => x) && bodies[i].applyForceToCenter(to(b.force), true));
      world.step(options.dt, options.velocity ?? 8, options.position ?? 3);
    },
    state: () => bodies.map((b) => flat.lift(list(b.getPosition()), b.getAngle(), list(b.getLinearVelocity()), b.getAngularVelocity())),
    properties: () => bodies.map((b) => {
      const fixture = b.getFixtureList();
      return [b.getMass(), null, b.getInertia(), null, fixture.getFriction(), fixture.getRestitution()];
    }),
  };
}
