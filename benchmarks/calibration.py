"""Relative motion error over relative residual: `python -m benchmarks calibration`.

Iterates of several solvers at several budgets, each with its relative residual and its relative motion error; their
ratio says how much a residual hides.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np

from benchmarks.output import markdown
from lavender import motion
from lavender.base.errors import CapabilityError, InputError
from lavender.io.stored import write_figure
from lavender.judge.measures import natural_map, siconos_error
from lavender.lab.bench import resolve, structure_of
from lavender.problem import Problem
from lavender.solvers.registry import available, get
from lavender.solving.solve import solve

BUDGETS = (1, 4, 16, 64, 256)  # sweeps or iterations of each iterate
SOLVERS = ("pgs", "jacobi", "anderson", "nncg", "block_gauss_seidel", "admm", "newton")
# Above it an iterate is no attempt, below it rounding speaks.
LARGEST, SMALLEST = 1.0, 1e-11
SEARCH = 6  # runs of the search behind a Coulomb problem's distance


@dataclass(frozen=True)
class Sample:
    """One iterate: its residuals and how wrong it moves."""

    case: str
    law: str
    structure: str
    solver: str
    iterations: int
    relative: float  # -, the judge's
    energy: float  # -, E / E0 alone
    velocity: float  # -, V / V0 alone
    plain: float  # -, |lambda - Pi(lambda - w)| over the same of doing nothing; nan where it is not defined
    motion: float  # -, relative motion error
    speed: float  # m/s, nan where bodies are not known
    bound: float  # sqrt J, nan under Coulomb's law
    found: float  # sqrt J, what the bound is of


def samples(name: str, problem: Problem, structure: str) -> Iterator[Sample]:
    """Iterates of every solver of SOLVERS at every budget on one problem that has a reference."""
    if problem.law == "coulomb":
        motion.motions(problem, SEARCH)
    for solver in SOLVERS:
        try:
            spec = get(solver)
            if spec.refuses(problem) is not None:
                continue
            for budget in BUDGETS:
                end = solve(problem, solver, tol=0.0, max_iter=min(budget, spec.max_iter))
                r = end.residual
                if not SMALLEST < r.relative < LARGEST or r.relative <= 100.0 * r.floor:
                    continue
                error = motion.motion_error(problem, end.impulse)
                if error.relative is None or not math.isfinite(error.relative):
                    continue
                yield Sample(
                    case=name,
                    law=problem.law,
                    structure=structure,
                    solver=solver,
                    iterations=end.iterations,
                    relative=r.relative,
                    energy=r.energy / r.energy_start,
                    velocity=r.velocity / r.velocity_start,
                    plain=_plain(problem, end.impulse),
                    motion=error.relative,
                    speed=_number(error.speed),
                    bound=_number(error.bound),
                    found=_number(error.energy),
                )
        except CapabilityError:
            continue


def _number(x: float | None) -> float:
    return math.nan if x is None else x


def _plain(problem: Problem, impulse: np.ndarray) -> float:
    try:
        if problem.law in ("linear", "lcp"):
            one, two = natural_map(problem, impulse), natural_map(problem, problem.start())
        elif problem.law == "coulomb":
            one, two = (siconos_error(problem, x)["absolute"] for x in (impulse, problem.start()))
        else:
            return math.nan
    except InputError:  # spin
        return math.nan
    return one / two if two > 0.0 else math.nan


def is_measured(problem: Problem, rows: int) -> bool:
    """Whether a problem has rows, few enough of them, and a solver here."""
    return 0 < problem.m <= rows and bool(available(problem))


@dataclass(frozen=True)
class Calibration:
    """Motion error over residual of some iterates."""

    structure: str
    iterates: int
    median: float
    high: float  # 95 % are below
    largest: float
    where: str  # the largest


def calibration(found: Sequence[Sample]) -> list[Calibration]:
    """Motion error over residual by structure, by law and of all."""
    groups: dict[str, list[Sample]] = {}
    for sample in found:
        for word in dict.fromkeys((*sample.structure.split(" + "), f"law {sample.law}", "all")):
            groups.setdefault(word, []).append(sample)
    rows = []
    for word, group in groups.items():
        ratio = np.array([s.motion / s.relative for s in group])
        worst = group[int(np.argmax(ratio))]
        where = f"{worst.case}, {worst.solver} {worst.iterations}"
        median, high = float(np.median(ratio)), float(np.quantile(ratio, 0.95))
        rows.append(Calibration(word, len(group), median, high, float(ratio.max()), where))
    return sorted(
        rows, key=lambda row: (row.structure == "all", row.structure.startswith("law "), -row.iterates)
    )


def predictors(found: Sequence[Sample]) -> list[tuple[str, int, float, float]]:
    """How well each residual predicts the motion error: (name, iterates, median factor, spread of its log10)."""
    rows = []
    same = [s for s in found if math.isfinite(s.plain) and s.plain > 0.0]
    measures = (
        ("max(E / E0, V / V0)", [s.relative for s in same]),
        ("E / E0 alone", [s.energy for s in same]),
        ("V / V0 alone", [s.velocity for s in same]),
        ("unit step, lambda - Pi(lambda - w)", [s.plain for s in same]),
    )
    for name, values in measures:
        kept = [(s.motion, v) for s, v in zip(same, values, strict=True) if s.motion > 0.0 and v > 0.0]
        if kept:
            log = np.log10([m / v for m, v in kept])
            rows.append((name, len(kept), float(10.0 ** np.median(log)), float(np.std(log))))
    return rows


def table(found: Sequence[Sample]) -> str:
    """The calibration as markdown."""
    heads = ("structure", "iterates", "median", "95 % below", "largest", "where")
    rows = [
        (c.structure, c.iterates, f"{c.median:.2g}", f"{c.high:.2g}", f"{c.largest:.2g}", c.where)
        for c in calibration(found)
    ]
    how = "spread (decades, one standard deviation)"
    lines = [
        markdown(heads, rows),
        "",
        markdown(
            ("residual", "iterates", "median factor to the motion error", how),
            [(name, n, f"{median:.2g}", f"{spread:.2f}") for name, n, median, spread in predictors(found)],
        ),
    ]
    bounded = [s for s in found if math.isfinite(s.bound) and s.found > 0.0]
    if bounded:
        ratio = np.array([s.bound / s.found for s in bounded])
        said = f"{len(ratio)} iterates, median {np.median(ratio):.3g}, largest {ratio.max():.3g}"
        lines += ["", f"Bound / motion error: {said}."]
    return "\n".join(lines)


def figure(found: Sequence[Sample], path: str | Path) -> None:
    """Relative motion error over relative residual, a dot an iterate, a colour a law.

    Raises
    ------
    InputError
        A path that cannot be written, or a suffix that matplotlib does not know.
    """
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(6.4, 5.2), layout="constrained")
    ax = canvas.subplots()
    for law in dict.fromkeys(s.law for s in found):
        own = [s for s in found if s.law == law]
        ax.loglog(
            [s.relative for s in own], [max(s.motion, 1e-16) for s in own], ".", ms=4, alpha=0.5, label=law
        )
    line = np.array([SMALLEST, LARGEST])
    ax.loglog(line, line, "k-", lw=0.8)
    for factor in (10.0, 100.0):
        ax.loglog(line, factor * line, "k:", lw=0.6)
        ax.annotate(f"{factor:g} times", (line[0] * 30, factor * line[0] * 40), fontsize=7, color="0.3")
    ax.set(
        xlabel="relative residual [-]",
        ylabel="relative motion error [-]",
        xlim=(SMALLEST, LARGEST),
        ylim=(1e-12, 10),
    )
    ax.legend(fontsize=8)
    write_figure(canvas, path, dpi=150)


@click.command("calibration")
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@click.option(
    "--rows", type=click.IntRange(1), default=3000, show_default=True, help="Leave larger problems out."
)
@click.option(
    "--figure", "picture", type=click.Path(path_type=Path), help="Residual against motion error, drawn."
)
def command(files: tuple[str, ...], rows: int, picture: Path | None) -> None:
    """Compare residual and motion error on FILES, or on the default set of the suite."""
    seen: list[Sample] = []
    left = 0
    for item in resolve(files or ["default"]):
        if not is_measured(item.problem, rows):
            left += 1
            continue
        seen += samples(item.name, item.problem, " + ".join(structure_of(item.problem)))
        item.forget()
    if seen:
        click.echo(table(seen))
    if left:
        click.echo(f"\n{left} problems left out: empty, above {rows} rows, or without a solver here.")
    if picture is not None:
        figure(seen, picture)
