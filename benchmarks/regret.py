"""CPU time of `auto` compared with every other solver of this package by name, on drawn problems.

    python -m benchmarks regret [--seed 0] [--count 100] [--worst 20] [--out FILE]

Regret is (t + 50 us) / (best + 50 us). t is the CPU time of a cold call of `auto` to `TOL`, and best is the CPU time of
the fastest solver that reaches `TOL` by name; each is the minimum of alternating runs. Problems that no solver
solves do not count. The draws of a seed are the same on every machine: tune on some seeds, publish figures of others.
`python -m benchmarks corpus` compares `auto` of two commits on the same draws.
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

import lavender as lv
from benchmarks.core_problems import fresh
from benchmarks.output import markdown, out_option, write_json
from benchmarks.pairs import run_timed, time_alternately
from benchmarks.random_families import draw_problems
from lavender import registry
from lavender.base.errors import LavenderError
from lavender.problem import Problem

TOL = 1e-6  # Relative residual to reach.
SHIFT = 50e-6  # [s] Added to all times, because Python dominates shorter ones.
MAX_ROWS = 3_000
SLOWER_RATIO = 3.0  # Other solvers stop after this multiple of the time of `auto`.
MIN_LIMIT, MAX_LIMIT = 0.02, 10.0  # [s] Smallest and largest such time.
CLOSE_RATIO = 1.6  # Solvers within this multiple of the fastest one are timed again.
MAX_REPEATED_TIME = 1.0  # [s] Longer solves run once.
ROUNDS = 3


def call(problem: Problem, solver: str, limit: float | None = None) -> lv.Solution:
    """Solve a problem without derived data."""
    return lv.solve(fresh(problem), solver, tol=TOL, time_limit=limit)


def measure(problem: Problem) -> dict[str, Any] | None:
    """Return the times [s] of `auto` and of the solvers by name; None if no solver solves the problem."""
    others = [
        name
        for name, spec in registry.specs().items()
        if spec.builtin and not spec.external and name != "auto" and not spec.refuses(problem)
    ]
    solution, taken = run_timed(partial(call, problem, "auto"))
    limit = min(MAX_LIMIT, max(MIN_LIMIT, SLOWER_RATIO * taken))
    times = {"auto": taken} if solution.residual.relative <= TOL else {}
    for name in others:
        try:
            found, taken = run_timed(partial(call, problem, name, limit))
        except LavenderError:
            continue
        if found.residual.relative <= TOL:
            times[name] = taken
    if not times:
        return None
    fastest = min(times.values())
    if fastest <= MAX_REPEATED_TIME:
        close = [
            n for n, t in times.items() if n == "auto" or t <= CLOSE_RATIO * fastest + 2 * SHIFT
        ]
        calls = (partial(call, problem, name) for name in close)
        again = time_alternately(*calls, rounds=ROUNDS, before=int).min(axis=0)
        times |= {n: min(times[n], float(t)) for n, t in zip(close, again, strict=True)}
    best = min((n for n in times if n != "auto"), key=times.__getitem__, default="auto")
    return {
        "auto": times.get("auto", math.nan),
        "best": times[best],
        "solver": best,
        "regret": (times.get("auto", math.nan) + SHIFT) / (times[best] + SHIFT),
        "stages": [describe_stage(stage) for stage in solution.stages],
        "status": str(solution.status),
        "relative": float(solution.residual.relative),
        "times": times,
    }


def describe_stage(stage: Any) -> str:
    """Return the solver of a stage and its work."""
    work = " ".join(f"{count} {unit}" for unit, count in stage.work.items() if count)
    return f"{stage.solver} ({work})"


def summarize(label: str, lines: list[dict[str, Any]]) -> list[str]:
    """Return the cells of a table's row: regrets of `auto`."""
    regrets = np.array([x["regret"] for x in lines])
    solved = regrets[np.isfinite(regrets)]
    if not len(solved):
        return [label, str(len(lines)), *["-"] * 5, str(len(lines))]
    figures = np.exp(np.log(solved).mean()), solved.mean(), np.quantile(solved, 0.95), solved.max()
    return [
        label,
        str(len(lines)),
        *(f"{x:.2f}" for x in figures),
        str(sum(solved > 2.0)),
        str(len(lines) - len(solved)),
    ]


def print_tables(lines: list[dict[str, Any]], worst: int) -> None:
    """Print regrets of all problems, of each source and law, and the problems with the largest regret."""
    groups = {"all": lines}
    for key in ("source", "law"):
        for name in sorted({x[key] for x in lines}):
            groups[name] = [x for x in lines if x[key] == name]
    head = ["problems", "count", "geometric mean", "mean", "95 %", "worst", "above 2", "unsolved"]
    click.echo(markdown(head, [summarize(*group) for group in groups.items()]))
    order = sorted(lines, key=lambda x: -np.nan_to_num(x["regret"], nan=math.inf))
    head = ["problem", "rows", "regret", "auto [ms]", "best [ms]", "solver", "stages of auto"]
    rows = [
        [
            f"{x['source']} {x['seed']} {x['name']}",
            x["m"],
            f"{x['regret']:.2f}",
            f"{1e3 * x['auto']:.3g}",
            f"{1e3 * x['best']:.3g}",
            x["solver"],
            ", ".join(x["stages"]) or x["status"],
        ]
        for x in order[:worst]
    ]
    click.echo("\n" + markdown(head, rows))


@click.command("regret")
@click.option("--seed", default=0, show_default=True, help="First seed of every source.")
@click.option("--count", default=100, show_default=True, help="Number of seeds of every source.")
@click.option("--worst", default=20, show_default=True, help="Number of problems that are listed.")
@out_option("Write every measurement to this JSON file.")
def command(seed: int, count: int, worst: int, out: Path | None) -> None:
    """Compare auto with every solver by name on drawn problems."""
    lines: list[dict[str, Any]] = []
    unsolved = 0
    for source, number, problem in draw_problems(seed, count, MAX_ROWS):
        measured = measure(problem)
        if measured is None:
            unsolved += 1
            continue
        drawn = {"source": source, "seed": number, "name": problem.name, "m": problem.m}
        lines.append(drawn | {"law": problem.law} | measured)
        if out is not None:
            write_json(out, lines)  # After each problem: a long run may be interrupted.
    print_tables(lines, worst)
    click.echo(f"\n{unsolved} problems were not solved by any solver and do not count.")
