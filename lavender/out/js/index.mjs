// liblavender in WebAssembly: the functions and names of lavender.h, a solver over typed arrays.
import { LAV_BODIES, LAV_ERROR_COUNT, LAV_ERROR_NO_PROBLEM, LAV_ERROR_ROOM, STRUCTS } from './header.mjs';
export * from './header.mjs';

const ARRAYS = { 'int32_t*': Int32Array, 'double*': Float64Array, 'uint64_t*': BigUint64Array };
const MOST = 2 ** 31; // bytes of memory: places in it are 32-bit integers

/** How long each array must be by the counts of its struct; the module would read on behind one that is shorter. */
const LENGTHS = {
  lav_problem(q, given) {
    const [k, m, bodies, joints, speeds, held] = ['n_blocks', 'n_rows', 'n_bodies', 'n_joints', 'n_velocities', 'n_mass_entries'].map((n) => q.get(n));
    const entries = q.get('n_entries'), c = k - joints, of = (n, names) => Object.fromEntries(names.map((name) => [name, n]));
    return {
      ...of(k, ['kind', 'mu', 'patch_radius', 'rolling', 'key', 'order']), ...of(m, ['lower', 'upper', 'b', 'target', 'compliance', 'impulse']),
      ...of(entries, ['index', 'value']), ...of(held, ['mass_index', 'mass_value']), ...of(3 * c, ['normal', 'tangent', 'arm_a', 'arm_b']),
      block_ptr: k + 1, index_ptr: m + 1, mass_ptr: speeds + 1, velocity: q.get('form') === LAV_BODIES ? 6 * bodies : speeds,
      inv_mass: bodies, inv_inertia: 9 * bodies, joint_body: 2 * joints, contact_body: 2 * c,
      jac: 12 * (given.block_ptr?.[joints] ?? joints),
    };
  },
};

export class LavenderError extends Error {
  constructor(code, text) {
    super(text);
    this.name = 'LavenderError';
    this.code = code;
  }
}

/** The library of a module: bytes of liblavender.wasm, or a compiled WebAssembly.Module. */
export async function load(module) {
  const made = await WebAssembly.instantiate(module, {});
  const library = new Library((made.instance ?? made).exports);
  library.check(library.c.lav_self_test());
  return library;
}

export class Library {
  constructor(c) {
    this.c = c;
    this.top = c.__heap_base.value;
  }
  /** Bytes of the module's memory, which grows and is never given back. */
  take(bytes) {
    const at = Math.ceil(this.top / 16) * 16, top = at + bytes, missing = top - this.c.memory.buffer.byteLength;
    if (!(top <= MOST)) throw new LavenderError(LAV_ERROR_ROOM, `${top} bytes are needed; a module has ${MOST} at most`);
    if (missing > 0) this.c.memory.grow(Math.ceil(missing / 65536));
    this.top = top; // where there was memory
    return at;
  }
  view(kind, at, count) {
    return new ARRAYS[kind](this.c.memory.buffer, at, count);
  }
  text(at) {
    const bytes = new Uint8Array(this.c.memory.buffer);
    let end = at;
    while (bytes[end]) end++;
    return new TextDecoder().decode(bytes.slice(at, end));
  }
  check(code, where = '') {
    if (code < 0) throw new LavenderError(code, `${where || ''}${this.text(this.c.lav_text(code))}`);
    return code;
  }
  struct(name) {
    return new Struct(this, name);
  }
  hash(x, seed = 0n) {
    const at = this.take(8 * x.length + 8);
    this.view('double*', at, x.length).set(x);
    const out = BigInt.asUintN(64, this.c.lav_hash(at, x.length, seed));
    this.top = at;
    return out;
  }
  solver(method, options = {}) {
    return new Solver(this, method, options);
  }
}

class Struct {
  constructor(library, name, at) {
    const { size, fields } = STRUCTS[name];
    Object.assign(this, { library, name, fields, size, at: at ?? library.take(size) });
  }
  get(field) {
    const [kind, offset] = this.fields[field];
    if (kind === 'lav_verdict') return new Struct(this.library, kind, this.at + offset);
    const view = new DataView(this.library.c.memory.buffer);
    if (kind === 'double') return view.getFloat64(this.at + offset, true);
    return kind === 'uint64_t' ? view.getBigUint64(this.at + offset, true) : view.getInt32(this.at + offset, true);
  }
  set(field, value) {
    if (!(field in this.fields)) throw new TypeError(`there is no ${field}; one of ${Object.keys(this.fields).join(', ')} is needed`);
    const [kind, offset] = this.fields[field], view = new DataView(this.library.c.memory.buffer);
    if (kind === 'double') view.setFloat64(this.at + offset, value, true);
    else if (kind === 'int32_t' && (value | 0) !== value) throw new TypeError(`${field} is ${value}; a whole number of 32 bits is needed`);
    else if (kind === 'uint64_t') view.setBigUint64(this.at + offset, BigInt(value), true);
    else view.setInt32(this.at + offset, value, true);
  }
  plain() {
    return Object.fromEntries(Object.keys(this.fields).map((key) => {
      const value = this.get(key);
      return [key, value instanceof Struct ? value.plain() : value];
    }));
  }
}

function needsFields(given) {
  if (Object(given) !== given) throw new TypeError(`${given} is no table of fields by name: { iterations: 100 }, for one, is needed`);
}

/** One solver; its memory at least doubles where a problem asks for more, and impulses move with it. */
export class Solver {
  constructor(library, method, options) {
    if (!Number.isInteger(method)) throw new TypeError(`method is ${method}; a number is needed, LAV_NEWTON for one`);
    Object.assign(this, { library, c: library.c, at: 0, bytes: 0, rows: 0, speeds: 0 });
    for (const name of ['options', 'budget', 'result', 'problem']) this[name] = library.struct(`lav_${name}`);
    library.check(this.c.lav_default_options(method, this.options.at));
    this.pointer = library.take(16);
    this.arrays = new Map(); // name -> place and room of the copy that the module reads
    this.fill(this.options, options);
  }
  /** A problem: counts by name, arrays of numbers by name, as in lavender.h. */
  set(given) {
    const q = this.problem;
    needsFields(given);
    this.library.check(this.c.lav_default_problem(given.form ?? LAV_BODIES, q.at));
    this.fill(q, given);
    if (!this.at) this.open();
    let code = this.c.lav_set(this.at, q.at);
    for (let turn = 0; code === LAV_ERROR_ROOM && turn < 40; turn++) {
      this.grow();
      code = this.c.lav_set(this.at, q.at);
    }
    const array = this.c.lav_refused(this.at, this.pointer), index = this.library.view('int32_t*', this.pointer, 1)[0];
    this.library.check(code, array && `${this.library.text(array)}[${index}]: `);
    this.rows = q.get('n_rows');
    this.speeds = q.get('form') === LAV_BODIES ? 6 * q.get('n_bodies') : q.get('n_velocities');
  }
  /** Counts and numbers first, then arrays, whose lengths follow from them. */
  fill(struct, given) {
    needsFields(given);
    const some = Object.entries(given).filter(([, value]) => value != null);
    const kind = ([key]) => struct.fields[key]?.[0] ?? '', isArray = (field) => kind(field) in ARRAYS;
    for (const field of some) if (/\(\*\)|void/.test(kind(field))) throw new TypeError(`${field[0]} is of C alone: leave it out`);
    for (const [key, value] of some.filter((field) => !isArray(field))) struct.set(key, value);
    const lengths = LENGTHS[struct.name]?.(struct, given);
    for (const [key, values] of some.filter(isArray)) {
      if (typeof values !== 'object' || !Number.isInteger(values.length)) throw new TypeError(`${key} is ${values}; an array of numbers is needed`);
      if (values.length < lengths[key]) throw new LavenderError(LAV_ERROR_COUNT, `${key} has ${values.length} numbers; ${lengths[key]} are needed by its counts`);
      struct.set(key, this.copy(key, values, struct.fields[key][0]));
    }
  }
  copy(key, values, kind) {
    if (kind === 'int32_t*' && !(values instanceof Int32Array) && Array.prototype.some.call(values, (x) => (x | 0) !== x)) {
      throw new TypeError(`${key} holds what is no whole number of 32 bits`);
    }
    if (kind === 'double*' && !ArrayBuffer.isView(values) && Array.prototype.some.call(values, (x) => typeof x !== 'number')) {
      throw new TypeError(`${key} holds what is no number, which would count as 0, for one null: JSON has it for NaN and infinity`);
    }
    if (kind === 'uint64_t*' && Array.prototype.some.call(values, (x) => typeof x !== 'bigint')) {
      throw new TypeError(`${key} holds what is no BigInt: 7n or BigInt(7) is needed`);
    }
    const bytes = values.length * ARRAYS[kind].BYTES_PER_ELEMENT;
    let held = this.arrays.get(key);
    if (!held || held.bytes < bytes) this.arrays.set(key, (held = { at: this.library.take(2 * bytes + 8), bytes: 2 * bytes }));
    this.library.view(kind, held.at, values.length).set(values);
    return held.at;
  }
  open() {
    this.library.check(this.c.lav_room(this.problem.at, this.options.at, this.pointer));
    this.bytes = Number(this.library.view('uint64_t*', this.pointer, 1)[0]) + 16;
    const memory = this.library.take(this.bytes);
    this.library.check(this.c.lav_open(memory, BigInt(this.bytes), this.problem.at, this.options.at, this.pointer));
    this.at = this.library.view('int32_t*', this.pointer, 1)[0];
  }
  grow() {
    this.bytes = Math.max(Number(BigInt.asUintN(64, this.c.lav_needed(this.at))), 2 * this.bytes);
    const memory = this.library.take(this.bytes);
    this.library.check(this.c.lav_move(this.at, memory, BigInt(this.bytes), this.pointer));
    this.at = this.library.view('int32_t*', this.pointer, 1)[0];
  }
  run(budget = {}) {
    this.needsProblem();
    this.library.check(this.c.lav_default_budget(this.budget.at)); // 1000 iterations, tol 1e-6
    this.fill(this.budget, budget);
    this.result.set('size', STRUCTS.lav_result.size);
    this.library.check(this.c.lav_run(this.at, this.budget.at, this.result.at));
    return this.result.plain();
  }
  needsProblem() {
    if (!this.at) this.library.check(LAV_ERROR_NO_PROBLEM);
  }
  numbers(call, n) {
    this.needsProblem();
    const at = this.library.take(8 * n + 8);
    const code = call(this.at, at, n), out = this.library.view('double*', at, n).slice();
    this.library.top = at;
    this.library.check(code);
    return out;
  }
  impulse() {
    return this.numbers(this.c.lav_impulse, this.rows);
  }
  velocity() {
    return this.numbers(this.c.lav_velocity, this.speeds);
  }
}
