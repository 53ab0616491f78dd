"""Steps of a simulation in their order: each solver carries its own impulses from step to step, or starts cold.

Impulses travel by the keys of blocks; without keys, or where a block has changed its size, they are kept
where the step before has the same blocks in the same places, else they start from doing nothing.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np

from lavender._arrays import FloatArray
from lavender.bench.cases import SUFFIXES, Item
from lavender.bench.plan import UNLIMITED, Plan
from lavender.errors import InputError
from lavender.problem import Problem
from lavender.registry import SolverSpec

__all__ = ["carry", "passes", "sequence", "steps_in"]


def sequence(problems: Iterable[Problem], name: str) -> list[Item]:
    """Consecutive problems as the steps of one sequence."""
    items = []
    for i, problem in enumerate(problems):
        items.append(Item(f"{name}[{i}]", name, _give(problem), sequence=name, step=i))
    return items


def _give(problem: Problem) -> Callable[[], Problem]:
    return lambda: problem


def steps_in(folder: str | Path) -> list[Item]:
    """Problem files of a folder as the steps of one sequence, numbers in their names in numeric order.

    Raises
    ------
    InputError
        Not a folder, or fewer than two problem files in it.
    """
    from lavender import io

    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(
            f"{folder} is not a folder; a sequence is a folder of problem files, one for each step"
        )
    paths = sorted((p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES), key=_natural)
    if len(paths) < 2:
        raise InputError(
            f"{folder} holds {len(paths)} problem files ({', '.join(SUFFIXES)}); a sequence needs two"
        )
    name = folder.resolve().name
    return [
        Item(f"{name}[{i}]", str(path), lambda path=path: io.load(path), sequence=name, step=i)  # type: ignore[misc]
        for i, path in enumerate(paths)
    ]


def _natural(path: Path) -> list[tuple[int, int | str]]:
    return [(0, int(t)) if t.isdigit() else (1, t) for t in re.split(r"(\d+)", path.name) if t]


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
    """What is run over a sequence: (start, mode, tol, max_iter), each budget and the middle level."""
    starts = ["cold", "carried"] if spec.impulse and not spec.exact else ["cold"]
    level = (
        ("tol", plan.levels[len(plan.levels) // 2], UNLIMITED if spec.resumable else 0)
        if plan.levels
        else None
    )
    budgets = [("budget", 0.0, n) for n in plan.budgets] if spec.resumable and not spec.exact else []
    return [(start, *what) for start in starts for what in [*budgets, *([level] if level else [])]]
