// The tower of tower.c in JavaScript: the same bits.    node tower.mjs
import { readFileSync } from 'node:fs';
import { LAV_CONTACT, LAV_SEQUENTIAL_IMPULSES, load } from './index.mjs';

const BOXES = 8, CONTACTS = 4 * BOXES, dt = 1 / 64, side = [[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]];
const lavender = await load(readFileSync(new URL('./liblavender.wasm', import.meta.url)));
const solver = lavender.solver(LAV_SEQUENTIAL_IMPULSES);
const x = new Float64Array(3 * BOXES), inv_inertia = new Float64Array(9 * BOXES);
let v = new Float64Array(6 * BOXES), result;
for (let i = 0; i < BOXES; i++) {
  for (let k = 0; k < 3; k++) inv_inertia[9 * i + 4 * k] = 6;
  x.set([0.0625 * (i % 3), 0.03125 * (i % 2), 0.5 + i], 3 * i);
}
for (let step = 0; step < 120; step++) {
  const q = { n_blocks: CONTACTS, n_rows: 3 * CONTACTS, n_bodies: BOXES, block_ptr: [], kind: [], key: [], mu: [], contact_body: [] };
  for (const name of ['normal', 'tangent', 'arm_a', 'arm_b', 'target']) q[name] = new Float64Array(3 * CONTACTS);
  for (let i = 0; i < BOXES; i++) v[6 * i + 2] -= 9.75 * dt;
  for (let c = 0; c < CONTACTS; c++) { // the corners of each box on what is below it
    const i = Math.floor(c / 4);
    q.block_ptr.push(3 * c), q.kind.push(LAV_CONTACT), q.key.push(BigInt(c)), q.mu.push(0.5), q.contact_body.push(i - 1, i);
    q.normal[3 * c + 2] = q.tangent[3 * c] = 1;
    for (let k = 0; k < 3; k++) {
      q.arm_b[3 * c + k] = k === 2 ? -0.5 : side[c % 4][k];
      q.arm_a[3 * c + k] = i === 0 ? 0 : x[3 * i + k] + q.arm_b[3 * c + k] - x[3 * i - 3 + k];
    }
    q.target[3 * c] = -(x[3 * i + 2] - 0.5 - (i === 0 ? 0 : x[3 * i - 1] + 0.5)) / dt; // -gap / dt
  }
  q.block_ptr.push(3 * CONTACTS);
  solver.set({ ...q, inv_mass: new Float64Array(BOXES).fill(1), inv_inertia, velocity: v });
  result = solver.run();
  v = solver.velocity();
  for (let i = 0; i < BOXES; i++) for (let k = 0; k < 3; k++) x[3 * i + k] += dt * v[6 * i + k];
}
const { relative, floor, worst } = result.verdict;
console.log(`${result.sweeps} sweeps, residual ${relative.toExponential(2)}, floor ${floor.toExponential(0)}, worst row ${worst}`);
console.log(lavender.hash(v, lavender.hash(x)).toString(16).padStart(16, '0'));
