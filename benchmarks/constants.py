"""What the constants of `auto` that no fit sets are worth: each halved and doubled, on drawn problems.

    change = mean of log((t + SHIFT) / (t_0 + SHIFT))          over problems and levels          (1)
    under limits: the same of the residual, 0.1 to 10 times; and time over the limit at 95 %

t is CPU time, the least of three, of solves whose turns are others than with the constant as it is; where turns are
the same there is no change. A constant whose change is below NOISE either way is not worth having.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from time import process_time
from typing import Any

import click
import numpy as np

import benchmarks.drawn  # noqa: F401  # its family is among those of the suite
import lavender as lv
from benchmarks.auto.regret import LEVELS, SHIFT
from lavender import suite
from lavender.bench.running.timing import one_thread
from lavender.problem import Problem
from lavender.residuals import reference

NOISE = 0.02
LIMITS = (1e-4, 1e-3, 1e-2)  # s
LONG = 0.3  # s: a problem that takes longer is left out
ROOMS = ("auto", "costs", "schedule", "methods", "solve_log", "small", "structure")
Drawn = list[tuple[str, Problem]]


@contextmanager
def changed(name: str, factor: float) -> Iterator[None]:
    """A constant of `lavender.solvers`, times the factor, wherever it was imported."""
    rooms = [sys.modules[f"lavender.solvers.{room}"] for room in ROOMS]
    kept = [(room, getattr(room, name)) for room in rooms if hasattr(room, name)]
    for room, value in kept:
        setattr(room, name, type(value)(value * factor) if value < 1e300 else value)
    try:
        yield
    finally:
        for room, value in kept:
            setattr(room, name, value)


def timed(problem: Problem, level: float) -> tuple[float, Any]:
    """CPU time [s] and the turns."""
    fresh = replace(problem, copy=False)
    begun = process_time()
    solution = lv.solve(fresh, tol=level)
    return process_time() - begun, [(t.solver, dict(t.work)) for t in solution.turns]


def regret_change(problems: Drawn, name: str, factor: float, known: dict[Any, Any]) -> tuple[float, int]:
    """(1), and how many solves took other turns."""
    found, others = [], 0
    for case, problem in problems:
        for level in LEVELS:
            if (case, level) not in known:
                known[case, level] = timed(problem, level)
            seconds, turns = known[case, level]
            if seconds > LONG:
                continue
            with changed(name, factor):
                again, now = timed(problem, level)
            found.append(0.0)
            if now != turns:
                others += 1
                new, old = again, seconds
                for _ in range(2 if again < LONG else 0):
                    old = min(old, timed(problem, level)[0])
                    with changed(name, factor):
                        new = min(new, timed(problem, level)[0])
                found[-1] = math.log((new + SHIFT) / (old + SHIFT))
    return float(np.mean(found)), others


def under_limits(problems: Drawn) -> tuple[np.ndarray, np.ndarray]:
    """Residuals, and times over limits, cold and from stale guesses, of all; medians of three, CPU time."""
    residuals, over = [], []
    for case, problem in problems:
        rng = np.random.default_rng(len(case))
        near = lv.solve(problem, tol=1e-4, time_limit=LONG).impulse
        stale = near * (1.0 + 0.3 * rng.standard_normal(problem.m))
        stale = problem.impulse_array(stale)
        for start in (problem.start(), stale):
            for limit in LIMITS:
                got = []
                for _ in range(3):
                    fresh = replace(problem, copy=False)
                    reference(fresh)
                    prepared = lv.prepare(fresh, "auto")
                    solution = prepared.solve(impulse=start, tol=1e-9, time_limit=limit)
                    got.append((solution.residual.relative, solution.solve_time / limit))
                middle = np.median(got, axis=0)
                residuals.append(max(middle[0], 1e-9))
                over.append(middle[1])
    return np.array(residuals), np.array(over)


def p95(values: np.ndarray) -> float:
    """The 95th percentile, one of them."""
    return float(np.sort(values)[max(0, math.ceil(0.95 * len(values)) - 1)])


@contextmanager
def clock_of_the_process() -> Iterator[None]:
    """CPU time in place of the clock on the wall: the machine may be busy."""
    named = [room for name, room in list(sys.modules.items()) if name.startswith("lavender.")]
    rooms = [room for room in named if hasattr(room, "perf_counter")]
    kept = [(room, room.perf_counter) for room in rooms]
    for room in rooms:
        room.perf_counter = process_time
    try:
        yield
    finally:
        for room, clock in kept:
            room.perf_counter = clock


@click.command()
@click.argument("names", nargs=-1, required=True)
@click.option("--families", default="wild,foreign,foreign_new,drawn_tuned", show_default=True)
@click.option("--seeds", default=30, show_default=True, help="Of each family.")
@click.option("--factors", default="0.5,2", show_default=True, help="What each is multiplied by.")
@click.option("--limits/--no-limits", default=False, help="Under time limits instead.")
def command(names: tuple[str, ...], families: str, seeds: int, factors: str, limits: bool) -> None:
    """Halve and double the constants of auto that are called NAME, such as FIRST or BELIEVED."""
    lv.solve(suite.case("wild(seed=3)").problem)
    problems = [
        (name, suite.case(name).problem)
        for family in families.split(",")
        for name in (f"{family}(seed={seed})" for seed in range(seeds))
    ]
    known: dict[Any, Any] = {}
    with one_thread(), clock_of_the_process():
        if limits:
            base, base_over = under_limits(problems)
            again, _ = under_limits(problems)
            noise = np.log(np.clip(again / base, 0.1, 10.0)).mean()
            click.echo(f"as it is: over the limit at 95 % {p95(base_over):.2f}; residual again {noise:+.3f}")
        for name in names:
            for factor in map(float, factors.split(",")):
                if limits:
                    with changed(name, factor):
                        now, over = under_limits(problems)
                    gain = np.log(np.clip(now / base, 0.1, 10.0)).mean()
                    click.echo(
                        f"{name} times {factor:g}: residual {gain:+.3f}, over the limit at 95 % {p95(over):.2f}"
                    )
                else:
                    change, others = regret_change(problems, name, factor, known)
                    click.echo(
                        f"{name} times {factor:g}: regret {change:+.4f}, other turns {others} of {3 * len(problems)}"
                    )
