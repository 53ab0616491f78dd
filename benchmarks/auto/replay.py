"""The tree of `auto` on records: what a solve would have taken, with a line put in or taken out, without solving.

    regret = (t + SHIFT) / (least t of all solvers + SHIFT)

The lines are made by the tree itself; in place of solvers stand their curves. Beside these a call and each line cost what
Python takes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import islice

import numpy as np
from scipy import optimize

from benchmarks.auto.record import LEVELS, Record
from lavender.problem import Problem
from lavender.registry import SMALL_ROWS
from lavender.solvers import costs
from lavender.solvers.auto import SHARE, Stage, Tree
from lavender.solvers.small import who
from lavender.solvers.steps import FIRST
from lavender_ext.small.checked_sweeps import sweeps_left

__all__ = ["RULES", "fit", "measured", "regrets", "replayed", "summary"]

SHIFT = 50e-6  # s: below it the difference of two solvers is Python's share
CALL, LINE = 35e-6, 20e-6  # s that Python takes for a solve, and for each line
LINES = 60
LOST = 100.0  # times the best, that a solve which does not end counts for
Curves = Mapping[str, Record]
Rule = Callable[[Tree], Iterator[Stage]]


def without(*names: str) -> Rule:
    """The tree without these solvers, but for linear matrices."""
    return lambda tree: (s for s in tree if s.solver not in names or s.iterations == math.inf)


def two_lines(tree: Tree) -> Iterator[Stage]:
    """Sweeps for a share of Newton's cost, Newton, then both in turn; over J and M Newton, linear matrices `direct`."""
    if tree.law == "linear" and tree.problem.matrix is not None:
        yield Stage("direct", math.inf, 0.0, "")
    elif tree.problem.generalized is None and tree.law != "linear":
        yield Stage("anderson", SHARE * tree.newton / tree.sweep, 0.0, "")
    yield Stage("newton", 10.0 * costs.factorisations(tree.law), 0.0, "")
    for k in range(LINES):
        yield Stage("anderson", 10.0 * 2**k * tree.newton / tree.sweep, 0.0, "")
        yield Stage("newton", 10.0 * 2**k * costs.factorisations(tree.law), 0.0, "")


def always_first(tree: Tree) -> Iterator[Stage]:
    """Sweeps first wherever Newton's method costs more than nothing."""
    tree.__dict__["least"] = math.inf if tree.newton == math.inf else tree.newton
    if tree.newton < costs.SWEEPS * tree.sweep and tree.law != "linear":
        yield tree.sweeps(SHARE * tree.newton, "", tree.newton)
    yield from tree


RULES: dict[str, Rule] = {
    "the tree": iter,
    "the two-line rule": two_lines,
    "without `direct` on bounded rows": without("direct"),
    "without rows of A over J and M": without("newton over rows"),
    "without the prediction of sweeps": lambda tree: (replace(s, least=math.inf) for s in tree),
    "sweeps first even if 100 cost more": always_first,
    "without the relaxation": without("relaxation"),
    "without `nncg` at the end": without("nncg"),
    "with `admm` at the end": lambda tree: (
        t
        for s in tree
        for t in ((s, replace(s, solver="admm")) if s.solver == "anderson" and s.least == math.inf else (s,))
    ),
}


def replayed(tree: Tree, curves: Curves, level: float, rule: Rule = iter) -> float:
    """What the lines of this rule would take to `level` [s]; inf where none gets there."""
    done: dict[str, float] = {}
    spent: dict[str, float] = {}
    total, over = CALL, set[str]()
    for stage in islice(rule(tree), LINES):
        curve = curves.get(stage.solver)
        if curve is None or not curve.points or stage.solver in over:
            continue
        before, name = done.get(stage.solver, 0.0), stage.solver
        time, end = curve.to(level)
        n = (
            _given_up(curve, before, stage, level)
            if math.isfinite(stage.least)
            else before + max(stage.iterations, 1.0)
        )
        solved = n >= end
        now = time if solved else _at(curve, n)
        total += now - spent.get(name, 0.0) + LINE
        if solved:
            return total
        done[name], spent[name] = n, now
        if n >= curve.points[-1][0]:
            over.add(name)
    return math.inf


def _at(curve: Record, n: float) -> float:
    """CPU time [s] of n iterations."""
    before = (0.0, curve.setup)
    for count, t, _ in curve.points:
        if count > n:
            return before[1] + (t - before[1]) * (n - before[0]) / (count - before[0])
        before = (count, t)
    return before[1]


def _given_up(curve: Record, before: float, stage: Stage, level: float) -> float:
    """Iterations at which more than `stage.least` are predicted to be left, or all of the stage."""
    now, end = before, before + stage.iterations
    last = _residual(curve, now)
    while now < end:
        step = min(max(now // 2, FIRST), end - now)
        now += step
        at = _residual(curve, now)
        if at <= level or sweeps_left(step, last, at, level) > stage.least:
            break
        last = at
    return now


def _residual(curve: Record, n: float) -> float:
    return min((relative for count, _, relative in curve.points if count <= n), default=1.0)


def regrets(cases: Iterable[tuple[Problem, Curves]], rule: Rule | None) -> list[tuple[float, str, float]]:
    """(regret, case, level) where somebody gets there: of `auto` as measured, or of a rule, replayed; inf: it does not."""
    found = []
    for problem, curves in cases:
        tree = Tree(problem)
        if rule is not None and (problem.m <= SMALL_ROWS or who(problem)):
            continue  # one compiled call: nothing to choose
        for level in LEVELS:
            best = min(curve.to(level)[0] for curve in curves.values())
            if math.isfinite(best):
                t = measured(curves, level) if rule is None else replayed(tree, curves, level, rule)
                extra = 0.0 if rule is None else CALL
                found.append(((t + SHIFT) / (best + extra + SHIFT), next(iter(curves.values())).case, level))
    return found


def measured(curves: Curves, level: float) -> float:
    """`auto` as it ran [s]."""
    return curves["auto"].to(level)[0] if "auto" in curves else math.inf


def summary(found: list[tuple[float, str, float]]) -> str:
    """Mean with what is lost, mean, 95 %, worst, unsolved."""
    every = np.array([r for r, _, _ in found])
    some = every[np.isfinite(every)]
    if not len(some):
        return f"{len(found)}: none solved"
    lost = np.exp(np.log(np.minimum(every, LOST)).mean())
    mean = np.exp(np.log(some).mean())
    return (
        f"{len(every):4d}  mean {mean:.2f} ({lost:.2f} with the unsolved as {LOST:.0f})  95 % {np.quantile(some, 0.95):.2f}  "
        f"worst {some.max():.1f}  unsolved {len(every) - len(some)}"
    )


def fit(cases: Iterable[tuple[Problem, Curves]]) -> dict[str, object]:
    """The twelve rates: medians of counts; of times least squares in the logarithm, at 1e-6."""
    kinds = {"rows": ("linear", "lcp"), "cone": ("cone",), "coulomb": ("coulomb",)}
    forms, newton, sweeps, counts = (
        ("bodies", "dense", "panels", "velocities"),
        [],
        [],
        {kind: [7.0] for kind in kinds},
    )
    for problem, curves in cases:
        kind = next(kind for kind, laws in kinds.items() if problem.law in laws)
        if "anderson" in curves and len(points := curves["anderson"].points) > 4:
            (n, t, _), (last, end, _) = points[len(points) // 2], points[-1]
            cone, work = problem.law == "cone", costs.sweep_work(problem)
            if end - t > LINE * len(points):  # else it is Python's share
                sweeps.append(([problem.m, work * (not cone), work * cone], 1e9 * (end - t) / max(1, last - n)))
        for name, state in Tree(problem).states.items():
            time, n = curves[name].to(1e-6) if name in curves else (math.inf, math.inf)
            if math.isfinite(time) and problem.m > 20:
                c = state.count
                compiled = c.form == "velocities"
                if not compiled and problem.law != "linear":
                    counts[kind].append(max(n, 1.0))
                newton.append(
                    (kind, 1.0 if problem.law == "linear" else 0.0, max(n, 1.0), compiled, c, 1e9 * time)
                )
    x, t = (np.array(column, float) for column in zip(*sweeps, strict=True))
    row, entry, cone = _positive(lambda q: x @ q, t, [12.0, 0.5, 1.7])
    count = {kind: float(np.median(found)) for kind, found in counts.items()}

    def model(q: np.ndarray) -> np.ndarray:
        made = []
        for kind, one, n, compiled, c, _ in newton:
            k = (1.0 if one else count[kind]) if compiled else n
            each = q[1] * c.rows + entry * c.entries + q[2 + forms.index(c.form)] * c.work
            made.append((0.0 if compiled else q[0]) + c.set_up + k * each)
        return np.array(made)

    q = _positive(model, np.array([n[-1] for n in newton]), [8e4, 300.0, 0.2, 0.03, 0.5, 0.2])
    return {
        "start": q[0], "row": q[1], "entry": entry, "work": dict(zip(forms, q[2:], strict=True)), "count": count,
        "sweep row": row, "sweep cone": cone,
    }  # fmt: skip


def _positive(model: Callable[[np.ndarray], np.ndarray], time: np.ndarray, start: list[float]) -> list[float]:
    found = optimize.least_squares(
        lambda q: np.log(model(np.exp(q))) - np.log(time), np.log(start), loss="soft_l1"
    )
    return [float(f"{rate:.3g}") for rate in np.exp(found.x)]
