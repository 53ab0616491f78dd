"use strict";
(function () {
  const figures = JSON.parse(document.getElementById("figures").textContent);
  const root = document.documentElement;
  const drawn = new Set();
  const PAPER = 680;  // px, the width of a sheet within its margins

  function theme() {
    const css = getComputedStyle(root);
    const get = (name) => css.getPropertyValue(name).trim();
    return { paper: get("--paper"), ink: get("--ink"), quiet: get("--quiet"), line: get("--line") };
  }

  function layout(figure, width) {
    const t = theme();
    const phone = width < 520;
    const axis = (a) => ({
      title: { text: a.title, font: { size: 12 } },
      type: a.log ? "log" : "linear",
      gridcolor: t.line,
      zeroline: false,
      exponentformat: a.seconds ? "SI" : a.log ? "power" : "none",
      minexponent: 1,
      ticksuffix: a.seconds ? "s" : "",
      automargin: true,
    });
    const line = (y, color, dash) => ({
      type: "line", xref: "paper", x0: 0, x1: 1, yref: "y", y0: y, y1: y, layer: "below",
      line: { color: color, width: 1, dash: dash },
    });
    const shapes = figure.levels.map((y) => line(y, t.line, "solid"));
    const annotations = [];
    if (figure.floor !== null) {
      shapes.push(line(figure.floor, t.quiet, "dot"));
      annotations.push({
        xref: "paper", x: 1, xanchor: "right", yref: "y", yanchor: "bottom", showarrow: false, text: "floor",
        y: figure.y.log ? Math.log10(figure.floor) : figure.floor, font: { size: 10, color: t.quiet },
      });
    }
    const below = phone || width < 620;
    const longest = Math.max(...figure.traces.map((trace) => trace.name.length));
    const entry = Math.max(phone ? 92 : 110, 5.5 * longest);
    const columns = Math.max(1, Math.floor((width - 76) / (entry + 42)));
    const rows = below ? Math.ceil(figure.traces.length / columns) : 0;
    const legend = 20 * rows + (below ? 14 : 0);
    return {
      height: below ? 330 + legend : Math.max(420, 110 + 19 * figure.traces.length),
      title: { text: figure.title.replace(/&/g, "&amp;").replace(/</g, "&lt;"), font: { size: 13 } },
      font: { color: t.ink, family: "system-ui, sans-serif", size: 11 },
      paper_bgcolor: t.paper, plot_bgcolor: t.paper,
      margin: { l: 60, r: 12, t: 36, b: 48 + legend },
      xaxis: axis(figure.x), yaxis: axis(figure.y),
      legend: below
        ? { orientation: "h", yref: "container", y: 0, yanchor: "bottom", font: { size: 10 }, entrywidth: entry }
        : { font: { size: 10 } },
      hoverlabel: { align: "left" }, hovermode: "closest",
      shapes: shapes, annotations: annotations,
    };
  }

  function config(box) {
    return {
      responsive: true, displaylogo: false,
      displayModeBar: box.clientWidth < 520 ? false : "hover",  // it would cover the title
      toImageButtonOptions: { format: "svg", filename: box.dataset.figure },
      modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
    };
  }

  function draw(box) {
    const figure = figures[box.dataset.figure];
    if (!figure || drawn.has(box)) return;
    drawn.add(box);
    Plotly.newPlot(box, figure.traces, layout(figure, box.clientWidth), config(box));
  }

  function redraw(paper) {
    drawn.forEach((box) => {
      const figure = figures[box.dataset.figure];
      const whole = layout(figure, paper || box.clientWidth);
      if (paper) whole.width = paper;
      Plotly.react(box, figure.traces, whole, config(box));
    });
  }

  const boxes = Array.from(document.querySelectorAll(".chart"));
  const watcher = new IntersectionObserver(
    (entries) => entries.forEach((e) => { if (e.isIntersecting) { draw(e.target); watcher.unobserve(e.target); } }),
    { rootMargin: "600px" });
  boxes.forEach((box) => watcher.observe(box));

  const dark = matchMedia("(prefers-color-scheme: dark)");
  const isDark = () => (root.dataset.theme ? root.dataset.theme === "dark" : dark.matches);
  document.getElementById("theme").addEventListener("click", () => {
    root.dataset.theme = isDark() ? "light" : "dark";
    redraw();
  });
  dark.addEventListener("change", () => redraw());
  let before = "";
  addEventListener("beforeprint", () => {
    before = root.dataset.theme || "";
    root.dataset.theme = "light";
    boxes.forEach(draw);
    redraw(PAPER);
    document.querySelectorAll("details").forEach((d) => { d.open = true; });
  });
  addEventListener("afterprint", () => {
    if (before) root.dataset.theme = before; else delete root.dataset.theme;
    redraw();
  });
  function follow() {
    const target = location.hash ? document.getElementById(decodeURIComponent(location.hash.slice(1))) : null;
    if (target && target.closest("details")) target.closest("details").open = true;
  }
  addEventListener("hashchange", follow);
  follow();
})();
