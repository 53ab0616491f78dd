// p2-es in the plane x, z; a hinge is a revolute constraint, a belt a kinematic body.
// Options: iterations, tolerance, frequency (of contacts, in 1/dt), damping.
import { project } from "./plane.mjs";

export async function build(P, scene, options) {
  const flat = project(scene), moving = scene.bodies.filter((b) => b.mass > 0);
  const world = new P.World({ gravity: flat.to(scene.gravity) });
  for (const key of ["iterations", "tolerance"]) if (key in options) world.solver[key] = options[key];
  Object.assign(world.defaultContactMaterial, { friction: scene.friction, restitution: scene.restitution ?? 0 });
  if ("frequency" in options) { // the stiffness that gives the heaviest body this frequency, at least the shipped one
    const stiffness = Math.max(...moving.map((b) => b.mass)) * (2 * Math.PI * options.frequency / options.dt) ** 2;
    const most = Math.max(1e6, stiffness);
    Object.assign(world.defaultContactMaterial, { stiffness: most, frictionStiffness: most });
  }
  const ground = new P.Body();
  if (moving.length < scene.bodies.length) ground.addShape(new P.Plane());
  world.addBody(ground);
  const free = "damping" in options ? { damping: options.damping, angularDamping: options.damping } : {};
  const bodies = moving.map((b) => {
    const type = b.kinematic ? P.Body.KINEMATIC : P.Body.DYNAMIC, [w, , y] = b.quaternion;
    const place = { position: flat.to(b.position), angle: -2 * Math.atan2(y, w), velocity: flat.to(b.velocity) };
    const body = new P.Body({ mass: b.kinematic ? 0 : b.mass, type, ...place, ...free });
    const box = b.shape.kind === "box", size = b.shape.size;
    body.addShape(box ? new P.Box({ width: size[0], height: size[2] }) : new P.Circle({ radius: b.shape.radius }));
    if (!b.kinematic) [body.inertia, body.invInertia] = [b.inertia[1], 1 / b.inertia[1]];
    world.addBody(body);
    return body;
  });
  for (const j of scene.joints) {
    const first = bodies[j.a] ?? ground;
    const hinge = new P.RevoluteConstraint(first, bodies[j.b], { worldPivot: flat.to(j.anchor), collideConnected: false });
    world.addConstraint(hinge);
    if (!j.motor) continue;
    [hinge.motorEnabled, hinge.motorSpeed] = [true, j.motor[0]]; // The speed is that of the first body.
    Object.assign(hinge.motorEquation, { maxForce: j.motor[1], minForce: -j.motor[1] });
  }
  return {
    step: () => {
      moving.forEach((b, i) => b.force?.some((x) => x) && bodies[i].applyForce(flat.to(b.force)));
      world.step(options.dt);
    },
    state: () => bodies.map((b) => flat.lift(b.position, b.angle, b.velocity, b.angularVelocity)),
    properties: () => bodies.map((b) => [b.mass, null, b.inertia, null, scene.friction, scene.restitution ?? 0]),
  };
}
