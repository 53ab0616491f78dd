"""Calls under a time limit, on drawn problems: answers and times.

    python -m benchmarks limits [--sheet auto|prepared|programs] [--count 100] [--seed 0] [--solver clarabel ...]

Problems are those of `regret`. The sheet `auto` divides the residual of `auto` by that of the best sweeps with the same
limit: 60 to 3,000 rows, limits of 0.1 to 10 ms, from zero or a stale start. The sheet `prepared` compares the CPU time
of prepared solves of every own solver, 300 to 3,000 rows, limits L of 1 to 50 ms, with 2 L + 5 ms and 2 L + 25 ms.
The sheet `programs` prints for each solver in which share of quadratic programs of 5 to 1,000 variables the CPU time of
`solve_qp`, without the time inside of the backend's package and imports, is at most the limit plus OVERHEAD.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from time import thread_time
from typing import Any

import click
import numpy as np
import scipy.sparse as sp
from scipy.stats import gmean

import lavender as lv
import lavender.solving.loop
from benchmarks.core_problems import forms, fresh, stacks
from benchmarks.output import markdown
from benchmarks.pairs import run_timed
from benchmarks.peers.backend_time import measure_backend_time
from benchmarks.random_families import draw_problems
from lavender import registry
from lavender.problem import Problem
from lavender.solvers.registry import get
from lavender_ext.core.deadline import play_clock

LIMITS = (1e-3, 1e-2)  # s
OVERHEAD = 5e-3  # s
SHEET_SWEEPS = (
    "pgs",
    "sequential_impulses",
    "block_gauss_seidel",
    "nncg",
    "anderson",
)  # Four accept each problem.
MAX_ROWS = 3_000
MIN_ROWS = {"auto": 60, "prepared": 300}
TOLERANCE, REPEATS = 1e-6, 3

Line = dict[str, Any]


# -- quadratic programs ------------------------------------------------------------------------------


def draw_program(rng: np.random.Generator) -> dict[str, Any]:
    """Return the arrays of a program of 5 to 1,000 variables: control, linear, contradictory, sparse or dense."""
    n = round(10.0 ** rng.uniform(np.log10(5.0), 3.0))
    kind = rng.integers(5)

    def draw(m: int, per_row: float) -> Any:
        return sp.random(
            m, n, min(1.0, per_row / n), random_state=rng, data_rvs=rng.standard_normal
        ).tocsc()

    if kind == 0:  # steps of a mass in three axes with bounds on speed and force
        steps = max(1, n // 9)
        dt = 0.05
        one = np.eye(3)
        none = np.zeros((3, 3))
        move = np.block([[one, dt * one], [none, one]])
        push = np.vstack([0.5 * dt * dt * one, dt * one])
        later = sp.kron(sp.eye_array(steps, k=-1), move) - sp.eye_array(6 * steps)
        b = np.zeros(6 * steps)
        b[:3] = rng.normal(size=3)
        high = np.append(np.tile([5.0] * 3 + [0.8] * 3, steps), np.full(3 * steps, 2.0))
        P = sp.diags_array(
            np.append(np.tile([10.0] * 3 + [1.0] * 3, steps), np.full(3 * steps, 0.1))
        )
        A = sp.hstack([later, sp.kron(sp.eye_array(steps), push)])
        return {
            "P": P.tocsc(),
            "q": np.zeros(9 * steps),
            "A": A.tocsc(),
            "b": b,
            "lb": -high,
            "ub": high,
        }
    if kind == 1:  # a linear program with a degenerate vertex
        m = max(1, n // 3)
        A = (draw(m, 5.0) + sp.eye_array(m, n)).tocsc()
        x = np.where(rng.random(n) < 0.3, rng.uniform(0.5, 2.0, n), 0.0)
        q = A.T @ rng.normal(size=m) + np.where(x > 0.0, 0.0, rng.uniform(0.1, 1.0, n))
        return {"P": sp.csc_array((n, n)), "q": q, "A": A, "b": A @ x, "lb": np.zeros(n)}
    if kind == 2:  # rows that contradict each other
        rows = draw(n, 4.0)
        h = rng.normal(size=n)
        sides = np.append(h, -h - rng.uniform(0.1, 1.0, n))
        return {
            "P": sp.eye_array(n).tocsc(),
            "q": rng.normal(size=n),
            "G": sp.vstack([rows, -rows]).tocsc(),
            "h": sides,
        }
    half = draw(n, 3.0)
    A = draw(max(1, n // 5), 5.0)
    G = draw(n // 2 + 1, 5.0)
    x = rng.normal(size=n)
    P = (half @ half.T + rng.choice([0.0, 0.1]) * sp.eye_array(n)).tocsc()
    if kind == 3 and n <= 300:
        P = np.eye(n) + half.toarray() @ half.toarray().T
        A = rng.normal(size=A.shape)
    h = G @ x + rng.uniform(0.0, 0.5, n // 2 + 1) * (rng.random(n // 2 + 1) < 0.7)
    return {
        "P": P,
        "q": rng.normal(size=n),
        "A": A,
        "b": A @ x,
        "G": G,
        "h": h,
        "lb": x - 0.5,
        "ub": x + 1.0,
    }


def measure_programs(count: int, solvers: tuple[str, ...]) -> list[list[Any]]:
    """Return the rows of the table of `--programs`."""
    own: dict[str, list[float]] = {name: [] for name in solvers}
    for name in solvers:  # Imports, and processes of backends.
        lv.solve_qp(
            np.eye(3), -np.ones(3), lb=np.zeros(3), ub=np.full(3, 0.5), solver=name, time_limit=5.0
        )
        lv.solve_qp(np.eye(1), [0.0], G=[[1.0], [-1.0]], h=[-1.0, -1.0], solver=name)
    rng = np.random.default_rng(0)
    for i in range(count):
        arrays = draw_program(rng)
        limit = LIMITS[i % 2]
        for name in solvers:
            problem = lv.Problem.from_qp(**arrays)
            if get(name).refuses(problem):
                continue
            with measure_backend_time(name) as spent:
                call = partial(lv.solve_qp, problem, name, tol=1e-6, time_limit=limit)
                own[name].append(run_timed(call)[1] - sum(spent) - limit)
    rows = []
    for name, times in own.items():
        share = 100.0 * np.mean(np.array(times) <= OVERHEAD)
        rows.append(
            [
                name,
                len(times),
                f"{share:.1f} %",
                f"{1e3 * np.quantile(times, 0.99):.1f}",
                f"{1e3 * max(times):.1f}",
            ]
        )
    return rows


# -- sheets of drawn contact problems ------------------------------------------------------------------


def draw_call(problem: Problem, rng: np.random.Generator) -> tuple[Any, float]:
    """Draw (start or None, limit [s]) of a line of the sheet `auto`."""
    start = None
    if rng.random() < 0.67:
        noise = 0.3 * problem.b * rng.standard_normal(problem.m)
        other = problem.updated(
            b=problem.b + noise + 0.1 * np.abs(problem.b).max() * rng.standard_normal(problem.m)
        )
        sweeps = next(name for name in SHEET_SWEEPS if not get(name).refuses(problem))
        stale = lv.solve(other, sweeps, max_iter=int(rng.integers(5, 60)), tol=0.0).impulse
        start = float(rng.choice([1.0, 1.0, 3.0])) * stale
    return start, float(np.exp(rng.uniform(np.log(1e-4), np.log(1e-2))))


def measure_auto(problem: Problem, rng: np.random.Generator) -> list[Line]:
    """Measure a line of the sheet `auto`."""
    start, limit = draw_call(problem, rng)
    names = [solver for solver in ("auto", *SHEET_SWEEPS) if not get(solver).refuses(problem)]
    runs = np.empty((REPEATS, len(names), 2))
    for i in range(REPEATS):
        for j, solver in enumerate(names):
            cold = fresh(problem)
            given = {"impulse": start, "tol": TOLERANCE, "time_limit": limit}
            solution, time = run_timed(partial(lv.solve, cold, solver, **given))
            runs[i, j] = solution.residual.relative, time / limit
    (own, over) = np.median(runs, axis=0)[0]
    others = np.median(runs, axis=0)[1:, 0]
    at_start = lv.residual(problem, problem.start() if start is None else start).relative
    line = {
        "name": problem.name,
        "rows": problem.m,
        "limit": limit,
        "residual": own,
        "best": others.min(),
        "by": names[1 + int(others.argmin())],
        "at start": at_start,
        "ratio": max(own, TOLERANCE) / max(others.min(), TOLERANCE),
        "time": over,
    }
    return [line]


def print_auto(lines: list[Line], worst: int) -> None:
    """Print the figures of the sheet `auto`, and the lines with the largest ratios."""
    ratio, time = (np.array([line[key] for line in lines]) for key in ("ratio", "time"))
    lost = sum(line["residual"] > line["at start"] * (1 + 1e-9) for line in lines)
    quantiles = ", ".join(f"{x:.2f}" for x in np.quantile(time, (0.5, 0.95, 1)))
    figures = {
        "residual of `auto` over that of the best sweeps, geometric mean": f"{gmean(ratio):.2f}",
        "the same, of ratios above 1": f"{gmean(np.maximum(ratio, 1.0)):.2f}",
        "above 10 times": (ratio > 10.0).sum(),
        "worse than the start": lost,
        "time over the limit, median, 95 %, worst": quantiles,
    }
    columns = {
        "limit [ms]": lambda x: f"{1e3 * x['limit']:.2f}",
        "`auto`": lambda x: f"{x['residual']:.1e}",
        "best sweeps": lambda x: f"{x['best']:.1e} {x['by']}",
        "start": lambda x: f"{x['at start']:.1e}",
        "time/limit": lambda x: f"{x['time']:.2f}",
    }
    print_figures(figures, columns, sorted(lines, key=lambda x: -x["ratio"])[:worst])


def print_figures(
    figures: dict[str, Any], columns: dict[str, Callable[[Line], str]], lines: list[Line]
) -> None:
    """Print a table of figures, and one of lines with these columns."""
    click.echo(markdown(["figure", "value"], figures.items()))
    rows = ((x["name"], x["rows"], *(cell(x) for cell in columns.values())) for x in lines)
    click.echo("\n" + markdown(["problem", "rows", *columns], rows))


def measure_prepared(problem: Problem, rng: np.random.Generator) -> list[Line]:
    """Measure the own solvers on a problem of the sheet `prepared`."""
    limit = float(np.exp(rng.uniform(np.log(1e-3), np.log(5e-2))))
    lines = []
    for solver, spec in registry.specs().items():
        if not spec.builtin or spec.external or spec.refuses(problem):
            continue
        prepared = lv.prepare(fresh(problem), solver)
        for _ in range(3):
            b = problem.b * (1.0 + 0.01 * rng.random())
            call = partial(prepared.solve, b=b, tol=1e-8, time_limit=limit)
            solution, time = run_timed(call)
            lines.append(
                {
                    "name": problem.name,
                    "rows": problem.m,
                    "solver": solver,
                    "limit": limit,
                    "time": time,
                    "excess": time - 2.0 * limit,
                    "status": solution.status.name,
                }
            )
    return lines


def print_prepared(lines: list[Line], worst: int) -> None:
    """Print the figures of the sheet `prepared`, and the lines with the largest times over 2 L."""
    excess = np.array([line["excess"] for line in lines])
    figures = {
        "solves": len(lines),
        "CPU time at most 2 L + 5 ms": f"{np.mean(excess <= 5e-3):.2%}",
        "CPU time at most 2 L + 25 ms": f"{np.mean(excess <= 25e-3):.2%}",
        "largest time over 2 L": f"{1e3 * excess.max():.1f} ms",
    }
    columns = {
        "solver": lambda x: x["solver"],
        "limit [ms]": lambda x: f"{1e3 * x['limit']:.1f}",
        "time [ms]": lambda x: f"{1e3 * x['time']:.1f}",
        "status": lambda x: x["status"],
    }
    print_figures(figures, columns, sorted(lines, key=lambda x: -x["excess"])[:worst])


def print_sheet(sheet: str, count: int, seed: int, worst: int = 12) -> None:
    """Measure and print a sheet; CPU time is the clock, so that other processes do not count."""
    problems = forms(stacks(2, 3, 0.5, False))
    for solver in ("auto", *SHEET_SWEEPS):  # Imports do not count.
        for problem in problems.values():
            if not get(solver).refuses(problem):
                lv.solve(problem, solver, tol=1e-12, time_limit=0.05)
    play_clock(thread_time)
    lavender.solving.loop.perf_counter = thread_time  # type: ignore[attr-defined]
    gc.disable()
    lines: list[Line] = []
    measure = measure_auto if sheet == "auto" else measure_prepared
    for source, number, problem in draw_problems(seed, count, MAX_ROWS):
        if problem.m >= MIN_ROWS[sheet]:
            named = replace(problem, name=f"{source} {number} {problem.name}")
            lines += measure(named, np.random.default_rng([number, 1]))
            gc.collect()
    (print_auto if sheet == "auto" else print_prepared)(lines, worst)


@click.command("limits")
@click.option(
    "--sheet",
    type=click.Choice(["auto", "prepared", "programs"]),
    default="auto",
    show_default=True,
)
@click.option("--solver", "solvers", multiple=True, default=("auto",), help="Of the programs.")
@click.option("--count", default=100, show_default=True, help="Number of seeds, or of programs.")
@click.option("--seed", default=0, show_default=True)
def command(sheet: str, solvers: tuple[str, ...], count: int, seed: int) -> None:
    """Measure calls under time limits."""
    if sheet != "programs":
        print_sheet(sheet, count, seed)
        return
    head = [
        "solver",
        "programs",
        "within limit + 5 ms",
        "above the limit in 1 % [ms]",
        "largest [ms]",
    ]
    click.echo(markdown(head, measure_programs(count, solvers)))
