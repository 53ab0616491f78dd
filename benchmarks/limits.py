"""Times of calls under a time limit.

    python -m benchmarks limits [--case 'granularF(n=12)' ...] [--solver auto ...] [--repeats 5]

Prints medians of wall and CPU time of cold calls divided by their limit, the number of sweeps or steps, the relative
residual, and the residual of the start; before the limits the smallest CPU time of one cold sweep without a limit,
set-up and judge included. `python -m benchmarks rates` measures the costs that decide what starts under a limit.
"""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from time import perf_counter, thread_time
from typing import Any

import click
import numpy as np

import lavender as lv
from benchmarks.core_problems import forms, fresh
from benchmarks.output import markdown
from lavender import suite
from lavender.problem import Problem
from lavender.solvers.registry import get

CASES = ("stack(n=64)", "chain(n=33)", "pyramidF(k=6)", "stack(n=5000)", "granular(n=12)", "granularF(n=12)",
         "dense 300 x 100", "dense 3000 x 300", "matrix 300", "matrix 2400")  # fmt: skip
LIMITS = (1e-3, 1e-2)  # s
# the first one that accepts the problem's form is used
SWEEPS = (
    "sequential_impulses",
    "block_gauss_seidel",
    "pgs",
)


def problem_of(name: str) -> Callable[[], Problem]:
    """Return a function that makes a problem without derived data: a case, a case in another form, or a dense one."""
    kind, _, rest = name.partition(" ")
    if kind not in ("dense", "matrix"):
        case, _, form = name.partition(" as ")
        problem = suite.case(case).problem
        given = forms(problem)[form] if form else problem
        return lambda: fresh(given)
    rng = np.random.default_rng(0)
    m = int(rest.split(" x ")[0])
    if kind == "dense":
        n = int(rest.split(" x ")[1])
        half, jac, free = rng.normal(size=(n, n)), rng.normal(size=(m, n)), rng.normal(size=n)
        cones = lv.Cones.contacts(np.full(m // 3, 0.5), 2)
        return lambda: Problem.from_jacobian(jac, half @ half.T / n + np.eye(n), free, cones=cones)
    half, b = rng.normal(size=(m, m // 2)), rng.normal(size=m)
    matrix = half @ half.T / m + 0.01 * np.eye(m)
    return lambda: Problem.contact(matrix, b, 0.5, friction="cone")


def calls(make: Callable[[], Problem], solver: str, limit: float, repeats: int) -> tuple[float, float, Any]:
    """Return medians of wall and CPU time divided by the limit, and the last solution."""
    wall, cpu, found = [], [], None
    for _ in range(repeats):
        problem = make()
        begun, clock = thread_time(), perf_counter()
        found = lv.solve(problem, solver, time_limit=limit)
        wall.append(perf_counter() - clock)
        cpu.append(thread_time() - begun)
    return median(wall) / limit, median(cpu) / limit, found


def least(make: Callable[[], Problem], call: Callable[[Problem], Any], repeats: int = 3) -> float:
    """Return the smallest CPU time [s] of a call on new problems."""
    times = []
    for _ in range(repeats):
        problem = make()
        start = thread_time()
        call(problem)
        times.append(thread_time() - start)
    return min(times)


@click.command("limits")
@click.option("--case", "names", multiple=True, help=f"Default: {', '.join(CASES)}.")
@click.option("--solver", "solvers", multiple=True, default=("auto",), show_default=True)
@click.option("--repeats", default=5, show_default=True)
def command(names: tuple[str, ...], solvers: tuple[str, ...], repeats: int) -> None:
    """Measure calls under time limits."""
    lv.solve(problem_of("dense 30 x 20")(), time_limit=1e-2)
    head = [
        "problem",
        "rows",
        "solver",
        "one sweep [ms]",
        "limit [ms]",
        "wall",
        "CPU",
        "iterations",
        "relative",
        "of the start",
    ]
    rows = []
    for name in names or CASES:
        make = problem_of(name)
        problem = make()
        start = lv.residual(problem, problem.start()).relative
        sweeps = next(other for other in SWEEPS if not get(other).refuses(problem))
        alone = least(make, lambda p, s=sweeps: lv.solve(p, s, tol=0.0, max_iter=1), repeats)  # type: ignore[misc]
        for solver in solvers:
            if get(solver).refuses(problem):
                continue
            for limit in LIMITS:
                wall, cpu, found = calls(make, solver, limit, repeats)
                rows.append([name, problem.m, solver, f"{1e3 * alone:.2f}", f"{1e3 * limit:g}", f"{wall:.2f}",
                             f"{cpu:.2f}", found.iterations, f"{found.residual.relative:.1e}",
                             f"{start:.1e}"])  # fmt: skip
    click.echo(markdown(head, rows))
