// Plots of the page with uPlot, in the colours of the page, over time or over sweeps.

import { find } from "./draw.js";

export const positive = (x) => (x > 0 ? x : null);
// Fields of each chart over time, for both sides, in the order of its series.
export const OVER_TIME = {
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

export class Chart {
  // series: an array of { side, dash, scale }; `log`: logarithmic left axis.
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

  // It also runs after a change between the light and the dark style.
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
    // A panel without data is hidden.
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
