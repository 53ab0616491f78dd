"""Measure the rates [ns] of the operations that `lavender/solvers/costs.py` counts, and write `rates.json`.

    python -m benchmarks rates [--write]

Three fits, each of nonnegative rates with least squares of relative errors: factorisations of `newton` and `direct`,
sweeps of `anderson`, and set-ups. Times are the smallest CPU times of several runs. The rates of set-ups are stored
times SETUP_MARGIN, because under a time limit `auto` had better sweep than factor too late. The table shows the stored
rates and the measured ones. `--write` replaces the file; results on this machine then depend on it, because `auto`
compares the costs.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
from scipy.optimize import nnls

import lavender as lv
from benchmarks.core_problems import forms, fresh, stacks
from benchmarks.output import markdown
from benchmarks.pairs import run_timed, time_anew
from lavender import suite
from lavender.base import rates
from lavender.base.lazy_import import import_numerical_modules
from lavender.judge import residuals
from lavender.problem import Problem
from lavender.solvers import costs
from lavender.solvers._accelerated import estimate_sweep_work
from lavender.solvers.registry import get

RATES_PATH = Path(rates.RATES_PATH)
SETUP_MARGIN = 1.5
STORED_WEIGHT = 0.5  # Weight of a stored rate, compared with 1 for each measured time.
CASES = (
    "stack(n=64)",
    "chain(n=33)",
    "pyramidF(k=6)",
    "stack(n=5000)",
    "granular(n=12)",
    "granularF(n=12)",
    "dense 300 x 100",
    "dense 3000 x 300",
    "matrix 300",
    "matrix 2400",
)
SETUP_CASES = (*CASES[1:-1], "granularF(n=5) as matrix", "granularF(n=5) as J and M", "matrix 1200")
SETUP_SOLVERS = ("newton", "direct")
SETUP_RATES = (
    "set-up",
    "form row",
    "form entry",
    "form product",
    "scipy calls",
    "layout entry",
    "full layout entry",
    "analysis entry",
    "full analysis entry",
    "body elimination",
    "velocity elimination",
    "judge entry",
)
NEWTON_RATES = (
    "start",
    "row",
    "entry",
    "bodies",
    "dense",
    "panels",
    "velocities",
    "velocity row",
    "velocity contact row",
)
PIVOT_RATES = ("pivot row", "pivot work")
SWEEP_RATES = ("sweep row", "sweep entry", "sweep cone", "sweep body cone", "sweep velocities")
MEASURED_SWEEPS = 100  # The first sweeps cost more, and `auto` uses about as many.

Fit = dict[str, float]  # Rate by name [ns].
Line = tuple[str, dict[str, float], float]  # (problem, {rate: number of operations}, time [ns]).


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
        half = rng.normal(size=(n, n))
        jac = rng.normal(size=(m, n))
        free = rng.normal(size=n)
        cones = lv.Cones.contacts(np.full(m // 3, 0.5), 2)
        return lambda: Problem.from_jacobian(jac, half @ half.T / n + np.eye(n), free, cones=cones)
    half = rng.normal(size=(m, m // 2))
    b = rng.normal(size=m)
    matrix = half @ half.T / m + 0.01 * np.eye(m)
    return lambda: Problem.contact(matrix, b, 0.5, friction="cone")


def fit_rates(names: tuple[str, ...], lines: list[Line]) -> Fit:
    """Return the nonnegative rates that fit the times with the least squares of relative errors.

    Each rate's relative change from its stored value is one more equation, so that operations whose counts are
    proportional to each other in all problems keep the ratio of their rates.
    """
    stored = np.array([get_stored(name) for name in names])
    table = (
        np.array([[counts.get(name, 0.0) / time for name in names] for _, counts, time in lines])
        * stored
    )
    known = table.any(axis=0)
    equations = np.vstack([table, STORED_WEIGHT * np.eye(len(names))])
    found = (
        stored
        * nnls(equations, np.append(np.ones(len(lines)), np.full(len(names), STORED_WEIGHT)))[0]
    )
    return {
        name: float(x) for name, x, is_known in zip(names, found, known, strict=True) if is_known
    }


def get_stored(name: str) -> float:
    """Return the stored rate of this name; set-ups are stored with their margin."""
    work = costs.RATES["work"]
    value = float(
        work[name] if name in work else costs.RATES["entry" if name == "sweep entry" else name]
    )
    return value / SETUP_MARGIN if name in SETUP_RATES else value


def draw_problems(law: str) -> Iterator[tuple[str, Problem]]:
    """Yield columns and loose piles of several sizes in each form, and full matrices, under this law."""
    for height, count in ((3, 1), (3, 6), (8, 1), (8, 6), (20, 1), (20, 6), (40, 1)):
        bodies = stacks(count, height, None if law == "lcp" else 0.5, False, seed=height)
        for form, problem in forms(bodies).items():
            yield (
                f"{count} stacks of {height}, {form}, {law}",
                problem if law == "lcp" else problem.relaxed(law),
            )
    for n in (3, 4, 5, 6):
        for form, problem in forms(suite.granular(n=n, friction="coulomb").problem).items():
            if law != "lcp":
                yield f"pile of {n}, {form}, {law}", problem.relaxed(law)
    for m in (90, 180, 360, 720):
        if law == "cone":
            yield f"full matrix of {m}", problem_of(f"matrix {m}")()


def newton_lines() -> Iterator[Line]:
    """Yield operations and times of runs of `newton` over velocities of J and M, bodies, and rows of A."""
    for law in ("coulomb", "cone"):
        for label, problem in draw_problems(law):
            form = "impulse" if problem.matrix is not None else "velocity"

            def run(p: Problem, n: int = 24, form: str = form) -> lv.Solution:
                return lv.prepare(p, "newton", form=form).solve(max_iter=n, tol=1e-12)

            state = get("newton").load()(form=form).prepare(fresh(problem))
            steps = run(fresh(problem)).work.get("factorisations", 0)
            # Reading the start and the result is not part of the solver's cost.
            before = time_anew(
                lambda p=problem: fresh(p), lambda p: lv.solve(p, "block_gauss_seidel", max_iter=0)
            )  # type: ignore[misc]
            time = 1e9 * (time_anew(lambda p=problem: fresh(p), run) - before)  # type: ignore[misc]
            if not steps or time <= 0.0:
                continue
            if state.general is not None:
                each = steps / max(1, state.general.islands)
                contact_rows = 0 if law == "lcp" else problem.m
                counts = {
                    "entry": each * problem.metric.work,
                    "velocities": each * state.general.work,
                    "velocity row": each * (problem.m - contact_rows),
                    "velocity contact row": each * contact_rows,
                }
            else:
                c = state.count
                counts = {
                    "start": 1.0,
                    "row": steps * c.rows,
                    "entry": steps * c.entries,
                    c.form: steps * c.work,
                }
            yield label, counts, time


def pivot_lines() -> Iterator[Line]:
    """Yield operations and times of exchanges of `direct` on bounded rows of a matrix."""
    rng = np.random.default_rng(0)
    for m in (80, 150, 300, 600):
        half = rng.normal(size=(m, m))
        dense = Problem.lcp(half @ half.T / m + 0.1 * np.eye(m), rng.normal(size=m))
        band = suite.stack(n=m).problem
        for kind, problem in (("dense", dense), ("band", Problem.lcp(band.csr, band.b))):
            state = get("direct").load()().prepare(fresh(problem))
            solution = lv.solve(fresh(problem), "direct")
            steps = solution.work.get("factorisations", 0)
            if not steps or state is None:
                continue
            width = 1.0 + max(problem.bandwidth)
            setup = time_anew(lambda p=problem: fresh(p), get("direct").load()().prepare)  # type: ignore[misc]
            time = 1e9 * (
                time_anew(lambda p=problem: fresh(p), lambda p: lv.solve(p, "direct")) - setup
            )  # type: ignore[misc]
            if time > 0.0:
                yield (
                    f"{kind} {m}",
                    {"pivot row": steps * m, "pivot work": steps * m * width**2},
                    time,
                )


def sweep_lines() -> Iterator[Line]:
    """Yield operations and times of sweeps of `anderson`."""
    for law in ("lcp", "coulomb", "cone"):
        for label, problem in draw_problems(law):

            def run(p: Problem, n: int) -> float:
                prepared = lv.prepare(p, "anderson")
                return min(
                    run_timed(lambda: prepared.solve(max_iter=n, tol=0.0))[1] for _ in range(3)
                )

            p = fresh(problem)
            time = 1e9 * (run(p, MEASURED_SWEEPS) - run(p, 1)) / (MEASURED_SWEEPS - 1)
            rate = costs.get_sweep_rate_name(p)
            rate = "sweep entry" if rate == "entry" else rate
            yield label, {"sweep row": p.m, rate: estimate_sweep_work(p)}, time


def measure_kernels() -> Fit:
    """Return the time [ns] of a multiply-add of Newton's method with sparse factors."""
    chain = forms(suite.chain(n=200).problem)["J and M"]
    state = get("newton").load()(form="velocity").prepare(fresh(chain))

    def run(p: Problem) -> lv.Solution:
        return lv.prepare(p, "newton", form="velocity").solve(tol=1e-9)

    steps = run(fresh(chain)).work["factorisations"]
    sparse = time_anew(lambda: fresh(chain), run) / (steps * state.general.work)
    return {"sparse velocities": 1e9 * SETUP_MARGIN * sparse}  # It decides under a time limit.


def measure_setups(name: str) -> Iterator[tuple[str, Callable[[], float], float]]:
    """Yield the name, the function of the estimated cost [ns], and the smallest CPU time [ns] of each set-up."""
    make = problem_of(name)

    def ready() -> Problem:
        problem = make()
        residuals.get_zero_impulse_reference(problem)
        return problem

    problem = ready()
    for name_of_solver in SETUP_SOLVERS:
        spec = get(name_of_solver)
        solver = spec.load()()
        if spec.refuses(problem) or not 0.0 < solver.estimate_setup_cost(ready()) < 1e9:
            continue
        untouched = ready()
        yield (
            name_of_solver,
            lambda s=solver, p=untouched: s.estimate_setup_cost(p),
            time_anew(ready, solver.prepare),
        )  # type: ignore[misc]


def estimate_with(estimate: Callable[[], float], rates: Fit) -> float:
    """Return an estimate with other rates."""
    before = {name: costs.RATES[name] for name in rates}
    try:
        costs.RATES.update(rates)
        return estimate()
    finally:
        costs.RATES.update(before)


def setup_lines() -> Iterator[Line]:
    """Yield operations and times of the set-ups, whose estimates are linear in their rates."""
    none = dict.fromkeys(SETUP_RATES, 0.0)
    for name in SETUP_CASES:
        for label, estimate, seconds in measure_setups(name):
            fixed = estimate_with(estimate, none)
            counts = {
                key: estimate_with(estimate, none | {key: 1.0}) - fixed for key in SETUP_RATES
            }
            yield f"{name}: {label}", counts, max(1e9 * seconds - fixed, 1.0)


def measure_rates() -> dict[str, Any]:
    """Measure all rates and return the contents of the file; rates without a measurement keep their values."""
    newton = fit_rates(NEWTON_RATES, list(newton_lines()))
    pivot = fit_rates(PIVOT_RATES, list(pivot_lines()))
    sweep = fit_rates(SWEEP_RATES, list(sweep_lines()))
    setup = {
        name: SETUP_MARGIN * x for name, x in fit_rates(SETUP_RATES, list(setup_lines())).items()
    }
    sweep.pop("sweep entry", None)
    work = {form: newton.pop(form) for form in costs.RATES["work"] if form in newton}
    measured: dict[str, Any] = {
        **costs.RATES,
        **newton,
        **pivot,
        **sweep,
        **setup,
        **measure_kernels(),
    }
    return measured | {"work": costs.RATES["work"] | work}


@click.command("rates")
@click.option("--write", is_flag=True, help=f"Replace {RATES_PATH.name} by the measured rates.")
def command(write: bool) -> None:
    """Measure the rates of the operations whose counts are the estimated costs."""
    import_numerical_modules()
    lv.solve(problem_of("dense 30 x 20")(), time_limit=1e-2)
    measured = measure_rates()
    lines = []
    for name, value in costs.RATES.items():
        pairs = value.items() if isinstance(value, dict) else [("", value)]
        for form, stored in pairs:
            now = measured[name][form] if form else measured[name]
            lines.append([f"{name} {form}".strip(), f"{stored:.3g}", f"{now:.3g}"])
    click.echo(markdown(["rate [ns]", "stored", "measured"], lines))
    if write:
        text = json.dumps(measured, indent=1, default=float)
        RATES_PATH.write_text(text + "\n", encoding="utf-8")
