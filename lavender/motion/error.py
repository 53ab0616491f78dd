"""How wrong the motion is: distance of an impulse to the solution, in units of motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.errors import InputError
from lavender.motion.bound import difference
from lavender.motion.operator import U
from lavender.motion.reference import Reference, as_reference, kept
from lavender.motion.reference import reference as reference_of
from lavender.problem import Problem

if TYPE_CHECKING:
    from lavender.motion.several import Motions

# Motions nearer than this are one, as a share of the constraints' own motion: a residual of 1e-10 moves by up to
# 1e-7 of it on the worst conditioned piles of the suite.
SAME = 1e-6

NUMBERS = (
    "kinetic", "energy", "speed", "spin", "rows", "bound", "bound_speed", "bound_spin", "moved",
)  # fmt: skip

__all__ = ["MotionError", "motion_error"]


@dataclass(frozen=True)
class MotionError:
    """Distance of one impulse to the solution. None where a number means nothing; `str()` is one line."""

    kinetic: float | None  # sqrt J, of the difference of body velocities; None where M is not known
    energy: float | None  # sqrt J, with what compliance stores
    relative: float | None  # -, over the same of the constraints' own motion M^-1 J^T lambda*
    speed: float | None  # m/s, of the body that is furthest off; m/s or rad/s of a generalised velocity
    spin: float | None  # rad/s, of the body that is furthest off; None in generalised coordinates
    rows: float | None  # m/s (rad/s on angular rows), max |w - w*|
    body: int  # that of `speed`, -1 without one
    spin_body: int  # that of `spin`, -1 without one
    row: int  # that of `rows`, -1 without one
    bound: float | None  # sqrt J, `energy` is no more; see lavender.motion.bound
    bound_speed: float | None  # m/s, `speed` is no more
    bound_spin: float | None  # rad/s, `spin` is no more
    moved: float | None  # m/s, what the targets are moved by in the problem that the bound holds for
    reference: Reference  # what was compared with
    note: str  # why a number is missing
    # Coulomb: the largest distance between two motions that both solve the problem, as far as they were searched.
    spread: float | None = None  # sqrt J
    spread_speed: float | None = None  # m/s, of a body; of a row where bodies are not known
    count: int = 1  # motions that the distance is the shortest of
    unique: str = ""  # why there is one motion alone; empty where nothing proves it
    _problem: Problem | None = field(default=None, repr=False)

    @property
    def body_name(self) -> str:
        """Name of the body (the generalised velocity) that is furthest off, e.g. "body 3"; empty without one."""
        return (
            kept(self._problem).operator.name(self.body)
            if self._problem is not None and self.body >= 0
            else ""
        )

    @property
    def row_name(self) -> str:
        """Name of the row that is furthest off, e.g. "contact 3, normal"; empty without one."""
        return self._problem.row_name(self.row) if self._problem is not None and self.row >= 0 else ""

    def __str__(self) -> str:
        parts = []
        if self.relative is not None:
            parts.append(f"relative {self.relative:.2e}")
        if self.kinetic is not None or self.energy is not None:
            parts.append(f"{self.kinetic if self.kinetic is not None else self.energy:.2e} sqrt(J)")
        if self.speed is not None:
            spin = "" if self.spin is None else f", {self.spin:.2g} rad/s"
            unit = " m/s" if self.spin is not None else ""  # a generalised velocity is m/s or rad/s
            parts.append(f"{self.body_name or 'bodies'} {self.speed:.2g}{unit}{spin}")
        if self.rows is not None:
            parts.append(f"{self.row_name or 'rows'} {self.rows:.2g} m/s")
        if self.bound is not None:
            speed = "" if self.bound_speed is None else f" ({self.bound_speed:.2g} m/s)"
            moved = "" if self.moved is None else f" with targets moved by {self.moved:.1e} m/s"
            parts.append(f"at most {self.bound:.2e} sqrt(J){speed}{moved}")
        if self.spread_speed is not None and self.count > 1:
            parts.append(f"nearest of {self.count} motions {self.spread_speed:.2g} m/s apart")
        if self.unique:
            parts.append(f"unique: {self.unique}")
        parts.append(f"to {self.reference}")
        if self.note:
            parts.append(self.note)
        return f"motion error: {', '.join(parts)}"


def motion_error(problem: Problem, impulse: Any, reference: Any = None) -> MotionError:
    """How wrong the motion of an impulse is: its distance to the solution, with a bound.

    With lambda* the reference and M^-1 J^T (lambda - lambda*) the difference dv of body velocities,

        kinetic = sqrt(1/2 dv.M dv)        energy = sqrt(1/2 (lambda - lambda*).A (lambda - lambda*))

    so that two impulses which differ by what moves nothing (a table on four legs) are at distance 0. The
    bound needs no trust in the reference: with e the judge's error of lambda* and targets moved by d e,
    the solution is within sqrt(1/2) |e|_A of it (proof in `lavender.motion.bound`).

    Parameters
    ----------
    problem : Problem
    impulse : (m,) N s
    reference : (m,) N s, Solution or Reference, optional
        What stands for the solution. Default: what `auto` finds at the floor, solved for once and kept
        with the problem; under Coulomb's law the nearest of the motions that `lavender.motions` finds and of the
        one that the impulse itself leads to.

    Returns
    -------
    MotionError
        No estimate where the reference is no solution (relative above 1e-10 and above twice its floor); no
        energies where A is asymmetric or indefinite; no bound under Coulomb's law. `note` says so.

    Raises
    ------
    InputError
        An impulse or reference of the wrong length, or one that is not finite.
    CapabilityError
        Generalised coordinates in which M couples more than 2000 velocities.
    """
    if not isinstance(problem, Problem):
        raise InputError(f"problem is a {type(problem).__name__}; a lavender.Problem is needed")
    x = problem.on_disk(problem.impulse_array(impulse))
    if problem.cones.has_ellipse:  # rows are those of its disks
        if reference is not None and not isinstance(reference, Reference):
            given = problem.impulse_array(getattr(reference, "impulse", reference), "reference")
            reference = problem.on_disk(given)
        problem = problem.disk
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is told in `note`
        if reference is not None:
            return measure(problem, x, as_reference(problem, reference))
        if problem.law != "coulomb":
            return measure(problem, x, reference_of(problem))
        from lavender.motion.several import motions_of

        return nearest(problem, x, motions_of(problem))


def nearest(problem: Problem, x: FloatArray, found: Motions) -> MotionError:
    """The distance of an impulse x (m,) to the nearest of several motions, and of the one that it leads to."""
    from lavender.motion.several import branch, distance

    references = [motion.reference for motion in found]
    spread, energy = found.spread, found.spread_energy
    if not found.unique:
        own = branch(problem, x)
        far = [distance(problem, own.impulse, motion.impulse) for motion in found]
        if own.accepted and all(d.share > SAME for d in far):
            references.append(own)
            spread = max([spread, *(d.speed for d in far)])
            energy = None if energy is None else max([energy, *(d.energy for d in far)])
    if not references:
        return measure(problem, x, reference_of(problem))
    best = min((measure(problem, x, reference) for reference in references), key=_distance)
    made = replace(best, spread=energy, spread_speed=spread, count=len(references), unique=found.unique)
    return _told(made, ("spread", "spread_speed"))


def _distance(error: MotionError) -> float:
    known = error.energy if error.energy is not None else error.rows
    return math.inf if known is None else known


def measure(problem: Problem, x: FloatArray, reference: Reference) -> MotionError:
    """The distance of an impulse x (m,) [N s] to one reference; None for what float64 cannot hold, as `note` says."""
    found = _told(_measured(problem, x, reference), NUMBERS)
    if found.relative == math.inf:
        words = "relative to next to nothing, as the solution moves no more"
        return replace(found, note="; ".join(n for n in (found.note, words) if n))
    return found


def _told(found: MotionError, names: Sequence[str]) -> MotionError:
    """None in the place of numbers that float64 cannot hold, which `note` names."""
    beyond = [n for n in names if (value := getattr(found, n)) is not None and not math.isfinite(value)]
    if not beyond:
        return found
    note = "; ".join(n for n in (found.note, f"beyond float64: {', '.join(beyond)}") if n)
    gone: dict[str, Any] = dict.fromkeys(beyond)
    return replace(found, note=note, **gone)


def _measured(problem: Problem, x: FloatArray, reference: Reference) -> MotionError:
    operator = kept(problem).operator
    delta, size = difference(operator, x, reference.impulse)
    notes = [reference.refusal and f"{reference.refusal}: no energies"]
    energies = reference.accepted and not reference.refusal
    if not reference.accepted:
        notes.append("nothing reached the floor: no estimate")
    values: dict[str, Any] = dict.fromkeys((*NUMBERS, "relative"))
    values |= {"body": -1, "spin_body": -1, "row": -1}
    velocity = operator.velocity(delta, U * np.abs(delta))
    speed = fast = np.zeros(0)
    spin: FloatArray | None = None
    swift: FloatArray | None = None
    if velocity is not None:
        speed, spin = operator.lengths(velocity[0])
        fast, swift = operator.lengths(np.abs(velocity[0]) + velocity[1])
    if energies:
        own = operator.size(reference.impulse, np.zeros(problem.m))
        values |= {"kinetic": size.kinetic, "energy": size.energy}
        values["relative"] = (
            _ratio(size.energy, own.energy)
            if size.kinetic is None or own.kinetic is None
            else _ratio(size.kinetic, own.kinetic)
        )
    if reference.accepted:
        if velocity is not None:
            values["body"], values["speed"] = _largest(speed)
            if spin is not None:
                values["spin_body"], values["spin"] = _largest(spin)
        values["row"], values["rows"] = _largest(np.abs(operator.slack(delta)[0] + problem.b))
    proof = reference.witness
    if proof is None and not reference.refusal:
        notes.append("no bound under Coulomb's law")
    if proof is not None:
        values["bound"], values["moved"] = size.most + proof.radius, proof.moved
        reach = operator.reach(proof.radius)
        if reach is not None:
            values["bound_speed"] = float(fast.max(initial=0.0)) * (1.0 + 8.0 * U) + reach[0]
            if swift is not None and reach[1] is not None:
                values["bound_spin"] = float(swift.max(initial=0.0)) * (1.0 + 8.0 * U) + reach[1]
    return MotionError(**values, reference=reference, note="; ".join(n for n in notes if n), _problem=problem)


def _ratio(x: float, reference: float) -> float:
    return 0.0 if x == 0.0 else x / reference if reference > 0.0 and x < math.inf else math.inf


def _largest(x: FloatArray) -> tuple[int, float]:
    if not len(x):
        return -1, 0.0
    i = int(np.argmax(x))
    return i, float(x[i])
