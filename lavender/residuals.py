"""The one judge: how wrong an impulse is, in units, row by row. No solver decides success.

With w = A lambda - b recomputed from the problem's data, d = diag(A) (`Problem.d`), e the error of a
block (an inactive row: w / d, the step that is missing; formulas in `lavender_ext/core/block.pxd`):

    energy    E = sqrt(sum d e^2)                    [sqrt J]
    velocity  V = max sqrt(nu d) |e|                 [m/s]
    relative  max(E / E0, V / V0)                    [-]     E0, V0: E, V of doing nothing, lambda = Pi(0)
    floor     2^-53 (|A| |lambda| + |b|) put through the same two norms: what rounding lambda to
              float64 costs; no solver can promise less than about twice that
    success   relative <= tol

Where doing nothing already solves the problem to rounding (E0 <= 2^-48 of the energy norm of b), the
norms of b stand in for E0 and V0. E sees heavy bodies, V sees light ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lavender._arrays import ArrayLike, FloatArray, read_only
from lavender.errors import InputError
from lavender.problem import Problem
from lavender_ext.judge import measure

__all__ = ["Residual", "nothing_to_do", "residual"]

AT_REST = 1e-9  # m/s, V0 below which nobody could tell doing nothing from a solution


@dataclass(frozen=True)
class Residual:
    """Error of one impulse. `str()` is one line."""

    relative: float  # -, max(energy / energy_start, velocity / velocity_start)
    energy: float  # sqrt J
    velocity: float  # m/s, of the worst row
    floor: float  # -, relative residual that float64 alone costs
    worst_row: int  # row of the largest velocity error, -1 for an empty problem
    energy_start: float  # sqrt J, E of doing nothing (or the norm of b)
    velocity_start: float  # m/s
    error: FloatArray = field(repr=False)  # (m,) N s, e
    slack: FloatArray = field(repr=False)  # (m,) m/s, w
    _problem: Problem = field(repr=False)

    @property
    def at_floor(self) -> bool:
        """Within twice what float64 allows, and no worse than doing nothing."""
        return at_floor(self.relative, self.floor)

    @property
    def nothing_to_do(self) -> bool:
        """Doing nothing is right (see `nothing_to_do`): neither solved nor failed, read `energy` and `velocity`."""
        return nothing_to_do(self._problem)

    @property
    def worst_name(self) -> str:
        """Name of the worst row, e.g. "contact 3, tangent 1"; empty for an empty problem."""
        return self._problem.row_name(self.worst_row) if self.worst_row >= 0 else ""

    @property
    def velocity_by_row(self) -> FloatArray:
        """sqrt(nu d) |e| (m,) [m/s]; each tangent of a pair alone."""
        return self._problem.metric.weight * np.abs(self.error)

    def __str__(self) -> str:
        worst = f", worst {self.worst_name} {self.velocity:.2g} m/s" if self.worst_row >= 0 else ""
        return (
            f"relative {self.relative:.2e}, energy {self.energy:.2e} sqrt(J){worst}, floor {self.floor:.1e}"
        )


def at_floor(relative: float, floor: float) -> bool:
    """Whether a relative residual is within twice its floor, both finite, and better than doing nothing.

    Above 1 the floor is that of an impulse that ran away: it says nothing of the problem.
    """
    return relative <= 2.0 * floor < math.inf and relative < 1.0


def relative_of(data: Any, energy: float, velocity: float) -> float:
    """The relative residual of two errors [sqrt J, m/s]; inf where one is not finite, or has no reference."""
    return measure.compare(energy, velocity, data.start_energy, data.start_velocity)


def reference(problem: Problem) -> tuple[float, float]:
    """E0 [sqrt J] and V0 [m/s]; computed once per problem."""
    data = problem.metric
    if data.start_energy < 0.0:
        start = measure.begin(data, len(data.empty) > 0 and len(problem.vanished_rows) > 0)
        problem.__dict__.setdefault("_start", start)
        if problem.generalized is not None and "csr_data" in problem.__dict__:
            problem.csr_data.set_start(data.start_energy, data.start_velocity)
    return data.start_energy, data.start_velocity


def nothing_to_do(problem: Problem) -> bool:
    """Whether doing nothing is right: E0 <= 2^-48 of the energy norm of b, or V0 < 1e-9 m/s.

    Such a problem is neither solved nor failed by anybody. Relative to nothing, rounding is everything: a residual of
    it means something in units alone.
    """
    kept = problem.derived
    if kept.nothing is None:
        m = problem.m
        energy, velocity, *_ = measure.judge(problem.metric, problem._start, np.empty(m), np.empty(m), False)
        kept.nothing = bool(energy <= 2.0**-48 * measure.rhs_norms(problem.metric)[0] or velocity < AT_REST)
    return kept.nothing


def judged(problem: Problem, impulse: FloatArray) -> measure.Judged:
    """The judge's pass over an impulse (m,) [N s], which is kept as it is: it must not change any more."""
    data = problem.metric
    if data.start_energy < 0.0:
        reference(problem)
    return measure.Judged(data, impulse)


def remember(problem: Problem, last: measure.Judged) -> None:
    """Leave a result for the next `residual` of this problem, which takes it for the same impulse, bit for bit."""
    problem.derived.judged = last


def known(problem: Problem, impulse: FloatArray) -> float | None:
    """Relative residual of doing nothing, or of what `remember` was given, where `impulse` is that, bit for bit."""
    last = problem.derived.judged
    if last is not None and measure.same_bits(last.impulse, impulse):
        return float(last.relative)
    start: float = problem.metric.start_relative
    return start if start >= 0.0 and measure.same_bits(problem._start, impulse) else None


def quick(
    problem: Problem, impulse: FloatArray, w: FloatArray, e: FloatArray, floor: bool = False
) -> tuple[float, float]:
    """(relative, floor) with w, e as scratch (m,): the solvers' own stopping test, the judge's arithmetic."""
    reference(problem)
    data = problem.metric
    energy, velocity, _, floor_energy, floor_velocity, finite = measure.judge(data, impulse, w, e, floor)
    if not finite:
        return np.inf, 0.0
    return relative_of(data, energy, velocity), relative_of(data, floor_energy, floor_velocity)


def residual(problem: Problem, impulse: ArrayLike) -> Residual:
    """Judge an impulse (m,) [N s].

    Non-finite entries are allowed here and give an infinite relative residual.

    Raises
    ------
    InputError
        `impulse` has the wrong length or holds no numbers.
    """
    try:
        if type(impulse) is not np.ndarray or impulse.dtype != float or not impulse.flags.c_contiguous:
            impulse = np.ascontiguousarray(impulse, float)
    except (TypeError, ValueError) as error:
        raise InputError(f"impulse is not an array of numbers ({error})") from None
    if impulse.shape != (problem.m,):
        raise InputError(f"impulse has shape {impulse.shape}; ({problem.m},) is needed")
    last, problem.derived.judged = problem.derived.judged, None
    if last is None or last.data is not problem.metric or not measure.same_bits(last.impulse, impulse):
        last = judged(problem, impulse)
    return told(problem, last)


def told(problem: Problem, last: measure.Judged) -> Residual:
    """What the judge found, with its names and units."""
    made: Residual = object.__new__(Residual)
    state = {
        "relative": last.relative,
        "energy": last.energy,
        "velocity": last.velocity,
        "floor": last.floor,
        "worst_row": last.worst,
        "energy_start": problem.metric.start_energy,
        "velocity_start": problem.metric.start_velocity,
        "error": read_only(last.error),
        "slack": read_only(last.slack),
        "_problem": problem,
    }
    object.__setattr__(made, "__dict__", state)  # a quarter of the time of a frozen dataclass's __init__
    return made
