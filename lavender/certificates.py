"""Proofs that a problem has no solution, checked on its own data."""

from __future__ import annotations

import math
from itertools import pairwise, product
from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.problem import Problem

__all__ = ["check_certificate"]

UNIT = 2.0**-53


def check_certificate(problem: Problem, y: Any) -> str | None:
    """Does y (m,) prove that the problem has no solution? None if it does, else the reason it does not.

    y is a direction in which the bounds never end: along free rows, up where there is no upper bound, in the
    cone of a contact (Coulomb: along its normal alone). There w.y >= 0 at every solution, so with z = A^T y

        0 <= w.y = z.lambda - b.y,    and none exists where   b.y > max z.lambda                      (1)

    over all lambda within the bounds, for any A and every law. z_i counts as zero up to
    1e-10 (b.y / |b|.|y|) (|A|^T |y|)_i: with more a solution could exist, but only one with
    |A| |lambda| > 1e10 |b| in the weights |y|, whose floor is above 1e-6. Where rounding of the sums is more than
    that, they are taken exactly.
    """
    with np.errstate(all="ignore"):  # what overflows proves nothing
        y = np.asarray(y, float)
        return _disproof(problem.disk, problem.on_disk(y) if y.shape == (problem.m,) else y)


def _disproof(problem: Problem, y: FloatArray) -> str | None:
    if y.shape != (problem.m,) or not np.isfinite(y).all() or not np.any(y):
        return f"certificate of shape {y.shape} must be {problem.m} finite numbers, not all zero"
    # Only the rows that y takes part in: others may have overflown.
    rows = np.flatnonzero(y)
    vanished = np.intersect1d(rows, problem.vanished_rows)
    if len(vanished):
        return f"products of {problem.row_name(int(vanished[0]))} vanish in float64: its row of A is not zero"
    a = problem.csr[rows]
    # The largest y at 1, or above by what small entries of A lack: so that products with them do not vanish.
    lack = max(0, min(1000, *(-_exponent(x) for x in (a.data, problem.b))))
    y = np.ldexp(y, lack - _exponent(y))
    gain, most = float(problem.b @ y), float(np.abs(problem.b) @ np.abs(y))
    if not gain > 1e-10 * most:
        return f"b.y = {gain:.2e} is not positive"
    outside = _recession_violation(problem, y)
    if outside:
        return outside
    z, size = a.T @ y[rows], abs(a).T @ np.abs(y[rows])
    zero = 1e-10 * (gain / most) * size
    off = (len(rows) + 2.0) * UNIT * size
    if off.max() > 0.5 * zero.max():  # what has rounded may be what b.y needs
        z, off = _exactly(problem, y, rows, size)
    if not np.isfinite(z).all():
        return "A^T y overflows"
    none = np.abs(z) + off <= zero
    z[none], off[none] = 0.0, 0.0
    pull = _pull(problem, z, off, zero)
    if gain - pull.sum() > 1e-10 * (most + np.abs(pull).sum()):
        return None
    return f"A^T y reaches {np.abs(z).max(initial=0.0):.2e}, above rounding; impulses within the bounds can meet b.y"


def _exactly(problem: Problem, y: FloatArray, rows: Any, size: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A^T y and what rounding may have changed in it: what A was formed with, but where J^T y is 0 exactly."""
    if problem.matrix is None and not np.any(_product(problem.jacobian, y)):
        return problem.compliance * y, np.zeros(problem.m)  # type: ignore[operator]
    z = _product(problem.csr[rows], y[rows])
    return z, 2.0 * UNIT * (np.abs(z) if problem.matrix is not None else size)


def _product(a: Any, y: FloatArray) -> FloatArray:
    """A^T y of a CSR matrix (k, m), each sum rounded once: products of halves of 26 bits are exact."""
    columns = a.tocsc()
    halves, power = [], []
    for x in (columns.data, y[columns.indices]):
        part, exponent = np.frexp(x)
        high = np.ldexp(np.round(np.ldexp(part, 26)), -26)
        halves.append((high, part - high))
        power.append(exponent)
    total, out = power[0] + power[1], np.zeros(a.shape[1])
    for i, (start, end) in enumerate(pairwise(columns.indptr.tolist())):
        if start < end:
            top = int(total[start:end].max())
            terms = [
                np.ldexp(p[start:end] * q[start:end], total[start:end] - top) for p, q in product(*halves)
            ]
            out[i] = np.ldexp(math.fsum(np.concatenate(terms)), top)
    return out


def _exponent(x: FloatArray) -> int:
    """Of the power of two above the largest of |x|; 0 for none."""
    return math.frexp(float(np.abs(x).max(initial=0.0)))[1]


def _rims(problem: Problem, x: FloatArray) -> tuple[Any, FloatArray, FloatArray]:
    """Of what one bound holds together: its contact's normal row, the bound over the normal, and |x| of its rows."""
    c = problem.cones
    parts, reach = list(c.parts()), c.reach
    normal = c.ptr[np.array([i for i, _ in parts], int)]
    bound = np.array([reach[part[0]] for _, part in parts])
    return normal, bound, np.array([np.hypot.reduce(x[part]) for _, part in parts])


def _pull(problem: Problem, z: FloatArray, off: FloatArray, zero: FloatArray) -> FloatArray:
    """Largest (z +- off)_i lambda_i (m,) of each row within its bounds; of a contact's together, on its normal."""
    c = problem.cones
    pull = np.full(problem.m, -np.inf)
    for x, bound in ((z - off, c.lower), (z + off, c.upper)):
        pull = np.maximum(pull, np.multiply(x, bound, out=np.zeros(problem.m), where=x != 0.0))
    normal, limit, size = _rims(problem, np.abs(z) + off)
    most, first = z + off, c.normal_rows
    np.add.at(most, normal, limit * size)
    pull[c.contact_rows] = 0.0
    # What pulls along tangents alone is beyond its own zero already; against a normal it may be rounding.
    pull[first] = np.where(most[first] > np.where(z[first] == 0.0, 0.0, zero[first]), np.inf, 0.0)
    return pull


def _recession_violation(problem: Problem, y: FloatArray) -> str | None:
    c = problem.cones
    bad = ((y > 0.0) & np.isfinite(c.upper)) | ((y < 0.0) & np.isfinite(c.lower))
    bad[c.contact_rows] = False
    if bad.any():
        i = int(np.flatnonzero(bad)[0])
        return f"y[{i}] = {y[i]:.2e} leaves the bounds of {problem.row_name(i)}"
    normal, limit, size = _rims(problem, y)
    if problem.law == "coulomb":
        across = normal[size > 0.0]
        if len(across):
            return (
                f"y is not along the normal of {problem.row_name(int(across[0]))}, as Coulomb friction needs"
            )
    first = c.normal_rows
    out = np.concatenate([first[y[first] < 0.0], normal[size > limit * y[normal] * (1 + 1e-12)]])
    if len(out):
        return f"y leaves the cone of {problem.row_name(int(out.min()))}"
    return None
