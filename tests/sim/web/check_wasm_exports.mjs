// The WebAssembly build under Node: what it exports, how its contact cache behaves, and that scenes recorded natively
// come out the same to the last bit.
//
//     node tests/sim/web/check_wasm_exports.mjs MODULE.wasm [FOLDER]
//
// `lavender web check` builds both modules and runs this. newton.wasm lies beside MODULE.wasm. FOLDER holds recording.json and recording.bin of
// tests/sim/web/record.py; without one they are recorded first, by the interpreter that PYTHON names (python3 by default), into a temporary folder.

import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { createHash } from "node:crypto";
import { mkdtempSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

import { Kernels, Newton, ORDERS, Simulation, SOLVER_FIELDS } from "../../../lavender/sim/web/page/lavender.js";

const here = dirname(fileURLToPath(import.meta.url));
const LARGEST = 260_000; // bytes, as in lavender/sim/web/compile.py

const [modulePath, given] = process.argv.slice(2);
if (!modulePath) {
  console.error("usage: node check_wasm_exports.mjs MODULE.wasm [FOLDER]");
  process.exit(2);
}
const folder = given ?? mkdtempSync(join(tmpdir(), "lavender-"));
let recording, numbers;
try {
  if (!given) {
    execFileSync(process.env.PYTHON ?? "python3", [join(here, "record.py"), folder], { stdio: ["ignore", "ignore", "inherit"] });
  }
  recording = JSON.parse(readFileSync(join(folder, "recording.json"), "utf8"));
  numbers = readFileSync(join(folder, "recording.bin"));
} finally {
  if (!given) {
    rmSync(folder, { recursive: true });
  }
}
const bytes = readFileSync(modulePath);
const module = new WebAssembly.Module(bytes);
const newtonBytes = readFileSync(join(dirname(modulePath), "newton.wasm"));
const newtonModule = new WebAssembly.Module(newtonBytes);

// Bytes of a recorded array [offset, count, type].
function recorded([offset, count, type]) {
  return numbers.subarray(offset, offset + count * Number(type.slice(-1)));
}

function doubles(place) {
  const raw = recorded(place);
  return new Float64Array(raw.buffer.slice(raw.byteOffset, raw.byteOffset + raw.byteLength));
}

function asBytes(array) {
  return Buffer.from(array.buffer, array.byteOffset, array.byteLength);
}

function sameBits(found, expected, what) {
  if (Buffer.compare(asBytes(found), asBytes(expected)) !== 0) {
    const at = found.findIndex((x, i) => !Object.is(x, expected[i]));
    assert.fail(`${what}: entry ${at} is ${found[at]}, natively ${expected[at]}`);
  }
}

function checkModule() {
  assert.deepEqual(WebAssembly.Module.imports(module), [], "the module imports something");
  assert.ok(bytes.length < LARGEST, `${bytes.length} bytes; below ${LARGEST} are allowed`);
  const exports = WebAssembly.Module.exports(module);
  const functions = exports.filter((e) => e.kind === "function").map((e) => e.name);
  for (const name of [
    "lav_engine_substeps", "lav_engine_prepare", "lav_engine_solve", "lav_engine_solve_watched", "lav_engine_finish",
    "lav_engine_lengths", "lav_engine_offsets", "lav_engine_grow_workspace", "lav_engine_move",
  ]) {
    assert.ok(functions.includes(name), `no function ${name}`);
  }
  const kernels = new Kernels(module, recording.layout);
  assert.equal(kernels.functions.__data_end.value, kernels.functions.__global_base.value, "static data is left");
  return `${bytes.length} bytes, ${functions.length} functions, no imports`;
}

function checkPersistentContact() {
  const scene = recording.scenes.find((s) => s.name === "stack(substeps=1)");
  const simulation = new Simulation(new Kernels(module, recording.layout), scene);
  const at = (field) => simulation.values[SOLVER_FIELDS.indexOf(field)];
  simulation.step();
  const contacts = at("contacts");
  assert.ok(contacts > 0, "no contact was made");
  assert.equal(at("cache_matches"), 0, "a first contact cannot be in the cache");
  simulation.step();
  assert.equal(at("contacts"), contacts);
  assert.equal(at("cache_matches"), contacts, "a contact that stays is found in the cache");
  simulation.set({ warm_start: 0 });
  simulation.step();
  assert.equal(at("warm_start"), 0);
  assert.equal(at("cache_matches"), 0, "without warm start nothing is taken from the cache");
  assert.ok(at("contacts") > 0);
  simulation.set({ warm_start: 1 });
  simulation.step();
  assert.equal(at("cache_matches"), at("contacts"), "the cache is kept while warm start is off");
  return `${contacts} contacts made, kept, found; none found without warm start`;
}

function checkNewtonModule() {
  const imports = WebAssembly.Module.imports(newtonModule).map((i) => `${i.module}.${i.name} (${i.kind})`);
  assert.deepEqual(imports, ["env.memory (memory)"], "newton.wasm imports more than a memory");
  assert.ok(newtonBytes.length < LARGEST, `${newtonBytes.length} bytes; below ${LARGEST} are allowed`);
  const newton = new Newton(newtonModule, new Kernels(module, recording.layout));
  assert.equal(newton.f.__data_end.value, newton.f.__global_base.value, "static data is left in newton.wasm");
  const kernels = new Kernels(module, recording.layout);
  const lower = { memory: kernels.memory, alloc: () => 0, functions: { __heap_base: { value: 16 } } };
  assert.throws(() => new Newton(newtonModule, lower), /not built alike/);
  return `${newtonBytes.length} bytes, imports the memory alone`;
}

function replayNewton(scene) {
  const kernels = new Kernels(module, recording.layout);
  const simulation = new Simulation(kernels, scene);
  simulation.use(new Newton(newtonModule, kernels));
  const [states, values, said] = ["states", "values", "said"].map((name) => doubles(scene[name]));
  const hashes = recorded(scene.hashes);
  const width = states.length / scene.steps;
  let told;
  for (let step = 0; step < scene.steps; step++) {
    if (scene.changes[step]) {
      simulation.set(scene.changes[step]);
    }
    if (step === 50) {
      const snapshot = simulation.snapshot();
      simulation.use(null); // a detour by sweeps
      simulation.step();
      simulation.restore(snapshot);
    }
    const where = `${scene.name}, step ${step + 1}`;
    told = simulation.stepWatched();
    assert.ok(told.finite, `${where}: not finite`);
    sameBits(Float64Array.from(simulation.values), values.subarray(8 * step, 8 * step + 8), `${where}, eight values`);
    sameBits(Float64Array.of(told.sweeps, told.steps, told.relative, told.at.length), said.subarray(4 * step, 4 * step + 4), `${where}, what it said`);
    const state = Float64Array.from(recording.body_arrays.flatMap((name) => Array.from(simulation.array(name))));
    sameBits(state, states.subarray(width * step, width * (step + 1)), `${where}, ${recording.body_arrays}`);
    if (Buffer.compare(hashOf(simulation), hashes.subarray(32 * step, 32 * step + 32)) !== 0) {
      assert.fail(`${where}: some other array differs from the native one`);
    }
  }
  const trace = Float64Array.from(told.at.flatMap((at, i) => [at, told.energy[i], told.normal[i]]));
  sameBits(trace, doubles(scene.trace), `${scene.name}, scores of the last solve`);
  assert.deepEqual([simulation.solved - simulation.short, simulation.solved], [scene.met, scene.solved], scene.name);
}

function hashOf(simulation) {
  const { k, lengths } = simulation;
  const hash = createHash("sha256");
  hash.update(k.bytes(simulation.real, 8 * lengths[0]));
  hash.update(k.bytes(simulation.index, 4 * lengths[1]));
  hash.update(k.bytes(simulation.keys, 8 * Math.max(lengths[2], 1)));
  return hash.digest();
}

function replay(scene) {
  const simulation = new Simulation(new Kernels(module, recording.layout), scene);
  const { k } = simulation;
  const states = doubles(scene.states);
  const values = doubles(scene.values);
  const hashes = recorded(scene.hashes);
  const width = states.length / scene.steps;
  let snapshot = null;
  for (let step = 0; step < scene.steps; step++) {
    if (scene.changes[step]) {
      const { velocity, ...settings } = scene.changes[step];
      simulation.set(settings);
      if (velocity) {
        simulation.setVelocity(...velocity);
      }
    }
    // A detour of three steps from which a snapshot leads back.
    if (step % 150 === 149) {
      snapshot = simulation.snapshot();
      simulation.set({ iterations: 9, warm_start: 0 });
      for (let i = 0; i < 3; i++) {
        simulation.step();
      }
      simulation.restore(snapshot);
    }
    const where = `${scene.name}, step ${step + 1}`;
    assert.ok(step % 2 ? simulation.step() : simulation.stepWatched().finite, `${where}: not finite`);
    sameBits(Float64Array.from(simulation.values), values.subarray(8 * step, 8 * step + 8), `${where}, eight values`);
    const state = Float64Array.from(recording.body_arrays.flatMap((name) => Array.from(simulation.array(name))));
    sameBits(state, states.subarray(width * step, width * (step + 1)), `${where}, ${recording.body_arrays}`);
    if (Buffer.compare(hashOf(simulation), hashes.subarray(32 * step, 32 * step + 32)) !== 0) {
      assert.fail(`${where}: some other array differs from the native one`);
    }
  }
  sameBits(k.f64(simulation.real, simulation.lengths[0]), doubles(scene.last), `${scene.name}, last state`);
  return Math.max(...Array.from({ length: scene.steps }, (_, i) => values[8 * i + 2]));
}

console.log(`module: ${checkModule()}`);
console.log(`newton: ${checkNewtonModule()}`);
console.log(`cache: ${checkPersistentContact()}`);
assert.deepEqual(Object.keys(recording.layout.orders), ORDERS);
let steps = 0;
for (const scene of recording.scenes) {
  const most = replay(scene);
  steps += scene.steps;
  console.log(`${scene.name}: ${scene.steps} steps, up to ${most} contacts, every array and value the same`);
}
let solved = 0;
for (const scene of recording.newton) {
  replayNewton(scene);
  solved += scene.solved;
  console.log(`${scene.name}: ${scene.steps} steps, ${scene.met} of ${scene.solved} solves within tol, all the same`);
}
console.log(`all the same: ${recording.scenes.length} scenes, ${steps} steps, ${solved} solves by newton`);
