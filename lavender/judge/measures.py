"""Other measures of an impulse, on request: none of them decides success.

The chapter's natural map, the errors of FCLIB and Siconos, and the optimality of a quadratic program.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lavender.base.arrays import ArrayLike, FloatArray
from lavender.base.errors import InputError
from lavender.problem import Problem

__all__ = ["QPResidual", "natural_map", "qp_residual", "siconos_error"]


def natural_map(problem: Problem, impulse: ArrayLike) -> float:
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


def siconos_error(problem: Problem, impulse: ArrayLike) -> dict[str, float]:
    """The full Coulomb errors of FCLIB and Siconos (Acary, Bremond, Huber 2018), friction blocks without spin.

        |F|_2,  F_i = r_i - P_K(r_i - (u_i + (mu |u_T| + mu_r |u_R|) n))   on contacts, with unit step

    Returns
    -------
    dict
        "absolute" = |F|; "siconos" = |F| / max(|q|, |r|, |u|); "relative" = |F| / |q|;
        "fclib" = |F| / (1 + sqrt(|q|)). Mixes N s and m/s, and depends on the unit of mass.
    """
    lam = problem.impulse_array(impulse)
    u = problem.slack(lam)
    c = problem.cones
    if (c.apart_rows >= 0).any() or c.has_round or c.has_ellipse:
        raise InputError("siconos_error has no spin rows, and no boxes or ellipses: its friction is a disk")
    own: dict[int, list[tuple[slice, float]]] = {}
    reach, contact = c.reach, c.is_contact
    for i, rows in c.parts():
        at = slice(int(rows[0] - c.ptr[i]), int(rows[-1] - c.ptr[i]) + 1)
        own.setdefault(i, []).append((at, float(reach[rows[0]])))
    out = np.empty(problem.m)
    for i in range(c.n_blocks):
        s = slice(c.ptr[i], c.ptr[i + 1])
        if not contact[i]:
            out[s] = lam[s] - np.clip(lam[s] - u[s], c.lower[s], c.upper[s])
            continue
        z, parts = lam[s] - u[s], own.get(i, [])
        z[0] -= sum(a * float(np.linalg.norm(u[s][at])) for at, a in parts)
        out[s] = lam[s] - _project_unit_cone(z, parts)
    total, q, r, v = (float(np.linalg.norm(x)) for x in (out, problem.b, lam, u))
    big = max(q, r, v)
    return {
        "absolute": total,
        "siconos": total / big if big > 0 else total,
        "relative": total / q if q > 0 else total,
        "fclib": total / (1.0 + np.sqrt(q)),
    }


def _project_unit_cone(z: FloatArray, parts: Sequence[tuple[slice, float]]) -> FloatArray:
    # Euclidean projection on {|z_g| <= a_g z_n for every part g}: core/block.pxd (7).
    out, n = z.copy(), max(0.0, float(z[0]))
    size = [float(np.linalg.norm(z[at])) for at, _ in parts]
    for some in range(1, 2 ** len(parts)):
        took = [(t, a) for g, (t, (_, a)) in enumerate(zip(size, parts, strict=True)) if some >> g & 1]
        n = max(n, (z[0] + sum(a * t for t, a in took)) / (1.0 + sum(a * a for _, a in took)))
    out[0] = n
    for t, (at, a) in zip(size, parts, strict=True):
        if t > a * n:
            out[at] *= a * n / t
    return out


@dataclass(frozen=True)
class QPResidual:
    """Optimality of a bounded-row problem as the QP min 1/2 l.A l - b.l, lower <= l <= upper."""

    primal: float  # N s, largest violation of a bound
    dual: float  # m/s, largest |A l - b + z|, z the multiplier of the bounds
    gap: float  # J, |l.A l - b.l + z_upper.upper - z_lower.lower|
    sign: float  # m/s, largest multiplier of the wrong sign, or on a bound that does not exist

    @property
    def worst(self) -> float:
        """The largest of the four numbers [mixes their units]."""
        return max(self.primal, self.dual, self.gap, self.sign)


def qp_residual(problem: Problem, impulse: ArrayLike, multiplier: ArrayLike) -> QPResidual:
    """Primal, dual and gap residuals with multiplier signs checked.

    Parameters
    ----------
    impulse : (m,) N s
    multiplier : (m,) m/s
        z with A l - b + z = 0: positive part for the upper bound, negative for the lower (the sign of
        qpsolvers' `z_box`).
    """
    if problem.law not in ("linear", "lcp"):
        raise InputError(f"qp_residual is for bounded rows; this problem is {problem.law!r}")
    lam = problem.impulse_array(impulse)
    w = problem.slack(lam)
    c = problem.cones
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
