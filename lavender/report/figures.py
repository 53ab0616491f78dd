"""Compute the points of every figure of a report, independent of the drawing library (`plotting`)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lavender.report.records import format_tolerance
from lavender.report.text import format_count

if TYPE_CHECKING:
    import pandas as pd

    from lavender.report.findings import Report

MIN_RESIDUAL = 1e-17  # A residual of exactly zero is drawn here.
MAX_CURVES = 6  # Largest number of solvers in a figure, without plug-ins; more are hard to distinguish.
GRID_SIZE = 49  # Number of points on the horizontal axis at which the residuals of all cases are evaluated.
MAX_SEQUENCES = 4  # Largest number of sequences that have a figure.
FLAT_LINES_NOTE = (
    "A curve is flat after the last run of its solver, which ended at a tolerance (grey lines) or after a fixed "
    "number of iterations."
)


@dataclass(frozen=True)
class Curve:
    """A line of a figure."""

    solver: str
    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    thin: bool = False  # Drawn thin and dashed: a cold start, or a fit.
    steps: bool = False  # A step function.
    points: bool = False  # Points without a line.
    unmarked: bool = False  # No marks at the points of the line.
    low: tuple[float, ...] = ()  # Edges of a band about the line, as `y`; empty without a band.
    high: tuple[float, ...] = ()

    @classmethod
    def from_points(
        cls, solver: str, label: str, places: Iterable[tuple[float, float]], **more: Any
    ) -> Curve:
        """Create a line through points. A residual of zero is drawn at `MIN_RESIDUAL`; nan and inf are gaps."""
        x, y = zip(*places, strict=True)
        drawn = tuple(max(v, MIN_RESIDUAL) if math.isfinite(v) else math.nan for v in y)
        return cls(solver, label, tuple(map(float, x)), drawn, **more)


@dataclass(frozen=True)
class Figure:
    """Titles, scales and curves of a diagram; `name` is its file name without suffix."""

    name: str
    title: str
    x_title: str
    y_title: str
    curves: tuple[Curve, ...]
    x_log: bool = True
    y_log: bool = True
    tolerances: tuple[float, ...] = ()  # Horizontal lines.
    note: str = ""  # A sentence that explains the curves.

    @property
    def description(self) -> str:
        """Alternative text: the title, the axes and the names of the curves."""
        names = ", ".join(dict.fromkeys(c.label for c in self.curves))
        return f"{self.title}. {self.y_title} against {self.x_title}. Curves: {names}."


def build_figures(report: Report) -> list[Figure]:
    """Build the figures of a report that have a curve; none for a campaign, which has no times."""
    if report.is_campaign or not len(report.frame):
        return []
    figures = [build_overall_figure(report), build_cost_figure(report)]
    sequences = [name for name in report.frame["sequence"].unique() if name][:MAX_SEQUENCES]
    figures += [build_sequence_figure(report, name) for name in sequences]
    return [figure for figure in figures if figure.curves]


def select_drawn_solvers(report: Report, frame: pd.DataFrame) -> list[str]:
    """Select the solvers that figures show: the best of the ranking, at most `MAX_CURVES`, and all plug-ins."""
    from lavender.report.ranking import rank_solvers
    from lavender.report.recommendation import is_plug_in

    ranking = [str(name) for name in rank_solvers(frame, report.tolerance).index]
    plug_ins = [name for name in ranking if is_plug_in(name)]
    return [*[name for name in ranking if name not in plug_ins][:MAX_CURVES], *plug_ins]


def build_overall_figure(report: Report, name: str = "error-against-time", law: str = "") -> Figure:
    """Plot the residual that each solver has reached by a time: median over the cases, and a band of the quartiles.

    A case without a result by that time counts with residual 1, as the zero impulse. Cases are single problems from a
    cold start; if there are only sequences, each step is a case. With `law`, its cases and all solvers are drawn.
    """
    from lavender.report.ranking import select_starts

    frame = report.frame[report.frame["law"] == law] if law else report.frame
    single = frame["step"] < 0
    frame = frame[single] if single.any() else frame
    runs = select_starts(frame)
    runs = runs[np.isfinite(runs["relative"]) & (runs["time"] > 0.0)]
    if not len(runs):
        return Figure(name, "", "", "", ())
    cases = list(frame["case"].unique())
    grid = np.geomspace(runs["time"].min(), runs["time"].max(), GRID_SIZE)
    number = {case: i for i, case in enumerate(cases)}
    solvers = [str(s) for s in runs["solver"].unique()] if law else select_drawn_solvers(report, frame)
    curves: list[Curve] = []
    for solver in sorted(solvers) if law else solvers:
        own = runs[runs["solver"] == solver]
        if not len(own):
            continue
        reached = np.ones((len(cases), GRID_SIZE))
        places = np.minimum(np.searchsorted(grid * (1.0 + 1e-9), own["time"]), GRID_SIZE - 1)
        np.minimum.at(
            reached, (own["case"].map(number).to_numpy(int), places), own["relative"].clip(MIN_RESIDUAL)
        )
        bands = np.quantile(
            np.minimum.accumulate(reached, axis=1), (0.25, 0.5, 0.75), axis=0, method="inverted_cdf"
        )
        # From here on, half of the cases have a result.
        first = int(np.searchsorted(-bands[1], -1.0, side="right"))
        if first == GRID_SIZE:
            continue
        across, low, middle, high = (tuple(x[first:].tolist()) for x in (grid, *bands))
        n = own["case"].nunique()
        label = solver if n == len(cases) else f"{solver} ({n} of {len(cases)} cases)"
        band: dict[str, Any] = {"low": low, "high": high} if not curves and not law and len(cases) > 1 else {}
        curves.append(Curve(solver, label, across, middle, steps=len(cases) == 1, unmarked=True, **band))
    over = (
        f", median over {format_count(len(cases), 'case' if single.any() else 'step')}"
        if len(cases) > 1
        else ""
    )
    note = FLAT_LINES_NOTE
    if len(cases) > 1:
        note = f"The band holds the middle half of the cases. A case without a result counts as 1. {note}"
    return Figure(name, f"Error against time{over}", "time of a call [s]", "relative residual [-]", tuple(curves),
                  tolerances=report.tolerances, note=note)  # fmt: skip


def build_cost_figure(report: Report) -> Figure:
    """Plot the time to the middle tolerance against the number of rows, with the fitted power of each solver."""
    from lavender.report.ranking import get_times
    from lavender.report.tables import tabulate_costs

    fits, target = tabulate_costs(report), format_tolerance(report.tolerance)
    times, curves = get_times(report.frame, report.tolerance), []
    drawn = select_drawn_solvers(report, report.frame)
    for fit in fits.to_dict("records"):
        if fit["solver"] in drawn:
            own = times.loc[fit["solver"]].dropna()
            rows = np.array([report.records.cases[c].rows for c in own.index], float)
            solver, ends = fit["solver"], np.array([rows[rows > 0].min(), rows.max()])
            line = fit["fit at 1000 rows [s]"] * (ends / 1000.0) ** fit["exponent of rows"]
            label = f"{solver}, rows^{fit['exponent of rows']:.2f}"
            curves.append(Curve.from_points(solver, label, zip(ends, line, strict=True), unmarked=True))
            curves.append(Curve.from_points(solver, "", zip(rows, own, strict=True), points=True))
    note = "Each point is a case; a line is the power of the number of rows that fits a solver's points best."
    return Figure("cost-against-rows", f"Time to {target} against the number of rows", "rows", "time of a call [s]",
                  tuple(curves), note=note)  # fmt: skip


def build_sequence_figure(report: Report, name: str) -> Figure:
    """Plot the time of all steps so far of a sequence to the middle tolerance, carried and cold (thin)."""
    runs = report.frame[(report.frame["sequence"] == name) & (report.frame["mode"] == "tol")]
    curves: list[Curve] = []
    for solver in select_drawn_solvers(report, runs) if len(runs) else ():
        own = runs[(runs["solver"] == solver) & (runs["tol"] <= report.tolerance)]
        own = own[own["tol"] == own["tol"].max()]
        for start in ("carried", "cold"):
            some = own[own["start"] == start].sort_values("step")
            if len(some):
                cold = start == "cold" and (own["start"] == "carried").any()
                points = zip(some["step"], some["time"].cumsum(), strict=True)
                label = f"{solver} (cold)" if cold else solver
                curves.append(Curve.from_points(solver, label, points, thin=bool(cold), unmarked=True))
    title = f"{name}: time of all steps so far, to {format_tolerance(report.tolerance)}"
    return Figure(f"sequence-{name}", title, "step", "time of all steps so far [s]", tuple(curves), x_log=False,
                  note="Solid: impulses carried from step to step. Dashed: cold.")  # fmt: skip


def list_solvers(figures: Sequence[Figure]) -> list[str]:
    """Return the names of the curves of all figures, in their order."""
    return list(dict.fromkeys(c.solver for figure in figures for c in figure.curves))
