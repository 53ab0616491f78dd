"""Times of calls under a time limit.

    python -m benchmarks limits [--case 'granularF(n=12)' ...] [--solver auto ...] [--repeats 5]
    python -m benchmarks limits --programs 1000 [--solver auto --solver clarabel ...]

Prints medians of wall and CPU time of cold calls divided by their limit, the number of sweeps or steps, the relative
residual, and the residual of the start; before the limits the smallest CPU time of one cold sweep without a limit,
set-up and judge included. With --programs, it prints for each solver in which share of quadratic programs of 5 to 1,000
variables the CPU time of `solve_qp`, without the time inside of the backend's package and imports, is at most the limit
plus OVERHEAD. `python -m benchmarks rates` measures the costs that decide what starts under a limit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from statistics import median
from time import perf_counter, thread_time
from typing import Any

import click
import numpy as np
import scipy.sparse as sp

import lavender as lv
from benchmarks.core_problems import forms, fresh
from benchmarks.output import markdown
from lavender import suite
from lavender.problem import Problem
from lavender.solvers.registry import get

CASES = ("stack(n=64)", "chain(n=33)", "pyramidF(k=6)", "stack(n=5000)", "granular(n=12)", "granularF(n=12)",
         "dense 300 x 100", "dense 3000 x 300", "matrix 300", "matrix 2400")  # fmt: skip
LIMITS = (1e-3, 1e-2)  # s
OVERHEAD = 5e-3  # s
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


# -- quadratic programs ------------------------------------------------------------------------------


def draw_program(rng: np.random.Generator) -> dict[str, Any]:
    """Return the arrays of a program of 5 to 1,000 variables: control, linear, contradictory, sparse or dense."""
    n, kind = round(10.0 ** rng.uniform(np.log10(5.0), 3.0)), rng.integers(5)

    def draw(m: int, per_row: float) -> Any:
        return sp.random(m, n, min(1.0, per_row / n), random_state=rng, data_rvs=rng.standard_normal).tocsc()

    if kind == 0:  # steps of a mass in three axes with bounds on speed and force
        steps, dt, one, none = max(1, n // 9), 0.05, np.eye(3), np.zeros((3, 3))
        move, push = np.block([[one, dt * one], [none, one]]), np.vstack([0.5 * dt * dt * one, dt * one])
        later = sp.kron(sp.eye_array(steps, k=-1), move) - sp.eye_array(6 * steps)
        b = np.zeros(6 * steps)
        b[:3] = rng.normal(size=3)
        high = np.append(np.tile([5.0] * 3 + [0.8] * 3, steps), np.full(3 * steps, 2.0))
        P = sp.diags_array(np.append(np.tile([10.0] * 3 + [1.0] * 3, steps), np.full(3 * steps, 0.1)))
        A = sp.hstack([later, sp.kron(sp.eye_array(steps), push)])
        return {"P": P.tocsc(), "q": np.zeros(9 * steps), "A": A.tocsc(), "b": b, "lb": -high, "ub": high}
    if kind == 1:  # a linear program with a degenerate vertex
        m = max(1, n // 3)
        A = (draw(m, 5.0) + sp.eye_array(m, n)).tocsc()
        x = np.where(rng.random(n) < 0.3, rng.uniform(0.5, 2.0, n), 0.0)
        q = A.T @ rng.normal(size=m) + np.where(x > 0.0, 0.0, rng.uniform(0.1, 1.0, n))
        return {"P": sp.csc_array((n, n)), "q": q, "A": A, "b": A @ x, "lb": np.zeros(n)}
    if kind == 2:  # rows that contradict each other
        rows, h = draw(n, 4.0), rng.normal(size=n)
        sides = np.append(h, -h - rng.uniform(0.1, 1.0, n))
        return {
            "P": sp.eye_array(n).tocsc(),
            "q": rng.normal(size=n),
            "G": sp.vstack([rows, -rows]).tocsc(),
            "h": sides,
        }
    half, A, G, x = draw(n, 3.0), draw(max(1, n // 5), 5.0), draw(n // 2 + 1, 5.0), rng.normal(size=n)
    P = (half @ half.T + rng.choice([0.0, 0.1]) * sp.eye_array(n)).tocsc()
    if kind == 3 and n <= 300:
        P, A = np.eye(n) + half.toarray() @ half.toarray().T, rng.normal(size=A.shape)
    h = G @ x + rng.uniform(0.0, 0.5, n // 2 + 1) * (rng.random(n // 2 + 1) < 0.7)
    return {"P": P, "q": rng.normal(size=n), "A": A, "b": A @ x, "G": G, "h": h, "lb": x - 0.5, "ub": x + 1.0}


@contextmanager
def count_foreign_time() -> Iterator[list[float]]:
    """Yield a list whose entry grows by the CPU time [s] inside of other packages that solve programs."""
    import clarabel
    import osqp
    import qpsolvers

    spent = [0.0]

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            begin = thread_time()
            try:
                return function(*arguments, **options)
            finally:
                spent[0] += thread_time() - begin

        return call

    class Solver:
        """Clarabel's solver with a clock."""

        def __init__(self, *arguments: Any) -> None:
            self.solve = timed(timed(original)(*arguments).solve)

    original, parts = (
        clarabel.DefaultSolver,
        ((qpsolvers, "solve_problem"), (osqp.OSQP, "setup"), (osqp.OSQP, "solve")),
    )
    saved = [(owner, name, getattr(owner, name)) for owner, name in parts]
    try:
        clarabel.DefaultSolver = Solver
        for owner, name, function in saved:
            setattr(owner, name, timed(function))
        yield spent
    finally:
        clarabel.DefaultSolver = original
        for owner, name, function in saved:
            setattr(owner, name, function)


def measure_programs(count: int, solvers: tuple[str, ...]) -> list[list[Any]]:
    """Return the rows of the table of `--programs`."""
    own: dict[str, list[float]] = {name: [] for name in solvers}
    for name in solvers:  # Imports, and processes of backends.
        lv.solve_qp(np.eye(3), -np.ones(3), lb=np.zeros(3), ub=np.full(3, 0.5), solver=name, time_limit=5.0)
        lv.solve_qp(np.eye(1), [0.0], G=[[1.0], [-1.0]], h=[-1.0, -1.0], solver=name)
    rng = np.random.default_rng(0)
    with count_foreign_time() as spent:
        for i in range(count):
            arrays, limit = draw_program(rng), LIMITS[i % 2]
            for name in solvers:
                problem = lv.Problem.from_qp(**arrays)
                if get(name).refuses(problem):
                    continue
                spent[0], begin = 0.0, thread_time()
                lv.solve_qp(problem, name, tol=1e-6, time_limit=limit)
                own[name].append(thread_time() - begin - spent[0] - limit)
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


@click.command("limits")
@click.option("--case", "names", multiple=True, help=f"Default: {', '.join(CASES)}.")
@click.option("--solver", "solvers", multiple=True, default=("auto",), show_default=True)
@click.option("--repeats", default=5, show_default=True)
@click.option("--programs", default=0, help="Number of quadratic programs, in place of cases.")
def command(names: tuple[str, ...], solvers: tuple[str, ...], repeats: int, programs: int) -> None:
    """Measure calls under time limits."""
    if programs:
        head = ["solver", "programs", "within limit + 5 ms", "above the limit in 1 % [ms]", "largest [ms]"]
        click.echo(markdown(head, measure_programs(programs, solvers)))
        return
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
