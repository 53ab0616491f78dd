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

from lavender._arrays import FloatArray, read_only
from lavender.cones import CONTACT_SPIN, ROW
from lavender.errors import InputError
from lavender.problem import Problem
from lavender_ext.judge import measure

__all__ = ["Residual", "check_certificate", "natural_map", "qp_residual", "residual", "siconos_error"]


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
        """Within twice what float64 allows; a floor that is not finite allows nothing."""
        return at_floor(self.relative, self.floor)

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
    """Whether a relative residual is within twice its floor, both finite."""
    return relative <= 2.0 * floor < math.inf


def _ratio(x: float, reference: float) -> float:
    if x == 0.0:
        return 0.0
    if not math.isfinite(x):
        return math.inf
    return x / reference if reference > 0.0 else np.inf


def _relative(data: Any, energy: float, velocity: float) -> float:
    return max(_ratio(energy, data.start_energy), _ratio(velocity, data.start_velocity))


def reference(problem: Problem) -> tuple[float, float]:
    """E0 [sqrt J] and V0 [m/s]; computed once per problem."""
    data = problem.metric
    if data.start_energy < 0.0:
        m = problem.m
        w, e = np.empty(m), np.empty(m)
        if problem._start.any():
            energy, velocity, *_ = own = measure.judge(data, problem._start, w, e, False)
        else:  # the same numbers without a pass over A
            energy, velocity, *_ = own = measure.score(data, problem._start, np.negative(problem.b, out=w), e)
        # The norms of b: sqrt(sum b^2 / d), max |b| sqrt(nu / d), |b| the pair's norm on tangents.
        rhs_energy, rhs_velocity = measure.rhs_norms(data)
        if energy <= 2.0**-48 * rhs_energy:
            energy, velocity = rhs_energy, rhs_velocity
        # A size that overflows measures nothing: 0 makes every error beside it infinite.
        data.set_start(energy if energy < np.inf else 0.0, velocity if velocity < np.inf else 0.0)
        problem.derived.start_relative = _relative(data, *own[:2])
        if problem.generalized is not None and "csr_data" in problem.__dict__:
            problem.csr_data.set_start(data.start_energy, data.start_velocity)
    return data.start_energy, data.start_velocity


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
    start = problem.derived.start_relative
    return start if start is not None and measure.same_bits(problem._start, impulse) else None


def quick(
    problem: Problem, impulse: FloatArray, w: FloatArray, e: FloatArray, floor: bool = False
) -> tuple[float, float]:
    """(relative, floor) with w, e as scratch (m,): the solvers' own stopping test, the judge's arithmetic."""
    start_energy, start_velocity = reference(problem)
    energy, velocity, _, floor_energy, floor_velocity, finite = measure.judge(
        problem.metric, impulse, w, e, floor
    )
    if not finite:
        return np.inf, 0.0
    return (
        max(_ratio(energy, start_energy), _ratio(velocity, start_velocity)),
        max(_ratio(floor_energy, start_energy), _ratio(floor_velocity, start_velocity)),
    )


def residual(problem: Problem, impulse: Any) -> Residual:
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
    if last is None or last.data is not problem.data or not measure.same_bits(last.impulse, impulse):
        last = judged(problem, impulse)
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


# -- other measures, on request ------------------------------------------------------------------


def natural_map(problem: Problem, impulse: Any) -> float:
    """The chapter's plain r_p = |lambda - Pi(lambda - w)|_2, bounded rows only [mixes N s and m/s].

    Raises
    ------
    InputError
        The problem has friction, where Pi needs a metric: use `residual` or `siconos_error`.
    """
    if problem.law not in ("linear", "lcp"):
        raise InputError(
            f"natural_map is for bounded rows; this problem is {problem.law!r}: use residual or siconos_error"
        )
    lam = problem.impulse_array(impulse)
    w = problem.slack(lam)
    c = problem.cones
    # lambda - clip(lambda - w), written so that an inactive row keeps its digits.
    y = lam - w
    return float(
        np.linalg.norm(np.where(y < c.lower, lam - c.lower, np.where(y > c.upper, lam - c.upper, w)))
    )


def siconos_error(problem: Problem, impulse: Any) -> dict[str, float]:
    """The full Coulomb errors of FCLIB and Siconos (Acary, Bremond, Huber 2018), friction blocks without spin.

        |F|_2,  F_i = r_i - P_K(r_i - (u_i + mu |u_T| n))   on contacts, with unit step

    Returns
    -------
    dict
        "absolute" = |F|; "siconos" = |F| / max(|q|, |r|, |u|); "relative" = |F| / |q|;
        "fclib" = |F| / (1 + sqrt(|q|)). Mixes N s and m/s, and depends on the unit of mass.
    """
    lam = problem.impulse_array(impulse)
    u = problem.slack(lam)
    c = problem.cones
    out = np.empty(problem.m)
    for i in range(c.n_blocks):
        s = slice(c.ptr[i], c.ptr[i + 1])
        if c.kind[i] == ROW:
            out[s] = lam[s] - np.clip(lam[s] - u[s], c.lower[s], c.upper[s])
            continue
        if c.kind[i] != 1:
            raise InputError("siconos_error has no spin rows")
        z = lam[s] - u[s]
        z[0] -= c.mu[i] * np.linalg.norm(u[s][1:])
        out[s] = lam[s] - _project_unit_cone(z, float(c.mu[i]))
    total, q, r, v = (float(np.linalg.norm(x)) for x in (out, problem.b, lam, u))
    big = max(q, r, v)
    return {
        "absolute": total,
        "siconos": total / big if big > 0 else total,
        "relative": total / q if q > 0 else total,
        "fclib": total / (1.0 + np.sqrt(q)),
    }


def _project_unit_cone(z: FloatArray, mu: float) -> FloatArray:
    # Euclidean projection on {|z_t| <= mu z_n}.
    t = float(np.linalg.norm(z[1:]))
    if t <= mu * z[0]:
        return z
    if mu * t <= -z[0]:
        return np.zeros_like(z)
    n = (z[0] + mu * t) / (1.0 + mu * mu)
    return np.concatenate([[n], (mu * n / t) * z[1:]])


@dataclass(frozen=True)
class QPResidual:
    """Optimality of a bounded-row problem as the QP min 1/2 l.A l - b.l, lower <= l <= upper."""

    primal: float  # N s, largest violation of a bound
    dual: float  # m/s, largest |A l - b + z|, z the multiplier of the bounds
    gap: float  # J, |l.A l - b.l + z_upper.upper - z_lower.lower|
    sign: float  # m/s, largest multiplier of the wrong sign, or on a bound that does not exist

    @property
    def worst(self) -> float:
        return max(self.primal, self.dual, self.gap, self.sign)


def qp_residual(problem: Problem, impulse: Any, multiplier: Any = None) -> QPResidual:
    """Primal, dual and gap residuals with multiplier signs checked.

    Parameters
    ----------
    impulse : (m,) N s
    multiplier : (m,) m/s, optional
        z with A l - b + z = 0: positive part for the upper bound, negative for the lower (the sign of
        qpsolvers' `z_box`). Default: the slack, z = -(A l - b), where the bound is within 1e-9 of its
        range or of |l|.
    """
    if problem.law not in ("linear", "lcp"):
        raise InputError(f"qp_residual is for bounded rows; this problem is {problem.law!r}")
    lam = problem.impulse_array(impulse)
    w = problem.slack(lam)
    c = problem.cones
    scale = np.maximum(np.abs(lam).max(initial=0.0), 1e-300)
    if multiplier is None:
        at_low = lam - c.lower <= 1e-9 * scale
        at_high = c.upper - lam <= 1e-9 * scale
        z = np.where(at_low, np.minimum(-w, 0.0), 0.0) + np.where(at_high, np.maximum(-w, 0.0), 0.0)
    else:
        z = problem.impulse_array(multiplier, "multiplier")
    up, down = np.maximum(z, 0.0), np.maximum(-z, 0.0)
    bound = up @ np.where(np.isfinite(c.upper), c.upper, 0.0) - down @ np.where(
        np.isfinite(c.lower), c.lower, 0.0
    )
    wrong = np.where(np.isfinite(c.upper), 0.0, up) + np.where(np.isfinite(c.lower), 0.0, down)
    primal = np.maximum(np.maximum(c.lower - lam, lam - c.upper), 0.0)
    return QPResidual(
        float(primal.max(initial=0.0)),
        float(np.abs(w + z).max(initial=0.0)),
        float(abs(lam @ w + bound)),
        float(wrong.max(initial=0.0)),
    )


def check_certificate(problem: Problem, y: Any) -> str | None:
    """Does y (m,) prove that the problem has no solution? None if it does, else the reason it does not.

    y is a direction in which the bounds never end: along free rows, up where there is no upper bound, in the
    cone of a contact (Coulomb: along its normal alone). There w.y >= 0 at every solution, so with z = A^T y

        0 <= w.y = z.lambda - b.y,    and none exists where   b.y > max z.lambda                      (1)

    over all lambda within the bounds, for any A and every law. z_i counts as zero up to
    1e-10 (b.y / |b|.|y|) (|A|^T |y|)_i: with more a solution could exist, but only one with
    |A| |lambda| > 1e10 |b| in the weights |y|, whose floor is above 1e-6.
    """
    with np.errstate(all="ignore"):  # what overflows proves nothing
        return _disproof(problem, np.asarray(y, float))


def _disproof(problem: Problem, y: FloatArray) -> str | None:
    if y.shape != (problem.m,) or not np.isfinite(y).all() or not np.any(y):
        return f"certificate of shape {y.shape} must be {problem.m} finite numbers, not all zero"
    gain, most = float(problem.b @ y), float(np.abs(problem.b) @ np.abs(y))
    if not gain > 1e-10 * most:
        return f"b.y = {gain:.2e} is not positive"
    outside = _recession_violation(problem, y)
    if outside:
        return outside
    # Only the rows that y takes part in: others may have overflown.
    rows = np.flatnonzero(y)
    a = problem.csr[rows]
    z, zero = a.T @ y[rows], 1e-10 * (gain / most) * (abs(a).T @ np.abs(y[rows]))
    z[np.abs(z) <= zero] = 0.0
    pull = _pull(problem, z, zero)
    if gain - pull.sum() > 1e-10 * (most + np.abs(pull).sum()):
        return None
    return f"A^T y reaches {np.abs(z).max(initial=0.0):.2e}, above rounding; impulses within the bounds can meet b.y"


def _pull(problem: Problem, z: FloatArray, zero: FloatArray) -> FloatArray:
    """Largest z_i lambda_i (m,) of each row within its bounds; of a contact's together, on its normal."""
    c = problem.cones
    bound = np.where(z > 0.0, c.upper, c.lower)
    pull = np.zeros(problem.m)
    np.multiply(z, bound, out=pull, where=z != 0.0)
    for i in np.flatnonzero(c.kind != ROW):
        j, end, nt = c.ptr[i], c.ptr[i + 1], int(c.n_tangents[i])
        rim = float(np.linalg.norm(z[j + 1 : j + 1 + nt]))
        if c.kind[i] == CONTACT_SPIN:
            rim += c.patch_radius[i] * abs(z[end - 1])
        pull[j:end] = 0.0
        pull[j] = np.inf if z[j] + c.mu[i] * rim > zero[j] else 0.0
    return pull


def _recession_violation(problem: Problem, y: FloatArray) -> str | None:
    c = problem.cones
    bad = ((y > 0.0) & np.isfinite(c.upper)) | ((y < 0.0) & np.isfinite(c.lower))
    contact_rows = np.repeat(c.kind != ROW, np.diff(c.ptr))
    bad[contact_rows] = False
    if bad.any():
        i = int(np.flatnonzero(bad)[0])
        return f"y[{i}] = {y[i]:.2e} leaves the bounds of {problem.row_name(i)}"
    for k in np.flatnonzero(c.kind != ROW):
        part = y[c.ptr[k] : c.ptr[k + 1]]
        nt = int(c.n_tangents[k])
        limit = c.mu[k] * part[0] * (1 + 1e-12)
        spin = abs(part[-1]) if c.kind[k] == CONTACT_SPIN else 0.0
        if problem.law == "coulomb" and part[1:].any():
            return (
                f"y is not along the normal of {problem.row_name(int(c.ptr[k]))}, as Coulomb friction needs"
            )
        if part[0] < 0.0 or np.linalg.norm(part[1 : 1 + nt]) > limit or spin > limit * c.patch_radius[k]:
            return f"y leaves the cone of {problem.row_name(int(c.ptr[k]))}"
    return None
