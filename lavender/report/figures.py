"""Compute the points of every figure of a report, independent of the drawing library (`plotting`)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lavender.report.bench import statistics
from lavender.report.bench.record import Record, format_tolerance
from lavender.report.bench.store import Records
from lavender.report.text import format_count, format_run_name, make_time_axis_title
from lavender.solvers import registry

MIN_RESIDUAL = 1e-17  # A residual of exactly zero is drawn here.


@dataclass(frozen=True)
class Curve:
    """A line of a figure: points, each with the budget or tolerance of its run.

    Parameters
    ----------
    solver, label : solver, and name in the figure
    x, y : coordinates
    notes : target of each point: "to 1e-6", "16 iterations"
    thin : whether this is a warm start, drawn thin
    steps : whether the line is a step function
    points : whether points are drawn without a line
    unmarked : whether the line has no marks at its points
    low, high : edges of a band about the line, as `y`; empty without a band
    """

    solver: str
    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    notes: tuple[str, ...] = ()
    thin: bool = False
    steps: bool = False
    points: bool = False
    unmarked: bool = False
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()

    @classmethod
    def from_points(
        cls, solver: str, label: str, points: Iterable[tuple[float, float]], **more: Any
    ) -> Curve:
        """Create a line through points. A residual of zero is drawn at `MIN_RESIDUAL`; nan and inf are gaps."""
        x, y = zip(*points, strict=True)
        drawn = tuple(max(v, MIN_RESIDUAL) if math.isfinite(v) else math.nan for v in y)
        return cls(solver, label, tuple(map(float, x)), drawn, **more)

    @property
    def lower_front(self) -> Curve:
        """The curve through the points that are lower than all points with smaller x."""
        front: list[tuple[float, float]] = []
        for x, y in sorted(zip(self.x, self.y, strict=True)):
            if not front or y < front[-1][1]:
                front.append((x, y))
        xs, ys = zip(*front, strict=True) if front else ((), ())
        return replace(self, x=xs, y=ys, notes=())


@dataclass(frozen=True)
class Figure:
    """Titles, scales and curves of a diagram.

    Parameters
    ----------
    name : file name without suffix
    title, x_title, y_title : title, titles of the axes
    curves : lines
    x_log, y_log : whether the axes are logarithmic
    tolerances : horizontal lines
    roundoff_floor : dotted line; nan without one
    left_out : solvers that are not drawn because too many curves could not be distinguished
    note : a sentence that explains the curves, for the caption
    """

    name: str
    title: str
    x_title: str
    y_title: str
    curves: tuple[Curve, ...]
    x_log: bool = True
    y_log: bool = True
    tolerances: tuple[float, ...] = ()
    roundoff_floor: float = math.nan
    left_out: tuple[str, ...] = ()
    note: str = ""

    @property
    def heading(self) -> str:
        """The title, with the number of solvers that are left out."""
        omitted = format_count(len(self.left_out), "more solver")
        return f"{self.title}; {omitted} not drawn" if self.title and self.left_out else self.title


def _sort_by_work(runs: list[Record]) -> list[Record]:
    """Sort runs by iterations or by tolerance, not by time, as times of microseconds vary from run to run."""
    if any(r.mode == "budget" for r in runs):
        return sorted(runs, key=lambda r: (r.iterations, r.time_min))
    return sorted(runs, key=lambda r: (-r.tol, r.time_min))


def build_work_precision(records: Records, case: str) -> Figure:
    """Plot error against time for every run of a case: a curve for each solver and start, in the order of work."""
    curves, drawn = [], []
    for (name, solver, start), group in sorted(statistics.group_runs_by_pair(records).items()):
        runs = _sort_by_work([r for r in group if r.is_usable]) if name == case else []
        drawn += runs
        if runs:
            points, targets = [(r.time_min, r.relative) for r in runs], tuple(r.target for r in runs)
            curves.append(
                Curve.from_points(
                    solver, format_run_name(solver, start), points, notes=targets, thin=start != "cold"
                )
            )
    return _build_case_figure("work-precision", make_time_axis_title(drawn), records, case, curves)


def _build_case_figure(name: str, x_title: str, records: Records, case: str, curves: list[Curve]) -> Figure:
    """Create a figure of a case, with the round-off floor of its best run."""
    runs = (
        r for (of, _, _), some in statistics.group_runs_by_pair(records).items() if of == case for r in some
    )
    best = min(
        ((r.relative, r.roundoff_floor) for r in runs if r.is_usable and r.roundoff_floor > 0.0),
        default=(0.0, math.nan),
    )
    return Figure(
        f"{name} {case}", case, x_title, "relative residual [-]", tuple(curves),
        tolerances=statistics.get_tolerances(records), roundoff_floor=best[1],
    )  # fmt: skip


FLAT_LINES_NOTE = (
    "A curve is flat after the last run of its solver, which ended at a tolerance (grey lines) or after a fixed "
    "number of iterations."
)
PASSES_NOTE = (
    "A pass over A is one sweep over all blocks or one product with A, as each solver counts them; solvers that "
    "factorise, pivot or solve linear systems, or count neither sweeps nor products, are not compared"
)
GRID_SIZE = 49  # Number of points on the horizontal axis at which the residuals of all cases are evaluated.


def build_overall_figure(records: Records, measure: str = "time") -> Figure:
    """Plot the residual that each solver has reached by a time: median over all cases, and a band of the quartiles.

    A case without a result by that time counts with residual 1, as the zero impulse; so does a case that a solver
    does not accept, which the title states. Cases are single problems from a cold start. If there are only sequences,
    each step is a case, with carried impulses if there are any.

    Parameters
    ----------
    records : Records
    measure : {"time", "work"}
        Horizontal axis. "work": number of passes over A, for solvers that do no other work.
    """
    by_work = measure == "work"
    single = any(r.step < 0 for r in records)
    start = "cold" if single or all(r.start == "cold" for r in records) else "carried"
    runs = [
        r for r in records
        if (r.step < 0) == single and r.start == start and r.order == "given" and not r.interleave_group
    ]  # fmt: skip
    cases = sorted({r.case for r in runs})
    excluded = statistics.find_solvers_with_other_work(runs) if by_work else set()
    by: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for r in runs:
        if r.is_usable and r.time_min > 0.0 and r.solver not in excluded:
            cost = max(1.0, statistics.count_sweeps_and_products(r)) if by_work else r.time_min
            by.setdefault(r.solver, {}).setdefault(r.case, []).append((cost, max(r.relative, MIN_RESIDUAL)))
    times = [t for own in by.values() for some in own.values() for t, _ in some]
    name = "work over all" if by_work else "over all"
    if not times:
        return Figure(name, "", "", "", ())
    grid = np.geomspace(min(times), max(times), GRID_SIZE)
    curves = []
    for solver, own in sorted(by.items()):
        reached = np.ones((len(cases), GRID_SIZE))
        for row, case in zip(reached, cases, strict=True):
            for t, x in own.get(case, ()):
                np.minimum(row, x, out=row, where=grid * (1.0 + 1e-9) >= t)
        bands = np.quantile(reached, (0.25, 0.5, 0.75), axis=0, method="inverted_cdf")
        # The curve starts after the last time at which half of the cases have no result.
        first = max(np.flatnonzero(bands[0] == 1.0), default=0)
        across, lower, middle, upper = (tuple(x[first:].tolist()) for x in (grid, *bands))
        # A solver may not accept every case.
        label = solver if len(own) == len(cases) else f"{solver} ({len(own)} of {len(cases)})"
        curves.append(Curve(solver, label, across, middle, low=lower, high=upper))
    over = f" over all {len(cases)} {'cases' if single else 'steps'}: median, middle half"
    if any(len(own) < len(cases) for own in by.values()):
        over += "; no result counts as 1 (the legend gives the number of cases with results)"
    note = FLAT_LINES_NOTE
    if by_work:
        names = f" ({', '.join(sorted(excluded))})" if excluded else ""
        note = f"{PASSES_NOTE}{names}. {note}"
    return Figure(
        name, f"Error against {'work' if by_work else 'time'}{over if len(cases) > 1 else ''}",
        "passes over A" if by_work else make_time_axis_title(runs), "relative residual [-]", tuple(curves),
        tolerances=statistics.get_tolerances(records), note=note,
    )  # fmt: skip


def build_budget_figure(records: Records, case: str) -> Figure:
    """Plot the residual against exact iteration budgets, cold and warm."""
    curves = []
    for (name, solver, start), points in sorted(statistics.group_runs_by_budget(records).items()):
        if name == case:
            curves.append(
                Curve.from_points(solver, format_run_name(solver, start), points, thin=start != "cold")
            )
    # The axis is titled "sweeps" only if every solver's iteration is a sweep; an iteration of admm, for example, is
    # not.
    swept = all("sweeps" in r.work for r in records if r.mode == "budget" and r.case == case and r.is_usable)
    title = "sweeps" if swept else "iterations, each solver's own unit"
    return _build_case_figure("budget", title, records, case, curves)


# Largest number of curves of a profile. More are hard to distinguish and mislead about ranks below 1.
MAX_CURVES = 5
MIN_COMPARED = 2  # At least this many built-in solvers are drawn, however many plug-ins are.


def is_plug_in(solver: str) -> bool:
    """Return whether a solver is not part of lavender: a plug-in of the user, installed here or not."""
    spec = registry.specs().get(solver)
    return spec is None or not spec.builtin


def select_drawn_solvers(ranked: Sequence[str], always: Sequence[str] = ()) -> list[str]:
    """Select the solvers that a figure shows, from `ranked`, best first.

    All plug-ins, the solvers in `always` and the best other solvers are shown: `MAX_CURVES` in all, unless there are
    many plug-ins.
    """
    plug_ins = [name for name in ranked if is_plug_in(name)]
    required = [name for name in ranked if name in always and name not in plug_ins]
    others = [name for name in ranked if name not in (*plug_ins, *required)]
    n_others = max(MAX_CURVES - len(plug_ins), MIN_COMPARED) - len(required)
    return [*plug_ins, *others[: max(n_others, 1)], *required]


def build_pass_figure(sequence: str, passes: list[statistics.Pass]) -> Figure:
    """Plot the steps of a sequence at one target, carried and cold (thin), for a few solvers.

    With a budget: the residual of each step. To a tolerance: the time of all steps so far, because the times of single
    steps are noise.
    """
    timed = passes[0].mode == "tol"

    def get_sort_key(w: statistics.Pass) -> tuple[float, float, str]:
        return (
            -len(w.times[w.start]),
            w.total_times[w.start] if timed else w.get_median_residual(w.start),
            w.solver,
        )

    ranked = [w.solver for w in sorted(passes, key=get_sort_key)]
    drawn = set(select_drawn_solvers(ranked))
    curves = []
    for w in passes:
        for start, residuals in sorted(w.residuals.items()) if w.solver in drawn else ():
            values = np.cumsum(w.times[start]).tolist() if timed else residuals
            cold = start == "cold" and len(w.residuals) > 1
            label = f"{w.solver} (cold)" if cold else w.solver
            curves.append(
                Curve.from_points(w.solver, label, zip(w.numbers[start], values, strict=True), thin=cold)
            )
    target = passes[0].target
    return Figure(
        f"sequence {sequence} {target}", f"{sequence}: {target}", "step",
        "time of all steps so far [s]" if timed else "relative residual [-]", tuple(curves), x_log=False,
        left_out=tuple(sorted(set(ranked) - drawn)),
    )  # fmt: skip


def build_profile_figure(profile: statistics.Profile) -> Figure:
    """Plot a Dolan-More profile of the plug-ins and of the solvers that solve the largest number of cases fastest."""

    def get_sort_key(name: str) -> tuple[float, float, str]:
        steps = profile.curves[name]
        last = steps[-1][1] if steps else 0.0
        return (
            -last,
            sum(r * (s - t) for (r, s), t in zip(steps, (0.0, *(s for _, s in steps)), strict=False)),
            name,
        )

    ranked = sorted(profile.curves, key=get_sort_key)
    drawn = set(
        select_drawn_solvers([name for name in ranked if get_sort_key(name)[0] < 0.0 or is_plug_in(name)])
    )
    shown = [name for name in ranked if name in drawn]
    curves = [
        Curve.from_points(name, name, [(r, 100.0 * s) for r, s in profile.curves[name]], steps=True)
        for name in shown
    ]
    left_out = tuple(sorted(set(profile.curves) - set(shown)))
    by_work = profile.measure == "work"
    name = f"{'work profile' if by_work else 'profile'} {profile.law} {format_tolerance(profile.tolerance)}"
    cases = format_count(profile.cases, "case")
    return Figure(
        name,
        f"{profile.law}, to {format_tolerance(profile.tolerance)} ({cases}){', by work' if by_work else ''}",
        "passes over A / fewest passes" if by_work else "time / fastest time",
        "cases solved [%]", tuple(curves), y_log=False, left_out=left_out,
    )  # fmt: skip


Group = Mapping[str, tuple[Figure, ...]]  # Figures by case, law or sequence.


@dataclass(frozen=True)
class Figures:
    """Every figure of a report that has a curve, by its place on the page.

    Parameters
    ----------
    over : figure over all cases, under the key "all"
    profiles : performance profiles by law, one for each tolerance: by time, then by work
    sequences : figures by sequence
    cases : error against time and residual against iterations, by case
    """

    over: Group = field(default_factory=dict)
    profiles: Group = field(default_factory=dict)
    sequences: Group = field(default_factory=dict)
    cases: Group = field(default_factory=dict)

    @property
    def groups_by_section(self) -> dict[str, Group]:
        """The groups of figures by the name of their section."""
        return dict(vars(self))

    def __iter__(self) -> Iterator[Figure]:
        for group in self.groups_by_section.values():
            for some in group.values():
                yield from some


def build_figures(records: Records) -> Figures:
    """Build the figures of records; none for a campaign."""
    if statistics.is_campaign(records):
        return Figures()
    parts: dict[str, Records] = {}  # Records by case.
    for r in records:
        if r.step < 0:
            parts.setdefault(r.case, Records(records.runs)).add(r)
    profiles: dict[str, list[Figure]] = {}
    for profile in (*statistics.compute_profiles(records), *statistics.compute_profiles(records, "work")):
        if profile.cases > 1 and (profile.measure == "time" or len(profile.curves) > 1):
            profiles.setdefault(profile.law, []).append(build_profile_figure(profile))
    over = _select_drawn_figures(build_overall_figure(records))
    return Figures(
        over={"all": over} if over else {},
        profiles={law: _select_drawn_figures(*some) for law, some in profiles.items()},
        sequences={
            name: _build_pass_figures(name, passes)
            for name, passes in statistics.group_passes_by_sequence(records).items()
        },
        cases={
            c: _select_drawn_figures(build_work_precision(part, c), build_budget_figure(part, c))
            for c, part in parts.items()
        },
    )


def _select_drawn_figures(*some: Figure) -> tuple[Figure, ...]:
    return tuple(figure for figure in some if figure.curves)


def _build_pass_figures(name: str, passes: list[statistics.Pass]) -> tuple[Figure, ...]:
    # Draw each sequence at the middle budget and at the middle tolerance.
    budgets = sorted({w.max_iter for w in passes if w.mode == "budget"})
    middle = [w for w in passes if w.mode == "budget" and w.max_iter == budgets[len(budgets) // 2]]
    tolerances = sorted({w.tol for w in passes if w.mode == "tol"}, reverse=True)
    to_tolerance = [w for w in passes if w.mode == "tol" and w.tol == tolerances[len(tolerances) // 2]]
    return tuple(build_pass_figure(name, some) for some in (middle, to_tolerance) if some)
