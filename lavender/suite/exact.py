"""Solutions to beyond float64, for references: about 100 bits, whatever the machine.

Numbers are unevaluated sums of two float64, hi + lo. Products are split exactly (Dekker 1971) and rows
are summed without rounding (`math.fsum`), so a residual is right to about 2^-100 of its terms, and a few steps
of refinement with a float64 factorisation give impulses that are right to the last bit of float64 up to
condition numbers near 1e15.

A candidate from anywhere fixes which rows are free; those rows are solved, and every condition is then
checked. What passes is a solution whoever proposed it.
"""

from __future__ import annotations

from collections.abc import Callable
from math import fsum

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from lavender._arrays import FloatArray
from lavender.errors import InputError
from lavender.problem import Problem

__all__ = ["Wide", "solve_boxed", "solve_linear"]

SPLIT = 2.0**27 + 1.0
DENSE_ROWS = 1500  # up to here singular rows are found by a singular value decomposition
MAX_STEPS = 40

Pair = tuple[FloatArray, FloatArray]


def _split(x: FloatArray) -> Pair:
    # 53 bits into 26 + 26 (Veltkamp); |x| below 2^996.
    t = SPLIT * x
    high = t - (t - x)
    return high, x - high


def _product(x: FloatArray, y: FloatArray) -> Pair:
    """x y = p + e, exactly, barring underflow."""
    p = x * y
    (xh, xl), (yh, yl) = _split(x), _split(y)
    return p, ((xh * yh - p) + xh * yl + xl * yh) + xl * yl


def _matvec(a: sp.csr_array, x: Pair, *added: FloatArray) -> Pair:
    """A x plus vectors, each row summed without rounding; the result as hi + lo."""
    hi, lo = (part[a.indices] for part in x)
    p, e = _product(a.data, hi)
    terms = np.stack([p, e, a.data * lo], axis=1).ravel().tolist()
    more = np.stack(added, axis=1).tolist() if added else [[] for _ in range(a.shape[0])]
    ends = (3 * a.indptr).tolist()
    out_hi, out_lo = np.empty(a.shape[0]), np.empty(a.shape[0])
    for i in range(a.shape[0]):
        row = terms[ends[i] : ends[i + 1]] + more[i]
        out_hi[i] = s = fsum(row)
        out_lo[i] = fsum([*row, -s])
    return out_hi, out_lo


class Wide:
    """w = A lambda - b of a problem in about 100 bits: A as given, or J M^-1 J^T + compliance unrounded."""

    def __init__(self, problem: Problem) -> None:
        self.b = problem.b
        if problem.rows is None:
            self.parts = [problem.csr]
            self.compliance = np.zeros(problem.m)
        else:
            jac = problem.jacobian
            self.parts = [sp.csr_array(jac.T), problem.rows.inverse_mass_matrix().tocsr(), jac]
            assert problem.compliance is not None
            self.compliance = problem.compliance

    def slack(self, hi: FloatArray, lo: FloatArray | None = None) -> FloatArray:
        """w (m,) [m/s] of the impulse hi + lo."""
        lam = (hi, np.zeros_like(hi) if lo is None else lo)
        y = lam
        for part in self.parts[:-1]:
            y = _matvec(part, y)
        soft = _product(self.compliance, lam[0])
        return _matvec(self.parts[-1], y, -self.b, *soft, self.compliance * lam[1])[0]

    def size(self, impulse: FloatArray) -> FloatArray:
        """Sums of absolute values behind each row of w (m,) [m/s]: what rounding is relative to."""
        y = x = np.abs(impulse)
        for part in self.parts:
            y = abs(part) @ y
        return y + self.compliance * x + np.abs(self.b)


def solve_linear(problem: Problem) -> FloatArray:
    """A lambda = b (m,) [N s], right to the last bit where A is regular; else a solution, if there is one.

    Raises
    ------
    InputError
        The refinement does not settle (A is conditioned beyond 1e15), or b is outside the range of A.
    """
    wide = Wide(problem)
    hi, lo = _solve_rows(problem, wide, np.ones(problem.m, bool), np.zeros(problem.m))
    if np.any(np.abs(wide.slack(hi, lo)) > 2.0**-49 * wide.size(hi)):
        raise InputError("no solution: A is singular and b is outside its range")
    return hi


def solve_boxed(problem: Problem, candidate: FloatArray, margin: float = 1e-6) -> FloatArray:
    """A boxed solution near `candidate` (m,) [N s], proved.

    Rows of the candidate that stand off both bounds by `margin` of the largest impulse are solved for
    w = 0, as close to the candidate as they can be; the others sit on their bounds.

    Raises
    ------
    InputError
        No solution with that active set: a bound or a slack has the wrong sign beyond rounding.
    """
    wide, c = Wide(problem), problem.cones
    lam = np.clip(candidate, c.lower, c.upper)
    size = max(float(np.abs(lam).max(initial=0.0)), 1e-300)
    inside = (lam - c.lower > margin * size) & (c.upper - lam > margin * size)
    nearest = np.where(lam - c.lower <= c.upper - lam, c.lower, c.upper)
    hi, lo = _solve_rows(problem, wide, inside, np.where(inside, lam, nearest))
    w = wide.slack(hi, lo)
    wrong = np.where(
        hi <= c.lower, np.maximum(-w, 0.0), np.where(hi >= c.upper, np.maximum(w, 0.0), np.abs(w))
    )
    out = np.maximum(np.maximum(c.lower - hi, hi - c.upper), 0.0).max(initial=0.0)
    # Rows that are zero in exact arithmetic are known to some units of 2^-53 in the rounded data.
    if np.any(wrong > 2.0**-49 * wide.size(hi)) or out > 2.0**-49 * size:
        worst = max(float(wrong.max()), float(out))
        raise InputError(f"the candidate's active set gives no solution: a condition fails by {worst:.1e}")
    return np.clip(hi, c.lower, c.upper)


def _solve_rows(problem: Problem, wide: Wide, rows: np.ndarray, start: FloatArray) -> Pair:
    """Solve w = 0 on `rows`, the other entries as in `start`; the smallest change where those rows depend."""
    hi, lo = start.copy(), np.zeros_like(start)
    index = np.flatnonzero(rows)
    if len(index) == 0:
        return hi, lo
    solve = _solver(sp.csc_matrix(problem.csr[index][:, index]))
    last = np.inf
    for _ in range(MAX_STEPS):
        step = solve(-wide.slack(hi, lo)[index])
        change = float(np.abs(step).max())
        # hi + lo + step, renormalised.
        x, y = hi[index], lo[index] + step
        hi[index] = total = x + y
        back = total - x
        lo[index] = (x - (total - back)) + (y - back)
        if change <= 2.0**-60 * float(np.abs(hi).max()):
            return hi, lo
        if change > 0.5 * last and change <= 2.0**-53 * float(np.abs(hi).max()):
            return hi, lo  # dependent rows: what is left lies in the noise of the data
        last = change
    raise InputError("the refinement does not settle: the rows are singular to float64")


def _solver(a: sp.csc_matrix) -> Callable[[FloatArray], FloatArray]:
    if a.shape[0] <= DENSE_ROWS:
        dense = a.toarray()
        d = 1.0 / np.sqrt(np.maximum(np.abs(dense.diagonal()), 1e-300))
        u, s, vt = np.linalg.svd(dense * d[:, None] * d[None, :])
        keep = s > 1e-13 * s[0]
        if not keep.all():
            pinv = (vt[keep].T / s[keep]) @ u[:, keep].T
            return lambda r: d * (pinv @ (d * r))
    try:
        return spla.splu(a).solve
    except RuntimeError as error:
        raise InputError(f"the rows cannot be factorised ({error})") from None
