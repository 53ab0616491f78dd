// A scene in an engine that npm installs: node served.mjs ENGINE FOLDER. One JSON request a line, one answer each.
// {"scene": ..., "options": ...} builds it, {"steps": n, "every": k, "limit": s} makes steps until the CPU time is above
// the limit, with a state after every k of them and the last. An answer is {"cpu": s, "done": n, "states": [numbers]}, 13
// of each body that moves or has `still`: position [m], quaternion w x y z, velocity [m/s], spin [rad/s]; after building
// also the properties that the engine stores, see benchmarks/score/adapters; or {"cannot": why}, or {"error": what}.
import { createRequire } from "node:module";
import { join } from "node:path";
import { createInterface } from "node:readline";
import { pathToFileURL } from "node:url";

const [name, folder] = process.argv.slice(2);
const { build } = await import(`./${name}.mjs`);
const found = await import(pathToFileURL(createRequire(join(folder, "package.json")).resolve(folder)).href);
const CHUNK = 50; // steps between two looks at the CPU time
let engine = null, bodies = [];

async function answer(asked) {
  if (asked.scene) {
    engine?.close?.();
    engine = null;
    engine = await build(found, asked.scene, asked.options);
    bodies = asked.scene.bodies;
  }
  const { steps = 0, every = Math.max(steps, 1), limit = Infinity } = asked, states = [];
  const read = (moving = engine.state()) => bodies.flatMap((b) => (b.mass ? moving.shift() : (b.still ?? [])));
  let done = 0, cpu = 0;
  if (!steps) states.push(read());
  while (done < steps && cpu <= limit) {
    const n = Math.min(CHUNK, every - (done % every), steps - done), begin = process.cpuUsage();
    for (let i = 0; i < n; i++) {
      engine.step();
    }
    const used = process.cpuUsage(begin);
    cpu += 1e-6 * (used.user + used.system);
    done += n;
    if (done % every === 0 || done === steps) states.push(read());
  }
  return { cpu, done, states, ...(asked.scene ? { properties: engine.properties() } : {}) };
}

for await (const line of createInterface({ input: process.stdin })) {
  const said = await answer(JSON.parse(line)).catch((error) =>
    error.cannot ? { cannot: error.message } : { error: String(error?.message ?? error) },
  );
  process.stdout.write(JSON.stringify(said) + "\n"); // what is not finite is null
}
