"""The solution that motions are compared with: found once per problem, judged, and kept with it, or beside its file.

`pile.npz.reference` holds the solution of `pile.npz`, judged when it is read.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, field
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, read_only
from lavender.base.errors import CapabilityError, InputError
from lavender.io import npz
from lavender.io.stored import check_writable, write_bytes
from lavender.judge.residuals import Residual, residual
from lavender.judge.solution import Solution, uninterrupted
from lavender.lab.motion import operator as operators
from lavender.lab.motion.bound import Witness, witness
from lavender.problem import Problem, check_problem
from lavender.solving.solve import solve

SOLVER = "auto"
ASKED = 1e-15  # relative residual asked of it: it stops at the floor by itself
ACCEPTED = 1e-10  # relative residual that makes a reference, as does the floor
PROOF = "proof: "  # who solved what `enclosed` gives
SUFFIX = ".reference"  # of a problem's file name
CONVEX = ("linear", "lcp", "cone")


@dataclass(frozen=True, eq=False)
class Reference:
    """An impulse that stands for the solution, or the best that was found. `str()` is one line."""

    impulse: FloatArray = field(repr=False)  # (m,) N s
    residual: Residual
    solver: str  # who found it, e.g. "auto: direct 1 factorisations"
    refusal: str  # why there are no energies: asymmetric or indefinite A; empty where there are
    witness: Witness | None = field(repr=False)  # what it proves; None under Coulomb's law, or where refused

    @property
    def accepted(self) -> bool:
        """Near enough to a solution that distances to it are told: relative <= 1e-10, or at the floor."""
        return self.residual.relative <= ACCEPTED or self.residual.at_floor

    @property
    def enclosed(self) -> bool:
        """An exact solution, rounded, that was enclosed with proof."""
        return self.solver.startswith(PROOF)

    def __str__(self) -> str:
        quality = "" if self.accepted else ", no solution"
        residual = self.residual
        return (
            f"{self.solver}, relative {residual.relative:.1e}, floor {residual.roundoff_floor:.1e}{quality}"
        )


@dataclass
class Kept:
    """Everything that this room keeps with a problem."""

    operator: operators.Operator
    refusal: str
    reference: Reference | None = None
    motions: Any = None  # `SolutionSet` of a search, or None


def kept(problem: Problem) -> Kept:
    """What is kept with a problem, made when first asked for.

    Raises
    ------
    CapabilityError
        A problem with ellipses, whose motion is that of its disks.
    """
    check_problem(problem)
    if problem.cones.has_ellipse:
        raise CapabilityError(
            "the motions of ellipses are those of problem.disk: give that, and impulses as problem.on_disk(impulse)"
        )
    with problem.derived.lock:
        own = problem.derived.cache.get(__name__)
        if own is None:
            operator = operators.make(problem)
            own = problem.derived.cache[__name__] = Kept(operator, operator.refusal() or "")
        return own


def reference(problem: Problem) -> Reference:
    """The problem's reference; solved for by `auto` when first asked, then kept with the problem.

    The best that was found, also where it is no solution: ask `accepted`.
    """
    own = kept(problem)
    if own.reference is None:
        found = uninterrupted(solve(problem, SOLVER, tol=ASKED))
        own.reference = judged(problem, found.impulse, f"{SOLVER}: {found.message}")
    return own.reference


def adopt(problem: Problem, impulse: Any, solver: str = "given") -> Reference:
    """Judge an impulse (m,) [N s] and keep it as the problem's reference if it is better than the one kept."""
    own = kept(problem)
    new = judged(problem, problem.impulse_array(impulse, "reference"), solver)
    if own.reference is None or new.residual.relative < own.reference.residual.relative:
        own.reference = new
    return own.reference


@np.errstate(over="ignore", invalid="ignore")  # of impulses at the edge of float64
def judged(problem: Problem, impulse: FloatArray, solver: str) -> Reference:
    """A reference of an impulse that is finite and of the right length."""
    own = kept(problem)
    impulse = read_only(np.array(impulse))
    proof = None
    if not own.refusal and problem.law in CONVEX:
        proof = witness(problem, own.operator, impulse)
    return Reference(impulse, residual(problem, impulse, "float64"), solver, own.refusal, proof)


def as_reference(problem: Problem, given: Any) -> Reference:
    """A reference of what a caller gave: one already, a Solution, or an impulse (m,) [N s]."""
    solver, impulse = "given", given
    if isinstance(given, Reference):
        if given.residual._problem is problem:
            return given
        solver, impulse = given.solver, given.impulse  # of another problem, or an equal one: judged anew
    elif isinstance(given, Solution):
        solver, impulse = given.solver.name, given.impulse
    return judged(problem, problem.impulse_array(impulse, "reference"), solver)


# -- beside files -----------------------------------------------------------------------------------------


def _beside(path: str | PathLike[str]) -> Path:
    path = Path(path)
    return path.with_name(path.name + SUFFIX)


def save_reference(
    problem: Problem, path: str | PathLike[str], impulse: FloatArray | None = None, source: str = "given"
) -> Path:
    """Write a problem's reference beside its file `path`: an impulse (m,) [N s] and who says so, else the one kept.

    If none is kept, it is solved for. InputError where nothing solved the problem: then there is nothing to keep.
    """
    out = check_writable(_beside(path))
    if impulse is not None:
        kept(problem.disk).reference = judged(problem.disk, impulse, source)
    found = reference(problem.disk)
    if not found.accepted:
        raise InputError(f"{path}: nothing reached the floor ({found}); there is no reference to write")
    buffer = BytesIO()
    np.savez(buffer, impulse=found.impulse, solver=np.array(found.solver))
    write_bytes(out, buffer.getvalue())
    return out


def load_reference(problem: Problem, path: str | PathLike[str]) -> Reference | None:
    """Keep the reference beside a problem's file, if there is one and it solves this problem by the judge.

    None without a file, and where what it holds solves another problem: then the reference is solved for anew.
    """
    place, problem = _beside(path), problem.disk
    if not place.is_file():
        return None
    try:
        with closing(npz.Archive(place)) as data:
            impulse, solver = np.asarray(data["impulse"], float), str(data.scalar("solver"))
    except (InputError, ValueError, TypeError) as error:
        raise InputError(
            f"{str(place)!r} holds no reference ({error}); delete it, or write it again with `lavender reference`"
        ) from None
    if impulse.shape != (problem.m,) or not np.isfinite(impulse).all():
        return None
    found = judged(problem, impulse, solver)
    if not found.accepted:
        return None
    kept(problem).reference = found
    return found
