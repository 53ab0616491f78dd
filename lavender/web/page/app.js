// The page: two simulations of one scene with settings of their own, stepped together, drawn and plotted.

import { View, colors, fail, find, rows } from "./draw.js";
import { Kernels, Newton, ORDERS, Simulation, SOLVER_FIELDS, TOL } from "./lavender.js";

const KEPT = 720; // steps in the plots over time
const MOST_STEPS = 6; // in one frame; a slower machine runs slower than real time
const PART_EVERY = 16; // ms between two parts of the page beside the pictures, of eight, while it runs
const MOST_PARTS = 3; // in one frame
const DEFAULTS = [{ warm_start: 1 }, { warm_start: 0 }];
const WHOLE = new Set(["iterations", "warm_start", "contacts", "cache_matches"]);
const PULL = 200; // 1/s^2 and, as 2 sqrt of it, 1/s: the spring a held body hangs on, critically damped
const PLAIN = ["scene", "a", "b", "speed", "play"];
// Of joints, which the eight values of a step say nothing of: how far the worst is open, and its largest impulse.
const OF_JOINTS = ["joints open", "joint impulse"];

export function shown(field, value) {
  return WHOLE.has(field) || value === 0 ? String(value) : value.toExponential(5);
}

// -- plots -------------------------------------------------------------------------------------------------

const positive = (x) => (x > 0 ? x : null);
// Of each chart over time the fields of both sides, in the order of its series.
const OVER_TIME = {
  residual: { fields: ["residual_initial", "residual_final"], change: positive },
  violation: { fields: ["violation_initial", "violation_final"], change: positive },
  contacts: { fields: ["contacts", "cache_matches"] },
  settings: { fields: ["warm_start", "iterations"] },
};

function decades(plot, low, high) {
  if (low === null || high === null) {
    return [1e-6, 1];
  }
  const [from, to] = [Math.floor(Math.log10(low)), Math.ceil(Math.log10(high))];
  return [10 ** from, 10 ** Math.max(to, from + 1)];
}

function upwards(plot, low, high) {
  return [0, high === null || high <= 0 ? 1 : 1.08 * high];
}

class Chart {
  // series: { side, dash, scale } each; `log`: powers of ten on the left.
  constructor(place, series, { log = false, right = false, empty = false, x = "time [s]" } = {}) {
    this.place = find(place);
    this.series = series;
    this.options = { log, right, empty, x };
    this.data = null;
    this.make();
    new ResizeObserver(() => this.#resize()).observe(this.place);
  }

  get size() {
    return { width: Math.max(200, this.place.clientWidth), height: 190 };
  }

  // Also after a change between light and dark.
  make() {
    this.plot?.destroy();
    const style = getComputedStyle(document.documentElement);
    const color = (name) => style.getPropertyValue(name).trim();
    const colors = [color("--a"), color("--b")];
    const { log, right, x } = this.options;
    const axis = { stroke: color("--soft"), font: "12px system-ui", grid: { stroke: color("--line"), width: 1 }, ticks: { show: false } };
    const powers = (plot, axis, low, high) => {
      const [from, to] = [low, high].map((v) => Math.round(Math.log10(v)));
      const every = Math.ceil((to - from + 1) / 6);
      return Array.from({ length: Math.floor((to - from) / every) + 1 }, (_, i) => 10 ** (from + i * every));
    };
    const power = (plot, values) => values.map((v) => `1e${Math.round(Math.log10(v))}`);
    this.plot = new uPlot(
      {
        ...this.size,
        legend: { show: false },
        cursor: { show: false },
        scales: {
          x: { time: false },
          y: log ? { distr: 3, range: decades } : { range: upwards },
          ...(right ? { right: { range: [0, 1.08] } } : {}),
        },
        axes: [
          { ...axis, size: 34, label: x, labelSize: 16, labelFont: "12px system-ui" },
          { ...axis, size: 52, ...(log ? { splits: powers, filter: (plot, splits) => splits, values: power } : {}) },
          ...(right ? [{ ...axis, scale: "right", side: 1, size: 30, grid: { show: false }, splits: () => [0, 1] }] : []),
        ],
        series: [
          {},
          ...this.series.map(({ side, dash, scale }) => ({
            stroke: colors[side], width: dash ? 1.25 : 2, dash: dash ? [4, 4] : undefined, points: { show: false },
            scale: scale ?? "y", spanGaps: false,
          })),
        ],
      },
      this.data ?? [[], ...this.series.map(() => [])],
      this.place,
    );
  }

  set(data) {
    this.data = data;
    // A panel that has nothing to show gives way.
    const figure = this.place.closest("figure");
    const nothing = data[0].length > 0 && data.slice(1).every((ys) => ys.every((y) => y === null || y === undefined || (this.options.empty && y === 0)));
    if (figure.hidden !== nothing) {
      figure.hidden = nothing;
      this.#resize();
    }
    this.plot.setData(data);
  }

  #resize() {
    if (this.plot.width !== this.size.width) {
      this.plot.setSize(this.size);
    }
  }
}

// -- one side ----------------------------------------------------------------------------------------------

class Side {
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
    this.order.append(...ORDERS.map((name, i) => new Option(name.replace("_", " "), i)));
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
    this.forget();
    this.readSettings();
  }

  forget() {
    this.history = { time: [], values: [] };
    this.curve = null; // of the last step whose sweeps were watched
    this.fresh = true; // no step since then
    this.kept = null;
  }

  get settings() {
    return this.simulation && { ...this.simulation.settings, solver: this.wanted ?? "sweeps" };
  }

  set({ solver, ...changes }) {
    this.simulation.set(changes);
    if (solver) {
      this.choose(solver);
    }
    this.readSettings();
    this.app.write();
  }

  // The module of Newton's method is fetched when it is first asked for; no step is taken until it has come.
  choose(solver) {
    this.wanted = solver;
    if (solver !== "newton") {
      this.simulation.use(null, solver === "soft_step" ? solver : "impulses");
    } else if (this.app.newton instanceof WebAssembly.Module) {
      this.simulation.use(new Newton(this.app.newton, this.simulation.k));
    } else {
      this.app.fetchNewton();
    }
  }

  // A held body follows the pointer as if on a spring, whatever its mass.
  pull({ body, at }) {
    const [x, v, dynamic] = ["x", "v", "dyn"].map((name) => this.simulation.array(name));
    if (dynamic[body] < 0) {
      return;
    }
    const dt = this.app.scene.dt;
    for (let k = 0; k < 3; k++) {
      const now = v[6 * body + k];
      v[6 * body + k] = (now + dt * PULL * (at[k] - x[3 * body + k])) / (1 + 2 * dt * Math.sqrt(PULL));
    }
  }

  // How far [m] a body is from its start at most: sideways, and below it.
  lean() {
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

  // Largest distance [m] between the ends of a joint (from its length, of a distance joint).
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
    this.sweeps.disabled = newton; // it asks for a residual, not for a number of sweeps
    this.order.disabled = newton;
    this.sweeps.value = iterations;
    this.sweepsShown.textContent = iterations;
    this.warm.checked = Boolean(warm_start);
    this.box.checked = Boolean(box);
    this.order.value = order;
  }

  // Watching the sweeps of a step takes as long as the step: only where their error is shown.
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
    this.history.values.push(this.simulation.newton ? [null, ...values.slice(1)] : values); // no number of sweeps
    if (this.history.time.length > KEPT) {
      this.history.time.shift();
      this.history.values.shift();
    }
    return finite;
  }

  snapshot() {
    this.kept = {
      state: this.simulation.snapshot(),
      history: { time: [...this.history.time], values: [...this.history.values] },
      curve: this.curve,
      fresh: this.fresh,
    };
  }

  restore() {
    const { state, history, curve, fresh } = this.kept;
    this.simulation.restore(state);
    this.wanted = state.newton ? "newton" : state.stepper === "soft_step" ? "soft_step" : "sweeps";
    this.history = { time: [...history.time], values: [...history.values] };
    this.curve = curve;
    this.fresh = fresh;
    this.readSettings();
  }

  push(random) {
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

  // What the step cost, in words.
  work() {
    const { newton, substeps, short, solved, settings } = this.simulation;
    const parts = substeps === 1 ? "in one step" : `in each of ${substeps} substeps`;
    if (this.wanted === "soft_step") {
      return `soft step: ${settings.iterations} sweeps and one that relaxes ${parts}`;
    }
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

// -- the page ----------------------------------------------------------------------------------------------

class App {
  constructor(module, contents) {
    this.module = module;
    this.contents = contents;
    this.newton = null; // the module, once it has been asked for and has come
    this.playing = false;
    this.owed = 0; // s, simulated time that the frames have not stepped yet
    this.last = null;
    this.due = 0; // parts of the page that the next picture brings up to date
    this.next = 0; // the first of them
    this.colors = colors();
    this.sides = Array.from(document.querySelectorAll(".side"), (place, i) => new Side(place, i, this));
    const views = this.sides.map((side) => side.view);
    views.forEach((view) => {
      view.linked = views;
    });
    this.makeCharts();
    this.listen();
    find("scene").append(...contents.scenes.map((scene) => new Option(scene.title, scene.name)));
    find("presets").append(...contents.presets.map((preset) => {
      const button = Object.assign(document.createElement("button"), { type: "button", textContent: preset.title });
      button.dataset.preset = preset.name;
      button.addEventListener("click", () => {
        this.take(preset);
        this.play(true);
      });
      return button;
    }));
    this.read();
    window.addEventListener("hashchange", () => location.hash !== this.written && this.read());
    requestAnimationFrame((now) => this.frame(now));
  }

  makeCharts() {
    const both = [{ side: 0 }, { side: 1 }];
    const four = [{ side: 0, dash: true }, { side: 1, dash: true }, ...both];
    this.charts = {
      energy: new Chart("chart-energy", both, { log: true, x: "sweep, factorisation" }),
      normal: new Chart("chart-normal", both, { log: true, x: "sweep, factorisation" }),
      residual: new Chart("chart-residual", four, { log: true }),
      violation: new Chart("chart-violation", four, { log: true }),
      contacts: new Chart("chart-contacts", four, { empty: true }),
      settings: new Chart("chart-settings", four.map((s) => (s.dash ? { ...s, scale: "right" } : s)), { right: true }),
    };
    const time = (...fields) => fields.map((field) => () => this.plotTime(field));
    this.parts = [
      () => this.plotCurves(), ...time("residual", "violation", "contacts", "settings"),
      () => this.sides[0].show(), () => this.sides[1].show(), () => this.caption(),
    ];
  }

  listen() {
    const click = (id, act) => find(id).addEventListener("click", act);
    click("play", () => this.play(!this.playing));
    click("step", () => this.advance(1));
    click("second", () => this.advance(Math.round(1 / this.scene.dt)));
    click("reset", () => this.choose(this.scene.name));
    click("snapshot", () => this.snapshot());
    click("restore", () => this.restore());
    click("push", () => this.push());
    find("scene").addEventListener("change", (event) => this.choose(event.target.value));
    find("speed").addEventListener("change", () => this.write());
    document.addEventListener("keydown", (event) => this.key(event));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      this.colors = colors();
      Object.values(this.charts).forEach((chart) => chart.make());
      this.show(true);
    });
    window.addEventListener("resize", () => this.show(true));
  }

  key(event) {
    const typing = /^(SELECT|INPUT|BUTTON)$/.test(event.target.tagName);
    if (event.ctrlKey || event.metaKey || event.altKey || (typing && (event.key === " " || event.key === "Enter"))) {
      return;
    }
    if (event.target.tagName === "SELECT" && event.key.length === 1) {
      return; // a letter or digit there chooses an option
    }
    const side = this.sides[event.shiftKey ? 1 : 0];
    const sweeps = (by) => side.set({ iterations: Math.min(64, Math.max(4, side.simulation.settings.iterations + by)) });
    const scene = this.contents.scenes[Number(event.key) - 1];
    const acts = {
      " ": () => this.play(!this.playing),
      ".": () => this.advance(1),
      0: () => this.choose(this.scene.name),
      s: () => this.snapshot(),
      r: () => this.restore(),
      p: () => this.push(),
      w: () => side.set({ warm_start: 1 - side.simulation.settings.warm_start }),
      n: () => side.set({ solver: side.settings.solver === "newton" ? "sweeps" : "newton" }),
      "+": () => sweeps(4),
      "=": () => sweeps(4),
      "*": () => sweeps(4),
      "-": () => sweeps(-4),
      _: () => sweeps(-4),
    };
    const act = acts[event.key.toLowerCase()] ?? (scene ? () => this.choose(scene.name) : null);
    if (act) {
      act();
      event.preventDefault();
    }
  }

  // -- the address: everything that is set, or the name of a preset or of a scene alone

  read() {
    const words = decodeURIComponent(location.hash.slice(1));
    const given = new URLSearchParams(words.includes("=") ? words : "");
    const preset = this.contents.presets.find((one) => one.name === words);
    const scenes = this.contents.scenes.map((scene) => scene.name);
    if (words === "" || preset) {
      this.take(preset ?? this.contents.presets[0]);
      this.play(!matchMedia("(prefers-reduced-motion: reduce)").matches);
      return;
    }
    const name = given.get("scene") ?? words;
    this.choose(scenes.includes(name) ? name : scenes[0]);
    ["a", "b"].forEach((key, i) => {
      const [sweeps, warm, order, ...more] = (given.get(key) ?? "").split(",");
      const solver = more.find((word) => ["newton", "soft_step"].includes(word)) ?? "sweeps";
      const changes = { solver, box: Number(more.includes("box")) };
      if (Number(sweeps) >= 4 && Number(sweeps) <= 64) {
        changes.iterations = Math.round(Number(sweeps));
      }
      if (warm === "warm" || warm === "cold") {
        changes.warm_start = Number(warm === "warm");
      }
      if (ORDERS.includes(order)) {
        changes.order = ORDERS.indexOf(order);
      }
      this.sides[i].set(changes);
    });
    if (Array.from(find("speed").options, (option) => option.value).includes(given.get("speed"))) {
      find("speed").value = given.get("speed");
    }
    this.play(given.get("play") === "1");
    this.write();
  }

  write() {
    if (!this.scene || this.sides.some((side) => !side.simulation)) {
      return;
    }
    const said = this.sides.map(({ settings: s }) =>
      [s.iterations, s.warm_start ? "warm" : "cold", ORDERS[s.order], ...(s.solver === "sweeps" ? [] : [s.solver]),
        ...(s.box ? ["box"] : [])].join(","));
    const values = [this.scene.name, ...said, find("speed").value, this.playing ? 1 : 0];
    this.written = "#" + PLAIN.map((name, i) => `${name}=${values[i]}`).join("&");
    if (location.hash !== this.written) {
      history.replaceState(null, "", this.written);
    }
    const now = this.contents.presets.find((preset) => preset.scene === this.scene.name
      && preset.sides.every((side, i) => Object.entries(side).every(([key, value]) => this.sides[i].settings[key] === value)));
    find("note").textContent = (now ?? this.scene).note;
    for (const button of find("presets").children) {
      button.setAttribute("aria-pressed", button.dataset.preset === now?.name);
    }
  }

  take(preset) {
    this.choose(preset.scene);
    preset.sides.forEach((side, i) => this.sides[i].set(side));
  }

  fetchNewton() {
    this.newton ??= fetch("newton.wasm")
      .then((answer) => {
        if (!answer.ok) {
          throw new Error(`newton.wasm: ${answer.status} ${answer.statusText}`);
        }
        return answer.arrayBuffer();
      })
      .then((bytes) => WebAssembly.compile(bytes))
      .then((module) => {
        this.newton = module;
        this.sides.filter((side) => side.wanted === "newton").forEach((side) => side.choose("newton"));
      })
      .catch((error) => {
        this.newton = null;
        fail(`Newton's method could not be loaded: ${error.message}. Both sides sweep.`);
        this.sides.forEach((side) => side.set({ solver: "sweeps" }));
      });
  }

  // Whether a side waits for the module of Newton's method.
  get waiting() {
    return this.sides.some((side) => side.wanted === "newton" && !side.simulation.newton);
  }

  // -- a body held by the pointer, on both sides alike

  grab(side, body) {
    if (side.simulation.array("dyn")[body] >= 0) {
      const x = side.simulation.array("x");
      this.held = { body, at: Array.from(x.subarray(3 * body, 3 * body + 3)) };
    }
  }

  pull(way) {
    if (this.held) {
      this.held.at = this.held.at.map((v, k) => v + way[k]);
    }
  }

  release() {
    this.held = null;
  }

  choose(name) {
    this.held = null;
    this.scene = this.contents.scenes.find((scene) => scene.name === name);
    find("scene").value = name;
    this.steps = 0;
    this.seed = 1;
    this.owed = 0;
    for (const side of this.sides) {
      side.load(this.scene);
      side.view.fit(side.simulation);
    }
    find("restore").disabled = true;
    find("failure").hidden = true;
    this.write();
    this.show(true);
  }

  // A pause begins with a step that is watched, so that what is shown belongs to one step.
  play(on) {
    const pauses = this.playing && !on;
    this.playing = on;
    this.last = null;
    if (pauses) {
      this.sides.every((side) => side.fresh) ? this.show(true) : this.advance(1);
    }
    find("play").textContent = on ? "Pause" : "Play";
    find("play").setAttribute("aria-pressed", on);
    this.write();
  }

  // The same steps on both sides.
  advance(steps) {
    if (this.waiting) {
      return;
    }
    const curves = (this.parts.length - this.next) % this.parts.length < this.due;
    for (let i = 0; i < steps; i++) {
      const lost = this.sides.find((side) => side.simulation.lost >= 0);
      if (lost) {
        this.play(false);
        const body = this.scene.bodies[lost.simulation.lost];
        fail(`Side ${"AB"[lost.index]}: the state of ${body} is no longer finite. Reset, or restore a snapshot.`);
        break;
      }
      this.steps += 1;
      if (this.held) {
        this.sides.forEach((side) => side.pull(this.held));
      }
      const watched = !this.playing || (curves && i === steps - 1);
      this.sides.forEach((side) => side.step(this.steps * this.scene.dt, watched));
    }
    this.show(!this.playing);
  }

  snapshot() {
    this.sides.forEach((side) => side.snapshot());
    this.keptSteps = [this.steps, this.seed];
    find("restore").disabled = false;
  }

  restore() {
    if (find("restore").disabled) {
      return;
    }
    [this.steps, this.seed] = this.keptSteps;
    this.sides.forEach((side) => side.restore());
    find("failure").hidden = true;
    this.show(true);
  }

  // The same push on both sides, the same after every reset.
  push() {
    const start = this.seed;
    for (const side of this.sides) {
      this.seed = start;
      side.push(() => {
        this.seed = (Math.imul(this.seed, 1664525) + 1013904223) >>> 0;
        return this.seed / 2 ** 32;
      });
    }
    this.show(true);
  }

  frame(now) {
    if (this.playing && !this.waiting) {
      const passed = this.last === null ? 0 : now - this.last;
      this.owed += Math.min(0.1, passed / 1000) * Number(find("speed").value);
      this.last = now;
      this.due = Math.min(MOST_PARTS, Math.max(1, Math.round(passed / PART_EVERY)));
      const steps = Math.min(MOST_STEPS, Math.floor(this.owed / this.scene.dt));
      if (steps > 0) {
        this.owed = Math.min(this.owed - steps * this.scene.dt, this.scene.dt);
        this.advance(steps);
      }
    }
    requestAnimationFrame((next) => this.frame(next));
  }

  // The pictures, and of all else everything or what is due: text and charts that changed in every frame would cost
  // more than the pictures.
  show(always) {
    this.sides.forEach((side) => side.draw());
    const n = this.parts.length;
    if (always) {
      this.next = 0;
    }
    for (let left = always ? n : this.due; left > 0; left--) {
      this.parts[this.next]();
      this.next = (this.next + 1) % n;
    }
  }

  // What the two settings did, measured.
  caption() {
    find("clock").textContent = `${(this.steps * this.scene.dt).toFixed(3)} s, step ${this.steps}`;
    const { measure, bodies } = this.scene;
    const say = (a, between, b) => find("caption").replaceChildren(bold(a), between, bold(b));
    const bold = (text) => Object.assign(document.createElement("b"), { textContent: text });
    if (measure === "gap") {
      const [a, b] = this.sides.map((side) => length(side.gap()));
      say(`A's joints are open by ${a}`, ", ", `B's by ${b}`);
    } else if (measure === "lean") {
      const [a, b] = this.sides.map((side, i) => {
        const [across, down] = side.lean();
        return `${"AB"[i]} ${across >= down ? "leans" : "sinks"} ${length(Math.max(across, down))}`;
      });
      say(a, ", ", b);
    } else {
      const [a, b] = this.sides.map((side) => side.simulation.array("x"));
      let found = [0, -1];
      for (let i = 0; i < bodies.length; i++) {
        const far = Math.hypot(...[0, 1, 2].map((k) => a[3 * i + k] - b[3 * i + k]));
        found = far > found[0] ? [far, i] : found;
      }
      say("A", " and ", found[1] < 0 ? "B move alike" : `B are ${length(found[0])} apart at ${bodies[found[1]]}`);
    }
  }

  // Sweeps are watched one by one, Newton's method at its scores: each side has its own places, joined by lines.
  plotCurves() {
    const along = [...new Set(this.sides.flatMap((side) => side.curve?.at ?? []))].sort((x, y) => x - y);
    for (const name of ["energy", "normal"]) {
      const columns = this.sides.map(({ curve }) => {
        const of = new Map(curve?.at.map((at, i) => [at, curve[name][i]]) ?? []);
        return along.map((at) => (of.has(at) ? positive(of.get(at)) : undefined));
      });
      this.charts[name].set([along, ...columns]);
    }
  }

  plotTime(name) {
    const { fields, change } = OVER_TIME[name];
    const [a, b] = this.sides;
    const column = (side, field) => {
      const at = SOLVER_FIELDS.indexOf(field);
      return side.history.values.map((values) => (change ? change(values[at]) : values[at]));
    };
    this.charts[name].set([a.history.time, ...fields.flatMap((field) => [column(a, field), column(b, field)])]);
  }
}

// As people say lengths: 8 cm, 0.3 mm, 1.2 m.
export function length(x) {
  if (!Number.isFinite(x)) {
    return "out of sight";
  }
  const [scale, unit] = x >= 0.9995 ? [1, "m"] : x >= 0.00995 ? [0.01, "cm"] : [0.001, "mm"];
  return `${x / scale >= 9.95 ? Math.round(x / scale) : (x / scale).toFixed(1)} ${unit}`;
}

async function start() {
  const [module, contents] = await Promise.all([
    fetch("lavender.wasm").then((answer) => answer.arrayBuffer()).then((bytes) => WebAssembly.compile(bytes)),
    fetch("scenes.json").then((answer) => answer.json()),
  ]);
  window.lavender = new App(module, contents);
  document.documentElement.dataset.ready = "true";
}

start().catch((error) => {
  fail(`The page could not start: ${error.message}`);
  throw error;
});
