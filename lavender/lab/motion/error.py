"""How wrong the motion is: distance of an impulse to the solution, in units of motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.lab.motion.bound import difference
from lavender.lab.motion.operator import U
from lavender.lab.motion.reference import Reference, kept
from lavender.problem import Problem

# Motions nearer than this are one, as a share of the constraints' own motion: a residual of 1e-10 moves by up to
# 1e-7 of it on the worst conditioned piles of the suite.
SAME = 1e-6

NUMBERS = (
    "kinetic", "energy", "speed", "spin", "rows", "bound", "bound_speed", "bound_spin", "moved",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
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
    bound: float | None  # sqrt J, `energy` is no more; see lavender.lab.motion.bound
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


def measure(problem: Problem, x: FloatArray, reference: Reference) -> MotionError:
    """The distance of an impulse x (m,) [N s] to one reference; None for what float64 cannot hold, as `note` says."""
    found = told(_measured(problem, x, reference), NUMBERS)
    if found.relative == math.inf:
        words = "relative to next to nothing, as the solution moves no more"
        return replace(found, note="; ".join(n for n in (found.note, words) if n))
    return found


def told(found: MotionError, names: Sequence[str]) -> MotionError:
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


def in_own_rows(problem: Problem, x: FloatArray, found: MotionError) -> MotionError:
    """`rows` and `row` where contacts are ellipses, whose disks the error was measured on; x (m,) [N s] theirs."""
    if found.rows is None:
        return found
    delta = x - found.reference.impulse
    w = (kept(problem.disk).operator.slack(delta)[0] + problem.disk.b) / problem.cones.stretch
    row, rows = _largest(np.abs(w))
    return told(replace(found, row=row, rows=rows), ("rows",))


def _ratio(x: float, reference: float) -> float:
    return 0.0 if x == 0.0 else x / reference if reference > 0.0 and x < math.inf else math.inf


def _largest(x: FloatArray) -> tuple[int, float]:
    if not len(x):
        return -1, 0.0
    i = int(np.argmax(x))
    return i, float(x[i])
