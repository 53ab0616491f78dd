// Draw an orthographic view of boxes, spheres, the ground, joints and contacts on a canvas.

const PLANE = 1;
const SPHERE = 2;
const BOX = 3;
const FACES = [
  [0, 1, 3, 2], [4, 6, 7, 5], // -x, +x
  [0, 4, 5, 1], [2, 3, 7, 6], // -y, +y
  [0, 2, 6, 4], [1, 5, 7, 3], // -z, +z
];
const LIGHT = [-0.45, -0.62, 0.64];

// Return the rotation matrix, row by row, of the unit quaternion w, x, y, z at q[4 i].
function rotation(q, i) {
  const [w, x, y, z] = [q[4 * i], q[4 * i + 1], q[4 * i + 2], q[4 * i + 3]];
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// Return the component of a column of a rotation matrix along an axis.
function along(r, column, axis) {
  return r[column] * axis[0] + r[3 + column] * axis[1] + r[6 + column] * axis[2];
}

// Return the hsl colour of a face: hue of the body, brightness in whole percents, so that few colours have to be parsed.
const shades = new Map();
function shade(hue, saturation, bright, dark) {
  const light = Math.round(dark ? 26 + 34 * bright : 44 + 36 * bright);
  const key = (hue * 128 + saturation) * 128 + light;
  let said = shades.get(key);
  if (said === undefined) {
    said = `hsl(${hue} ${saturation}% ${light}%)`;
    shades.set(key, said);
  }
  return said;
}

// Return the colours of the page's style, light or dark.
export function colors() {
  const style = getComputedStyle(document.documentElement);
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  return {
    dark,
    sky: style.getPropertyValue("--sky").trim(),
    ground: style.getPropertyValue("--ground").trim(),
    edge: dark ? "rgb(0 0 0 / 60%)" : "rgb(40 25 60 / 55%)",
    mark: dark ? "#f0a35e" : "#ffffff",
    joint: dark ? "#ece8f2" : "#262130",
    contact: dark ? "#ffd166" : "#d61f69",
  };
}

const UNITS = {
  "joints open": "m", "joint impulse": "N s", residual_initial: "N s", residual_final: "N s", violation_initial: "m/s",
  violation_final: "m/s",
};

export const find = (id) => document.getElementById(id);

export function fail(text) {
  find("failure").textContent = text;
  find("failure").hidden = false;
}

// Add a table row with label and unit for each field; return the cells of the values by field.
export function rows(table, fields) {
  return Object.fromEntries(fields.map((field) => {
    const row = table.insertRow();
    const head = Object.assign(document.createElement("th"), { scope: "row", textContent: field.replace("_", " ") });
    if (UNITS[field]) {
      head.append(Object.assign(document.createElement("small"), { textContent: UNITS[field] }));
    }
    const cell = document.createElement("td");
    cell.dataset.field = field;
    row.append(head, cell);
    return [field, cell];
  }));
}

export class View {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false }); // The canvas is opaque: the browser need not blend it with the page.
    this.size = null; // [px]; the layout is only queried after a change.
    new ResizeObserver(() => {
      const { clientWidth, clientHeight } = canvas;
      const before = this.size;
      this.size = [clientWidth, clientHeight];
      if (before && (before[0] !== clientWidth || before[1] !== clientHeight)) {
        this.onlook?.();
      }
    }).observe(canvas);
    this.turn = 0.45; // [rad] about the vertical
    this.tilt = 0.22; // [rad] from above
    this.linked = [this];
    this.box = null;
    this.#listen();
  }

  #listen() {
    const { canvas } = this;
    let from = null;
    let held = null;
    const inside = (event) => {
      const box = canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    canvas.addEventListener("pointerdown", (event) => {
      const at = inside(event);
      const body = this.ongrab ? this.bodyAt(at) : -1;
      canvas.setPointerCapture(event.pointerId);
      if (body >= 0) {
        held = { body, at };
        this.ongrab(body);
        canvas.style.cursor = "grabbing";
      } else {
        from = [event.clientX, event.clientY];
      }
    });
    canvas.addEventListener("pointermove", (event) => {
      if (held) {
        const at = inside(event);
        this.onpull(this.inScene(at[0] - held.at[0], at[1] - held.at[1]));
        held.at = at;
      } else if (from) {
        this.#look((event.clientX - from[0]) * 0.008, (event.clientY - from[1]) * 0.006);
        from = [event.clientX, event.clientY];
      }
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, () => {
        from = null;
        if (held) {
          held = null;
          canvas.style.cursor = "";
          this.onrelease();
        }
      });
    }
    canvas.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.06], ArrowDown: [0, -0.06] }[event.key];
      if (by) {
        this.#look(...by);
        event.preventDefault();
      }
    });
  }

  #look(turn, tilt) {
    for (const view of this.linked) {
      view.turn += turn;
      view.tilt = Math.min(1.4, Math.max(0.02, view.tilt + tilt));
      view.onlook?.();
    }
  }

  // Return the nearest body of the last picture at a position on the canvas, or -1.
  bodyAt(at) {
    let best = { body: -1, depth: Infinity };
    for (const { body, middle, size } of this.places ?? []) {
      if (Math.hypot(at[0] - middle[0], at[1] - middle[1]) <= Math.max(size, 9) && middle[2] < best.depth) {
        best = { body, depth: middle[2] };
      }
    }
    return best.body;
  }

  // Convert a displacement on the canvas [px] to one in the scene [m], orthogonal to the line of sight.
  inScene(dx, dy) {
    const { right, top, scale } = this.eye;
    return [0, 1, 2].map((k) => (dx * right[k] - dy * top[k]) / scale);
  }

  // Compute the bounds of the picture: the bodies at the start, with a margin.
  fit(simulation) {
    const [x, kind, shape] = ["x", "kind_of_shape", "shape"].map((name) => simulation.array(name));
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    let hasGround = false;
    const take = (p, r) => p.forEach((v, k) => {
      low[k] = Math.min(low[k], v - r);
      high[k] = Math.max(high[k], v + r);
    });
    kind.forEach((what, i) => {
      if (what === PLANE) {
        hasGround = true;
      } else if (what >= SPHERE) {
        take(Array.from(x.subarray(3 * i, 3 * i + 3)), Math.max(...shape.subarray(4 * i, 4 * i + 3)));
      }
    });
    if (simulation.joints > 0 && !hasGround) {
      // A chain swings about the world's origin with a radius of its length.
      const reach = Math.max(...high.map((v, k) => Math.max(v, -low[k])));
      [low[0], low[2], high[0], high[2]] = [-reach, -1.05 * reach, reach, 0.05 * reach];
    }
    this.hasGround = hasGround;
    this.low = low;
    this.high = high;
    this.reach = Math.max(high[0] - low[0], high[1] - low[1], 0.6 * (high[2] - low[2]));
  }

  draw(simulation, colors) {
    const { canvas, context: c } = this;
    const ratio = window.devicePixelRatio || 1;
    this.size ??= [canvas.clientWidth, canvas.clientHeight];
    const [width, height] = this.size;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.fillStyle = colors.sky;
    c.fillRect(0, 0, width, height);
    c.lineJoin = "round";
    const [sin, cos, up, flat] = [Math.sin(this.turn), Math.cos(this.turn), Math.sin(this.tilt), Math.cos(this.tilt)];
    // Directions to the right, away from the viewer, and up on the screen.
    const right = [cos, sin, 0];
    const away = [-sin * flat, cos * flat, -up];
    const top = [-sin * up, cos * up, flat];
    // The scale is the largest one at which the bounds fit.
    const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((k) => [0, 1, 2].map((j) => (k & (1 << j) ? this.high : this.low)[j]));
    const extent = (axis) => [Math.min, Math.max].map((pick) => pick(...corners.map((p) => dot(p, axis))));
    const [across, tall] = [extent(right), extent(top)];
    const scale = Math.min((0.88 * width) / (across[1] - across[0]), (0.84 * height) / (tall[1] - tall[0]));
    const middle = [0.5 * (across[0] + across[1]), 0.5 * (tall[0] + tall[1])];
    const [left, high] = [0.5 * width - scale * middle[0], 0.49 * height + scale * middle[1]];
    this.eye = { right, top, away, scale, left, high };
    this.places = [];
    if (this.hasGround) {
      this.#ground(colors);
    }
    const items = this.#bodies(simulation, colors);
    items.sort((a, b) => b.depth - a.depth);
    items.forEach((item) => this.#paint(item, colors));
    this.#joints(simulation, colors);
    this.#contacts(simulation, colors);
  }

  // Return the position of a point on the canvas [px] and its depth [m].
  #project(x, y, z) {
    const { right, top, away, scale, left, high } = this.eye;
    return [
      left + scale * (x * right[0] + y * right[1] + z * right[2]),
      high - scale * (x * top[0] + y * top[1] + z * top[2]),
      x * away[0] + y * away[1] + z * away[2],
    ];
  }

  #ground(colors) {
    const { context: c } = this;
    const [x0, y0] = [0, 1].map((k) => Math.round(0.5 * (this.low[k] + this.high[k])));
    c.strokeStyle = colors.ground;
    c.lineWidth = 1;
    c.beginPath();
    const gap = Math.max(0.5, Math.round(this.reach / 8));
    const reach = gap * Math.ceil((0.7 * this.reach) / gap);
    const line = (p, q) => {
      c.moveTo(p[0], p[1]);
      c.lineTo(q[0], q[1]);
    };
    for (let i = -reach; i <= reach; i += gap) {
      line(this.#project(x0 + i, y0 - reach, 0), this.#project(x0 + i, y0 + reach, 0));
      line(this.#project(x0 - reach, y0 + i, 0), this.#project(x0 + reach, y0 + i, 0));
    }
    c.stroke();
  }

  // Collect the visible faces of boxes, and balls; `depth` [m] is the depth of the centre.
  #bodies(simulation, colors) {
    const { away, scale } = this.eye;
    const [x, q, kind, shape] = ["x", "q", "kind_of_shape", "shape"].map((name) => simulation.array(name));
    const items = [];
    for (let i = 0; i < kind.length; i++) {
      if (kind[i] !== BOX && kind[i] !== SPHERE) {
        continue;
      }
      const middle = this.#project(x[3 * i], x[3 * i + 1], x[3 * i + 2]);
      const size = [shape[4 * i], shape[4 * i + 1], shape[4 * i + 2]];
      const half = kind[i] === SPHERE ? size[0] : 0.8 * Math.max(...size);
      this.places.push({ body: i, middle, size: half * scale });
      const hue = 262 + 17 * ((i * 5) % 7) - 51;
      const r = rotation(q, i);
      if (kind[i] === SPHERE) {
        items.push({ depth: middle[2], middle, size: size[0] * scale, hue, r });
        continue;
      }
      const corners = [];
      for (let k = 0; k < 8; k++) {
        const [u, v, w] = [k & 4 ? size[0] : -size[0], k & 2 ? size[1] : -size[1], k & 1 ? size[2] : -size[2]];
        corners.push(this.#project(
          x[3 * i] + r[0] * u + r[1] * v + r[2] * w,
          x[3 * i + 1] + r[3] * u + r[4] * v + r[5] * w,
          x[3 * i + 2] + r[6] * u + r[7] * v + r[8] * w,
        ));
      }
      for (let f = 0; f < 6; f++) {
        const [axis, sign] = [f >> 1, f & 1 ? 1 : -1];
        if (sign * along(r, axis, away) < 0) {
          const points = FACES[f].map((k) => corners[k]);
          const bright = 0.5 + 0.5 * sign * along(r, axis, LIGHT);
          items.push({
            depth: (points[0][2] + points[1][2] + points[2][2] + points[3][2]) / 4,
            points,
            color: shade(hue, 36, bright, colors.dark),
          });
        }
      }
    }
    return items;
  }

  #paint(item, colors) {
    if (!item.points) {
      this.#ball(item, colors);
      return;
    }
    const { context: c } = this;
    const [p, q, r, s] = item.points;
    c.beginPath();
    c.moveTo(p[0], p[1]);
    c.lineTo(q[0], q[1]);
    c.lineTo(r[0], r[1]);
    c.lineTo(s[0], s[1]);
    c.closePath();
    c.fillStyle = item.color;
    c.fill();
    c.strokeStyle = colors.edge;
    c.lineWidth = 1;
    c.stroke();
  }

  // Draw a shaded ball with three great circles, which show its rotation. The visible half of a circle is half an
  // ellipse: its long axis is a diameter of the ball, orthogonal to the circle's normal n; the short one is size |n away|.
  #ball({ middle, size, hue, r }, colors) {
    const { context: c } = this;
    const { right, top, away } = this.eye;
    const light = c.createRadialGradient(
      middle[0] - 0.35 * size, middle[1] - 0.4 * size, 0.1 * size, middle[0], middle[1], size,
    );
    light.addColorStop(0, shade(hue, 40, 1, colors.dark));
    light.addColorStop(1, shade(hue, 40, 0.15, colors.dark));
    c.beginPath();
    c.arc(middle[0], middle[1], size, 0, 2 * Math.PI);
    c.fillStyle = light;
    c.fill();
    c.strokeStyle = colors.edge;
    c.lineWidth = 1;
    c.stroke();
    const half = (axis) => {
      const off = along(r, axis, away);
      const turned = Math.atan2(-along(r, axis, top), along(r, axis, right)) - Math.PI / 2;
      const [from, sign] = off > 0 ? [0, 1] : [Math.PI, -1];
      c.moveTo(middle[0] + sign * size * Math.cos(turned), middle[1] + sign * size * Math.sin(turned));
      c.ellipse(middle[0], middle[1], size, size * Math.abs(off), turned, from, from + Math.PI);
    };
    c.beginPath();
    half(1);
    half(2);
    c.stroke();
    c.beginPath();
    half(0);
    c.strokeStyle = colors.mark;
    c.lineWidth = 2.5;
    c.stroke();
  }

  // Draw a dot at each joint, and a line from it to the centre of its second body.
  #joints(simulation, colors) {
    const { context: c } = this;
    const [x, q, joint, bodies] = ["x", "q", "joint", "joint_bodies"].map((name) => simulation.array(name));
    const size = Math.min(2.5, Math.max(1, 0.04 * this.eye.scale));
    c.fillStyle = colors.joint;
    c.strokeStyle = colors.joint;
    c.lineWidth = 1;
    for (let j = 0; j < simulation.joints; j++) {
      const b = bodies[2 * j + 1];
      const at = (j * joint.length) / simulation.joints + simulation.k.layout.joint.anchor_b;
      const r = rotation(q, b);
      const arm = [0, 3, 6].map((k) => r[k] * joint[at] + r[k + 1] * joint[at + 1] + r[k + 2] * joint[at + 2]);
      const p = this.#project(x[3 * b] + arm[0], x[3 * b + 1] + arm[1], x[3 * b + 2] + arm[2]);
      const m = this.#project(x[3 * b], x[3 * b + 1], x[3 * b + 2]);
      c.beginPath();
      c.moveTo(p[0], p[1]);
      c.lineTo(m[0], m[1]);
      c.stroke();
      c.beginPath();
      c.arc(p[0], p[1], bodies[2 * j] < 0 ? 2 * size : size, 0, 2 * Math.PI);
      c.fill();
    }
  }

  // Draw a dot at each contact; its size shows the normal impulse relative to the largest one.
  #contacts(simulation, colors) {
    const { context: c } = this;
    const [point, impulse, ptr] = ["point", "impulse", "ptr"].map((name) => simulation.array(name));
    const joints = simulation.joints;
    const n = simulation.steps ? simulation.values[2] : 0;
    let most = 0;
    for (let i = 0; i < n; i++) {
      most = Math.max(most, impulse[ptr[joints + i]]);
    }
    const size = Math.min(3.5, Math.max(1.2, 0.1 * this.eye.scale));
    c.fillStyle = colors.contact;
    for (let i = 0; i < n; i++) {
      const share = most > 0 ? impulse[ptr[joints + i]] / most : 0;
      const p = this.#project(point[3 * i], point[3 * i + 1], point[3 * i + 2]);
      c.beginPath();
      c.arc(p[0], p[1], size * (0.3 + Math.sqrt(share)), 0, 2 * Math.PI);
      c.fill();
    }
  }
}
