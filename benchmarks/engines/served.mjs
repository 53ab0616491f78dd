// A scene in an engine that npm installs: node served.mjs ENGINE FOLDER. One JSON request a line, one answer each.
// {"scene": ..., "options": ...} builds it, {"steps": n} steps. An answer is {"cpu": s, "state": numbers}, 13 of each
// body: position [m], quaternion w x y z, velocity [m/s], spin [rad/s]; or {"cannot": why}, or {"error": what}.
import { createRequire } from "node:module";
import { join } from "node:path";
import { createInterface } from "node:readline";
import { pathToFileURL } from "node:url";

const [name, folder] = process.argv.slice(2);
const { build } = await import(`./${name}.mjs`);
const found = await import(pathToFileURL(createRequire(join(folder, "package.json")).resolve(folder)).href);
let engine = null;

async function answer(asked) {
  if (asked.scene) {
    engine = await build(found, asked.scene, asked.options);
  }
  const begin = process.cpuUsage();
  for (let i = 0; i < (asked.steps ?? 0); i++) {
    engine.step();
  }
  const used = process.cpuUsage(begin);
  return { cpu: 1e-6 * (used.user + used.system), state: engine.state() };
}

for await (const line of createInterface({ input: process.stdin })) {
  const said = await answer(JSON.parse(line)).catch((error) =>
    error.cannot ? { cannot: error.message } : { error: String(error?.message ?? error) },
  );
  process.stdout.write(JSON.stringify(said) + "\n"); // what is not finite is null
}
