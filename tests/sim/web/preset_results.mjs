// Run every preset of the page under Node with the page's modules; print the captions and the compared numbers as JSON.
//
//     node preset_results.mjs FOLDER          a folder written by `lavender web page`
//
// Captions are those after 5 s: the text of app.js for each side. Numbers are medians of A and B, and their ratios.
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const folder = process.argv[2];
const load = (name) => import(pathToFileURL(join(folder, name)));
const { Kernels, Newton, Simulation, SOLVER_FIELDS } = await load("lavender.js");
const { Side } = await load("side.js");
const source = readFileSync(join(folder, "app.js"), "utf8").match(/export (function length\(x\) {[^]*?\n})/)[1];
const length = new Function(`${source}; return length`)();
const contents = JSON.parse(readFileSync(join(folder, "scenes.json"), "utf8"));
const module = new WebAssembly.Module(readFileSync(join(folder, "lavender.wasm")));
const newton = new WebAssembly.Module(readFileSync(join(folder, "newton.wasm")));

function open(scene, { solver, iterations, warm_start, order, box }) {
  const simulation = new Simulation(new Kernels(module, contents.layout), scene);
  simulation.set({ iterations, warm_start, order, box });
  simulation.use(solver === "newton" ? new Newton(newton, simulation.k) : null);
  return { simulation, start: Float64Array.from(simulation.array("x")) };
}

function caption(side, measure) {
  if (measure === "gap") {
    return length(Side.prototype.gap.call(side));
  }
  const [across, down] = Side.prototype.displacement.call(side);
  return across >= down ? `moved sideways by ${length(across)}` : `sank by ${length(down)}`;
}

const median = (x) => {
  const sorted = Float64Array.from(x).sort();
  return (sorted[(sorted.length - 1) >> 1] + sorted[sorted.length >> 1]) / 2;
};

const results = {};
for (const preset of contents.presets) {
  const scene = contents.scenes.find(({ name }) => name === preset.scene);
  const sides = preset.sides.map((settings) => open(scene, settings));
  const steps = preset.numbers.length ? Math.max(...preset.numbers.map(({ last }) => last)) : Math.round(5 / scene.dt);
  const values = sides.map(({ simulation }) => Array.from({ length: Math.max(steps, 1) }, () => {
    simulation.step();
    return Array.from(simulation.values);
  }));
  results[preset.name] = {
    captions: preset.numbers.length ? [] : sides.map((side) => caption(side, scene.measure)),
    numbers: preset.numbers.map(({ field, first, last }) => {
      const [a, b] = values.map((side, i) => {
        const shown = last > 0 ? side.slice(first, last) : [Array.from(sides[i].simulation.first)];
        return median(shown.map((v) => v[SOLVER_FIELDS.indexOf(field)]));
      });
      return { field, first, last, a, b };
    }),
  };
}
console.log(JSON.stringify(results, null, 1));
