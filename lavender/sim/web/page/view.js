// Show a film: poses of a run, frame by frame, live from the Python process that steps it, or from a file.

import { View, colors, fail, find, rows } from "./draw.js";
import { SOLVER_FIELDS } from "./lavender.js";

const [PLANE, SPHERE] = [1, 2];
const LEAD = 9; // Numbers of a frame before the poses: time and the eight solver values.
const MAGIC = "LAVENDER-FILM\n";
const VERSION = 1;
const POLL = 60; // [ms] Time between two requests for new frames.

// Return header and frames from the bytes of a film; everything is checked before anything is displayed.
function read(bytes) {
  const start = MAGIC.length + 8, text = new TextDecoder().decode(bytes.slice(0, MAGIC.length));
  const size = bytes.byteLength > start ? Number(new DataView(bytes).getBigUint64(MAGIC.length, true)) : 0;
  if (text !== MAGIC || start + size > bytes.byteLength) {
    throw new Error("it does not begin as one");
  }
  const header = JSON.parse(new TextDecoder().decode(bytes.slice(start, start + size)));
  const data = new Float32Array(bytes.slice(start + size));
  const { bodies, joints } = header;
  const numbers = (x, count) => x.length === count && x.every(Number.isFinite);
  const isBody = (x) => Number.isInteger(x) && x < bodies.length;
  if (header.version !== VERSION || !Array.isArray(bodies) || !Array.isArray(joints)
    || !bodies.every((body) => [0, 1, 2, 3].includes(body.kind) && numbers(body.shape, 4))
    || !joints.every((joint) => isBody(joint.body) && isBody(joint.other) && joint.body >= 0 && numbers(joint.anchor, 3))
    || data.length % (LEAD + 7 * bodies.length) || !data.every(Number.isFinite)) {
    throw new Error("its header or its frames have another version");
  }
  return { header, data };
}

// A frame with the interface of a simulation that draw.js uses.
class Frame {
  constructor(header) {
    this.header = header;
    this.joints = header.joints.length;
    this.steps = 0; // A film has no contacts.
    this.values = new Float32Array(8);
    this.k = { layout: { joint: { anchor_b: 0 } } };
    const n = header.bodies.length;
    this.arrays = {
      x: new Float64Array(3 * n),
      q: new Float64Array(4 * n),
      kind_of_shape: Int32Array.from(header.bodies, (body) => body.kind),
      shape: Float64Array.from(header.bodies.flatMap((body) => body.shape)),
      joint: Float64Array.from(header.joints.flatMap((joint) => joint.anchor)),
      joint_bodies: Int32Array.from(header.joints.flatMap((joint) => [joint.other, joint.body])),
      point: new Float64Array(0),
      impulse: new Float64Array(0),
      ptr: new Int32Array(0),
    };
  }

  array(name) {
    return this.arrays[name];
  }

  set(numbers) {
    this.values = numbers.subarray(1, LEAD);
    const { x, q } = this.arrays;
    for (let i = 0; i < this.header.bodies.length; i++) {
      const at = LEAD + 7 * i;
      x.set(numbers.subarray(at, at + 3), 3 * i);
      q.set(numbers.subarray(at + 3, at + 7), 4 * i);
    }
  }
}

// Bounds of the picture: all bodies of the present frames, at most three times as large as for the first frame.
class Bounds {
  constructor(header) {
    this.seen = header.bodies.flatMap((body, i) => (
      body.kind >= SPHERE ? [[i, Math.hypot(...body.shape.slice(0, body.kind === SPHERE ? 1 : 3))]] : []
    ));
    this.hasGround = header.bodies.some((body) => body.kind === PLANE);
    this.low = null;
  }

  // Extend the bounds by frames; return whether they have changed.
  take(numbers) {
    const [low, high] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
    for (const [i, r] of this.seen) {
      for (let k = 0; k < 3; k++) {
        const x = numbers[LEAD + 7 * i + k];
        low[k] = Math.min(low[k], x - r);
        high[k] = Math.max(high[k], x + r);
      }
    }
    if (this.low === null) {
      if (!this.seen.length) {
        low.fill(-1);
        high.fill(1);
      }
      [this.low, this.high] = [low, high];
      const room = Math.max(...high.map((v, k) => v - low[k]));
      this.most = low.map((v, k) => [v - room, high[k] + room]);
      return true;
    }
    let grown = false;
    for (let k = 0; k < 3; k++) {
      const [from, to] = [Math.max(low[k], this.most[k][0]), Math.min(high[k], this.most[k][1])];
      grown ||= from < this.low[k] || to > this.high[k];
      this.low[k] = Math.min(this.low[k], from);
      this.high[k] = Math.max(this.high[k], to);
    }
    return grown;
  }
}

class Player {
  constructor() {
    this.view = new View(document.querySelector("canvas"));
    this.view.onlook = () => this.show();
    this.cells = rows(document.querySelector("tbody"), SOLVER_FIELDS);
    this.playing = true;
    this.following = true;
    find("play").addEventListener("click", () => this.play(!this.playing));
    find("live").addEventListener("click", () => this.follow(true));
    find("place").addEventListener("input", () => this.seek(Number(find("place").value)));
    find("file").addEventListener("change", (event) => this.open(event.target.files[0]));
    document.addEventListener("keydown", (event) => {
      if (event.key === " " && !/^(SELECT|INPUT|BUTTON)$/.test(event.target.tagName)) {
        this.play(!this.playing);
        event.preventDefault();
      }
    });
    window.addEventListener("resize", () => this.show());
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.show());
    requestAnimationFrame((now) => this.frame(now));
  }

  load(header) {
    this.header = header;
    this.state = new Frame(header);
    this.frames = [];
    this.at = 0;
    this.bounds = new Bounds(header);
    find("title").textContent = `${header.scene}, ${header.bodies.length} bodies`;
  }

  // Add frames (f, 9 + 7 n) from number `first` on.
  add(first, data) {
    const width = LEAD + 7 * this.header.bodies.length;
    this.frames.length = first;
    for (let i = 0; i + width <= data.length; i += width) {
      this.frames.push(data.subarray(i, i + width));
    }
    find("place").max = Math.max(0, this.frames.length - 1);
    let grown = false;
    for (const numbers of this.frames.slice(first)) {
      grown = this.bounds.take(numbers) || grown;
    }
    if (grown) {
      this.view.hold(this.bounds.low, this.bounds.high, this.bounds.hasGround);
      this.show();
    }
    if (this.following && this.frames.length) {
      this.at = this.frames.length - 1;
      this.show();
    }
  }

  play(on) {
    this.playing = on;
    if (on && this.at >= this.frames.length - 1) {
      this.at = 0;
    }
    this.follow(false);
    find("play").textContent = on ? "Pause" : "Play";
    find("play").setAttribute("aria-pressed", on);
  }

  follow(on) {
    this.following = on;
    this.last = null;
    find("live").setAttribute("aria-pressed", on);
  }

  seek(frame) {
    this.follow(false);
    this.playing = false;
    find("play").textContent = "Play";
    this.at = frame;
    this.show();
  }

  frame(now) {
    if (this.playing && !this.following && this.frames?.length > 1) {
      if (this.last != null) {
        this.clock += (Math.min(100, now - this.last) / 1000) * Number(find("speed").value);
        let at = Math.floor(this.at);
        while (at < this.frames.length - 1 && this.frames[at + 1][0] <= this.clock) {
          at += 1;
        }
        if (at !== this.at) {
          this.at = at;
          this.show();
        }
        if (at === this.frames.length - 1) {
          this.playing = false;
          find("play").textContent = "Play";
          find("play").setAttribute("aria-pressed", false);
        }
      } else {
        this.clock = this.frames[this.at][0];
      }
      this.last = now;
    }
    requestAnimationFrame((next) => this.frame(next));
  }

  show() {
    if (!this.frames?.length) {
      return;
    }
    this.state.set(this.frames[Math.min(this.at, this.frames.length - 1)]);
    this.view.draw(this.state, colors());
    SOLVER_FIELDS.forEach((field, i) => {
      const value = this.state.values[i];
      this.cells[field].textContent = i < 4 || value === 0 ? String(value) : value.toExponential(3);
    });
    find("place").value = this.at;
    find("clock").textContent = `${this.frames[this.at][0].toFixed(3)} s, frame ${this.at + 1} of ${this.frames.length}`;
    document.querySelector("canvas").setAttribute("aria-label", `${this.header.scene}, ${this.header.bodies.length} bodies`);
  }

  async open(file) {
    if (!file) {
      return;
    }
    let film;
    try {
      film = read(await file.arrayBuffer());
    } catch (error) {
      fail(`${file.name} is not a film that this page reads: ${error.message}`); // The displayed film stays.
      return;
    }
    find("failure").hidden = true;
    this.source = null;
    this.load(film.header);
    this.follow(false);
    this.add(0, film.data);
    this.playing = true;
    find("live").disabled = true;
  }

  // Request new frames until the run has ended.
  async listen() {
    this.source = {};
    const source = this.source;
    let stride = 0;
    while (this.source === source) {
      const answer = await fetch(`frames?from=${this.frames.length}&stride=${stride || 1}`);
      const [first, now, ended] = ["X-First", "X-Stride", "X-Ended"].map((name) => Number(answer.headers.get(name)));
      stride = now;
      const data = new Float32Array(await answer.arrayBuffer());
      if (this.source !== source) {
        return;
      }
      this.add(first, data);
      if (ended) {
        find("live").disabled = true;
        this.follow(false);
        this.play(true);
        return;
      }
      if (!data.length) {
        await new Promise((done) => setTimeout(done, POLL));
      }
    }
  }
}

async function start() {
  const player = new Player();
  window.lavender = player;
  const answer = await fetch("film.json");
  if (!answer.ok) {
    find("title").textContent = "open a film"; // The page comes from a file server, without a run.
    find("live").disabled = true;
    return;
  }
  player.load(await answer.json());
  document.documentElement.dataset.ready = "true";
  await player.listen();
}

start().catch((error) => {
  fail(`The run cannot be followed any more: ${error.message}`);
});
