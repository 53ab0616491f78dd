"""What a residual tells of the motion, and how many motions a problem has: `python -m benchmarks motions`.

Two lists over problems of any source. **Calibration**: iterates of several solvers at several budgets, each with
its relative residual and its relative motion error; their ratio says what a residual is worth. **Several
motions**: how often a search finds more than one, how far apart, by law, structure, friction and sliding.
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
from lavender.problem.cones import ROW
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


@dataclass(frozen=True)
class Branches:
    """How many motions a search found in one problem."""

    case: str
    law: str
    structure: str
    rows: int
    friction: float  # -, largest coefficient
    sliding: float  # m/s, fastest tangent of a contact that presses, at the first motion
    motions: int  # 0 where no run ended at a solution
    runs: int
    spread: float  # m/s
    share: float  # -, the spread over the fastest constraint motion of a row, w of doing nothing
    unique: str  # criterion that proves one motion, or empty
    warm: str  # several motions and a guess: sweeps from it end at the motion "nearest" to it or at "another"


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


def branches(name: str, problem: Problem, structure: str, runs: int) -> Branches:
    """Search the motions of one problem."""
    found = motion.motions(problem, runs)
    c = problem.cones
    contact = c.kind != ROW
    sliding = 0.0
    if len(found):
        x, w = found[0].impulse, found[0].slack
        for i in np.flatnonzero(contact & (np.diff(c.ptr) > 1)):
            if x[c.ptr[i]] > 0.0:
                t = w[c.ptr[i] + 1 : c.ptr[i] + 1 + c.n_tangents[i]]
                sliding = max(sliding, float(np.linalg.norm(t)))
    fastest = float(np.max(np.abs(problem.slack(problem.start())), initial=0.0))
    return Branches(
        case=name,
        law=problem.law,
        structure=structure,
        rows=problem.m,
        friction=float(np.max(c.mu[contact], initial=0.0)),
        sliding=sliding,
        motions=len(found),
        runs=found.runs,
        spread=found.spread,
        share=found.spread / fastest if fastest > 0.0 else 0.0,
        unique=found.unique,
        warm=_warm(problem, found),
    )


def _warm(problem: Problem, found: motion.Motions) -> str:
    if len(found) < 2 or problem.guess is None:
        return ""
    end = motion.branch(problem, problem.guess)
    here = motion.distance(problem, end.impulse, problem.guess).energy
    there = motion.distance(problem, found.nearest(problem.guess).impulse, problem.guess).energy
    # Nothing that was found is nearer to the guess, to a hundredth of the way.
    return "nearest" if here <= 1.01 * there else "another"


def is_searched(problem: Problem, rows: int) -> bool:
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


def several_table(found: Sequence[Branches]) -> str:
    """Share of Coulomb problems with several motions, by structure, friction and sliding, as markdown."""
    coulomb = [b for b in found if b.law == "coulomb"]
    groups: list[tuple[str, list[Branches]]] = [("all", coulomb)]
    words = dict.fromkeys(word for b in coulomb for word in b.structure.split(" + "))
    groups += [(word, [b for b in coulomb if word in b.structure.split(" + ")]) for word in words]
    for low, high in ((0.0, 0.3), (0.3, 0.6), (0.6, math.inf)):
        name = f"friction from {low:g}" + (f" to {high:g}" if high < math.inf else "")
        groups.append((name, [b for b in coulomb if low <= b.friction < high]))
    # Relative to nothing: m/s as they are; a thousandth of a millimetre per second is at rest.
    for name, low, high in (
        ("nothing slides", -1.0, 1e-6),
        ("slides below 0.1 m/s", 1e-6, 0.1),
        ("slides faster", 0.1, math.inf),
    ):
        groups.append((name, [b for b in coulomb if low < b.sliding <= high]))
    rows = []
    for name, group in groups:
        if not group:
            continue
        proved = sum(bool(b.unique) for b in group)
        several = [b for b in group if b.motions > 1]
        one = sum(b.motions == 1 and not b.unique for b in group)
        worst = max(several, key=lambda b: b.spread, default=None)
        last = ("", "") if worst is None else (f"{worst.spread:.2g} m/s", worst.case)
        rows.append(
            (name, len(group), proved, one, f"{len(several)} ({len(several) / len(group):.0%})", *last)
        )
    head = ("Coulomb problems", "count", "proved unique", "one found", "several", "largest spread", "where")
    lines = [markdown(head, rows)]
    warm = [b.warm for b in coulomb if b.warm]
    if warm:
        stay = sum(word == "nearest" for word in warm)
        lines += [
            "",
            f"Warm starts where there are several: sweeps from {stay} of {len(warm)} end at the motion nearest to it.",
        ]
    none = sum(b.motions == 0 for b in coulomb)
    if none:
        lines += ["", f"No run ended at a solution of {none} of them; they count in the first column alone."]
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


@click.command("motions")
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@click.option("--runs", type=click.IntRange(0), default=12, show_default=True, help="Runs of each search.")
@click.option(
    "--rows", type=click.IntRange(1), default=3000, show_default=True, help="Leave larger problems out."
)
@click.option(
    "--figure", "picture", type=click.Path(path_type=Path), help="Residual against motion error, drawn."
)
def command(
    files: tuple[str, ...],
    runs: int,
    rows: int,
    picture: Path | None,
) -> None:
    """What a residual tells of the motion, and how many motions a problem has.

    On FILES, or on the default set of the suite.
    """
    seen: list[Sample] = []
    found: list[Branches] = []
    left = 0
    for item in resolve(files or ["default"]):
        problem = item.problem
        if not is_searched(problem, rows):
            left += 1
            continue
        structure = " + ".join(structure_of(problem))
        found.append(branches(item.name, problem, structure, runs))
        click.echo(f"{item.name}: {found[-1].motions} motions, {found[-1].spread:.2g} m/s apart", err=True)
        seen += samples(item.name, problem, structure)
        item.forget()
    if seen:
        click.echo(table(seen))
    if found:
        click.echo(("\n" if seen else "") + several_table(found))
    if left:
        click.echo(f"\n{left} problems left out: empty, above {rows} rows, or without a solver here.")
    if picture is not None:
        figure(seen, picture)
