"""Points of every figure, once: `figures` lists those of a report, for its page and for SVG and PNG alike."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lavender.lab.bench.record import Record, level_name
from lavender.lab.bench.store import Records
from lavender.lab.report import tables
from lavender.lab.report.moved import by_speed, speed_levels
from lavender.lab.report.text import count, who

TINY = 1e-17  # where a residual of exactly zero is drawn


@dataclass(frozen=True)
class Curve:
    """One line: points, and what each was asked for."""

    solver: str
    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    notes: tuple[str, ...] = ()  # what each point was asked for: "1e-6", "16"
    thin: bool = False  # warm starts
    steps: bool = False
    points: bool = False  # without a line between them
    low: tuple[float, ...] = ()  # of a band about the line, as `y`
    high: tuple[float, ...] = ()

    @classmethod
    def of(cls, solver: str, label: str, points: Iterable[tuple[float, float]], **more: Any) -> Curve:
        """Through points; a residual of exactly zero is drawn at `TINY`, what is not finite breaks the line."""
        x, y = zip(*points, strict=True)
        drawn = tuple(max(v, TINY) if math.isfinite(v) else math.nan for v in y)
        return cls(solver, label, tuple(map(float, x)), drawn, **more)

    @property
    def front(self) -> Curve:
        """What was reached by each x: points in its order, each lower than all before."""
        kept: list[tuple[float, float]] = []
        for x, y in sorted(zip(self.x, self.y, strict=True)):
            if not kept or y < kept[-1][1]:
                kept.append((x, y))
        xs, ys = zip(*kept, strict=True) if kept else ((), ())
        return replace(self, x=xs, y=ys, notes=())


@dataclass(frozen=True)
class Figure:
    """A diagram without a drawing library."""

    name: str  # file name, without suffix
    title: str
    x_title: str
    y_title: str
    curves: tuple[Curve, ...]
    x_log: bool = True
    y_log: bool = True
    levels: tuple[float, ...] = ()
    floor: float = math.nan
    left_out: tuple[str, ...] = ()  # solvers without a curve, for more of them cannot be told apart

    @property
    def heading(self) -> str:
        """The title, and how many solvers are left out."""
        left = count(len(self.left_out), "more solver")
        return f"{self.title}; {left} not drawn" if self.title and self.left_out else self.title


def _in_order_of_work(runs: list[Record]) -> list[Record]:
    # Times of microseconds jitter; iterations and tolerances do not.
    if any(r.mode == "budget" for r in runs):
        return sorted(runs, key=lambda r: (r.iterations, r.time_min))
    return sorted(runs, key=lambda r: (-r.tol, r.time_min))


def work_precision(records: Records, case: str) -> Figure:
    """Error against time: every run of a case, one curve for each solver and start, along its work."""
    curves = []
    for (name, solver, start), group in sorted(tables.pairs(records).items()):
        runs = _in_order_of_work([r for r in group if r.usable]) if name == case else []
        if runs:
            points, asked = [(r.time_min, r.relative) for r in runs], tuple(r.asked for r in runs)
            curves.append(Curve.of(solver, who(solver, start), points, notes=asked, thin=start != "cold"))
    return _of_case("work-precision", "time: set-up and solve [s]", records, case, curves)


def _of_case(name: str, x_title: str, records: Records, case: str, curves: list[Curve]) -> Figure:
    """With the floor of the best run: it depends on the impulses, and those are nearest to the solution's."""
    runs = (r for (of, _, _), some in tables.pairs(records).items() if of == case for r in some)
    best = min(((r.relative, r.floor) for r in runs if r.usable and r.floor > 0.0), default=(0.0, math.nan))
    return Figure(
        f"{name} {case}", case, x_title, "relative residual [-]", tuple(curves),
        levels=tables.levels_of(records), floor=best[1],
    )  # fmt: skip


GRID = 49  # times of a figure over all cases


def overall_figure(records: Records) -> Figure:
    """Residual that a solver has reached by a time, over all cases: median, and a band of the middle half.

    A case on which nothing has been reached by then stands at 1, doing nothing; so does one that a solver does not
    take, which the title says. Cases are single problems from a cold start; of sequences alone each step is one, from
    the impulses of the step before where they are carried.
    """
    single = any(r.step < 0 for r in records)
    start = "cold" if single or all(r.start == "cold" for r in records) else "carried"
    runs = [
        r for r in records
        if (r.step < 0) == single and r.start == start and r.order == "given" and not r.turns
    ]  # fmt: skip
    cases = sorted({r.case for r in runs})
    by: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for r in runs:
        if r.usable and r.time_min > 0.0:
            by.setdefault(r.solver, {}).setdefault(r.case, []).append((r.time_min, max(r.relative, TINY)))
    times = [t for own in by.values() for some in own.values() for t, _ in some]
    if not times:
        return Figure("over all", "", "", "", ())
    grid = np.geomspace(min(times), max(times), GRID)
    curves = []
    for solver, own in sorted(by.items()):
        reached = np.ones((len(cases), GRID))
        for row, case in zip(reached, cases, strict=True):
            for t, x in own.get(case, ()):
                np.minimum(row, x, out=row, where=grid * (1.0 + 1e-9) >= t)
        bands = np.quantile(reached, (0.25, 0.5, 0.75), axis=0, method="inverted_cdf")
        # from the last time at which half of the cases have nothing
        first = max(np.flatnonzero(bands[0] == 1.0), default=0)
        across, lower, middle, upper = (tuple(x[first:].tolist()) for x in (grid, *bands))
        curves.append(Curve(solver, solver, across, middle, low=lower, high=upper))
    over = f" over all {len(cases)} {'cases' if single else 'steps'}: median, middle half"
    if any(len(own) < len(cases) for own in by.values()):
        over += "; no result: 1"
    return Figure(
        "over all", f"Error against time{over if len(cases) > 1 else ''}",
        "time: set-up and solve [s]", "relative residual [-]", tuple(curves), levels=tables.levels_of(records),
    )  # fmt: skip


def budget_figure(records: Records, case: str) -> Figure:
    """Residual against exact iteration budgets, cold and warm."""
    curves = []
    for (name, solver, start), points in sorted(tables.budgets(records).items()):
        if name == case:
            curves.append(Curve.of(solver, who(solver, start), points, thin=start != "cold"))
    return _of_case("budget", "iterations (sweeps)", records, case, curves)


def pass_figure(sequence: str, passes: list[tables.Pass]) -> Figure:
    """Each step of a sequence, carried and cold (thin): its residual at one budget, its time to one level."""
    timed = passes[0].mode == "tol"
    curves = []
    for w in passes:
        for start, residuals in sorted(w.residuals.items()):
            values = w.times[start] if timed else residuals
            cold = start == "cold" and len(w.residuals) > 1
            label = f"{w.solver} (cold)" if cold else w.solver
            curves.append(Curve.of(w.solver, label, enumerate(values), thin=cold))
    asked = passes[0].asked
    return Figure(
        f"sequence {sequence} {asked}", f"{sequence}: {asked}", "step",
        "time: set-up and solve [s]" if timed else "relative residual [-]", tuple(curves), x_log=False,
    )  # fmt: skip


LINES = 5  # of a profile: more cannot be told apart, and mislead about who comes second


def profile_figure(profile: tables.Profile) -> Figure:
    """Dolan-More profile as steps, of the five solvers that solve most and are nearest to the fastest."""

    def standing(name: str) -> tuple[float, float, str]:
        steps = profile.curves[name]
        last = steps[-1][1] if steps else 0.0
        return (
            -last,
            sum(r * (s - t) for (r, s), t in zip(steps, (0.0, *(s for _, s in steps)), strict=False)),
            name,
        )

    shown = [name for name in sorted(profile.curves, key=standing) if standing(name)[0] < 0.0][:LINES]
    curves = [
        Curve.of(name, name, [(r, 100.0 * s) for r, s in profile.curves[name]], steps=True) for name in shown
    ]
    left = tuple(sorted(set(profile.curves) - set(shown)))
    return Figure(
        f"profile {profile.law} {level_name(profile.level)}",
        f"{profile.law}, to {level_name(profile.level)} ({count(profile.cases, 'case')})",
        "time / fastest time", "cases solved [%]", tuple(curves), y_log=False, left_out=left,
    )  # fmt: skip


Group = Mapping[str, tuple[Figure, ...]]  # by what they are of


@dataclass(frozen=True)
class Figures:
    """Every figure of a report, in the places where its page shows them; those without a curve are left out."""

    over: Group = field(default_factory=dict)  # "all": the one over all cases
    profiles: Group = field(default_factory=dict)  # by law, one for each level
    sequences: Group = field(default_factory=dict)
    cases: Group = field(default_factory=dict)  # error against time, residual against iterations
    moved: Figures | None = None  # the same with motion errors [m/s] in place of residuals, where known

    @property
    def places(self) -> dict[str, Group]:
        """The groups by their names."""
        return {name: group for name, group in vars(self).items() if name != "moved"}

    def __iter__(self) -> Iterator[Figure]:
        for group in self.places.values():
            for some in group.values():
                yield from some
        yield from self.moved or ()


def figures(records: Records) -> Figures:
    """The figures of the records, by residual and, where it is known, by motion error; none of a campaign."""
    if tables.is_campaign(records):
        return Figures()
    found = _figures(records)
    return replace(found, moved=_by_motion(_figures(by_speed(records)))) if speed_levels(records) else found


def _by_motion(found: Figures) -> Figures:
    """Figures of `by_speed` records, with names, axes and levels that say what they show."""

    def told(figure: Figure) -> Figure:
        return replace(
            figure,
            name=f"motion {figure.name}",
            title=re.sub(r"(, to \S+) \(", r"\1 m/s (", figure.title),
            y_title=figure.y_title.replace("relative residual [-]", "motion error [m/s]"),
        )

    groups: dict[str, Any] = {
        place: {name: tuple(map(told, own)) for name, own in group.items()}
        for place, group in found.places.items()
    }
    return Figures(**groups)


def _figures(records: Records) -> Figures:
    parts: dict[str, Records] = {}  # of each case: what the figures of all cases look through
    for r in records:
        if r.step < 0:
            parts.setdefault(r.case, Records(records.runs)).add(r)
    profiles: dict[str, list[Figure]] = {}
    for profile in tables.profiles(records):
        if profile.cases > 1:
            profiles.setdefault(profile.law, []).append(profile_figure(profile))
    over = _drawn(overall_figure(records))
    return Figures(
        over={"all": over} if over else {},
        profiles={law: _drawn(*some) for law, some in profiles.items()},
        sequences={name: _pass_figures(name, passes) for name, passes in tables.by_sequence(records).items()},
        cases={c: _drawn(work_precision(part, c), budget_figure(part, c)) for c, part in parts.items()},
    )


def _drawn(*some: Figure) -> tuple[Figure, ...]:
    return tuple(figure for figure in some if figure.curves)


def _pass_figures(name: str, passes: list[tables.Pass]) -> tuple[Figure, ...]:
    # The middle budget, and the solvers that have none.
    budgets = sorted({w.max_iter for w in passes if w.mode == "budget"})
    middle = [w for w in passes if w.mode == "budget" and w.max_iter == budgets[len(budgets) // 2]]
    levels = [w for w in passes if w.mode == "tol"]
    return tuple(pass_figure(name, some) for some in (middle, levels) if some)
