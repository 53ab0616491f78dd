"""Steps of a simulation in their order: each solver carries its own impulses from step to step, or starts cold.

Impulses travel by `Problem.carry`.
"""

from __future__ import annotations

from lavender._arrays import FloatArray
from lavender.bench.running.plan import UNLIMITED, Plan
from lavender.problem import Problem
from lavender.registry import SolverSpec

__all__ = ["carry", "passes"]


def carry(before: Problem, impulse: FloatArray, problem: Problem) -> FloatArray:
    """Start of `problem` (m,) [N s] from the impulses of the step before."""
    return problem.carry((before, impulse))


def passes(plan: Plan, spec: SolverSpec) -> list[tuple[str, str, float, int]]:
    """What is run over a sequence: (start, mode, tol, max_iter), each budget and level."""
    starts = ["cold", "carried"] if spec.impulse and not spec.exact else ["cold"]
    asked = plan.levels[-1:] if spec.exact else plan.levels
    levels = [("tol", level, UNLIMITED if spec.resumable else 0) for level in asked]
    budgets = [("budget", 0.0, n) for n in plan.budgets] if spec.resumable and not spec.exact else []
    return [(start, *what) for start in starts for what in [*budgets, *levels]]
