// The page: two simulations of one scene with different settings, stepped together, drawn and plotted.

import { Chart, OVER_TIME, positive } from "./charts.js";
import { colors, fail, find } from "./draw.js";
import { Newton, ORDERS, SOLVER_FIELDS } from "./lavender.js";
import { Side } from "./side.js";

const MOST_STEPS = 6; // Largest number of steps per frame; a slow machine runs slower than real time.
const PART_EVERY = 16; // [ms] Time between updates of two of the eight parts of the page that are not pictures, while it runs.
const MOST_PARTS = 3; // Largest number of such updates per frame.
const PLAIN = ["scene", "a", "b", "speed", "play"];

class App {
  constructor(module, contents) {
    this.module = module;
    this.contents = contents;
    this.newton = null; // The module, after it was requested and loaded.
    this.playing = false;
    this.owed = 0; // [s] Simulated time that has not been stepped yet.
    this.last = null;
    this.due = 0; // Number of parts of the page to update with the next picture.
    this.next = 0; // The first part to update.
    this.colors = colors();
    this.sides = Array.from(document.querySelectorAll(".side"), (place, i) => new Side(place, i, this));
    const views = this.sides.map((side) => side.view);
    views.forEach((view) => {
      view.linked = views;
    });
    this.makeCharts();
    this.listen();
    find("scene").append(...contents.scenes.map((scene) => new Option(scene.title, scene.name)));
    for (const preset of contents.presets) {
      const button = Object.assign(document.createElement("button"), { type: "button", textContent: preset.title });
      button.dataset.preset = preset.name;
      button.addEventListener("click", () => {
        this.take(preset);
        this.play(true);
      });
      find(preset.numbers.length ? "experiments" : "presets").append(button);
    }
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
    click("open", () => find("file").click());
    click("download", () => this.download());
    find("file").addEventListener("change", (event) => this.open(event.target.files[0]));
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
      return; // In such a field, a letter or digit selects an option.
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

  // -- the address: all settings, or only the name of a preset or of a scene

  read() {
    let words = location.hash.slice(1);
    try {
      words = decodeURIComponent(words);
    } catch {
      // An invalid escape sequence: the name is used unchanged.
    }
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
    if (!scenes.includes(name)) {
      fail(`There is no scene "${name}": this is ${scenes[0]}.`);
    }
    ["a", "b"].forEach((key, i) => {
      const [sweeps, warm, order, ...more] = (given.get(key) ?? "").split(",");
      const solver = more.includes("newton") ? "newton" : "sweeps";
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
    for (const button of document.querySelectorAll("[data-preset]")) {
      button.setAttribute("aria-pressed", button.dataset.preset === now?.name);
    }
    if (this.now !== now) {
      this.now = now;
      const pressed = document.querySelector("[data-preset][aria-pressed=true]");
      if (pressed) { // The row of buttons may be wider than the window.
        pressed.parentElement.scrollLeft = pressed.offsetLeft - pressed.parentElement.offsetLeft;
      }
      this.forgetNumbers();
    }
  }

  // Create the lines of an experiment before the first step.
  forgetNumbers() {
    const numbers = this.now?.numbers ?? [];
    this.seen = numbers.map(() => null);
    find("numbers").hidden = numbers.length === 0;
    find("numbers").tBodies[0].replaceChildren(...numbers.map(({ text, first, last }) => {
      const row = document.createElement("tr");
      row.append(Object.assign(document.createElement("th"), { textContent: text }));
      const steps = last ? `${first + 1} to ${last}` : "first solve";
      row.append(...[steps, "–", "–", "–"].map((words) => Object.assign(document.createElement("td"), { textContent: words })));
      return row;
    }));
  }

  // Fill each line once, after its last step.
  tellNumbers() {
    (this.now?.numbers ?? []).forEach(({ field, first, last, over }, i) => {
      if (this.seen[i]) {
        return;
      }
      const [a, b] = this.sides.map((side) => side.median(field, first, last));
      if (a === null || b === null) {
        return;
      }
      this.seen[i] = { a, b, ratio: over === "AB" ? a / b : b / a };
      const { ratio } = this.seen[i];
      const cells = find("numbers").tBodies[0].rows[i].cells;
      [cells[2].textContent, cells[3].textContent] = [a, b].map((x) => (Number.isInteger(x) ? x : x.toExponential(2)));
      cells[4].textContent = over ? `${over[0]} / ${over[1]} = ${ratio >= 1000 ? ratio.toExponential(0) : ratio.toPrecision(3)}` : "";
    });
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

  // Return whether a side waits for the module of Newton's method.
  get waiting() {
    return this.sides.some((side) => side.wanted === "newton" && !side.simulation.newton);
  }

  // -- a body held by the pointer, in the same way on both sides

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
    this.forgetNumbers();
    this.show(true);
  }

  // A pause begins with a step that records its sweeps, so that all displayed data belong to one step.
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

  // Do the same steps on both sides.
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
      this.tellNumbers();
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
    this.write();
    find("failure").hidden = true;
    this.show(true);
  }

  // Add the scene of a file to the list, and select it. The file has the layout of the kernels that wrote it.
  async open(file) {
    find("file").value = "";
    try {
      const { lavender_scene: version, layout, scene } = JSON.parse(await file.text());
      if (version !== 1 || JSON.stringify(layout) !== JSON.stringify(this.contents.layout)) {
        throw new Error("it was not written by lavender.sim.web.write_scene of this version");
      }
      const others = this.contents.scenes.filter(({ name }) => name !== scene.name);
      this.contents.scenes = [...others, scene];
      find("scene").replaceChildren(...this.contents.scenes.map(({ title, name }) => new Option(title, name)));
      this.choose(scene.name);
    } catch (error) {
      fail(`${file.name} could not be opened: ${error.message}.`);
    }
  }

  // Download the values of both sides over the steps that the plots show.
  download() {
    const head = ["time [s]", ...["A", "B"].flatMap((side) => SOLVER_FIELDS.map((field) => `${side} ${field}`))];
    const [a, b] = this.sides.map((side) => side.history);
    const lines = a.time.map((time, i) => [time, ...a.values[i], ...(b.values[i] ?? [])].join(","));
    const text = [head.join(","), ...lines, ""].join("\n");
    const link = Object.assign(document.createElement("a"), {
      href: URL.createObjectURL(new Blob([text], { type: "text/csv" })), download: `${this.scene.name}.csv`,
    });
    link.click();
    URL.revokeObjectURL(link.href);
  }

  // Apply the same push on both sides; it is also the same after every reset.
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

  // Draw the pictures, and update all other parts or only those that are due: updating text and charts in every frame
  // would take more time than the pictures.
  show(always) {
    this.sides.forEach((side) => side.draw());
    find("download").disabled = this.sides[0].history.time.length === 0;
    const n = this.parts.length;
    if (always) {
      this.next = 0;
    }
    for (let left = always ? n : this.due; left > 0; left--) {
      this.parts[this.next]();
      this.next = (this.next + 1) % n;
    }
  }

  // Update the captions with the measured effects of the two settings.
  caption() {
    find("clock").textContent = `${(this.steps * this.scene.dt).toFixed(3)} s, step ${this.steps}`;
    const { measure, bodies } = this.scene;
    const say = (a, between, b) => find("caption").replaceChildren(bold(a), between, bold(b));
    const bold = (text) => Object.assign(document.createElement("b"), { textContent: text });
    if (measure === "gap") {
      const [a, b] = this.sides.map((side) => length(side.gap()));
      say(`A's joints are open by ${a}`, ", ", `B's by ${b}`);
    } else if (measure === "displacement") {
      const [a, b] = this.sides.map((side, i) => {
        const [across, down] = side.displacement();
        return across >= down ? `${"AB"[i]} moved sideways by ${length(across)}` : `${"AB"[i]} sank by ${length(down)}`;
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

  // The error is recorded at every sweep, or at the checks of Newton's method: each side has its own points, joined by lines.
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

// Format a length with a suitable unit: 8 cm, 0.3 mm, 1.2 m.
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
