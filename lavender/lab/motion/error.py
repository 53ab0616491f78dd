"""The error of a motion: the distance of an impulse from the solution, in units of motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.lab.motion.bound import subtract_impulses
from lavender.lab.motion.operator import U
from lavender.lab.motion.reference import Reference, get_motion_cache
from lavender.problem import Problem

# Two motions count as equal if their distance is below this fraction of the motion M^-1 J^T lambda of the constraints.
# On the worst conditioned piles of the suite, a residual of 1e-10 changes the motion by up to 1e-7 of it.
SAME_MOTION_FRACTION = 1e-6

# Fields that become None if their numbers are not finite.
MOTION_ERROR_FIELDS = (
    "kinetic",
    "energy",
    "speed",
    "spin",
    "rows",
    "bound",
    "bound_speed",
    "bound_spin",
    "moved",
)


@dataclass(frozen=True, eq=False)
class MotionError:
    """Distance of one impulse from the solution; `str()` gives one line. A number that does not apply is None.

    Parameters
    ----------
    kinetic : float or None, sqrt J
        Energy norm of the difference of body velocities; None if M is not known.
    energy : float or None, sqrt J
        `kinetic` with the energy in compliance added under the root.
    relative : float or None
        `kinetic` (or `energy`) divided by the norm of the constraints' own motion M^-1 J^T lambda*.
    speed : float or None, m/s
        Velocity error of the body with the largest one; m/s or rad/s of a generalised velocity.
    spin : float or None, rad/s
        Angular velocity error of the body with the largest one; None in generalised coordinates.
    rows : float or None, m/s (rad/s on angular rows)
        max |w - w*|.
    body, spin_body, row : int
        Body of `speed`, body of `spin`, and row of `rows`; -1 without one.
    bound : float or None, sqrt J
        Upper bound of `energy`; see `lavender.lab.motion.bound`.
    bound_speed : float or None, m/s
        Upper bound of `speed`.
    bound_spin : float or None, rad/s
        Upper bound of `spin`.
    moved : float or None, m/s
        Largest shift of a target in the problem that the bound holds for.
    reference : Reference
        The solution that the impulse was compared with.
    note : str
        Reason why a number is missing.
    spread : float or None, sqrt J
        Coulomb: largest distance between two motions that both solve the problem, as far as they were searched.
    spread_speed : float or None, m/s
        Coulomb: largest difference of a body's speed between two such motions; of a row's if bodies are not known.
    count : int
        Number of known motions; the distance is measured from the nearest of them.
    unique : str
        Criterion that proves that the motion is unique; empty if no criterion holds.
    """

    kinetic: float | None
    energy: float | None
    relative: float | None
    speed: float | None
    spin: float | None
    rows: float | None
    body: int
    spin_body: int
    row: int
    bound: float | None
    bound_speed: float | None
    bound_spin: float | None
    moved: float | None
    reference: Reference
    note: str
    spread: float | None = None
    spread_speed: float | None = None
    count: int = 1
    unique: str = ""
    _problem: Problem | None = field(default=None, repr=False)

    @property
    def body_name(self) -> str:
        """Name of the body (or generalised velocity) with the largest error, e.g. "body 3"; empty without one."""
        return self._name_body(self.body)

    @property
    def _worst_row_unit(self) -> str:
        """Unit of `rows`: " m/s" or " rad/s" by the kind of the row, or " m/s or rad/s" if bodies are not known."""
        if self._problem is None or self._problem.rows is None or self.row < 0:
            return " m/s or rad/s"
        row = self._problem.jacobian[[self.row]]
        return " m/s" if row.data[row.indices % 6 < 3].any() else " rad/s"

    def _name_body(self, body: int) -> str:
        """Return the name of a body or generalised velocity; empty for -1."""
        return (
            get_motion_cache(self._problem).operator.get_name(body)
            if self._problem is not None and body >= 0
            else ""
        )

    @property
    def row_name(self) -> str:
        """Name of the row with the largest error, e.g. "contact 3, normal"; empty without one."""
        return self._problem.row_name(self.row) if self._problem is not None and self.row >= 0 else ""

    def __str__(self) -> str:
        is_generalized = self.spin is None  # A generalised velocity may be in m/s or rad/s.
        numbers = (
            ("relative", self.relative, "", ""),
            ("kinetic", self.kinetic, " sqrt(J)", ""),
            ("energy", self.energy if self.kinetic is None else None, " sqrt(J)", ""),
            ("speed", self.speed, " m/s or rad/s" if is_generalized else " m/s", self.body_name),
            ("spin", self.spin, " rad/s", self._name_body(self.spin_body)),
            ("rows", self.rows, self._worst_row_unit, self.row_name),
            ("bound", self.bound, " sqrt(J)", ""),
            ("bound_speed", self.bound_speed if self.bound is not None else None, " m/s", ""),
        )
        parts = [
            f"{name} {x:.2g}{unit}{f' ({where})' if where else ''}"
            for name, x, unit, where in numbers
            if x is not None
        ]
        if self.bound is not None and self.moved is not None:
            parts[-1] += f" with targets moved by {self.moved:.1e} m/s"
        text = f"motion error: {', '.join(parts)}"
        if self.spread_speed is not None and self.count > 1:
            text += f"; nearest of {self.count} motions {self.spread_speed:.2g} m/s apart"
        if self.unique:
            text += f"; unique: {self.unique}"
        text += f"; compared with {self.reference}"
        return f"{text}; {self.note}" if self.note else text


def measure_distance(problem: Problem, x: FloatArray, reference: Reference) -> MotionError:
    """Compute the distance of an impulse x (m,) [N s] from one reference; numbers beyond float64 are None."""
    error = drop_non_finite(_compute_error(problem, x, reference), MOTION_ERROR_FIELDS)
    if error.relative == math.inf:
        explanation = (
            "the relative error has a tiny reference, because the constraints cause almost no motion"
        )
        return replace(error, note="; ".join(n for n in (error.note, explanation) if n))
    return error


def drop_non_finite(error: MotionError, names: Sequence[str]) -> MotionError:
    """Replace numbers that are not finite by None and name them in `note`."""
    beyond = [n for n in names if (value := getattr(error, n)) is not None and not math.isfinite(value)]
    if not beyond:
        return error
    note = "; ".join(n for n in (error.note, f"beyond float64: {', '.join(beyond)}") if n)
    missing: dict[str, Any] = dict.fromkeys(beyond)
    return replace(error, note=note, **missing)


def _compute_error(problem: Problem, x: FloatArray, reference: Reference) -> MotionError:
    """Compute all numbers of a `MotionError` for which the reference suffices."""
    operator = get_motion_cache(problem).operator
    delta, size = subtract_impulses(operator, x, reference.impulse)
    notes = [reference.refusal and f"{reference.refusal}: no energies"]
    energies = reference.is_accepted and not reference.refusal
    if not reference.is_accepted:
        notes.append("no solver reached the floor, so there is no estimate")
    values: dict[str, Any] = dict.fromkeys((*MOTION_ERROR_FIELDS, "relative"))
    values |= {"body": -1, "spin_body": -1, "row": -1}
    velocity = operator.compute_velocity(delta, U * np.abs(delta))
    speed = max_speed = np.zeros(0)
    spin: FloatArray | None = None
    max_spin: FloatArray | None = None
    if velocity is not None:
        speed, spin = operator.compute_speeds(velocity[0])
        max_speed, max_spin = operator.compute_speeds(np.abs(velocity[0]) + velocity[1])
    if energies:
        own = operator.compute_energy_norm(reference.impulse, np.zeros(problem.m))
        values |= {"kinetic": size.kinetic, "energy": size.energy}
        values["relative"] = (
            _divide_or_inf(size.energy, own.energy)
            if size.kinetic is None or own.kinetic is None
            else _divide_or_inf(size.kinetic, own.kinetic)
        )
    if reference.is_accepted:
        if velocity is not None:
            values["body"], values["speed"] = _find_index_and_max(speed)
            if spin is not None:
                values["spin_body"], values["spin"] = _find_index_and_max(spin)
        values["row"], values["rows"] = _find_index_and_max(
            np.abs(operator.compute_slack_with_rounding_bound(delta)[0] + problem.b)
        )
    proof = reference.witness
    if proof is None and not reference.refusal:
        notes.append("no bound under Coulomb's law")
    if proof is not None:
        values["bound"], values["moved"] = size.upper_bound + proof.radius, proof.moved
        max_from_witness = operator.bound_speeds(proof.radius)
        if max_from_witness is not None:
            values["bound_speed"] = float(max_speed.max(initial=0.0)) * (1.0 + 8.0 * U) + max_from_witness[0]
            if max_spin is not None and max_from_witness[1] is not None:
                values["bound_spin"] = (
                    float(max_spin.max(initial=0.0)) * (1.0 + 8.0 * U) + max_from_witness[1]
                )
    return MotionError(**values, reference=reference, note="; ".join(n for n in notes if n), _problem=problem)


def convert_to_ellipse_rows(problem: Problem, x: FloatArray, error: MotionError) -> MotionError:
    """Convert `rows` and `row` of an error to the problem's friction ellipses.

    The error and x (m,) [N s] belong to the equivalent problem with disks (one coefficient per contact).
    """
    if error.rows is None:
        return error
    delta = x - error.reference.impulse
    w = (
        get_motion_cache(problem.disk).operator.compute_slack_with_rounding_bound(delta)[0] + problem.disk.b
    ) / problem.cones.stretch
    row, rows = _find_index_and_max(np.abs(w))
    return drop_non_finite(replace(error, row=row, rows=rows), ("rows",))


def _divide_or_inf(x: float, reference: float) -> float:
    """Divide; 0 / 0 is 0 and x / 0 is inf."""
    return 0.0 if x == 0.0 else x / reference if reference > 0.0 and x < math.inf else math.inf


def _find_index_and_max(x: FloatArray) -> tuple[int, float]:
    """Return (index, value) of the largest number; (-1, 0) if there is none."""
    if not len(x):
        return -1, 0.0
    i = int(np.argmax(x))
    return i, float(x[i])
