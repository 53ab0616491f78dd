"""One solve of `python -m benchmarks scale`, in a process of any checkout."""

from __future__ import annotations

import resource
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

import lavender as lv
from benchmarks.pairs import Answer, run_timed, serve

MAX_REPEATED_TIME = 0.5  # [s] Shorter solves run three times, and the smallest time counts.

Stage = tuple[str, str, int]  # Solver, law ("coulomb": that of the problem), iterations or 0.


def measure_memory() -> int:
    """Return the peak memory of this process [KiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def run_stages(problem: lv.Problem, stages: list[Stage], limit: float, tol: float) -> Answer:
    """Run stages, each from the impulse of the one before; the answer holds impulse, work and names of solvers."""
    begun = perf_counter()
    answer: dict[str, Any] = {"impulse": None, "work": {}, "stages": []}
    for solver, law, count in stages:
        given = problem if law in ("coulomb", problem.law) else problem.relaxed(law)
        remaining = limit - (perf_counter() - begun)
        if remaining <= 0.01:
            break
        counts = {"max_iter": count} if count else {}
        solution = lv.solve(
            given, solver, impulse=answer["impulse"], tol=tol, time_limit=remaining, **counts
        )
        answer["impulse"] = solution.impulse
        answer["stages"] += [stage.solver for stage in solution.stages] or [solver]
        for key, value in solution.work.items():
            answer["work"][key] = answer["work"].get(key, 0) + value
        if len(stages) > 1 and lv.residual(problem, solution.impulse).relative <= tol:
            break
    return answer


def solve_stages(path: str, stages: list[Stage], limit: float, tol: float) -> Answer:
    """Solve the problem of a file, write the impulse beside it, and return time [s], memory [MiB], work and stages."""
    given = lv.load(path)
    small = lv.Problem.contact(np.eye(3), [1.0, 0.5, 0.2], [0.5])
    for solver, law, _ in stages:  # Imports do not count.
        lv.solve(small.relaxed(law), solver)
    before = measure_memory()
    problem = replace(given, copy=False)
    answer, best = run_timed(lambda: run_stages(problem, stages, limit, tol))
    memory = measure_memory() - before
    spent = taken = best
    while best < MAX_REPEATED_TIME and spent < 3.0 * best:
        problem = replace(given, copy=False)
        answer, taken = run_timed(lambda p=problem: run_stages(p, stages, limit, tol))
        best, spent = min(best, taken), spent + taken
    np.save(f"{path}.npy", answer.pop("impulse"))
    return answer | {"time": best, "memory": memory / 1024}


if __name__ == "__main__":
    serve({"solve_stages": solve_stages})
