// Scenes in the plane x, z of engines in two dimensions; see benchmarks/score/adapters/plane.py.

/** Return conversions to the plane and back; an error `cannot` if the horizontal vectors have several directions. */
export function project(scene) {
  if (!scene.planar) throw Object.assign(new Error("an engine in two dimensions"), { cannot: true });
  const moving = scene.bodies.filter((b) => b.mass > 0);
  const vectors = [scene.gravity, ...moving.flatMap((b) => [b.velocity, b.force])];
  const first = vectors.reduce((a, b) => (Math.hypot(b[0], b[1]) > Math.hypot(a[0], a[1]) ? b : a));
  const size = Math.hypot(first[0], first[1]), [c, s] = size > 0 ? [first[0] / size, first[1] / size] : [1, 0];
  return {
    to: (v) => [c * v[0] + s * v[1], v[2]],
    lift: (x, angle, v, spin) => [
      c * x[0], s * x[0], x[1], Math.cos(-0.5 * angle), 0, Math.sin(-0.5 * angle), 0, c * v[0], s * v[0], v[1], 0, -spin, 0,
    ],
  };
}
