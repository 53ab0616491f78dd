"""Tables of the comparison with other engines and solvers: ratios of times, means, losses, as markdown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import geometric_mean

from benchmarks.output import markdown
from benchmarks.peers.adapters import SCIPY, SCRATCH, TARGETS, Result
from benchmarks.peers.engines import Step
from lavender.base.deadline import format_seconds
from lavender.report.text import format_residual

LARGE = 1000  # minimum rows of a large problem


def over_ours(step: Step, steps: Sequence[Step]) -> float:
    """Return the time divided by LavenderSim's on the same scene in the same mode (sweeps or accurate), or nan."""
    own = [
        s.time
        for s in steps
        if s.engine.startswith("lavender") and (s.scene, s.accurate) == (step.scene, step.accurate)
    ]
    return step.time / own[0] if own else math.nan


def engines_table(steps: Sequence[Step]) -> str:
    """Return the table of engines with ratios in the same mode, or their notes; then LavenderSim's losses."""
    head = (
        "scene",
        "engine",
        "time / ours",
        "contacts",
        "depth [mm]",
        "speed left [m/s]",
        "residual",
    )
    rows, lost = [], []
    for s in steps:
        if not math.isfinite(s.time):
            rows.append((s.scene, s.engine, s.note, "", "", "", ""))
            continue
        over = over_ours(s, steps)
        known = format_residual(s.relative) if math.isfinite(s.relative) else "not known"
        timed = f"{_ratio(over)} ({format_seconds(s.time)})"
        rows.append(
            (
                s.scene,
                s.engine,
                timed,
                s.contacts,
                f"{1e3 * s.depth:.3g}",
                format_residual(s.speed),
                known,
            )
        )
        if over < 1.0:
            lost.append((over, f"- {s.scene}: {s.engine}, {over:.2f} of the time of ours"))
    told = [f"\nLost: {len(lost)}.", *(text for _, text in sorted(lost))] if lost else []
    return "\n".join([markdown(head, rows), *told])


@dataclass(frozen=True)
class Comparison:
    """Fastest times of lavender and of other solvers at one error on one problem."""

    problem: str
    rows: int
    law: str
    target: float
    ours: str
    our_time: float  # s; inf: not reached
    peer: str
    peer_time: float
    scratch: float  # s, fastest of lavender from scratch
    auto: float  # s, solver "auto"

    @property
    def ratios(self) -> tuple[float, float, float]:
        """Lavender's times and those of auto over the fastest peer's; nan: no peer converged, inf: ours did not."""
        known = math.isfinite(self.peer_time)
        a, b, c = (
            t / self.peer_time if known else math.nan
            for t in (self.our_time, self.scratch, self.auto)
        )
        return a, b, c

    @property
    def ratio(self) -> float:
        """Time of lavender over the fastest peer's."""
        return self.ratios[0]


def compare(results: Sequence[Result], scipy: bool = True) -> list[Comparison]:
    """Return a comparison for each problem and error; `scipy` False excludes SciPy's linear factorisations."""
    results = [r for r in results if scipy or not r.solver.startswith(SCIPY)]
    found = []
    for name in dict.fromkeys(r.problem for r in results):
        here = [r for r in results if r.problem == name]
        scratch = [r for r in here if r.solver.endswith(SCRATCH)]
        ours = [r for r in here if not r.peer and not r.solver.endswith(SCRATCH)]
        for target in TARGETS:
            (best, time), (peer, peer_time) = (
                _fastest(side, target) for side in (ours, [r for r in here if r.peer])
            )
            found.append(
                Comparison(
                    problem=name,
                    rows=here[0].rows,
                    law=here[0].law,
                    target=target,
                    ours=best,
                    our_time=time,
                    peer=peer,
                    peer_time=peer_time,
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


def losses(compared: Sequence[Comparison]) -> list[Comparison]:
    """Return the comparisons in which a peer is faster or alone, worst first."""
    return sorted((c for c in compared if c.ratio > 1.0), key=lambda c: -c.ratio)


@dataclass(frozen=True)
class Mean:
    """Geometric means of times over the fastest peer's, of problems in which both sides reached the error."""

    which: str  # group of problems
    target: float
    ours: float
    scratch: float
    auto: float
    compared: int


def means(results: Sequence[Result]) -> list[Mean]:
    """Return the means for cases (and files) and for exported problems, large and small, at each error.

    Peers are QP and cone backends, Pinocchio and Siconos; the last group counts SciPy's factorisations of linear
    systems, which do not solve constraint problems in general.
    """
    plain = compare(results, scipy=False)
    groups = {
        "cases": [c for c in plain if ":" not in c.problem],
        "exported by engines": [c for c in plain if ":" in c.problem],
        "all, SciPy too": compare(results),
    }
    out = []
    for group, compared in groups.items():
        for size, large in ((f"{LARGE} rows and more", True), ("smaller", False)):
            of_size = [
                c for c in compared if (c.rows >= LARGE) is large and math.isfinite(c.peer_time)
            ]
            for target in TARGETS:
                some = [c.ratios for c in of_size if c.target == target]
                if some:
                    columns = [
                        [x for x in column if math.isfinite(x)]
                        for column in zip(*some, strict=True)
                    ]
                    ours, scratch, auto = (
                        geometric_mean(column) if column else math.nan for column in columns
                    )
                    which = f"{group}, {size}"
                    out.append(
                        Mean(
                            which=which,
                            target=target,
                            ours=ours,
                            scratch=scratch,
                            auto=auto,
                            compared=len(columns[0]),
                        )
                    )
    return out


def _ratio(x: float) -> str:
    """Format a ratio with three digits; "-" if no peer reached the error, words if only a peer did."""
    return "-" if math.isnan(x) else "only the peer" if math.isinf(x) else f"{x:.3g}"


def _timed(name: str, time: float) -> str:
    return f"{name}, {format_seconds(time)}" if math.isfinite(time) else name


def _list(compared: Sequence[Comparison]) -> str:
    return ", ".join(f"{c.problem} at {c.target:.0e}" for c in compared) + "."


def solvers_tables(results: Sequence[Result]) -> str:
    """Return the tables of all problems and errors, geometric means, losses, and errors that no solver reached."""
    compared = compare(results)
    reached = [c for c in compared if math.isfinite(min(c.our_time, c.peer_time))]
    head = (
        "problem",
        "rows",
        "law",
        "error",
        "ours",
        "fastest peer",
        "ours / peer",
        "from scratch",
        "auto",
    )
    rows = [
        (
            c.problem,
            c.rows,
            c.law,
            f"{c.target:.0e}",
            _timed(c.ours, c.our_time),
            _timed(c.peer, c.peer_time),
            *map(_ratio, c.ratios),
        )
        for c in reached
    ]
    averages = [
        (m.which, f"{m.target:.0e}", *map(_ratio, (m.ours, m.scratch, m.auto)), m.compared)
        for m in means(results)
    ]
    lost = losses(compared)
    lines = [markdown(head, rows), ""]
    lines += [
        markdown(("problems", "error", "ours / peer", "from scratch", "auto", "compared"), averages)
    ]
    lines += [f"\nLost: {len(lost)} of {sum(math.isfinite(c.peer_time) for c in compared)}."]
    lines += [
        f"- {c.problem} at {c.target:.0e}: {c.peer} against {c.ours}, {_ratio(c.ratio)}"
        for c in lost
    ]
    alone = [c for c in reached if math.isinf(c.peer_time)]
    if alone:
        lines += ["", "Reached by no peer: " + _list(alone)]
    nobody = [c for c in compared if c not in reached]
    if nobody:
        lines += ["", "Reached by nobody: " + _list(nobody)]
    return "\n".join(lines)
