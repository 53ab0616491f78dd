// Bodies on a canvas: an orthographic view of boxes, spheres, the ground, joints and contacts.

const PLANE = 1;
const SPHERE = 2;
const BOX = 3;
const FACES = [
  [0, 1, 3, 2], [4, 6, 7, 5], // -x, +x
  [0, 4, 5, 1], [2, 3, 7, 6], // -y, +y
  [0, 2, 6, 4], [1, 5, 7, 3], // -z, +z
];
const LIGHT = [-0.45, -0.62, 0.64];

// Rows of the rotation matrix of a unit quaternion w, x, y, z, at q[4 i].
function rotation(q, i) {
  const [w, x, y, z] = q.subarray(4 * i, 4 * i + 4);
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

function times(m, v) {
  return m.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// hsl of a face: the body's hue, brightness by the light.
function shade(hue, saturation, bright, dark) {
  const light = dark ? 26 + 34 * bright : 44 + 36 * bright;
  return `hsl(${hue} ${saturation}% ${light}%)`;
}

export class View {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.turn = 0.45; // rad, about the vertical
    this.tilt = 0.22; // rad, from above
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

  // The nearest body of the picture as it was drawn that lies under a place on the canvas, or -1.
  bodyAt(at) {
    let best = { body: -1, depth: Infinity };
    for (const { body, middle, size } of this.places ?? []) {
      if (Math.hypot(at[0] - middle[0], at[1] - middle[1]) <= Math.max(size, 9) && middle[2] < best.depth) {
        best = { body, depth: middle[2] };
      }
    }
    return best.body;
  }

  // A way on the canvas [px] as one in the scene [m], across the line of sight.
  inScene(dx, dy) {
    const { right, top, scale } = this.eye;
    return [0, 1, 2].map((k) => (dx * right[k] - dy * top[k]) / scale);
  }

  // What the picture must hold: the bodies at the start, with room.
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
      // A chain swings about the world's origin as far as it is long.
      const reach = Math.max(...high.map((v, k) => Math.max(v, -low[k])));
      [low[0], low[2], high[0], high[2]] = [-reach, -1.05 * reach, reach, 0.05 * reach];
    }
    this.hold(low, high, hasGround);
  }

  // What the picture must hold, as a box.
  hold(low, high, hasGround) {
    this.hasGround = hasGround;
    this.low = low;
    this.high = high;
    this.reach = Math.max(high[0] - low[0], high[1] - low[1], 0.6 * (high[2] - low[2]));
  }

  draw(simulation, colors) {
    const { canvas, context: c } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, width, height);
    const [sin, cos, up, flat] = [Math.sin(this.turn), Math.cos(this.turn), Math.sin(this.tilt), Math.cos(this.tilt)];
    // Right, away from the eye, up on the screen.
    const right = [cos, sin, 0];
    const away = [-sin * flat, cos * flat, -up];
    const top = [-sin * up, cos * up, flat];
    // As large as the box of what must be seen allows.
    const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((k) => [0, 1, 2].map((j) => (k & (1 << j) ? this.high : this.low)[j]));
    const extent = (axis) => [Math.min, Math.max].map((pick) => pick(...corners.map((p) => dot(p, axis))));
    const [across, tall] = [extent(right), extent(top)];
    const scale = Math.min((0.88 * width) / (across[1] - across[0]), (0.84 * height) / (tall[1] - tall[0]));
    const middle = [0.5 * (across[0] + across[1]), 0.5 * (tall[0] + tall[1])];
    const project = (p) => [
      0.5 * width + scale * (dot(p, right) - middle[0]), 0.49 * height - scale * (dot(p, top) - middle[1]), dot(p, away),
    ];
    this.eye = { right, top, scale };
    this.places = [];
    if (this.hasGround) {
      this.#ground(project, colors);
    }
    const items = this.#bodies(simulation, project, away, scale, colors);
    items.sort((a, b) => b.depth - a.depth);
    items.forEach((item) => item.paint(c));
    this.#joints(simulation, project, scale, colors);
    this.#contacts(simulation, project, scale, colors);
  }

  #ground(project, colors) {
    const { context: c } = this;
    const [x0, y0] = [0, 1].map((k) => Math.round(0.5 * (this.low[k] + this.high[k])));
    c.strokeStyle = colors.ground;
    c.lineWidth = 1;
    c.beginPath();
    const gap = Math.max(0.5, Math.round(this.reach / 8));
    const reach = gap * Math.ceil((0.7 * this.reach) / gap);
    for (let i = -reach; i <= reach; i += gap) {
      for (const [p, q] of [[[x0 + i, y0 - reach, 0], [x0 + i, y0 + reach, 0]], [[x0 - reach, y0 + i, 0], [x0 + reach, y0 + i, 0]]]) {
        c.moveTo(...project(p).slice(0, 2));
        c.lineTo(...project(q).slice(0, 2));
      }
    }
    c.stroke();
  }

  #bodies(simulation, project, away, scale, colors) {
    const [x, q, kind, shape] = ["x", "q", "kind_of_shape", "shape"].map((name) => simulation.array(name));
    const items = [];
    kind.forEach((what, i) => {
      const centre = Array.from(x.subarray(3 * i, 3 * i + 3));
      const size = shape.subarray(4 * i, 4 * i + 3);
      const hue = 262 + 17 * ((i * 5) % 7) - 51;
      const r = rotation(q, i);
      if (what === BOX || what === SPHERE) {
        const half = what === SPHERE ? size[0] : 0.8 * Math.max(...size);
        this.places.push({ body: i, middle: project(centre), size: half * scale });
      }
      if (what === BOX) {
        const corners = [];
        for (let k = 0; k < 8; k++) {
          const local = [k & 4 ? size[0] : -size[0], k & 2 ? size[1] : -size[1], k & 1 ? size[2] : -size[2]];
          const world = times(r, local);
          corners.push(project(world.map((v, j) => v + centre[j])));
        }
        FACES.forEach((face, f) => {
          const axis = f >> 1;
          const sign = f & 1 ? 1 : -1;
          const normal = r.map((row) => sign * row[axis]);
          if (dot(normal, away) < 0) {
            const points = face.map((k) => corners[k]);
            const bright = 0.5 + 0.5 * dot(normal, LIGHT);
            items.push({
              depth: points.reduce((s, p) => s + p[2], 0) / 4,
              paint: (c) => {
                c.beginPath();
                points.forEach((p, k) => (k ? c.lineTo(p[0], p[1]) : c.moveTo(p[0], p[1])));
                c.closePath();
                c.fillStyle = shade(hue, 36, bright, colors.dark);
                c.fill();
                c.strokeStyle = colors.edge;
                c.lineWidth = 1;
                c.lineJoin = "round";
                c.stroke();
              },
            });
          }
        });
      } else if (what === SPHERE) {
        items.push(this.#ball(project, centre, size[0], r, hue, away, scale, colors));
      }
    });
    return items;
  }

  // A shaded ball with three great circles, so that turning shows.
  #ball(project, centre, radius, r, hue, away, scale, colors) {
    const middle = project(centre);
    return {
      depth: middle[2],
      paint: (c) => {
        const size = radius * scale;
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
        for (let axis = 0; axis < 3; axis++) {
          c.beginPath();
          let drawing = false;
          for (let k = 0; k <= 48; k++) {
            const angle = (2 * Math.PI * k) / 48;
            const local = [0, 0, 0];
            local[(axis + 1) % 3] = Math.cos(angle);
            local[(axis + 2) % 3] = Math.sin(angle);
            const unit = times(r, local);
            if (dot(unit, away) > 0) {
              drawing = false;
              continue;
            }
            const p = project(unit.map((v, j) => centre[j] + radius * v));
            if (drawing) {
              c.lineTo(p[0], p[1]);
            } else {
              c.moveTo(p[0], p[1]);
            }
            drawing = true;
          }
          c.strokeStyle = axis === 0 ? colors.mark : colors.edge;
          c.lineWidth = axis === 0 ? 2.5 : 1;
          c.stroke();
        }
      },
    };
  }

  // A dot at each joint, and a line from there to the middle of its second body.
  #joints(simulation, project, scale, colors) {
    const { context: c } = this;
    const [x, q, joint, bodies] = ["x", "q", "joint", "joint_bodies"].map((name) => simulation.array(name));
    const size = Math.min(2.5, Math.max(1, 0.04 * scale));
    c.fillStyle = colors.joint;
    c.strokeStyle = colors.joint;
    c.lineWidth = 1;
    for (let j = 0; j < simulation.joints; j++) {
      const b = bodies[2 * j + 1];
      const at = (j * joint.length) / simulation.joints + simulation.k.layout.joint.anchor_b;
      const local = Array.from(joint.subarray(at, at + 3));
      const arm = times(rotation(q, b), local);
      const p = project(arm.map((v, k) => v + x[3 * b + k]));
      c.beginPath();
      c.moveTo(p[0], p[1]);
      c.lineTo(...project(x.subarray(3 * b, 3 * b + 3)).slice(0, 2));
      c.stroke();
      c.beginPath();
      c.arc(p[0], p[1], bodies[2 * j] < 0 ? 2 * size : size, 0, 2 * Math.PI);
      c.fill();
    }
  }

  // A dot where bodies touch, as large as the normal impulse is beside the largest.
  #contacts(simulation, project, scale, colors) {
    const { context: c } = this;
    const [point, impulse, ptr] = ["point", "impulse", "ptr"].map((name) => simulation.array(name));
    const joints = simulation.joints;
    const n = simulation.steps ? simulation.values[2] : 0;
    let most = 0;
    for (let i = 0; i < n; i++) {
      most = Math.max(most, impulse[ptr[joints + i]]);
    }
    const size = Math.min(3.5, Math.max(1.2, 0.1 * scale));
    c.fillStyle = colors.contact;
    for (let i = 0; i < n; i++) {
      const share = most > 0 ? impulse[ptr[joints + i]] / most : 0;
      const p = project(point.subarray(3 * i, 3 * i + 3));
      c.beginPath();
      c.arc(p[0], p[1], size * (0.3 + Math.sqrt(share)), 0, 2 * Math.PI);
      c.fill();
    }
  }
}
