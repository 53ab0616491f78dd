"""The rates of `auto` from recorded curves of its candidates: least squares in the logarithm of the time.

    log t = log(start + formed E + n (row m + work w))         at points of a curve, n iterations after t        (1)

What a call, a row and a multiply-add cost is told by (1), how many iterations to count on by medians; no rate stands on
fewer than LEAST problems. Counts that a search over the replayed schedule found gained nothing on other seeds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from benchmarks.auto.curves import Curve
from lavender.problem import LAWS, Problem
from lavender.registry import SMALL_ROWS
from lavender.solvers.costs import READ, Costs
from lavender.solvers.structure import Structure
from lavender.solvers.weights import law_of

__all__ = ["DRAWN", "LEAST", "count_rates", "fit", "gathered", "least_squares", "middle"]

LEAST = 30  # problems that a rate stands on at least
DRAWN = 10  # problems that the median of all laws counts for beside those of one
LEVEL = 1e-6  # that counts are for
POINTS = 5  # of a curve, that are fitted at most
NINE_IN_TEN = 0.9
UPPER = 0.75  # quantile of counts of who promises nothing, and so is not left before what is expected of it
# Laws, as rates tell them apart: what a multiply-add of a sweep costs, and counts of iterations.
SWEPT = {"rows": ("linear", "lcp", "coulomb", "rolling"), "cone": ("cone",)}
KINDS = {"rows": ("linear", "lcp"), "cone": ("cone",), "coulomb": ("coulomb",)}
COUNTED = {
    "newton": KINDS | {"rolling": ("rolling",)},
    "velocities": KINDS,
    "nncg": {"rows": LAWS, "rolling": ("rolling",)},
}
Terms = list[float]
Recorded = tuple[Structure, dict[str, Curve]]


def gathered(curves: Iterable[Curve], problem_of: Callable[[str], Problem]) -> list[Recorded]:
    """Structure and curves, by candidate, of each problem of more than few rows.

    Parameters
    ----------
    curves : iterable of Curve
    problem_of : callable (name) -> Problem
    """
    found: dict[str, dict[str, Curve]] = {}
    for curve in curves:
        if curve.rows > SMALL_ROWS:  # others are mostly solved in one compiled call
            found.setdefault(curve.case, {})[curve.candidate] = curve
    return [(Structure(problem_of(case)), made) for case, made in found.items()]


def fit(cases: Iterable[Recorded]) -> dict[str, Any]:
    """All rates, as `rates.json` has them, of what `gathered` returned."""
    cases = list(cases)

    def of(*names: str) -> list[tuple[Structure, Curve]]:
        return [(s, c) for s, made in cases for n, c in made.items() if n in names and c.points]

    def given(s: Structure, value: float) -> Terms:
        """The value at the place of the problem's law."""
        return [value * (law_of(s.problem) in of_laws) for of_laws in SWEPT.values()]

    rates: dict[str, Any] = {}
    sweeps, back = of("anderson"), of("nncg")
    start, each_row, *work = least_squares(sweeps, lambda s, n: [1.0, n * s.m, *given(s, n * s.sweep)])
    rates["anderson"] = {"start": start, "row": each_row, "work": dict(zip(SWEPT, work, strict=True))}
    rates["nncg"] = {}
    finite = [(s, c) for s, c in of("direct") if s.is_definite]
    start, each_row, one, formed = least_squares(finite, lambda s, n: [1.0, n * s.m, n * s.direct, s.formed])
    rates["direct"] = {"start": start, "row": each_row, "work": one}
    rates["formed"] = formed
    newton = [(s, c) for s, c in of("newton", "newton over rows") if _is_over_rows(s, c)]
    start, each_row, one = least_squares(
        newton, lambda s, n: [1.0, n * s.m, n * s.newton], lambda s: formed * s.formed
    )
    rates["newton"] = {"start": start, "row": each_row, "work": one}
    steps = [(s, c) for s, c in of("newton over velocities") if s.kernel is not None]
    step, entry, one = least_squares(steps, lambda s, n: [n, READ * s.sweep + n * s.read, n * s.velocities])
    rates["velocities"] = {"step": step, "entry": entry, "work": one}
    split = of("admm")
    start, factor, one = least_squares(split, lambda s, n: [1.0, *s.admm(n)], lambda s: formed * s.formed)
    rates["admm"] = {"start": start, "factor": factor, "work": one}
    chosen = {
        "anderson": sweeps,
        "nncg": back,
        "direct": finite,
        "newton": newton,
        "velocities": steps,
        "admm": split,
    }
    for name, part in chosen.items():
        quantile = UPPER if name in ("nncg", "admm") else 0.5
        by_law = {law: [x for x in part if law_of(x[0].problem) == law] for law in (*LAWS, "rolling")}
        whole = middle([x for law in LAWS for x in by_law[law]], quantile=quantile)
        by_kind = {
            kind: _round(
                middle(
                    [x for law in laws for x in by_law[law]], whole, 0.5 if kind == "rolling" else quantile
                )
            )
            for kind, laws in COUNTED.get(name, {}).items()
        }
        rates[name] |= {"count": by_kind or _round(whole)}
    rates["sure"] = _round(surely({"direct": finite, "newton": newton + steps}, rates))
    return rates


def surely(chosen: Mapping[str, list[tuple[Structure, Curve]]], rates: Mapping[str, Any]) -> float:
    """Times its counted cost within which NINE_IN_TEN of who factors end, of those that reach LEVEL."""
    shares = []
    for solver, part in chosen.items():
        for s, curve in part:
            rows = "newton over rows"
            name = rows if curve.candidate == rows and s.problem.generalized is not None else solver
            shares.append(1e9 * curve.time(LEVEL) / Costs(s.problem, LEVEL, rates, s).of(name).total)
    return float(np.quantile([share for share in shares if math.isfinite(share)], NINE_IN_TEN))


def middle(part: list[tuple[Structure, Curve]], pooled: float | None = None, quantile: float = 0.5) -> float:
    """Iterations of an island to LEVEL, a quantile of those that end; `pooled` counts for DRAWN problems more."""
    counts = [
        (curve.iterations(LEVEL), s.steps if "velocities" in curve.candidate else 1.0) for s, curve in part
    ]
    ended = [n / each for n, each in counts if math.isfinite(n)]
    own = max(1.0, float(np.quantile(ended, quantile))) if ended else 1.0
    share = 1.0 if pooled is None else len(ended) / (len(ended) + DRAWN)
    return own**share * (1.0 if pooled is None else pooled ** (1.0 - share))


def _is_over_rows(s: Structure, curve: Curve) -> bool:
    return (curve.candidate == "newton") == (s.problem.generalized is None)


def _points(curve: Curve) -> list[tuple[int, float, float]]:
    """Some of a curve, evenly spread."""
    at = np.unique(np.linspace(0, len(curve.points) - 1, POINTS).round().astype(int))
    return [curve.points[i] for i in at]


def least_squares(
    chosen: list[tuple[Structure, Curve]],
    terms: Callable[[Structure, float], Terms],
    known: Callable[[Structure], float] = lambda s: 0.0,
) -> list[float]:
    """Positive rates by (1), robust: a curve that is far off counts by its distance, not by its square."""
    from scipy import optimize

    if len(chosen) < LEAST:
        raise ValueError(
            f"{len(chosen)} curves of {chosen[0][1].candidate if chosen else 'nobody'}: {LEAST} are needed"
        )
    x, y, z = [], [], []
    for s, curve in chosen:
        for n, t, _ in _points(curve):
            x.append(terms(s, float(max(n, 1))))
            y.append(1e9 * t)
            z.append(known(s))
    a, time, rest = np.array(x), np.array(y), np.array(z)
    scale = np.array([np.median(column[column > 0.0]) if (column > 0.0).any() else 1.0 for column in a.T])
    start = np.log(np.median(time) / scale / a.shape[1])
    found = optimize.least_squares(
        lambda q: np.log(a @ np.exp(q) + rest + 1.0) - np.log(time), start, loss="soft_l1"
    )
    return [_round(rate) for rate in np.exp(found.x)]


def _round(value: float) -> float:
    return float(f"{value:.3g}")


def count_rates(rates: Mapping[str, Any]) -> int:
    """How many numbers there are."""
    return sum(count_rates(value) if isinstance(value, Mapping) else 1 for value in rates.values())
