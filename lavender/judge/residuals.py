"""The judge: measure the error of an impulse in physical units, row by row, independently of the solvers.

Let w = A lambda - b, recomputed from the problem's data, and d = diag(A) (`Problem.d`). The error e of a block is the
step that one more projected update would take (w / d strictly inside the bounds; formulas, and the weight nu of a
row's velocity, in `lavender_ext/core/block.pxd`). Then

    energy    E = sqrt(sum d e^2)                    [sqrt J]
    velocity  V = max sqrt(nu d) |e|                 [m/s]
    relative  max(E / E0, V / V0)                    [-]     E0, V0: E, V of the zero impulse, lambda = Pi(0)
    floor     relative residual of the slack error 2^-53 (|A| |lambda| + |b|), which rounding lambda to float64
              causes; no solver can guarantee less than about twice the floor
    success   relative <= tol and floor <= tol

Each island (blocks connected through moving bodies, trees of M or entries of A) has its own E, V, E0 and V0, so bodies
that never meet do not change each other's verdict; the relative residual and the floor belong to the worst island.
E shows errors of heavy bodies, V errors of light bodies. If the zero impulse solves an island, row by row to rounding,
the size of the terms of its active rows replaces E0 and V0 (`lavender_ext/judge/reference.pxd`).

A floor of at least 1e-3 means that rounding hides a thousandth of the zero impulse's error. The relative residual is
then at least the floor, so that a diverged impulse does not count as a solution.

In generalised coordinates w = J x + theta lambda - b with M x = J^T lambda. Solving with the factor of an
ill-conditioned M loses digits of x, which the floor above does not include. If n 2^-53 cond(M) exceeds a tenth of the
tolerance, w is computed again with x refined by residuals in twice the precision of float64. The floor then also
contains the change of w and a bound of the error that remains (`lavender_ext/judge/refine.pxd`).

A solution computed in float32 has a different floor. Each number is rounded independently by up to u = 2^-24 of
itself, so the squares of the errors add up. Entry by entry (A^2 is A o A), with x = M^-1 J^T lambda, w^2 grows by

    lambda rounded         u^2 A^2 lambda^2                                                                        (1)
    a matrix's A and b     u^2 (A^2 lambda^2 + b^2)                                                                (2)
    J and M^-1 of bodies   u^2 (J^2 x^2 + (J M^-1)^2 J^T^2 lambda^2 + J^2 M^-1^2 (J^T lambda)^2) + (b)             (3)
    J and M                u^2 (J^2 x^2 + (J M^-1)^2 (J^T^2 lambda^2 + M^2 x^2)) + (b)                             (4)
                           (b): u^2 (theta^2 lambda^2 + target^2 + 2 J^2 v*^2), as b = target - J v*
    lambda computed of v+  u^2 A^2 (J^2 x^2 + b^2 + theta^2 lambda^2) / theta^2                                    (5)

(5) is included if impulses are computed by lambda = (target - J v+) / theta, as in engines that minimise over
velocities; this is assumed in generalised coordinates if every active row is soft. The floor is the root of
(1) + (2, 3 or 4) + (5), measured by E and V. A matrix that was given in float32 has no rounding (2). Forming A and b
from J and M in float32 causes about as large an error as rounding J and M.

An ellipse is measured as the disk of stretched tangents, `Problem.disk`: the energy is unchanged, and the velocity
along each tangent is weighted by mu_i / max(mu_1, mu_2), its share in the dissipation. e and w are returned for the
rows of the problem, not of the disk.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, cast

import numpy as np

from lavender.base.arrays import (
    ArrayLike,
    FloatArray,
    IntArray,
    check_choice,
    check_float,
    format_html_table,
    mark_read_only,
)
from lavender.base.errors import InputError
from lavender.problem import PRECISIONS, Problem, check_problem
from lavender.problem.derived import cached_property, late_field
from lavender_ext.core.checks import make_instance
from lavender_ext.judge import measure

# [-] A relative residual above this is never attributed to rounding to float64.
MAX_EXCUSED_RESIDUAL = 1e-5
MAX_REST_VELOCITY = (
    1e-9  # [m/s] If V0 is smaller, the zero impulse counts as the problem's solution.
)
UNIT_ROUNDOFF_FLOAT32 = 2.0**-24  # u of float32: half the distance from 1 to the next number.

# at_floor(relative, floor) returns whether rounding explains the residual of one island. Solvers call this kernel, too.
at_floor = measure.is_residual_at_floor

TOL = 1e-6  # [-] Default tolerance of `residual` and `solve`.
# [-] Relative residual of exact impulses, by which motions of engines are judged (`lavender.io.engine_motion`); below
# the rounding of most problems.
EXACT_TOL = 1e-12
MAX_STIFF_RATIO = (
    1e-5  # [-] If R / d of all rows is larger, an engine's forces keep 11 of 16 digits.
)
# [m/s] Default of `threshold`: sensors of robots do not measure smaller velocity errors.
DEFAULT_THRESHOLD = 1e-6
VERDICTS = AT_FLOOR, CLOSE, UNCONVERGED, WRONG = (
    "at its floor",
    "close enough",
    "stopped before convergence",
    "wrong",
)


@dataclass(frozen=True)
class Rounding:
    """Contributions of float32 to the round-off floor, as relative residuals."""

    impulse: float  # Rounding of the impulse, (1) of the module.
    data: float  # Rounding of the problem's data, or of A and b formed from it, (2, 3, 4).
    velocities: (
        float  # Impulses computed from rounded velocities, (5); 0 if an active row is rigid.
    )

    def __str__(self) -> str:
        more = f", velocities {self.velocities:.1e}" if self.velocities else ""
        return f"impulse {self.impulse:.1e}, data {self.data:.1e}{more}"


class Islands(NamedTuple):
    """Errors of n islands: sets of blocks that share no moving body, tree of M or entry of A with other blocks."""

    label: IntArray  # (k,): island of each block.
    relative: FloatArray  # (n,): larger of E / E0 and V / V0.
    energy: FloatArray  # (n,), sqrt J: E.
    velocity: FloatArray  # [m/s] (n,): V.
    # (n,), sqrt J: E0; -1 if the zero impulse solves the island and no row is active: each row is then compared with
    # its own b.
    energy_at_zero: FloatArray
    velocity_at_zero: FloatArray  # [m/s] (n,): V0.


@dataclass(frozen=True, eq=False, repr=False)
class Residual:
    """Error of one impulse. `str()` is one line.

    Parameters
    ----------
    relative : float, -
        Larger of E / E0 and V / V0, maximum over the islands.
    energy, energy_at_zero : float, sqrt J
        E of the impulse and of the zero impulse, over all rows.
    velocity, velocity_at_zero : float, m/s
        V of the impulse (the error of its worst row) and of the zero impulse, over all rows.
    floor : float, -
        Relative residual that rounding to `precision` alone can cause, in the island of `relative`.
    worst_row : int
        Row of the largest velocity error, -1 for an empty problem; `worst_name` is its name.
    above_floor : float, -
        Largest relative residual of the islands with a residual that rounding does not explain; else 0.
    worst_island : int
        Island of `relative` (see `islands`), -1 if all blocks are one island.
    floor_energy : float, sqrt J
        E that rounding to float64 alone can cause, over all rows.
    error : (m,), N s
        e of each row; `velocity_by_row` has the same error in m/s.
    slack : (m,), m/s
        w of each row.
    precision : {"float64", "float32"}
        Precision in which the impulse was computed.
    rounding : Rounding or None
        With float32: contributions to the floor.
    threshold : float, m/s
        Largest velocity error of an answer with the verdict "close enough".
    moved_by : {"impulse", "acceleration"}
        Judged quantity: the impulse, or the acceleration by which an engine moved the bodies. `error` then is the
        difference of its velocities from the exact ones, divided by the weights of `velocity_by_row`.
    lost_digits : float
        Decimal digits that an engine's forces have lost, because R is far below the diagonal of A; else 0.
    acceleration_error : float, m/s
        Velocity error of the engine's acceleration, if forces that have lost digits were judged; else NaN.
    """

    relative: float
    energy: float
    velocity: float
    roundoff_floor: float
    worst_row: int
    energy_at_zero: float
    velocity_at_zero: float
    error: FloatArray = field(repr=False)
    slack: FloatArray = field(repr=False)
    _problem: Problem = field(repr=False)
    _impulse: FloatArray = field(repr=False)
    above_floor: float = 0.0
    worst_island: int = -1
    floor_energy: float = 0.0
    precision: str = "float64"
    rounding: Rounding | None = None
    threshold: float = DEFAULT_THRESHOLD
    moved_by: str = "impulse"
    lost_digits: float = 0.0
    acceleration_error: float = math.nan
    # Relative residual before the refinement for an ill-conditioned M.
    _float64_relative: float = field(default=math.nan, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        self.error  # noqa: B018 - computes the rows, because a raw judge pass cannot be pickled
        return self.__dict__

    @property
    def at_floor(self) -> bool:
        """Whether rounding explains the residual, and the impulse is better than the zero impulse.

        Rounding explains residuals up to twice the floor in float64, where the floor is a sum of absolute values, and
        up to four times the floor in float32. There the floor is a root of a sum of squares in which each rounding
        error has its largest size, sqrt(3) standard deviations, but the maximum over many rows may be larger. In
        float64 the relative residual must also be at most 1e-5. In float32, rounding of the data alone can cause an
        error almost as large as the error of the zero impulse.
        """
        return _is_at_floor(self.relative, self.above_floor, self.precision)

    @property
    def rounds(self) -> bool:
        """Whether rounding explains the residual, even if the impulse is not better than the zero impulse."""
        return _is_explained_by_rounding(self.relative, self.roundoff_floor, self.precision)

    @property
    def verdict(self) -> str:
        """Verdict: "at its floor", "close enough", "stopped before convergence" (see `excess`) or "wrong".

        At its floor: `at_floor` holds. Close enough: `at_floor` does not hold, but no row's velocity error exceeds
        `threshold`. Wrong: the residual is not finite, or at least as large as for the zero impulse. A smaller
        mistake, such as a wrong mu, cannot be distinguished from a stop before convergence.
        """
        return compute_verdict(
            self.relative,
            self.roundoff_floor,
            self.above_floor,
            self.energy,
            self.velocity,
            self.energy_rhs,
            self.nothing_to_do,
            self.precision,
            self.threshold,
        )

    @property
    def verdict_in_words(self) -> str:
        """The verdict, with the factor over the floor if the solve stopped before convergence."""
        verdict = self.verdict
        return (
            f"{verdict}, {self.excess:.2g} times its floor" if verdict == UNCONVERGED else verdict
        )

    @property
    def excess(self) -> float:
        """Relative residual divided by its floor [-]; 0 for an exact answer."""
        if self.relative == 0.0:
            return 0.0
        return self.relative / self.roundoff_floor if self.roundoff_floor > 0.0 else math.inf

    @property
    def nothing_to_do(self) -> bool:
        """Whether the zero impulse is a solution (see `is_solved_by_zero`): read `energy` and `velocity` instead."""
        return is_solved_by_zero(self._problem)

    @property
    def energy_rhs(self) -> float:
        """Energy norm of b [sqrt J]."""
        return float(measure.compute_rhs_energy(self._problem.disk.metric))

    @property
    def worst_name(self) -> str:
        """Name of the worst row, e.g. "contact 3, tangent 1"; empty for an empty problem."""
        return self._problem.row_name(self.worst_row) if self.worst_row >= 0 else ""

    @property
    def velocity_unit(self) -> str:
        """Unit of `velocity`: "m/s", or "rad/s" if the worst row is angular and its error is not converted."""
        return self._problem.row_unit(self.worst_row) if self.worst_row >= 0 else "m/s"

    @property
    def worst_label(self) -> str:
        """`worst_name`, followed by " [rad/s]" if that is the unit of `velocity`: for tables of errors in m/s."""
        return self.worst_name + (" [rad/s]" if self.velocity_unit == "rad/s" else "")

    @property
    def velocity_by_row(self) -> FloatArray:
        """Velocity error sqrt(nu d) |e| of each row (m,) [m/s]; the tangents of a pair are separate."""
        p = self._problem
        return p.disk.metric.weight * np.abs(p.on_disk(self.error))

    @cached_property
    def islands(self) -> Islands:
        """Error of each island, in the order of their first blocks."""
        problem = self._problem.disk
        get_zero_impulse_reference(problem)
        label, table = measure.residuals_by_island(problem.metric, self._impulse, TOL)
        return Islands(label, *table.T)

    def __repr__(self) -> str:
        return f"<Residual {self}>"

    def _repr_html_(self) -> str:
        """Return a small HTML table for notebooks."""
        return format_html_table(self._facts | {"verdict": self.verdict}, "Residual")

    @property
    def _facts(self) -> dict[str, str]:
        """Numbers for the tables of notebooks."""
        return {
            "relative residual": f"{self.relative:.2e}",
            "energy": f"{self.energy:.2e} √J",
            "worst row": f"{self.worst_name}, {self.velocity:.2g} {self.velocity_unit}",
            f"floor of {self.precision}": f"{self.roundoff_floor:.1e}",
        }

    def __str__(self) -> str:
        worst = (
            f", worst {self.worst_name} ({self.velocity:.2g} {self.velocity_unit})"
            if self.worst_row >= 0
            else ""
        )
        text = f"relative {self.relative:.2e}, energy {self.energy:.2e} sqrt(J){worst}, floor {self.roundoff_floor:.1e}"
        if self.moved_by == "acceleration":
            text += "; judged by its acceleration, which moves the bodies"
        if self.lost_digits:
            text += f"; the forces lose {self.lost_digits:.0f} digits"
        if not math.isnan(self.acceleration_error):
            text += (
                f", its acceleration is exact to {self.acceleration_error:.1e} m/s; the step, which uses its forces, "
                "is not"
            )
        if self.rounding is None:
            return text
        return f"{text} of {self.precision} ({self.rounding}): {self.verdict_in_words}"


def _is_explained_by_rounding(relative: float, floor: float, precision: str) -> bool:
    """Compute `Residual.rounds` from numbers."""
    return relative <= (2.0 if precision == "float64" else 4.0) * floor < math.inf


def _is_at_floor(relative: float, above_floor: float, precision: str) -> bool:
    """Compute `Residual.at_floor` from numbers."""
    return above_floor == 0.0 and (precision == "float64" or relative < 1.0)


def compute_verdict(
    relative: float,
    floor: float,
    above_floor: float,
    energy: float,
    velocity: float,
    energy_rhs: float,
    nothing: bool,
    precision: str,
    threshold: float,
) -> str:
    """Compute `Residual.verdict` from numbers.

    `nothing` is true if the zero impulse is a solution; `energy_rhs` [sqrt J] is the energy norm of b.
    """
    if _is_at_floor(relative, above_floor, precision):
        return AT_FLOOR
    if nothing and _is_explained_by_rounding(relative, floor, precision):
        # The reference E0 is rounding noise, so compare with the norm of b, which the error of a diverged impulse
        # exceeds.
        return AT_FLOOR if energy <= energy_rhs else WRONG
    if velocity <= threshold:
        return CLOSE
    return UNCONVERGED if relative < 1.0 else WRONG


def divide_by_reference(data: Any, energy: float, velocity: float, rows: Any = None) -> float:
    """Compute the relative residual of two errors [sqrt J, m/s]; inf if one is not finite or has no reference.

    The references belong to the islands with the given rows (indices), by default of all islands.
    """
    references = data.reference_energy, data.reference_velocity
    if rows is not None:
        references = measure.combine_references(data, np.asarray(rows, np.int32))
    return measure.make_relative_score(energy, velocity, *references)


def get_zero_impulse_reference(problem: Problem) -> tuple[float, float]:
    """Return E0 [sqrt J] and V0 [m/s] over all rows; the references of all islands are computed once per problem."""
    data = problem.metric
    if data.reference_energy < 0.0:
        rows = problem.rows
        general = problem.generalized
        free = None
        if rows is not None:
            free = rows.v_free.ravel()
        elif general is not None:
            free = general.v_free if general.order is None else general.v_free[general.order]
        start = measure.store_zero_impulse_residual(data, free)
        problem.__dict__.setdefault("_start", start)
        if problem.generalized is not None and "csr_data" in problem.__dict__:
            problem.csr_data.share_reference(data)
    return data.reference_energy, data.reference_velocity


def choose_start(problem: Problem, impulse: FloatArray, tol: float) -> FloatArray:
    """Return the start of a solve: an impulse (m,) [N s] within its bounds, or zero in islands that begin there."""
    get_zero_impulse_reference(problem)
    start: FloatArray = measure.BestImpulse(problem.metric, impulse, tol).begin
    return start


def is_solved_by_zero(problem: Problem) -> bool:
    """Return whether the zero impulse solves every island (`lavender_ext/judge/reference.pxd`), or V0 < 1e-9 m/s.

    The relative residual of such a problem compares rounding with rounding, so read its errors in units.
    """
    problem = problem.disk
    get_zero_impulse_reference(problem)
    data = problem.metric
    return bool(data.relative_at_zero < 0.5 or data.reference_velocity < MAX_REST_VELOCITY)


def judge_impulse(problem: Problem, impulse: FloatArray) -> measure.Judged:
    """Judge an impulse (m,) [N s]. The result refers to the array, which must not change afterwards."""
    data = problem.metric
    if data.reference_energy < 0.0:
        get_zero_impulse_reference(problem)
    return measure.Judged(data, impulse)


def combine_best_islands(
    problem: Problem,
    start: FloatArray,
    impulses: Sequence[FloatArray],
    tol: float,
    by_energy: bool = False,
    is_long: bool = False,
) -> FloatArray:
    """Return the best of a start and impulses (m,) [N s] in each island (`lavender_ext/judge/best.pxd`).

    An impulse replaces the start if it solves the island, if its objective is lower (symmetric A, bounded rows or
    cones), or if its energy error is lower (Coulomb's law, asymmetric A, or `by_energy`). The same holds, with
    `is_long`, for the islands that seem to have no solution after a long or failed run that ended at the last impulse.
    """
    get_zero_impulse_reference(problem)
    best = measure.BestImpulse(problem.metric, start, tol, by_energy)
    for impulse in impulses:
        best.store(impulse)
    if is_long and impulses:
        other = combine_best_islands(problem, start, impulses, tol, by_energy=True)
        return cast("FloatArray", best.replace_growing_islands(impulses[-1], other))
    return cast("FloatArray", best.impulse)


def reuse_or_judge_impulse(
    problem: Problem, impulse: FloatArray, judged: measure.Judged | None = None
) -> measure.Judged:
    """Return `judged` if it belongs to this problem and impulse, bit for bit; else judge a copy of the impulse."""
    is_known = judged is not None and judged.data is problem.metric
    if judged is not None and is_known and measure.are_bit_identical(judged.impulse, impulse):
        return judged
    return judge_impulse(problem, impulse.copy())


def find_relative_at_zero(problem: Problem, impulse: FloatArray) -> float | None:
    """Return the known relative residual if `impulse` is the zero impulse, bit for bit; else None."""
    relative: float = problem.metric.relative_at_zero
    return (
        relative if relative >= 0.0 and measure.are_bit_identical(problem._start, impulse) else None
    )


def residual(
    problem: Problem,
    impulse: ArrayLike,
    precision: str | None = None,
    threshold: float = DEFAULT_THRESHOLD,
    tol: float = TOL,
) -> Residual:
    """Measure the error of any impulse (m,) [N s] with the judge that every solve uses.

    Parameters
    ----------
    problem : Problem
    impulse : (m,), N s, Solution, or (Problem, impulse)
        As in `Problem.make_start`. Entries that are not finite are allowed and give an infinite relative residual.
    precision : {"float64", "float32"}, optional
        Precision in which the impulse was computed. It determines the floor and therefore the verdict. Default:
        `problem.precision`. The error itself is always measured in float64.
    threshold : float, default 1e-6, m/s
        Velocity error up to which the verdict is "close enough"; rad/s on angular rows in generalised coordinates.
    tol : float, default 1e-6
        Relative residual that must be computed correctly. It matters only for J and an ill-conditioned M, whose factor
        loses digits: if n 2^-53 cond(M) is above tol / 10, M^-1 J^T impulse is refined in twice that precision.

    Returns
    -------
    Residual

    Raises
    ------
    InputError
        `impulse` has the wrong length or is not numeric, `precision` is unknown, `threshold` or `tol` is negative.

    Examples
    --------
    >>> import numpy as np
    >>> import lavender as lv
    >>> problem = lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, 0.3])
    >>> lv.residual(problem, np.float32([0.5, 0.0]), precision="float32").verdict  # the solution
    'at its floor'
    >>> early = lv.residual(problem, np.float32([0.49, 0.0]), precision="float32")  # 2 % short of it
    >>> early.verdict, early.excess > 1e4
    ('stopped before convergence', True)
    """
    if type(impulse) is np.ndarray:  # The caller may change it before `islands` is read.
        impulse = impulse.copy()
    result = measure_residual(problem, impulse, precision, threshold, tol)
    motion = None if result.at_floor else problem.engine_motion
    if motion is not None and np.array_equal(motion.impulse, result._impulse):
        result = motion.judge(problem, result)
    return result


def measure_residual(
    problem: Problem,
    impulse: Any,
    precision: str | None = None,
    threshold: float = DEFAULT_THRESHOLD,
    tol: float = TOL,
) -> Residual:
    """Return the residual of the impulses themselves, even if an engine moved the bodies by another acceleration."""
    check_problem(problem)
    precision = (
        problem.precision if precision is None else check_choice("precision", precision, PRECISIONS)
    )
    if type(impulse) is not np.ndarray or impulse.dtype != float or not impulse.flags.c_contiguous:
        impulse = problem.make_start(impulse, finite=False)
    if impulse.shape != (problem.m,):
        raise InputError(f"impulse has shape {impulse.shape}; ({problem.m},) is needed")
    if problem.cones.has_ellipse:
        of_disk = measure_residual(
            problem.disk, problem.on_disk(impulse), precision, threshold, tol
        )
        stretch = problem.cones.stretch
        with np.errstate(over="ignore"):
            error = mark_read_only(stretch * of_disk.error)
            slack = mark_read_only(of_disk.slack / stretch)
        return replace(of_disk, error=error, slack=slack, _problem=problem)
    if tol != TOL and not (type(tol) is float and tol >= 0.0):
        tol = check_float("tol", tol, low=0.0)
    judged = judge_impulse(problem, impulse).refine(tol)  # Refined if M is ill-conditioned.
    result = make_residual(problem, judged)
    if type(threshold) is not float or threshold != DEFAULT_THRESHOLD:
        result = replace(result, threshold=check_float("threshold", threshold, low=0.0))
    if precision != "float64":
        result = _apply_float32_floor(problem, result, impulse)
    return result


def replace_error(
    result: Residual, problem: Problem, error: FloatArray, rounding: FloatArray, **fields: Any
) -> Residual:
    """Return a residual with the error (m,) [N s] of an engine's motion and its rounding."""
    get_zero_impulse_reference(problem)
    found, rounds = (
        measure.measure_error(problem.metric, np.ascontiguousarray(e)) for e in (error, rounding)
    )
    energy, velocity, worst, by_island = found
    floors = rounds[-1]
    at = int(np.argmax(by_island))
    limit = MAX_EXCUSED_RESIDUAL if result.precision == "float64" else 1.0
    above = [
        0.0 if _is_explained_by_rounding(x, floor, result.precision) and x <= limit else x
        for x, floor in zip(by_island, floors, strict=True)
    ]
    return replace(
        result,
        relative=by_island[at],
        energy=energy,
        velocity=velocity,
        roundoff_floor=floors[at],
        worst_row=worst,
        error=mark_read_only(error),
        worst_island=-1,
        above_floor=max(above),
        moved_by="acceleration",
        **fields,
    )


def _apply_float32_floor(problem: Problem, result: Residual, impulse: FloatArray) -> Residual:
    """Replace the floor of a residual by the floor of float32."""
    # For an impulse that is not finite, the floor is not finite.
    with np.errstate(over="ignore", invalid="ignore"):
        of_impulse, of_data, of_velocities = estimate_float32_slack_errors(problem, impulse)
        relative = (
            [result.relative] if result.worst_island < 0 else result.islands.relative.tolist()
        )
        squares = of_impulse, of_data, of_velocities, of_impulse + of_data + of_velocities
    floors = [measure.relative_size_by_island(problem.metric, x) for x in squares]
    *contributions, floor = (x[max(result.worst_island, 0)] for x in floors)
    is_rounding = [
        _is_explained_by_rounding(x, island_floor, "float32") and x < 1.0
        for x, island_floor in zip(relative, floors[-1], strict=True)
    ]
    above = max(
        (x for x, rounds in zip(relative, is_rounding, strict=True) if not rounds), default=0.0
    )
    rounding = Rounding(*contributions)
    return replace(
        result, precision="float32", roundoff_floor=floor, above_floor=above, rounding=rounding
    )


def estimate_float32_slack_errors(
    problem: Problem, impulse: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the squared changes of w (m,) [m^2/s^2] by float32: terms (1), (2, 3 or 4) and (5) of the module."""
    general = problem.generalized
    if general is not None:
        free = general.v_free if general.order is None else general.v_free[general.order]
        of_impulse, of_data, of_velocities = measure.squared_float32_rounding(
            problem.metric, general.operator.mass, free, impulse
        )
        return of_impulse, of_data, of_velocities
    unit = UNIT_ROUNDOFF_FLOAT32 * UNIT_ROUNDOFF_FLOAT32
    zeros = np.zeros(problem.m)
    a = _square_entries(problem.csr)
    b = problem.b**2
    lam = impulse**2
    of_impulse = a @ lam
    if problem.matrix is not None:
        of_data = zeros if problem.precision == "float32" else unit * (of_impulse + b)
        return unit * of_impulse, of_data, zeros
    jac, compliance, rows = problem.jacobian, problem.compliance, problem.rows
    assert compliance is not None
    assert rows is not None
    inverse = rows.inverse_mass_matrix()
    x = inverse @ (jac.T @ impulse)
    free = rows.v_free.ravel()
    of_inverse = _square_entries(jac @ inverse) @ (_square_entries(jac.T) @ lam)
    of_inverse += _square_entries(jac) @ (_square_entries(inverse) @ (jac.T @ impulse) ** 2)
    of_rhs = (problem.b + jac @ free) ** 2 + 2.0 * (_square_entries(jac) @ free**2)
    of_data = _square_entries(jac) @ x**2 + of_inverse + compliance**2 * lam + of_rhs
    return unit * of_impulse, unit * of_data, zeros


def _square_entries(a: Any) -> Any:
    """Square every entry of a sparse matrix."""
    return a.multiply(a).tocsr()


def make_residual(problem: Problem, judgement: measure.Judged) -> Residual:
    """Build a `Residual` from a raw judge pass."""
    return make_instance(Residual, measure.list_residual_fields(judgement, problem, _read_rows))


def _read_rows(judgement: measure.Judged) -> dict[str, FloatArray]:
    """Return the fields of a `Residual` that have one number for each row."""
    return {"error": mark_read_only(judgement.error), "slack": mark_read_only(judgement.slack)}


LATE_FIELDS = "error slack _problem _impulse worst_island floor_energy rounding _float64_relative"
for _name in LATE_FIELDS.split():
    setattr(Residual, _name, late_field(_name))
