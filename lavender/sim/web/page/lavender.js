// JavaScript interface of lavender.wasm (memory, and a simulation in three buffers) and of newton.wasm (exact solves).
//
// The module has no imports and no allocator: this file places all its data in its memory.

const SIZES = 10; // Entries of size[], as in lavender_ext/engine/arrays.pxd.
const MOST_SWEEPS = 64;
const SCRATCH_TOO_SMALL = -2; // Result of lav_newton_plan, as in lavender_ext/engine/newton_substep.pyx.
const SCRATCH_HEADER = 4; // Smallest number of integers of its scratch, also as there.
const MOST_TRACED = 256; // Largest number of checks of one solve by Newton's method, as in lavender_ext/newton/warm_start.pxd.
export const TOL = 1e-6; // Relative residual at which Newton's method ends, as in Python.
const OK = 0;
const NEED_CAPACITY = 1;
const NOT_FINITE = 2;

export const SOLVER_FIELDS = [
  "iterations", "warm_start", "contacts", "cache_matches", "residual_initial", "residual_final", "violation_initial",
  "violation_final",
];
export const ORDERS = ["given", "reverse", "symmetric", "random", "bottom_up", "top_down", "colored", "alternating",
  "colored_pairs"];

export class Kernels {
  // `module`: a WebAssembly.Module; `layout`: arrays and indices, as listed by lavender.sim.web.scenes.
  constructor(module, layout) {
    this.functions = new WebAssembly.Instance(module, {}).exports;
    this.memory = this.functions.memory;
    this.layout = layout;
    this.top = this.functions.__heap_base.value;
  }

  // Allocate zeroed bytes; they are free again when `top` is reset.
  alloc(bytes) {
    const place = Math.ceil(this.top / 16) * 16;
    this.top = place + bytes;
    const missing = this.top - this.memory.buffer.byteLength;
    if (missing > 0) {
      this.memory.grow(Math.ceil(missing / 65536));
    }
    new Uint8Array(this.memory.buffer, place, bytes).fill(0);
    return place;
  }

  // Views are created at each use, because growing the memory detaches older ones.
  f64(place, n) {
    return new Float64Array(this.memory.buffer, place, n);
  }

  i32(place, n) {
    return new Int32Array(this.memory.buffer, place, n);
  }

  u64(place, n) {
    return new BigUint64Array(this.memory.buffer, place, n);
  }

  bytes(place, n) {
    return new Uint8Array(this.memory.buffer, place, n);
  }

  // Copy values to the module's memory; return the address.
  putInts(values) {
    const place = this.alloc(4 * Math.max(values.length, 1));
    this.i32(place, values.length).set(values);
    return place;
  }
}

// Newton's method for simulations on `kernels`: a second module in the same memory. `solve` needs a prepared substep with
// its initial guess applied.
export class Newton {
  constructor(module, kernels) {
    this.k = kernels;
    this.f = new WebAssembly.Instance(module, { env: { memory: kernels.memory } }).exports;
    if (this.f.__heap_base.value > kernels.functions.__heap_base.value) {
      throw new Error("newton.wasm and lavender.wasm were not built alike: the one would write over what the other keeps");
    }
    this.said = this.k.alloc(32);
    this.trace = this.k.alloc(24 * MOST_TRACED);
    this.workspace = [0, 0];
    this.places = [0, 0];
  }

  // Return memory for n numbers of 4 or 8 bytes; memory that has become too small is not reused.
  #scratch(which, n) {
    if (n < 0) {
      throw new Error("the substep needs more than 2^31 numbers of scratch");
    }
    if (n > this.workspace[which]) {
      this.workspace[which] = Math.ceil(1.25 * n) + 64;
      this.places[which] = this.k.alloc((which === 0 ? 4 : 8) * this.workspace[which]);
    }
    return this.places[which];
  }

  // Return { met, sweeps, steps, relative, at, energy, normal }: whether the residual is within tol, the work, and the
  // relative residual; for each check, the work until then, E [sqrt J] and max |e_n| [N s].
  solve(buffers, tol) {
    let whole = this.#scratch(0, SCRATCH_HEADER);
    let numbers = this.f.lav_newton_plan(...buffers, 1, this.workspace[0], whole);
    while (numbers === SCRATCH_TOO_SMALL) {
      whole = this.#scratch(0, this.k.i32(whole, 3)[2]);
      numbers = this.f.lav_newton_plan(...buffers, 1, this.workspace[0], whole);
    }
    const real = this.#scratch(1, numbers);
    const how = this.f.lav_newton_substep(...buffers, tol, 1, whole, real, this.trace, this.said);
    const [sweeps, steps, relative, n] = this.k.f64(this.said, 4);
    const scores = this.k.f64(this.trace, 3 * n);
    const column = (c) => Array.from({ length: n }, (_, i) => scores[3 * i + c]);
    return { met: how > 0 || relative === 0, sweeps, steps, relative, at: column(0), energy: column(1), normal: column(2) };
  }
}

// A running scene: its state consists of `size` and three buffers in `kernels.memory`.
export class Simulation {
  // scene: { size, arrays, substeps, dt }; missing arrays are zero. Every Simulation needs its own Kernels, because memory
  // that has become too small is only freed with both.
  constructor(kernels, scene) {
    this.k = kernels;
    this.scene = scene;
    this.substeps = scene.substeps;
    this.newton = null;
    this.short = 0; // Number of substeps in which Newton's method did not reach TOL.
    this.solved = 0; // Number of substeps that it solved.
    this.steps = 0;
    this.first = null; // The eight values of the very first solve.
    this.lost = -1;
    this.#allocate(scene.size);
    for (const [name, values] of Object.entries(scene.arrays)) {
      this.array(name).set(name === "key" || name === "cache_key" ? values.map(BigInt) : values);
    }
    this.done = this.k.alloc(8);
    this.curve = this.k.alloc(16 * (MOST_SWEEPS + 1));
  }

  #allocate(size) {
    this.size = this.k.putInts(size);
    const used = this.k.alloc(12);
    this.k.functions.lav_engine_lengths(this.size, used);
    this.lengths = Array.from(this.k.i32(used, 3));
    if (Math.min(...this.lengths) < 0) {
      throw new Error("the scene needs more than 2^31 entries in one buffer");
    }
    this.real = this.k.alloc(8 * Math.max(this.lengths[0], 1));
    this.index = this.k.alloc(4 * Math.max(this.lengths[1], 1));
    this.keys = this.k.alloc(8 * Math.max(this.lengths[2], 1));
    this.#findArrays();
    const { joints, joint_rows, rows_per_contact, cap_contact } = this.k.layout.size;
    this.joints = size[joints];
    this.rows = size[joint_rows] + size[rows_per_contact] * size[cap_contact];
    this.scratch = this.k.alloc(16 * (this.rows + 1));
  }

  #findArrays() {
    const { real, index, keys } = this.k.layout.arrays;
    const names = [...real, ...index, ...keys];
    const place = this.k.alloc(4 * names.length);
    this.k.functions.lav_engine_offsets(...this.buffers, place);
    const first = this.k.i32(place, names.length);
    this.places = {};
    let i = 0;
    [real, index, keys].forEach((list, buffer) => {
      list.forEach((name, j) => {
        const end = j + 1 < list.length ? first[i + 1] : this.lengths[buffer];
        this.places[name] = [buffer, first[i], end - first[i]];
        i += 1;
      });
    });
  }

  get buffers() {
    return [this.size, this.real, this.index, this.keys];
  }

  // Return a view of one of the engine's arrays.
  array(name) {
    const [buffer, first, n] = this.places[name];
    if (buffer === 0) {
      return this.k.f64(this.real + 8 * first, n);
    }
    return buffer === 1 ? this.k.i32(this.index + 4 * first, n) : this.k.u64(this.keys + 8 * first, n);
  }

  // Return the world position (3,) [m] of a point that is fixed to a body; body -1 is the world.
  point(body, local) {
    if (body < 0) {
      return Array.from(local);
    }
    const [x, q] = [this.array("x"), this.array("q")];
    const [w, ...u] = q.subarray(4 * body, 4 * body + 4);
    const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    const t = cross(u, local).map((v) => 2 * v);
    const turned = cross(u, t).map((v, k) => local[k] + w * t[k] + v);
    return turned.map((v, k) => v + x[3 * body + k]);
  }

  get sizes() {
    return Array.from(this.k.i32(this.size, SIZES));
  }

  // Set iterations, warm_start, order, and box: 1 if friction has a separate bound for each tangent, else 0.
  get settings() {
    const [head, at] = [this.array("head"), this.k.layout.head];
    return {
      iterations: head[at.iterations], warm_start: head[at.warm_start], order: head[at.order], box: head[at.friction_shape],
    };
  }

  set(changes) {
    const [head, at] = [this.array("head"), this.k.layout.head];
    for (const [name, value] of Object.entries(changes)) {
      head[name === "box" ? at.friction_shape : at[name]] = value;
    }
  }

  // Set the velocity [m/s, rad/s] with which a dynamic body enters the next step: six numbers, in world axes.
  setVelocity(body, velocity) {
    if (!(this.array("dyn")[body] >= 0) || velocity.length !== 6) {
      throw new Error("the number of a body that is not static, and six numbers are needed");
    }
    this.array("v").set(velocity, 6 * body);
    this.array("head")[this.k.layout.head.kept] = 0;
  }

  // Return the eight values of SOLVER_FIELDS.
  get values() {
    const { out } = this.k.layout.setting;
    return Array.from(this.array("setting").subarray(out, out + 8));
  }

  #grow() {
    const old = this.buffers;
    const workspace = this.k.alloc(4 * SIZES);
    this.k.functions.lav_engine_grow_workspace(...old, workspace);
    this.#allocate(Array.from(this.k.i32(workspace, SIZES)));
    this.k.functions.lav_engine_move(...old, ...this.buffers);
  }

  // Select the solver from the next step on: a Newton of the same kernels, or null for the sweeps. The number of substeps and
  // the compliance of rigid joints are those that Python uses for it.
  use(newton) {
    const { head, setting, joint_give } = this.k.layout;
    this.newton = newton;
    this.substeps = newton ? this.scene.newton_substeps : this.scene.substeps;
    this.array("setting")[setting.h] = this.scene.dt / this.substeps;
    this.array("setting")[setting.joint_give] = newton && this.array("head")[head.position_iterations] > 0 ? joint_give : 0;
    this.array("head")[this.k.layout.head.substeps] = this.substeps;
  }

  #stepNewton() {
    let status = OK;
    let told = null;
    for (let s = 0; s < this.substeps && status === OK; s++) {
      while (this.k.functions.lav_engine_prepare(...this.buffers) === NEED_CAPACITY) {
        this.#grow();
      }
      this.k.functions.lav_engine_solve(...this.buffers, 0);
      told = this.newton.solve(this.buffers, TOL);
      this.solved += 1;
      this.short += told.met ? 0 : 1;
      status = this.k.functions.lav_engine_finish(...this.buffers);
      this.first ??= this.values;
    }
    return { ...told, finite: this.#finished(status) };
  }

  // Do one step; return false if the state is no longer finite.
  step() {
    if (this.newton) {
      return this.#stepNewton().finite;
    }
    let left = this.substeps;
    for (;;) {
      const status = this.k.functions.lav_engine_substeps(...this.buffers, this.first ? left : 1, this.done);
      left -= this.k.i32(this.done, 1)[0];
      if (status === NEED_CAPACITY) {
        this.#grow();
        continue;
      }
      this.first ??= this.values;
      if (status !== OK || left === 0) {
        return this.#finished(status);
      }
    }
  }

  // Do the same step, bit for bit, and return the error before and after every sweep of its last substep:
  // { normal: max |e_n| [N s], energy: E [sqrt J], at: sweeps so far }, each with 1 + sweeps numbers. With Newton's method,
  // return the result of `Newton.solve` for the last substep.
  stepWatched() {
    if (this.newton) {
      return this.#stepNewton();
    }
    let status = OK;
    const sweeps = this.settings.iterations;
    if (sweeps > MOST_SWEEPS) {
      throw new Error(`${sweeps} sweeps; at most ${MOST_SWEEPS} are watched`);
    }
    const n = 1 + sweeps;
    for (let s = 0; s < this.substeps && status === OK; s++) {
      while (this.k.functions.lav_engine_prepare(...this.buffers) === NEED_CAPACITY) {
        this.#grow();
      }
      this.k.functions.lav_engine_solve_watched(...this.buffers, this.curve, this.scratch);
      status = this.k.functions.lav_engine_finish(...this.buffers);
      this.first ??= this.values;
    }
    const numbers = this.k.f64(this.curve, 2 * n);
    const column = (c) => Array.from({ length: n }, (_, i) => numbers[2 * i + c]);
    return { finite: this.#finished(status), normal: column(0), energy: column(1), at: [...Array(n).keys()] };
  }

  #finished(status) {
    this.steps += 1;
    if (status === NOT_FINITE) {
      this.lost = this.array("head")[this.k.layout.head.lost];
    }
    return status === OK;
  }

  // Return the bytes of the complete state; `restore` continues from it bit for bit.
  snapshot() {
    return {
      size: this.sizes,
      steps: this.steps,
      first: this.first,
      lost: this.lost,
      newton: this.newton,
      counts: [this.short, this.solved],
      real: this.k.f64(this.real, this.lengths[0]).slice(),
      index: this.k.i32(this.index, this.lengths[1]).slice(),
      keys: this.k.u64(this.keys, this.lengths[2]).slice(),
    };
  }

  restore(snapshot) {
    if (snapshot.size.some((n, i) => n !== this.sizes[i])) {
      this.#allocate(snapshot.size);
    }
    this.k.f64(this.real, this.lengths[0]).set(snapshot.real);
    this.k.i32(this.index, this.lengths[1]).set(snapshot.index);
    this.k.u64(this.keys, this.lengths[2]).set(snapshot.keys);
    this.steps = snapshot.steps;
    this.first = snapshot.first;
    this.lost = snapshot.lost;
    this.newton = snapshot.newton;
    this.substeps = this.newton ? this.scene.newton_substeps : this.scene.substeps;
    [this.short, this.solved] = snapshot.counts;
  }
}
