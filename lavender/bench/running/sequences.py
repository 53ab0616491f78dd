"""Steps of a simulation in their order: each solver carries its own impulses from step to step, or starts cold.

Impulses travel by the keys of blocks; without keys, or where a block has changed its size, they are kept
where the step before has the same blocks in the same places, else they start from doing nothing.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lavender._arrays import FloatArray
from lavender.bench.running.plan import UNLIMITED, Plan
from lavender.problem import Problem
from lavender.registry import SolverSpec

__all__ = ["carry", "passes"]


def carry(before: Problem, impulse: FloatArray, problem: Problem) -> FloatArray:
    """Start of `problem` (m,) [N s] from the impulses of the step before."""
    start = problem.start()
    old, new = before.cones, problem.cones
    if before.key is None or problem.key is None:
        if np.array_equal(old.ptr, new.ptr) and np.array_equal(old.kind, new.kind):
            start[:] = impulse
        return start
    place: Mapping[int, int] = {int(k): i for i, k in enumerate(before.key)}
    for block, key in enumerate(problem.key):
        i = place.get(int(key))
        if i is None or old.kind[i] != new.kind[block]:
            continue
        here, there = slice(new.ptr[block], new.ptr[block + 1]), slice(old.ptr[i], old.ptr[i + 1])
        if here.stop - here.start == there.stop - there.start:
            start[here] = impulse[there]
    return start


def passes(plan: Plan, spec: SolverSpec) -> list[tuple[str, str, float, int]]:
    """What is run over a sequence: (start, mode, tol, max_iter), each budget and level."""
    starts = ["cold", "carried"] if spec.impulse and not spec.exact else ["cold"]
    asked = plan.levels[-1:] if spec.exact else plan.levels
    levels = [("tol", level, UNLIMITED if spec.resumable else 0) for level in asked]
    budgets = [("budget", 0.0, n) for n in plan.budgets] if spec.resumable and not spec.exact else []
    return [(start, *what) for start in starts for what in [*budgets, *levels]]
