"""Times of calls under a time limit, and estimated against measured times of set-ups.

    python -m benchmarks limits [--case 'granularF(n=12)' ...] [--solver auto ...] [--repeats 5]
    python -m benchmarks limits --rates

The first prints medians of wall and CPU time of cold calls divided by their limit, the number of sweeps or steps, the
relative residual, and the residual of the start. Before the limits it prints the smallest CPU time of one cold sweep
without a limit, set-up and judge included. The second prints the estimated and smallest CPU time of every set-up, and
the rates that fit the measured times best (relative least squares, nonnegative). The constants in
`lavender/solvers/setup_times.py` and `lavender/judge/residuals.py` are 1.5 times these rates.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from statistics import median
from time import perf_counter, thread_time
from typing import Any

import click
import numpy as np
from scipy.optimize import nnls

import lavender as lv
from benchmarks.core_problems import forms, fresh
from benchmarks.output import markdown
from lavender import suite
from lavender.base import lazy_import as _lazy_import
from lavender.judge import residuals
from lavender.problem import Problem
from lavender.solvers import setup_times
from lavender.solvers.registry import get

CASES = ("stack(n=64)", "chain(n=33)", "pyramidF(k=6)", "stack(n=5000)", "granular(n=12)", "granularF(n=12)",
         "dense 300 x 100", "dense 3000 x 300", "matrix 300", "matrix 2400")  # fmt: skip
LIMITS = (1e-3, 1e-2)  # s
MEASURED = (*CASES[1:-1], "granularF(n=5) as matrix", "granularF(n=5) as J and M", "matrix 1200")
SOLVERS = ("newton", "direct", "pgs", "jacobi", "anderson", "sequential_impulses", "block_gauss_seidel")
SWEEPS = (
    "sequential_impulses",
    "block_gauss_seidel",
    "pgs",
)  # the first one that accepts the problem's form is used
RATES = {
    setup_times: (
        "START_TIME",
        "FORM_ROW_TIME",
        "FORM_ENTRY_TIME",
        "FORM_PRODUCT_TIME",
        "SCIPY_CALLS_TIME",
        "LAYOUT_ENTRY_TIME",
        "FULL_LAYOUT_ENTRY_TIME",
        "ROW_SUM_ENTRY_TIME",
        "ANALYSIS_ENTRY_TIME",
        "BODY_ELIMINATION_TIME",
        "VELOCITY_ELIMINATION_TIME",
        "DISK_J",
        "DISK_J_ROW",
        "DISK_J_ENTRY",
        "DISK_A",
        "DISK_A_ROW",
        "DISK_A_ENTRY",
    ),
    residuals: ("RESULT_TIME", "PASS_TIME_PER_PRODUCT", "WHITENING_TIME_PER_PRODUCT", "READ_TIME_PER_ENTRY"),
}


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


def with_ellipses(problem: Problem) -> Problem:
    """Return the problem with an ellipse for each contact of two tangents, mu_2 = mu_1 / 2."""
    c = problem.cones
    two = (c.kind == lv.CONTACT) & (c.n_tangents == 2)
    kind, ratio = np.where(two, lv.CONTACT_ELLIPSE, c.kind), np.where(two, 0.5, c.patch_radius)
    return replace(problem, cones=replace(c, kind=kind, patch_radius=ratio))


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


def set_ups(name: str) -> Iterator[tuple[str, Callable[[], float], float]]:
    """Yield the name, estimated time and smallest CPU time [s] of every set-up of one problem."""
    make = problem_of(name)

    def ready() -> Problem:
        problem = make()
        residuals.get_reference(problem)
        return problem

    problem, cold = ready(), make()
    impulse = np.ones(problem.m)
    yield "the judge", lambda: residuals.estimate_judge_setup_time(cold), least(make, lambda p: p.metric)
    yield (
        "his pass",
        lambda: residuals.estimate_judging_time(problem) - residuals.RESULT_TIME,
        least(ready, lambda p: residuals.judge_impulse(p, impulse)),
    )
    stretched = with_ellipses(make())
    if stretched.cones.has_ellipse:
        yield (
            "disks",
            lambda: setup_times.estimate_disk_time(stretched),
            least(lambda: with_ellipses(make()), lambda p: p.disk),
        )
    for solver in SOLVERS:
        spec = get(solver)
        own = spec.load()()
        counted: Any = getattr(own, "setup_time", None)
        if spec.refuses(problem) or counted is None or not 0.0 < counted(ready()) < 1.0:
            continue
        untouched = ready()
        yield solver, lambda c=counted, p=untouched: c(p), least(ready, own.prepare)  # type: ignore[misc]


def least(make: Callable[[], Problem], call: Callable[[Problem], Any], repeats: int = 3) -> float:
    """Return the smallest CPU time [s] of a call on new problems."""
    times = []
    for _ in range(repeats):
        problem = make()
        start = thread_time()
        call(problem)
        times.append(thread_time() - start)
    return min(times)


def with_rates(count: Callable[[], float], changed: dict[tuple[Any, str], float]) -> float:
    """Return an estimate with other rates."""
    before = {at: getattr(*at) for at in changed}
    try:
        for (module, name), value in changed.items():
            setattr(module, name, value)
        return count()
    finally:
        for (module, name), value in before.items():
            setattr(module, name, value)


@click.command("limits")
@click.option("--case", "names", multiple=True, help=f"Default: {', '.join(CASES)}.")
@click.option("--solver", "solvers", multiple=True, default=("auto",), show_default=True)
@click.option("--repeats", default=5, show_default=True)
@click.option("--rates", is_flag=True, help="Set-ups: counted, measured, and the rates that fit.")
def command(names: tuple[str, ...], solvers: tuple[str, ...], repeats: int, rates: bool) -> None:
    """Measure calls under time limits, or the estimated times of set-ups."""
    lv.solve(problem_of("dense 30 x 20")(), time_limit=1e-2)
    if rates:
        _lazy_import.import_numerics()
        show_rates(names or MEASURED)
        return
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


def show_rates(names: tuple[str, ...]) -> None:
    """Print the tables of set-up times and of fitted rates."""
    at = [(module, rate) for module, of in RATES.items() for rate in of]
    none = dict.fromkeys(at, 0.0)
    rows, weights, left = [], [], []
    for name in names:
        for what, count, took in set_ups(name):
            rows.append([name, what, f"{1e3 * count():.3f}", f"{1e3 * took:.3f}", f"{count() / took:.2f}"])
            fixed = with_rates(count, none)
            weights.append([(with_rates(count, none | {key: 1.0}) - fixed) / took for key in at])
            left.append(1.0 - fixed / took)
    click.echo(markdown(["problem", "set-up", "counted [ms]", "took [ms]", "ratio"], rows))
    scale = np.array([getattr(*key) for key in at])
    found = nnls(np.array(weights) * scale, np.array(left))[0] * scale
    lines = [
        [key[1], f"{getattr(*key):.2g}", f"{x:.2g}"]
        for key, x in zip(at, found, strict=True)
        if key[1] != "RESULT_TIME"
    ]
    click.echo("\n" + markdown(["rate [s]", "now", "fitted"], lines))
