// One side of the page: a simulation with its own settings, its picture and its numbers.

import { View, find, rows } from "./draw.js";
import { Kernels, Newton, ORDERS, Simulation, SOLVER_FIELDS, TOL } from "./lavender.js";

const KEPT = 720; // Number of steps in the plots over time.
const DEFAULTS = [{ warm_start: 1 }, { warm_start: 0 }];
const WHOLE = new Set(["iterations", "warm_start", "contacts", "cache_matches"]);
const PULL = 200; // Stiffness per mass [1/s^2] of the critically damped spring between the pointer and a held body; damping 2 sqrt(PULL) [1/s].
// Additional values for joints, which the eight values of a step do not contain: largest gap, and largest impulse.
const OF_JOINTS = ["joints open", "joint impulse"];

export function shown(field, value) {
  return WHOLE.has(field) || value === 0 ? String(value) : value.toExponential(5);
}

export class Side {
  constructor(place, index, app) {
    this.index = index;
    this.app = app;
    place.append(find("side").content.cloneNode(true));
    place.querySelector("h2").textContent = "AB"[index];
    const pick = (what) => place.querySelector(what);
    this.sweeps = pick(".sweeps input");
    this.sweepsShown = pick(".sweeps output");
    this.warm = pick(".warm input");
    this.box = pick(".box input");
    this.order = pick(".order");
    this.solver = pick(".solver");
    this.told = pick(".told");
    this.canvas = pick("canvas");
    this.order.append(...ORDERS.map((name, i) => new Option(name.replaceAll("_", " "), i)));
    this.cells = rows(pick("tbody"), [...OF_JOINTS, ...SOLVER_FIELDS]);
    this.sweeps.addEventListener("input", () => this.set({ iterations: Number(this.sweeps.value) }));
    this.warm.addEventListener("change", () => this.set({ warm_start: Number(this.warm.checked) }));
    this.box.addEventListener("change", () => this.set({ box: Number(this.box.checked) }));
    this.order.addEventListener("change", () => this.set({ order: Number(this.order.value) }));
    this.solver.addEventListener("change", () => this.set({ solver: this.solver.value }));
    this.view = new View(this.canvas);
    this.view.onlook = () => this.draw();
    this.view.ongrab = (body) => this.app.grab(this, body);
    this.view.onpull = (way) => this.app.pull(way);
    this.view.onrelease = () => this.app.release();
    this.history = null;
    this.kept = null;
  }

  load(scene) {
    const before = this.settings;
    this.simulation = new Simulation(new Kernels(this.app.module, this.app.contents.layout), scene);
    const { iterations, warm_start, order, solver, box } = before ?? { ...this.settings, ...DEFAULTS[this.index] };
    this.simulation.set({ iterations, warm_start, order, box });
    this.choose(solver);
    this.start = Float64Array.from(this.simulation.array("x"));
    this.history = { time: [], values: [], plain: true }; // plain: since the start, only the side's own settings have acted.
    this.curve = null; // Curve of the last step that recorded its sweeps.
    this.fresh = true; // No step has followed.
    this.kept = null;
    this.readSettings();
  }

  get settings() {
    return this.simulation && { ...this.simulation.settings, solver: this.wanted ?? "sweeps" };
  }

  set({ solver, ...changes }) {
    this.history.plain &&= this.history.time.length === 0;
    this.simulation.set(changes);
    if (solver) {
      this.choose(solver);
    }
    this.readSettings();
    this.app.write();
  }

  // The module of Newton's method is loaded at its first use; no step is done until it is loaded.
  choose(solver) {
    this.wanted = solver;
    if (solver !== "newton") {
      this.simulation.use(null);
    } else if (this.app.newton instanceof WebAssembly.Module) {
      this.simulation.use(new Newton(this.app.newton, this.simulation.k));
    } else {
      this.app.fetchNewton();
    }
  }

  // A held body follows the pointer as on a spring, independent of its mass.
  pull({ body, at }) {
    const [x, v, dynamic] = ["x", "v", "dyn"].map((name) => this.simulation.array(name));
    if (dynamic[body] < 0) {
      return;
    }
    this.history.plain = false;
    const dt = this.app.scene.dt;
    for (let k = 0; k < 3; k++) {
      const now = v[6 * body + k];
      v[6 * body + k] = (now + dt * PULL * (at[k] - x[3 * body + k])) / (1 + 2 * dt * Math.sqrt(PULL));
    }
  }

  // Return the largest distance [m] of a body from its initial position: sideways, and downwards.
  displacement() {
    const [x, dynamic] = [this.simulation.array("x"), this.simulation.array("dyn")];
    const most = [0, 0];
    for (let i = 0; i < dynamic.length; i++) {
      const [dx, dy, dz] = [0, 1, 2].map((k) => x[3 * i + k] - this.start[3 * i + k]);
      if (dynamic[i] >= 0) {
        most[0] = Math.max(most[0], Math.hypot(dx, dy));
        most[1] = Math.max(most[1], -dz);
      }
    }
    return most;
  }

  // Return the largest distance [m] between the ends of a joint (for a distance joint, the deviation from its length).
  gap() {
    const s = this.simulation;
    const { joint: at, joint_kinds: kinds } = s.k.layout;
    const [joint, bodies, kind] = ["joint", "joint_bodies", "joint_kind"].map((name) => s.array(name));
    const reals = joint.length / s.joints;
    let most = 0;
    for (let j = 0; j < s.joints; j++) {
      const end = (side, place) => s.point(bodies[2 * j + side], joint.subarray(j * reals + place, j * reals + place + 3));
      const [a, b] = [end(0, at.anchor_a), end(1, at.anchor_b)];
      const far = Math.hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2]);
      most = Math.max(most, kind[j] === kinds.distance ? Math.abs(far - joint[j * reals + at.length]) : far);
    }
    return most;
  }

  readSettings() {
    const { iterations, warm_start, order, solver, box } = this.settings;
    const newton = solver === "newton";
    this.solver.value = solver;
    this.sweeps.disabled = newton; // Newton's method has a tolerance, not a number of sweeps.
    this.order.disabled = newton;
    this.sweeps.value = iterations;
    this.sweepsShown.textContent = iterations;
    this.warm.checked = Boolean(warm_start);
    this.box.checked = Boolean(box);
    this.order.value = order;
  }

  // Recording the sweeps of a step takes as long as the step: it is only done if their error is displayed.
  step(time, watched = true) {
    this.fresh = watched || this.simulation.newton !== null;
    let finite;
    if (this.fresh) {
      this.curve = this.simulation.stepWatched();
      finite = this.curve.finite;
    } else {
      finite = this.simulation.step();
    }
    this.history.time.push(time);
    const values = this.simulation.values;
    this.history.values.push(this.simulation.newton ? [null, ...values.slice(1)] : values); // Newton's method has no number of sweeps.
    if (this.history.time.length > KEPT) {
      this.history.time.shift();
      this.history.values.shift();
    }
    return finite;
  }

  snapshot() {
    this.kept = {
      state: this.simulation.snapshot(),
      history: { ...this.history, time: [...this.history.time], values: [...this.history.values] },
      curve: this.curve,
      fresh: this.fresh,
    };
  }

  restore() {
    const { state, history, curve, fresh } = this.kept;
    this.simulation.restore(state);
    this.wanted = state.newton ? "newton" : "sweeps";
    this.history = { ...history, time: [...history.time], values: [...history.values] };
    this.curve = curve;
    this.fresh = fresh;
    this.readSettings();
  }

  push(random) {
    this.history.plain = false;
    const [v, dynamic] = [this.simulation.array("v"), this.simulation.array("dyn")];
    for (let i = 0; i < dynamic.length; i++) {
      for (let k = 0; k < 6; k++) {
        const share = random();
        if (dynamic[i] >= 0) {
          v[6 * i + k] += k === 2 ? 0 : 0.6 * (share - 0.5);
        }
      }
    }
  }

  draw() {
    this.view.draw(this.simulation, this.app.colors);
  }

  // Return the median of one of the eight values over steps first + 1 to last, or the value of the first solve if last is 0;
  // null before step `last`, or if the user has changed the run.
  median(field, first, last) {
    const { time, values, plain } = this.history;
    if (!plain || values.length < last || values.length !== Math.round(time[time.length - 1] / this.app.scene.dt)) {
      return null;
    }
    const at = SOLVER_FIELDS.indexOf(field);
    if (last === 0) {
      return this.simulation.first?.[at] ?? null;
    }
    const found = values.slice(first, last).map((row) => row[at]).sort((x, y) => x - y);
    const half = found.length >> 1;
    return found.length % 2 ? found[half] : (found[half - 1] + found[half]) / 2;
  }

  // Describe the work of the last step.
  work() {
    const { newton, substeps, short, solved, settings } = this.simulation;
    const parts = substeps === 1 ? "in one step" : `in each of ${substeps} substeps`;
    if (!newton) {
      return `sweeps: ${settings.iterations} ${parts}`;
    }
    if (!this.curve || this.curve.steps === undefined) {
      return `newton: to ${TOL.toExponential(0)} of the error ${parts}`;
    }
    const { sweeps, steps, relative } = this.curve;
    return `newton: ${sweeps} sweeps, ${steps} factorisations, ${relative.toExponential(0)} of the error left; `
      + `${short} of ${solved} solves short of ${TOL.toExponential(0)}`;
  }

  show() {
    const values = this.simulation.values;
    const stepped = this.simulation.steps > 0;
    const joints = this.simulation.joints > 0;
    const impulses = joints ? this.simulation.array("joint_impulse") : [];
    const most = [joints && stepped ? this.gap() : 0, impulses.reduce((x, y) => Math.max(x, Math.abs(y)), 0)];
    OF_JOINTS.forEach((field, i) => {
      const cell = this.cells[field];
      cell.parentElement.hidden = !joints;
      cell.textContent = stepped ? shown(field, most[i]) : "–";
      cell.dataset.value = stepped ? String(most[i]) : "";
    });
    SOLVER_FIELDS.forEach((field, i) => {
      const cell = this.cells[field];
      const asked = this.simulation.newton && field === "iterations" ? `to ${TOL.toExponential(0)}` : shown(field, values[i]);
      cell.textContent = stepped ? asked : "–";
      cell.dataset.value = stepped ? String(values[i]) : "";
    });
    this.told.textContent = this.work();
    const what = `Side ${"AB"[this.index]}: ${this.app.scene.title}, ${values[2]} contacts`;
    if (this.canvas.getAttribute("aria-label") !== what) {
      this.canvas.setAttribute("aria-label", what);
    }
  }
}
