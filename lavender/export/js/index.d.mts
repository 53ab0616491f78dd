export * from './header.mjs';

/** What lavender.h's lav_problem holds: counts, and arrays of numbers (key: bigint), copied by `set`. */
export interface Problem {
  form?: number; law?: number; n_blocks: number; n_rows: number; n_entries?: number; n_bodies?: number; n_joints?: number;
  n_velocities?: number; n_mass_entries?: number;
  block_ptr?: ArrayLike<number>; kind?: ArrayLike<number>; lower?: ArrayLike<number>; upper?: ArrayLike<number>;
  mu?: ArrayLike<number>; patch_radius?: ArrayLike<number>; b?: ArrayLike<number>; target?: ArrayLike<number>;
  velocity?: ArrayLike<number>; compliance?: ArrayLike<number>; impulse?: ArrayLike<number>; key?: ArrayLike<bigint>;
  order?: ArrayLike<number>; index_ptr?: ArrayLike<number>; index?: ArrayLike<number>; value?: ArrayLike<number>;
  mass_ptr?: ArrayLike<number>; mass_index?: ArrayLike<number>; mass_value?: ArrayLike<number>;
  inv_mass?: ArrayLike<number>; inv_inertia?: ArrayLike<number>; joint_body?: ArrayLike<number>; jac?: ArrayLike<number>;
  contact_body?: ArrayLike<number>; normal?: ArrayLike<number>; tangent?: ArrayLike<number>; arm_a?: ArrayLike<number>;
  arm_b?: ArrayLike<number>;
}
export interface Verdict { size: number; worst: number; relative: number; energy: number; velocity: number; floor: number; }
export interface Result {
  size: number; outcome: number; iterations: number; sweeps: number; restarts: number; method: number; verdict: Verdict;
}
export interface Options {
  order?: number; memory?: number; sweep?: number; convex?: number; keeps?: number; seed?: bigint; omega?: number;
}
export class LavenderError extends Error { code: number; }
export class Solver {
  set(problem: Problem): void;
  run(budget?: { iterations?: number; tol?: number }): Result;
  impulse(): Float64Array;
  velocity(): Float64Array;
}
export class Library {
  solver(method: number, options?: Options): Solver;
  hash(x: ArrayLike<number>, seed?: bigint): bigint;
}
export function load(module: BufferSource | WebAssembly.Module): Promise<Library>;
