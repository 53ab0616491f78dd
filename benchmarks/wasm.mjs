// The WebAssembly side of wasm.py: seconds for one substep and one sweep, as JSON.
//
//     node benchmarks/wasm.mjs FOLDER REPEATS

import { readFileSync } from "node:fs";
import { join } from "node:path";

import { Kernels, Simulation } from "../lavender/web/page/lavender.js";
import { load } from "../tests/wasm/problem.mjs";

const [folder, repeats] = process.argv.slice(2);
const { layout, scenes, problems } = JSON.parse(readFileSync(join(folder, "bench.json"), "utf8"));
const numbers = readFileSync(join(folder, "bench.bin"));
const module = new WebAssembly.Module(readFileSync(join(folder, "lavender.wasm")));
const recorded = ([offset, count, type]) => numbers.subarray(offset, offset + count * Number(type.slice(-1)));

function least(work, prepare = () => {}) {
  let best = Infinity;
  const begun = performance.now();
  // Node runs quickly made code first and replaces it between two calls, so the first calls do not count.
  for (let i = 0; i < Number(repeats) || performance.now() - begun < 500; i++) {
    prepare();
    const start = performance.now();
    work();
    best = Math.min(best, 1e-3 * (performance.now() - start));
  }
  return best;
}

const times = {};
for (const [name, scene] of Object.entries(scenes)) {
  const simulation = new Simulation(new Kernels(module, layout), { ...scene, arrays: {} });
  const snapshot = { size: scene.size, steps: 0, lost: -1 };
  for (const [buffer, place] of Object.entries(scene.buffers)) {
    const bytes = recorded(place);
    const type = { real: Float64Array, index: Int32Array, keys: BigUint64Array }[buffer];
    snapshot[buffer] = new type(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength));
  }
  times[name] = least(
    () => {
      if (!simulation.step()) {
        throw new Error(`${name}: not finite`);
      }
    },
    () => simulation.restore(snapshot),
  ) / scene.substeps;
}
for (const [name, problem] of Object.entries(problems)) {
  const loaded = load(new Kernels(module, layout), problem, recorded);
  times[name] = least(() => loaded.sweep(problem.run, problem.single_rows)) / problem.run;
}
console.log(JSON.stringify(times));
