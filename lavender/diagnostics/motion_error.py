"""The motion error of an impulse: how far its velocities are from the velocities of a reference, in units of motion.

```python
error = lv.motion_error(problem, solution.impulse)     # or solution.motion_error()
error.relative, error.speed, error.body_name
```
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, mark_read_only
from lavender.judge.residuals import Residual, measure_residual
from lavender.judge.solution import raise_if_interrupted
from lavender.problem import Problem, check_problem
from lavender.solving.solve import solve

# Relative residual tolerance of the reference solve; it is below the round-off floor, where `auto` stops.
REFERENCE_TOL = 1e-15
# The same under Coulomb's law: an impulse that is a solution to rounding is its own reference. At REFERENCE_TOL, `auto`
# would leave it and may end at another solution.
COULOMB_REFERENCE_TOL = 1e-12
# An impulse counts as a solution up to this relative residual, or at its round-off floor.
REFERENCE_MAX_RESIDUAL = 1e-10


@dataclass(frozen=True, eq=False)
class MotionError:
    """Distance of one impulse from a reference; `str()` gives one line. A number that does not apply is None.

    Parameters
    ----------
    kinetic : float or None, sqrt J
        Energy norm of the difference of body velocities; None if M is not known.
    energy : float or None, sqrt J
        `kinetic` with the energy in compliance added under the root.
    relative : float or None
        `kinetic` (or `energy`) divided by the norm of the reference's own motion M^-1 J^T lambda*.
    speed : float or None, m/s
        Velocity error of the body with the largest one; m/s or rad/s of a generalised velocity.
    spin : float or None, rad/s
        Angular velocity error of the body with the largest one; None in generalised coordinates.
    rows : float or None, m/s (rad/s on angular rows)
        max |w - w*|.
    body, spin_body, row : int
        Body of `speed`, body of `spin`, and row of `rows`; -1 without one.
    reference : (m,) N s
        The impulse that was compared with.
    reference_residual : Residual
        Its residual.
    note : str
        Reason why a number is missing.
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
    reference: FloatArray = field(repr=False)
    reference_residual: Residual
    note: str
    _problem: Problem = field(repr=False)

    @property
    def body_name(self) -> str:
        """Name of the body (or generalised velocity) with the largest error, e.g. "body 3"; empty without one."""
        if self.body < 0:
            return ""
        general = self._problem.generalized
        return f"body {self.body}" if general is None else general.velocity_name(self.body)

    @property
    def row_name(self) -> str:
        """Name of the row with the largest error, e.g. "contact 3, normal"; empty without one."""
        return self._problem.row_name(self.row) if self.row >= 0 else ""

    def __str__(self) -> str:
        is_angular = self.row >= 0 and self._problem.angular_rows[self.row]
        numbers = (
            ("relative", self.relative, "", ""),
            ("kinetic", self.kinetic, " sqrt(J)", ""),
            ("energy", self.energy if self.kinetic is None else None, " sqrt(J)", ""),
            ("speed", self.speed, " m/s or rad/s" if self.spin is None else " m/s", self.body_name),
            ("spin", self.spin, " rad/s", f"body {self.spin_body}"),
            ("rows", self.rows, " rad/s" if is_angular else " m/s", self.row_name),
        )
        parts = [
            f"{name} {x:.2g}{unit}{f' ({where})' if where else ''}"
            for name, x, unit, where in numbers
            if x is not None
        ]
        text = f"motion error: {', '.join(parts)}".rstrip(" :")
        text = f"{text}: {self.note}" if not parts and self.note else text
        text = f"{text}; reference: {self.reference_residual}"
        return f"{text}; {self.note}" if self.note and parts else text


def motion_error(problem: Problem, impulse: Any, reference: Any = None) -> MotionError:
    """Compute the distance of the velocities of an impulse from the velocities of a reference impulse.

    With lambda* the reference and M^-1 J^T (lambda - lambda*) the difference dv of body velocities,

        kinetic = sqrt(1/2 dv.M dv)        energy = sqrt(1/2 (lambda - lambda*).A (lambda - lambda*))

    so that two impulses with a difference that moves no body (a table on four legs) have distance 0.

    Parameters
    ----------
    problem : Problem
    impulse : (m,) N s
    reference : (m,) N s or Solution, optional
        The solution to compare with. Default: the result of `auto` at the round-off floor. It is solved once and stored
        with the problem. Under Coulomb's law, under which several motions may be solutions, `auto` starts from
        `impulse` at each call instead.

    Returns
    -------
    MotionError
        Distances are None if the reference is not a solution, that is, if its relative residual is above 1e-10 and
        above twice its floor. Energies are None if A is asymmetric or indefinite. `note` gives the reason.

    Raises
    ------
    InputError
        An impulse or reference has a wrong length or is not finite.
    """
    check_problem(problem)
    x = problem.make_start(impulse)
    if reference is None and problem.law == "coulomb":
        reference = raise_if_interrupted(
            solve(problem, impulse=x, tol=COULOMB_REFERENCE_TOL)
        ).impulse
    elif reference is None and (reference := problem.derived.cache.get(__name__)) is None:
        best = raise_if_interrupted(
            solve(problem, impulse=problem.start(), tol=REFERENCE_TOL)
        ).impulse
        reference = problem.derived.cache.setdefault(__name__, best)
    reference = mark_read_only(np.array(problem.make_start(reference, "reference")))
    # Numbers that are not finite are None; `note` names them.
    with np.errstate(over="ignore", invalid="ignore"):
        return _compute_error(problem, x, reference)


def _compute_error(problem: Problem, x: FloatArray, reference: FloatArray) -> MotionError:
    """Compute the distance of an impulse x (m,) [N s] from a reference (m,) [N s]."""
    judged = measure_residual(problem, reference, "float64")
    values: dict[str, Any] = dict.fromkeys(
        ("kinetic", "energy", "relative", "speed", "spin", "rows")
    )
    values |= {"body": -1, "spin_body": -1, "row": -1}
    notes = []
    if not (judged.relative <= REFERENCE_MAX_RESIDUAL or judged.at_floor):
        notes.append(
            f"no estimate, because the relative residual {judged.relative:.1e} of the reference is above "
            f"{REFERENCE_MAX_RESIDUAL:.0e} and above twice its floor {judged.roundoff_floor:.1e}: a solution to "
            f"tol={REFERENCE_MAX_RESIDUAL:.0e} is needed as reference"
        )
    else:
        delta = x - reference
        velocity, *energies = _compute_motion(problem, delta)
        if velocity is None:
            slack_change = problem.csr @ delta
        else:
            assert problem.compliance is not None
            slack_change = problem.jacobian @ velocity + problem.compliance * delta
        values["row"], values["rows"] = _find_index_and_max(np.abs(slack_change))
        if velocity is not None and problem.generalized is not None:
            values["body"], values["speed"] = _find_index_and_max(np.abs(velocity))
        elif velocity is not None:
            bodies = velocity.reshape(-1, 6)
            values["body"], values["speed"] = _find_index_and_max(
                np.linalg.norm(bodies[:, :3], axis=1)
            )
            values["spin_body"], values["spin"] = _find_index_and_max(
                np.linalg.norm(bodies[:, 3:], axis=1)
            )
        if not problem.is_semidefinite:
            asymmetry = f"not symmetric (by {problem.asymmetry:.1e})"
            reason = "not positive semidefinite" if problem.is_symmetric else asymmetry
            notes.append(f"A is {reason}: no energies")
        else:
            values["kinetic"], values["energy"] = energies
            _, *own = _compute_motion(problem, reference)
            size, scale = (x[velocity is None] for x in (energies, own))
            values["relative"] = 0.0 if size == 0.0 else size / scale if scale else math.inf
            if values["relative"] == math.inf and math.isfinite(size):
                notes.append("no relative error, because the constraints cause almost no motion")
                values["relative"] = None
    missing = [
        name for name, value in values.items() if value is not None and not math.isfinite(value)
    ]
    if missing:
        notes.append(f"beyond float64: {', '.join(missing)}")
        values |= dict.fromkeys(missing)
    return MotionError(
        **values,
        reference=reference,
        reference_residual=judged,
        note="; ".join(notes),
        _problem=problem,
    )


def _compute_motion(problem: Problem, impulse: FloatArray) -> tuple[FloatArray | None, Any, float]:
    """Compute dv = M^-1 J^T x (6 n,) or (nv,) [m/s, rad/s] of an impulse x (m,) [N s], and norms [sqrt J].

    The norms are sqrt(1/2 dv.M dv) and sqrt(1/2 x.A x). dv and the first norm are None if M is not known.
    """
    if problem.matrix is not None:
        return None, None, math.sqrt(max(0.5 * float(impulse @ (problem.csr @ impulse)), 0.0))
    velocity = problem.compute_velocity_change(impulse).ravel()
    kinetic = max(0.5 * float((problem.jacobian.T @ impulse) @ velocity), 0.0)
    assert problem.compliance is not None
    elastic = 0.5 * float(np.sum(problem.compliance * impulse * impulse))
    return velocity, math.sqrt(kinetic), math.sqrt(kinetic + elastic)


def _find_index_and_max(x: FloatArray) -> tuple[int, float]:
    """Return (index, value) of the largest number; (-1, 0) if there is none."""
    i = int(np.argmax(x)) if len(x) else -1
    return i, float(x[i]) if len(x) else 0.0
