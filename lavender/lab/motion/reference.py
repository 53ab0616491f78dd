"""The solution that motions are compared with: solved once per problem, judged, and stored with it or its file.

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

from lavender.base.arrays import FloatArray, mark_read_only
from lavender.base.errors import CapabilityError, InputError
from lavender.io import npz
from lavender.io.stored import check_writable, write_bytes
from lavender.judge.residuals import Residual, residual
from lavender.judge.solution import Solution, raise_if_interrupted
from lavender.lab.motion import operator as operators
from lavender.lab.motion.bound import Witness, compute_witness
from lavender.problem import Problem, check_problem
from lavender.solving.solve import solve

REFERENCE_SOLVER = "auto"
# Relative residual tolerance of the reference solve; it is below the floor, where `auto` stops.
REFERENCE_TOL = 1e-15
# An impulse is accepted as a reference up to this relative residual, or at its floor.
REFERENCE_MAX_RESIDUAL = 1e-10
REFERENCE_SUFFIX = ".reference"  # Appended to a problem's file name.
CONVEX_LAWS = ("linear", "lcp", "cone")


@dataclass(frozen=True, eq=False)
class Reference:
    """An impulse that stands for the solution in comparisons: the best that was found. `str()` gives one line.

    Parameters
    ----------
    impulse : (m,) N s
    residual : Residual
    solver : str
        The solver that found it, and its message, e.g. "auto: direct 1 factorisations".
    refusal : str
        Reason why energies cannot be computed, an asymmetric or indefinite A; empty if they can be computed.
    witness : Witness or None
        Proved bound of the distance of `impulse` from the solution; None under Coulomb's law, or if `refusal` is not
        empty.
    """

    impulse: FloatArray = field(repr=False)
    residual: Residual
    solver: str
    refusal: str
    witness: Witness | None = field(repr=False)

    @property
    def is_accepted(self) -> bool:
        """Whether it counts as a solution: its relative residual is at most 1e-10, or at its round-off floor."""
        return self.residual.relative <= REFERENCE_MAX_RESIDUAL or self.residual.at_floor

    def __str__(self) -> str:
        quality = "" if self.is_accepted else ", no solution"
        residual = self.residual
        return (
            f"{self.solver}, relative {residual.relative:.1e}, floor {residual.roundoff_floor:.1e}{quality}"
        )


@dataclass
class MotionCache:
    """Results about motions that are stored with a problem; `motions` is the `SolutionSet` of a search."""

    operator: operators.Operator
    refusal: str
    reference: Reference | None = None
    motions: Any = None


def get_motion_cache(problem: Problem) -> MotionCache:
    """Return the motion cache of a problem; it is created at the first call.

    Raises
    ------
    CapabilityError
        The problem has ellipses; its motion is computed on its disks.
    """
    check_problem(problem)
    if problem.cones.has_ellipse:
        raise CapabilityError(
            "the problem has ellipses, for which no reference is computed; its equivalent problem.disk is "
            "needed, with impulses problem.on_disk(impulse)"
        )
    with problem.derived.lock:
        cache = problem.derived.cache.get(__name__)
        if cache is None:
            operator = operators.make_operator(problem)
            cache = problem.derived.cache[__name__] = MotionCache(operator, operator.explain_refusal() or "")
        return cache


def get_reference(problem: Problem) -> Reference:
    """Return the problem's reference. At the first call, `auto` computes it, and it is stored with the problem.

    The reference is the best impulse that was found, which need not be a solution: see `Reference.is_accepted`.
    """
    cache = get_motion_cache(problem)
    if cache.reference is None:
        best = raise_if_interrupted(solve(problem, REFERENCE_SOLVER, tol=REFERENCE_TOL))
        cache.reference = make_reference(problem, best.impulse, f"{REFERENCE_SOLVER}: {best.message}")
    return cache.reference


def store_reference_if_better(problem: Problem, impulse: Any, solver: str = "given") -> Reference:
    """Judge an impulse (m,) [N s] and store it as the problem's reference if it is better than the stored one."""
    cache = get_motion_cache(problem)
    new = make_reference(problem, problem.impulse_array(impulse, "reference"), solver)
    if cache.reference is None or new.residual.relative < cache.reference.residual.relative:
        cache.reference = new
    return cache.reference


@np.errstate(over="ignore", invalid="ignore")  # Impulses may be at the limit of float64.
def make_reference(problem: Problem, impulse: FloatArray, solver: str) -> Reference:
    """Judge an impulse (m,) [N s], finite and of the right length, and build its `Reference`."""
    cache = get_motion_cache(problem)
    impulse = mark_read_only(np.array(impulse))
    proof = None
    if not cache.refusal and problem.law in CONVEX_LAWS:
        proof = compute_witness(problem, cache.operator, impulse)
    return Reference(impulse, residual(problem, impulse, "float64"), solver, cache.refusal, proof)


def as_reference(problem: Problem, value: Any) -> Reference:
    """Convert a Reference, a Solution or an impulse (m,) [N s] to a `Reference` of this problem."""
    solver, impulse = "given", value
    if isinstance(value, Reference):
        if value.residual._problem is problem:
            return value
        # The reference was made for another problem object: judge its impulse on this problem.
        solver, impulse = value.solver, value.impulse
    elif isinstance(value, Solution):
        solver, impulse = value.solver.name, value.impulse
    return make_reference(problem, problem.impulse_array(impulse, "reference"), solver)


# -- files ------------------------------------------------------------------------------------------------


def _make_reference_path(path: str | PathLike[str]) -> Path:
    """Return the path of the reference file of a problem's file."""
    path = Path(path)
    return path.with_name(path.name + REFERENCE_SUFFIX)


def save_reference(
    problem: Problem, path: str | PathLike[str], impulse: FloatArray | None = None, source: str = "given"
) -> Path:
    """Write a problem's reference next to its file `path` and return the path of the reference.

    The reference is `impulse` (m,) [N s], described by `source`. By default it is the problem's stored reference,
    which is computed if there is none. Raise InputError if no solver solved the problem.
    """
    out = check_writable(_make_reference_path(path))
    if impulse is not None:
        get_motion_cache(problem.disk).reference = make_reference(problem.disk, impulse, source)
    best = get_reference(problem.disk)
    if not best.is_accepted:
        raise InputError(
            f"{path}: no solver reached the round-off floor ({best}), so no reference was written: give the "
            "problem in other units, or remove dependent rows"
        )
    buffer = BytesIO()
    np.savez(buffer, impulse=best.impulse, solver=np.array(best.solver))
    write_bytes(out, buffer.getvalue())
    return out


def load_reference(problem: Problem, path: str | PathLike[str]) -> Reference | None:
    """Load the reference of a problem's file and store it with the problem.

    Return None if there is no file, or if its impulse does not solve this problem; `get_reference` then computes one.
    """
    location, problem = _make_reference_path(path), problem.disk
    if not location.is_file():
        return None
    try:
        with closing(npz.Archive(location)) as data:
            impulse, solver = np.asarray(data["impulse"], float), str(data.read_scalar("solver"))
    except (InputError, ValueError, TypeError) as error:
        raise InputError(
            f"{str(location)!r} holds no reference ({error}); delete it, or write it again with `lavender reference`"
        ) from None
    if impulse.shape != (problem.m,) or not np.isfinite(impulse).all():
        return None
    best = make_reference(problem, impulse, solver)
    if not best.is_accepted:
        return None
    get_motion_cache(problem).reference = best
    return best
