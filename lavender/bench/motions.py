"""What a residual tells of the motion, and how many motions a problem has: what `lavender bench motions` measures.

Two lists over problems of any source. **Calibration**: iterates of several solvers at several budgets, each with
its relative residual and its relative motion error; their ratio says what a residual is worth. **Several
motions**: how often a search finds more than one, how far apart, by law, structure, friction and sliding.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from lavender import motion
from lavender.cones import ROW
from lavender.errors import CapabilityError, InputError
from lavender.io.stored import write_atomically
from lavender.measures import natural_map, siconos_error
from lavender.problem import Problem
from lavender.registry import available, get
from lavender.solve import solve

__all__ = ["Branches", "Sample", "branches", "is_searched", "samples", "write_csv"]

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


def write_csv(found: Iterable[Any], path: Path) -> None:
    """One line for each entry, floats to their last digit."""
    entries = list(found)

    def write(part: Path) -> None:
        with part.open("w", newline="", encoding="utf-8") as stream:
            lines = csv.writer(stream)
            if entries:
                lines.writerow([f.name for f in fields(entries[0])])
            lines.writerows([*asdict(entry).values()] for entry in entries)

    write_atomically(path, write)


def is_searched(problem: Problem, rows: int) -> bool:
    """Whether a problem has rows, few enough of them, and a solver here."""
    return 0 < problem.m <= rows and bool(available(problem))
