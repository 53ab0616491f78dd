"""Engines and solvers of others beside ours: ratios of times, means, losses, and rows of tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.peers.contest import SCIPY, SCRATCH, TARGETS, Result
from benchmarks.peers.engines import Step
from lavender.report.table import Table
from lavender.report.text import residual, seconds

__all__ = [
    "Comparison",
    "Mean",
    "compare",
    "geometric_means",
    "losses",
    "mean_table",
    "over_ours",
    "ratio",
    "solver_table",
    "step_table",
]

LARGE = 1000  # rows from which a problem counts as large


def over_ours(step: Step, steps: Sequence[Step]) -> float:
    """Time over that of ours on the same scene in the same mode, sweeps or accurate; nan where there is none."""
    own = [
        s.time
        for s in steps
        if s.engine.startswith("lavender") and (s.scene, s.accurate) == (step.scene, step.accurate)
    ]
    return step.time / own[0] if own else math.nan


@dataclass(frozen=True)
class Comparison:
    """The fastest of ours and of others at one error on one problem."""

    problem: str
    rows: int
    law: str
    target: float
    ours: str
    our_time: float  # s, inf: nobody reached it
    peer: str
    peer_time: float
    scratch: float  # s, the fastest of ours from scratch
    auto: float  # s, "auto"

    @property
    def ratio(self) -> float:
        """Ours over theirs; nan where no peer reached the error, inf where only a peer did."""
        return self.over_peer(self.our_time)

    def over_peer(self, time: float) -> float:
        """A time over the fastest peer's; nan where there is none."""
        return time / self.peer_time if math.isfinite(self.peer_time) else math.nan


def compare(results: Sequence[Result], scipy: bool = True) -> list[Comparison]:
    """One line for each problem and error; `scipy` False leaves out SciPy's factorisations of linear systems."""
    results = [r for r in results if scipy or not r.solver.startswith(SCIPY)]
    found = []
    for name in dict.fromkeys(r.problem for r in results):
        here = [r for r in results if r.problem == name]
        scratch = [r for r in here if r.solver.endswith(SCRATCH)]
        ours = [r for r in here if not r.peer and not r.solver.endswith(SCRATCH)]
        for target in TARGETS:
            best = [_fastest(side, target) for side in (ours, [r for r in here if r.peer])]
            found.append(
                Comparison(
                    problem=name,
                    rows=here[0].rows,
                    law=here[0].law,
                    target=target,
                    ours=best[0][0],
                    our_time=best[0][1],
                    peer=best[1][0],
                    peer_time=best[1][1],
                    scratch=_fastest(scratch, target)[1],
                    auto=next((r.time(target) for r in ours if r.solver == "auto"), math.inf),
                )
            )
    return found


def _fastest(side: Sequence[Result], target: float) -> tuple[str, float]:
    best = min(side, key=lambda r: r.time(target), default=None)
    if best is None or not math.isfinite(best.time(target)):
        return "-", math.inf
    return best.solver, best.time(target)


@dataclass(frozen=True)
class Mean:
    """Geometric means of times over the fastest peer's, where both sides reached the error."""

    which: str  # problems
    target: float
    ours: float
    scratch: float
    auto: float
    compared: int


def geometric_means(results: Sequence[Result]) -> list[Mean]:
    """For cases (and files) and for what engines export, large and smaller, at each error.

    Peers are QP and cone backends, Pinocchio and Siconos; the last group counts SciPy's factorisations of linear
    systems among them, which are no solvers of constraint problems.
    """
    plain, every = compare(results, scipy=False), compare(results)
    groups = (
        ("cases", [c for c in plain if ":" not in c.problem]),
        ("exported by engines", [c for c in plain if ":" in c.problem]),
        ("all, SciPy too", every),
    )
    out = []
    for group, compared in groups:
        for size, large in ((f"{LARGE} rows and more", True), ("smaller", False)):
            of_size = [c for c in compared if (c.rows >= LARGE) is large and math.isfinite(c.peer_time)]
            for target in TARGETS:
                some = [c for c in of_size if c.target == target]
                if some:
                    out.append(_mean_of(f"{group}, {size}", target, some))
    return out


def _mean_of(which: str, target: float, some: Sequence[Comparison]) -> Mean:
    ours = _mean([c.ratio for c in some])
    scratch = _mean([c.over_peer(c.scratch) for c in some])
    auto = _mean([c.over_peer(c.auto) for c in some])
    return Mean(
        which=which,
        target=target,
        ours=ours,
        scratch=scratch,
        auto=auto,
        compared=sum(math.isfinite(c.our_time) for c in some),
    )


def _mean(ratios: Sequence[float]) -> float:
    known = [x for x in ratios if math.isfinite(x)]
    return float(np.exp(np.mean(np.log(known)))) if known else math.nan


def losses(compared: Sequence[Comparison]) -> list[Comparison]:
    """Where a peer is faster, or alone, worst first."""
    return sorted((c for c in compared if c.ratio > 1.0), key=lambda c: -c.ratio)


def ratio(x: float) -> str:
    """Three digits; "-" where no peer got there, words where only a peer did."""
    return "-" if math.isnan(x) else "only the peer" if math.isinf(x) else f"{x:.3g}"


def solver_table(compared: Sequence[Comparison]) -> Table:
    """Each problem and error: who is fastest on both sides, in what time, and ratios to the fastest peer."""
    head = ["problem", "rows", "law", "error", "ours", "fastest peer", "ours / peer", "from scratch", "auto"]
    rows = [
        [c.problem, str(c.rows), c.law, f"{c.target:.0e}", _timed(c.ours, c.our_time), _timed(c.peer, c.peer_time),
         *(ratio(c.over_peer(t)) for t in (c.our_time, c.scratch, c.auto))]
        for c in compared
    ]  # fmt: skip
    return Table(head, rows, ["bad" if c.ratio > 1.0 else "" for c in compared])


def _timed(name: str, time: float) -> str:
    return f"{name}, {seconds(time)}" if math.isfinite(time) else name


def mean_table(results: Sequence[Result]) -> Table:
    """`geometric_means`."""
    head = ["problems", "error", "ours / peer", "from scratch", "auto", "compared"]
    rows = [
        [m.which, f"{m.target:.0e}", *map(ratio, (m.ours, m.scratch, m.auto)), str(m.compared)]
        for m in geometric_means(results)
    ]
    return Table(head, rows)


def step_table(steps: Sequence[Step]) -> Table:
    """Each engine beside ours in the same mode; of one that was left out its note."""
    head = ["scene", "engine", "time / ours", "contacts", "depth [mm]", "speed left [m/s]", "residual"]
    rows = []
    for s in steps:
        if not math.isfinite(s.time):
            rows.append([s.scene, s.engine, s.note, "", "", "", ""])
            continue
        shown = f"{ratio(over_ours(s, steps))} ({seconds(s.time)})"
        known = residual(s.relative) if math.isfinite(s.relative) else "not known"
        rows.append(
            [s.scene, s.engine, shown, str(s.contacts), f"{1e3 * s.depth:.3g}", residual(s.speed), known]
        )
    return Table(head, rows, ["bad" if over_ours(s, steps) < 1.0 else "" for s in steps])
