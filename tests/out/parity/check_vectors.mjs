// Test vectors solved again by the library's WebAssembly module: node check_vectors.mjs PACKAGE VECTORS
//
// PACKAGE is a folder of `lavender export npm`, VECTORS a vectors.bin as `lavender.out.vectors` describes it.

import { readFileSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const [folder, path] = process.argv.slice(2);
const { load, STRUCTS } = await import(pathToFileURL(join(folder, "index.mjs")));
const module = new WebAssembly.Module(readFileSync(join(folder, "liblavender.wasm")));
const OPTIONS = ["order", "memory", "sweep", "convex", "keeps", "seed"];
const COUNTS = [
  "form", "law", "n_blocks", "n_rows", "n_entries", "n_bodies", "n_joints", "n_velocities", "n_mass_entries",
];
const KINDS = { "int32_t*": Int32Array, "double*": Float64Array, "uint64_t*": BigUint64Array };
const ARRAYS = Object.entries(STRUCTS.lav_problem.fields).filter(([, [kind]]) => kind in KINDS);

const file = readFileSync(path);
const data = new DataView(file.buffer, file.byteOffset, file.byteLength);
let at = 8; // behind the magic word
const whole = () => Number(data.getBigInt64((at += 8) - 8, true));
const real = () => data.getFloat64((at += 8) - 8, true);
const bytes = (n) => {
  const out = file.subarray(at, at + n);
  at += Math.ceil(n / 8) * 8;
  return out;
};
const array = (Kind, n) => new Kind(new Uint8Array(bytes(n)).buffer);

let differ = 0;
const count = whole();
for (let i = 0; i < count; i++) {
  if (whole() !== 1) throw new Error(`vector ${i} has several steps, which are of \`auto\``);
  const method = whole();
  const options = Object.fromEntries(OPTIONS.map((name) => [name, whole()]));
  options.omega = real();
  const budget = { iterations: whole(), tol: real() };
  const problem = Object.fromEntries(COUNTS.map((name) => [name, whole()]));
  for (const [name, [kind]] of ARRAYS) {
    const n = whole();
    problem[name] = n < 0 ? null : array(KINDS[kind], n);
  }
  const isMet = whole();
  const relative = real();
  const wanted = isMet ? null : bytes(8 * problem.n_rows);
  const library = await load(module); // with memory of its own
  const solver = library.solver(method, options);
  solver.set(problem);
  const found = solver.run(budget).verdict.relative;
  const same = isMet ? found <= relative : Object.is(found, relative) && wanted.equals(Buffer.from(solver.impulse().buffer));
  if (!same) {
    differ += 1;
    console.error(`vector ${i}, method ${method}, ${problem.n_rows} rows: DIFFERS, residual ${found} for ${relative}`);
  }
}
console.log(`${count - differ} of ${count} vectors the same`);
process.exitCode = differ > 0 ? 1 : 0;
