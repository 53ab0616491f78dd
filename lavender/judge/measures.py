"""Error measures from the literature, for comparison with other codes. They do not affect `Solution.success`.

They are the natural map, the errors of FCLIB and Siconos, and the optimality conditions of a quadratic program.
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
    """Compute the natural map r_p = |lambda - Pi(lambda - w)|_2 of a problem of bounded rows.

    Parameters
    ----------
    problem : Problem
    impulse : (m,), N s

    Returns
    -------
    float
        r_p; the sum adds squares of N s and m/s.

    Raises
    ------
    InputError
        The problem has friction, for which Pi depends on a metric: use `residual` or `siconos_error`.
    """
    if problem.law not in ("linear", "lcp"):
        raise InputError(
            f"natural_map measures problems of bounded rows, and this problem has the law {problem.law!r}: "
            "use residual or siconos_error"
        )
    lam = problem.impulse_array(impulse)
    w = problem.slack(lam)
    cones = problem.cones
    # Compute lambda - clip(lambda - w). Strictly inside the bounds this is w; computing the difference would lose
    # digits.
    step_end = lam - w
    error = np.where(step_end > cones.upper, lam - cones.upper, w)
    return float(np.linalg.norm(np.where(step_end < cones.lower, lam - cones.lower, error)))


def siconos_error(problem: Problem, impulse: ArrayLike) -> dict[str, float]:
    """Compute the errors of FCLIB and Siconos for Coulomb friction (Acary, Bremond, Huber 2018), without spin rows.

        |F|_2,  F_i = r_i - P_K(r_i - (u_i + (mu |u_T| + mu_r |u_R|) n))   on contacts, with unit step

    Parameters
    ----------
    problem : Problem
    impulse : (m,), N s

    Returns
    -------
    dict
        "absolute" = |F|; "siconos" = |F| / max(|q|, |r|, |u|); "relative" = |F| / |q|;
        "fclib" = |F| / (1 + sqrt(|q|)). The numbers mix N s and m/s, and depend on the unit of mass.

    Raises
    ------
    InputError
        The problem has spin rows, boxes or ellipses.
    """
    lam = problem.impulse_array(impulse)
    u = problem.slack(lam)
    c = problem.cones
    if (c.separate_rows >= 0).any() or c.has_round or c.has_ellipse:
        raise InputError(
            "siconos_error is defined for disks only, and this problem has spin rows, boxes or ellipses: "
            "use residual"
        )
    components_of: dict[int, list[tuple[slice, float]]] = {}
    coefficient, is_contact = c.friction_coefficient, c.is_contact
    for block, rows in c.friction_components():
        in_block = slice(int(rows[0] - c.ptr[block]), int(rows[-1] - c.ptr[block]) + 1)
        components_of.setdefault(block, []).append((in_block, float(coefficient[rows[0]])))
    error = np.empty(problem.m)
    for block in range(c.n_blocks):
        s = slice(c.ptr[block], c.ptr[block + 1])
        if not is_contact[block]:
            error[s] = lam[s] - np.clip(lam[s] - u[s], c.lower[s], c.upper[s])
            continue
        z, components = lam[s] - u[s], components_of.get(block, [])
        z[0] -= sum(mu * float(np.linalg.norm(u[s][in_block])) for in_block, mu in components)
        error[s] = lam[s] - _project_unit_cone(z, components)
    absolute, q, r, v = (float(np.linalg.norm(x)) for x in (error, problem.b, lam, u))
    scale = max(q, r, v)
    return {
        "absolute": absolute,
        "siconos": absolute / scale if scale > 0 else absolute,
        "relative": absolute / q if q > 0 else absolute,
        "fclib": absolute / (1.0 + np.sqrt(q)),
    }


def _project_unit_cone(z: FloatArray, components: Sequence[tuple[slice, float]]) -> FloatArray:
    """Project z on {|z_g| <= a_g z_n for every component g} in the Euclidean norm, by (7) of `core/block.pxd`."""
    out, normal = z.copy(), max(0.0, float(z[0]))
    size = [float(np.linalg.norm(z[rows])) for rows, _ in components]
    for subset in range(1, 2 ** len(components)):
        sliding = [
            (t, a) for g, (t, (_, a)) in enumerate(zip(size, components, strict=True)) if subset >> g & 1
        ]
        normal = max(normal, (z[0] + sum(a * t for t, a in sliding)) / (1.0 + sum(a * a for _, a in sliding)))
    out[0] = normal
    for t, (rows, a) in zip(size, components, strict=True):
        if t > a * normal:
            out[rows] *= a * normal / t
    return out


@dataclass(frozen=True)
class QPResidual:
    """Optimality of a bounded-row problem as the QP min 1/2 l.A l - b.l, lower <= l <= upper.

    Parameters
    ----------
    primal : float, N s
        Largest violation of a bound.
    dual : float, m/s
        Largest |A l - b + z|, with z the multiplier of the bounds.
    gap : float, J
        |l.A l - b.l + z_upper.upper - z_lower.lower|.
    sign : float, m/s
        Largest multiplier of the wrong sign, or of a bound that does not exist.
    """

    primal: float
    dual: float
    gap: float
    sign: float

    @property
    def worst(self) -> float:
        """Largest of the four numbers, although their units differ."""
        return max(self.primal, self.dual, self.gap, self.sign)


def qp_residual(problem: Problem, impulse: ArrayLike, multiplier: ArrayLike) -> QPResidual:
    """Compute primal, dual and gap residuals of a bounded-row problem, and check the signs of multipliers.

    Parameters
    ----------
    problem : Problem
    impulse : (m,), N s
    multiplier : (m,), m/s
        z with A l - b + z = 0: positive part for the upper bound, negative for the lower (the sign of
        qpsolvers' `z_box`).

    Returns
    -------
    QPResidual

    Raises
    ------
    InputError
        The problem has friction.
    """
    if problem.law not in ("linear", "lcp"):
        raise InputError(
            f"qp_residual measures problems of bounded rows, and this problem has the law {problem.law!r}: "
            "use residual"
        )
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
