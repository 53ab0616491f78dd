"""The tree of `auto` on records: what a solve would have taken, with a line put in or taken out; the fit of its rates.

    regret = (t + SHIFT) / (least t of all solvers + SHIFT)

The lines are made by the tree itself; in place of solvers stand their curves. A call and each line cost Python's share.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
from scipy import optimize

from benchmarks.auto.record import LEVELS, Record
from lavender.problem import Problem
from lavender.solvers import costs
from lavender.solvers.auto import MOST, Stage, Tree
from lavender.solvers.registry import SMALL_ROWS
from lavender.solvers.small import who
from lavender.solvers.steps import FIRST

__all__ = ["RULES", "fit", "regrets", "replayed", "summary"]

SHIFT = 50e-6  # s: below it the difference of two solvers is Python's share
CALL, LINE = 35e-6, 20e-6  # s that Python takes for a solve, and for each line
SHARE = 0.8  # of Newton's counted cost, that sweeps have before it in two lines
LOST = 100.0  # times the best, that a solve which does not end counts for
Curves = Mapping[str, Record]
Rule = Callable[[Tree], Iterator[Stage]]


def without(name: str) -> Rule:
    """The tree without a solver, but for linear matrices."""
    return lambda tree: (s for s in tree if not s.solver.startswith(name) or s.iterations == math.inf)


def two_lines(tree: Tree) -> Iterator[Stage]:
    """Sweeps for a share of Newton's cost, Newton, both in turn; J and M: Newton; linear matrices: `direct`."""
    count = costs.factorisations(tree.law)
    if tree.law == "linear" and tree.problem.matrix is not None:
        yield Stage("direct", math.inf, 0.0, "")
    elif tree.problem.generalized is None and tree.law != "linear":
        yield Stage("anderson", SHARE * tree.newton / tree.sweep, 0.0, "")
    for k in range(20):
        yield Stage("newton", MOST * 2**k * count, 0.0, "")
        yield Stage("anderson", MOST * 2**k * tree.newton / tree.sweep, 0.0, "")


RULES: dict[str, Rule] = {
    "the tree": iter,
    "the two-line rule": two_lines,
    "without `direct` on bounded rows": without("direct"),
    "without rows of A over J and M": without("newton over rows"),
    "without the prediction of sweeps": lambda tree: (replace(s, least=math.inf) for s in tree),
    "without `nncg`": without("nncg"),
}


def replayed(tree: Tree, curves: Curves, level: float, rule: Rule) -> float:
    """What the lines of this rule would take to `level` [s]; inf where none gets there."""
    total, at = CALL, dict[str, tuple[float, float]]()  # iterations and s of each solver so far
    tree.best = 1.0
    for stage in islice(rule(tree), 60):
        curve, (before, spent) = curves.get(stage.solver), at.get(stage.solver, (0.0, 0.0))
        if curve is None or not curve.points or before >= curve.points[-1][0]:
            tree.left += stage.cost
            continue
        time, end = curve.to(level)
        n = before + max(1.0, stage.iterations)
        if math.isfinite(stage.least):
            n = given_up(curve, before, stage, level)
        known = ((0, curve.setup, 1.0), *curve.points)
        now = time if n >= end else float(np.interp(n, [k for k, _, _ in known], [t for _, t, _ in known]))
        total += now - spent + LINE
        if n >= end:
            return total
        at[stage.solver] = n, now
        tree.best = min(tree.best, *(relative for k, _, relative in known if k <= n))
    return math.inf


def given_up(curve: Record, before: float, stage: Stage, level: float) -> float:
    """Iterations at which more than `stage.least` are predicted to be left, or all of the stage."""
    at, last = before, min((relative for k, _, relative in curve.points if k <= before), default=1.0)
    for n, _, relative in curve.points:
        if max(at + FIRST, 1.5 * at) <= n < before + stage.iterations:
            gain = math.log(last / relative) if 0.0 < relative < last else 0.0
            if relative <= level or gain * stage.least < (n - at) * math.log(relative / level):
                return n
            at, last = n, relative
    return before + stage.iterations


def regrets(cases: Iterable[tuple[Problem, Curves]], rule: Rule | None) -> list[tuple[float, str, float]]:
    """(regret, case, level) where somebody gets there: of `auto` as it ran, or of a rule, replayed; inf: lost."""
    found = []
    for problem, curves in cases:
        if rule is not None and (problem.m <= SMALL_ROWS or who(problem)):
            continue  # one compiled call: nothing to choose
        for level in LEVELS:
            best = min(curve.to(level)[0] for curve in curves.values())
            nothing = rule is not None and problem.metric.start_relative <= level  # to choose, either
            if not math.isfinite(best) or nothing:
                continue
            if rule is None:
                t, more = curves["auto"].to(level)[0], SHIFT
            else:
                t, more = replayed(Tree(problem), curves, level, rule), SHIFT + CALL
            found.append(((t + SHIFT) / (best + more), next(iter(curves.values())).case, level))
    return found


def summary(found: list[tuple[float, str, float]]) -> str:
    """How many, geometric mean, 95 %, worst, unsolved."""
    if not found:
        return "none"
    every = np.minimum([regret for regret, _, _ in found], LOST)
    mean, lost = np.exp(np.log(every).mean()), sum(regret == math.inf for regret, _, _ in found)
    high = f"95 % {np.quantile(every, 0.95):.2f}  worst {every.max():.1f}"
    return f"{len(every):4d}  mean {mean:.2f}  {high}  unsolved {lost}, counted as {LOST:.0f}"


def fit(cases: Iterable[tuple[Problem, Curves]]) -> dict[str, Any]:
    """The twelve rates: medians of counts; of times least squares in the logarithm, of Newton's method to 1e-6."""
    kinds, rows, newton = ("rows", "cone", "coulomb"), list[Any](), list[Any]()
    counts = {kind: list[float]() for kind in kinds}
    for problem, curves in cases:
        kind = problem.law if problem.law in kinds else "rows"
        points = curves["anderson"].points if "anderson" in curves else []
        if len(points) > 4:
            (n, t, _), (last, end, _) = points[len(points) // 2], points[-1]
            cone, work = problem.law == "cone", costs.sweep_work(problem)
            if end - t > LINE * len(points):  # else it is Python's share
                each = 1e9 * (end - t) / max(1, last - n)
                rows.append((0, 0, work * (not cone), 0, 0, 0, 0, problem.m, work * cone, 0, each))
        for name, state in Tree(problem).states.items():
            time, n = curves[name].to(1e-6) if name in curves else (math.inf, math.inf)
            compiled, linear = state.general is not None, problem.law == "linear"
            if name in curves and n > 0.0 and not compiled and not linear and not who(problem):
                counts[kind].append(n)  # inf: never; without these the median would be of the easy ones
            if math.isfinite(time) and problem.m > 20:
                newton.append(
                    (state.count, 1.0 if linear else "rows" if compiled else max(n, 1.0), 1e9 * time)
                )
    # What no record is of keeps its count.
    count: dict[Any, float] = {
        kind: float(np.median(found or costs.RATES["count"][kind])) for kind, found in counts.items()
    }
    works: dict[str, float] = costs.RATES["work"]
    for c, n, time in newton:
        k = c.steps * count.get(n, n)
        work = (k * c.work * (c.form == form) for form in works)
        rows.append((c.rows > 0, k * c.rows, k * c.entries, *work, 0, 0, c.set_up, time))
    x, r = np.array(rows, float), costs.RATES
    first = [r["start"], r["row"], r["entry"], *works.values(), r["sweep row"], r["sweep cone"]]
    found = optimize.least_squares(
        lambda q: np.log((x[:, :9] @ np.exp(q) + x[:, 9]) / x[:, 10]), np.log(first), loss="soft_l1"
    )
    start, row, entry, *each, sweep, cone = (float(f"{rate:.3g}") for rate in np.exp(found.x))
    rates = {"start": start, "row": row, "entry": entry, "work": dict(zip(works, each, strict=True))}
    return rates | {"count": count, "sweep row": sweep, "sweep cone": cone}
