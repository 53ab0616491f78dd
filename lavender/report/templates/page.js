"use strict";
(function () {
  const root = document.documentElement;
  const every = (selector, from) => Array.from((from || document).querySelectorAll(selector));

  // -- copying -------------------------------------------------------------------------------------
  const copy = document.getElementById("copy");
  if (copy && navigator.clipboard) {
    copy.hidden = false;
    copy.addEventListener("click", () => {
      navigator.clipboard.writeText(every(".code pre").find((pre) => pre.offsetParent).textContent);
      copy.textContent = "copied";
    });
  }

  // -- one filter for all charts: who is in colour, and whether the others are there ----------------
  const filter = document.getElementById("filter");
  const style = document.getElementById("colours");
  const COLOURS = 7;
  if (filter) {
    const boxes = every(".chip input", filter);
    const alone = document.getElementById("alone");
    let chosen = boxes.filter((b) => b.checked).map((b) => b.value);
    // The leaders keep the order of their colours, which the page was made with.
    const first = every("style").pop().textContent.match(/\.s(\d+) \{ --c/g) || [];
    const order = first.map((rule) => rule.match(/\d+/)[0]);
    chosen.sort((a, b) => order.indexOf(a) - order.indexOf(b));
    const paint = () => {
      const rules = chosen.map((n, i) => `.s${n} { --c: var(--c${i % COLOURS + 1}); }
        .c.s${n} { stroke-width: 5; stroke-opacity: 1; visibility: visible; } .c.s${n} text { display: block; }`);
      if (chosen.length) rules.push(`.c.s${chosen[0]} .b { fill: var(--c); fill-opacity: 0.16; }`);
      if (alone.checked) rules.unshift(".c { visibility: hidden; }");
      style.textContent = rules.join("\n");
    };
    filter.hidden = filter.parentElement.hidden = false;
    // What a link leads to stands below the bar, whatever its height is.
    const below = () => { root.style.scrollPaddingTop = `${filter.parentElement.offsetHeight + 8}px`; };
    addEventListener("resize", below);
    below();
    filter.addEventListener("change", (event) => {
      const box = event.target;
      if (box !== alone) {
        chosen = box.checked ? [...chosen, box.value] : chosen.filter((n) => n !== box.value);
        if (chosen.length > COLOURS) {
          const gone = chosen.shift();
          boxes.forEach((b) => { if (b.value === gone) b.checked = false; });
        }
      }
      paint();
    });
  }

  // -- what a point says ----------------------------------------------------------------------------
  const tip = document.createElement("div");
  tip.className = "tip";
  tip.hidden = true;
  document.body.append(tip);
  const value = (axis, place) => {
    const [log, low, high, first, last] = axis.split(" ").map(Number);
    const x = low + (high - low) * (place - first) / (last - first);
    return log ? 10 ** x : x;
  };
  const number = (x) => (x >= 0.1 && x < 1e4 ? String(+x.toPrecision(3)) : x.toExponential(1).replace("e+", "e"));
  const seconds = (t) => {
    const [scale, unit] = t >= 0.9995 ? [1, "s"] : t >= 0.9995e-3 ? [1e-3, "ms"] : [1e-6, "µs"];
    return `${+(t / scale).toPrecision(3)} ${unit}`;
  };
  const points = (curve) => {
    const path = curve.querySelector(".d") || curve.querySelector("path:not(.b)");
    return (path.getAttribute("d").match(/[ML]\d+ \d+/g) || []).map((p) => p.slice(1).split(" ").map(Number));
  };
  function show(event) {
    const chart = event.target.closest && event.target.closest("svg.chart");
    if (!chart) { tip.hidden = true; return; }
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(chart.getScreenCTM().inverse());
    let best = { away: 40 };
    every(".c", chart).forEach((curve) => {
      if (getComputedStyle(curve).visibility === "hidden") return;
      points(curve).forEach(([x, y], i) => {
        const away = Math.hypot(x - at.x, y - at.y);
        if (away < best.away) best = { away, curve, x, y, i };
      });
    });
    every(".c.near").forEach((c) => c.classList.remove("near"));
    if (!best.curve) { tip.hidden = true; return; }
    best.curve.classList.add("near");
    const [xs, ys] = chart.dataset.t;
    const note = (best.curve.dataset.n || "").split("|")[best.i];
    const asked = /^\d+$/.test(note) ? `${note} iterations` : note;
    const limit = /^\d+$/.test(note) ? `tol=0, max_iter=${note}` : /^to /.test(note) ? `tol=${note.slice(3)}` : "";
    const x = value(chart.dataset.x, best.x), y = value(chart.dataset.y, best.y);
    const said = [best.curve.dataset.l, asked, xs === "1" ? seconds(x) : number(x), ys === "1" ? seconds(y) : number(y)];
    const [name, start] = best.curve.dataset.l.split(" ");
    const from = start === "(warm)" ? "impulse=problem.guess, " : "";
    const line = limit && `lv.solve(problem, "${name}", ${from}${limit})`;
    tip.textContent = [said.filter(Boolean).join(", "), line].filter(Boolean).join("\n");
    tip.hidden = false;
    tip.style.left = Math.min(event.pageX + 12, root.clientWidth + scrollX - tip.offsetWidth - 6) + "px";
    tip.style.top = event.pageY + 14 + "px";
  }
  addEventListener("pointermove", show);
  addEventListener("pointerdown", show);

  // -- cases: sorted by a column --------------------------------------------------------------------
  const list = document.getElementById("list");
  if (list) {
    const rows = every("tbody tr", list);
    every("thead th", list).forEach((head, column) => {
      head.tabIndex = 0;
      const sort = () => {
        const down = head.dataset.sorted === "up";
        every("thead th", list).forEach((h) => delete h.dataset.sorted);
        head.dataset.sorted = down ? "down" : "up";
        const key = (row) => {
          const cell = row.cells[column];
          const text = cell.dataset.v || cell.textContent;
          const x = text === "inf" || text === "nan" ? Infinity : parseFloat(text);
          return cell.classList.contains("n") ? x : text.toLowerCase();
        };
        const order = (a, b) => (key(a) < key(b) ? -1 : key(a) > key(b) ? 1 : 0);
        rows.sort((a, b) => (down ? order(b, a) : order(a, b)));
        list.tBodies[0].append(...rows);
      };
      head.addEventListener("click", sort);
      head.addEventListener("keydown", (e) => { if (e.key === "Enter") sort(); });
    });
  }

  // -- links open what they lead to; print opens everything but single cases ---------------------------
  function follow() {
    const target = location.hash ? document.getElementById(decodeURIComponent(location.hash.slice(1))) : null;
    for (let part = target; part; part = part.parentElement) if (part.tagName === "DETAILS") part.open = true;
    if (target) target.scrollIntoView();
  }
  addEventListener("hashchange", follow);
  follow();
  let opened = [];
  addEventListener("beforeprint", () => {
    opened = every("details:not([open])");
    opened.forEach((d) => { d.open = true; });
  });
  addEventListener("afterprint", () => opened.forEach((d) => { d.open = false; }));
})();
