import type { Options, Problem, Result } from './header.mjs';
export * from './header.mjs';

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
