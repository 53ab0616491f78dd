"""Proofs that a problem has no solution, checked on its own data."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.cones import CONTACT_SPIN, ROW
from lavender.problem import Problem

__all__ = ["check_certificate"]


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
