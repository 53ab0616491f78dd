"""Solutions to beyond float64, for references: about 100 bits, whatever the machine.

Numbers are unevaluated sums of two float64, hi + lo. Products are split exactly (Dekker 1971) and rows
are summed without rounding (`math.fsum`), so a residual is right to about 2^-100 of its terms, and a few steps
of refinement with a float64 factorisation give impulses that are right to the last bit of float64 up to
condition numbers near 1e15.

A candidate from anywhere fixes which rows are free; those rows are solved, and every condition is then
checked. What passes is a solution whoever proposed it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import fsum

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.base.errors import InputError
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import sparse_lu
from lavender.problem import Problem
from lavender_ext.core.checks import LEAST

SPLIT = 2.0**27 + 1.0
DENSE_ROWS = 2000  # up to here singular rows are found by a singular value decomposition
MAX_STEPS = 40
MARGIN = 1e-6  # of the largest impulse, that a row which is free stands off its bounds

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


def solve_boxed(problem: Problem, candidate: FloatArray) -> FloatArray:
    """A boxed solution near `candidate` (m,) [N s], proved.

    Rows of the candidate that stand off both bounds by MARGIN of the largest impulse are solved for
    w = 0, as close to the candidate as they can be; the others sit on their bounds.

    Raises
    ------
    InputError
        No solution with that active set: a bound or a slack has the wrong sign beyond rounding.
    """
    wide, c = Wide(problem), problem.cones
    lam = np.clip(candidate, c.lower, c.upper)
    size = float(np.abs(lam).max(initial=0.0))
    inside = (lam - c.lower > MARGIN * size) & (c.upper - lam > MARGIN * size)
    nearest = np.where(lam - c.lower <= c.upper - lam, c.lower, c.upper)
    hi, lo = _solve_rows(problem, wide, inside, np.where(inside, lam, nearest))
    w = wide.slack(hi, lo)
    wrong = np.where(
        hi <= c.lower, np.maximum(-w, 0.0), np.where(hi >= c.upper, np.maximum(w, 0.0), np.abs(w))
    )
    out = np.maximum(np.maximum(c.lower - hi, hi - c.upper), 0.0).max(initial=0.0)
    # Rows that are zero in exact arithmetic are known to some units of 2^-53 in the rounded data.
    room = wide.size(hi)
    if np.any(wrong > 2.0**-49 * room + 2.0**-90 * room.max(initial=0.0)) or out > 2.0**-49 * size:
        worst = max(float(wrong.max()), float(out))
        raise InputError(f"the candidate's active set gives no solution: a condition fails by {worst:.1e}")
    return np.clip(hi, c.lower, c.upper)


def at_rest(problem: Problem) -> FloatArray:
    """Impulses within the cones that leave every body at rest (m,) [N s], proved; w = 0 is then the solution.

    A linear program proposes them (J^T lambda = -M v*, as far inside |t1| + |t2| <= mu n as it can); they are
    refined and checked like any candidate. Whatever the friction law, w = 0 with lambda in its cone is a solution.

    Raises
    ------
    InputError
        No such impulses were found: the bodies cannot stay at rest, or a row has no room for rounding.
    """
    c, rows = problem.cones, problem.rows
    if rows is None or np.any(~c.is_contact):
        raise InputError("at_rest needs contacts given by rows")
    normal = c.ptr[:-1]
    weight = np.repeat(np.stack([1.0 / rows.inv_mass, 1.0 / rows.inv_inertia[:, 0, 0]], 1), 3, axis=1)
    momentum = -weight * rows.v_free
    largest = np.abs(momentum).max(axis=1, initial=LEAST)
    wide = Wide(problem)
    # Two scales of the balance: the largest weight of all (heavy on light), each body's own (light on heavy).
    for scale in (np.full_like(largest, largest.max()), largest):
        candidate = _inside(problem, momentum.ravel(), np.repeat(scale, 6))
        if candidate is None:
            continue
        inside = np.repeat(candidate[normal] > 1e-12 * np.abs(candidate).max(), np.diff(c.ptr))
        hi, lo = _solve_rows(problem, wide, inside, np.where(inside, candidate, 0.0))
        if np.all(np.abs(wide.slack(hi, lo)) <= 2.0**-49 * wide.size(hi)) and _in_cones(problem, hi):
            return hi
    raise InputError("no impulses with room for rounding hold the bodies at rest")


def _inside(problem: Problem, momentum: FloatArray, scale: FloatArray) -> FloatArray | None:
    """J^T lambda = momentum (6 n,) [N s], rows divided by `scale`, as far inside the cones as a linear program can."""
    from scipy.optimize import linprog

    c = problem.cones
    normal, k, m = c.ptr[:-1], problem.n_blocks, problem.m
    balance = sp.csr_array(sp.diags_array(scale.max() / scale) @ problem.jacobian.T)
    # Unknowns: lambda / scale.max() and the room s. Facets: s - n <= 0, and +-t1 +- t2 - mu n + s <= 0.
    one = np.ones(k)
    pairs = np.stack([normal, np.full(k, m)], 1).ravel()
    facets = [sp.csr_array((np.tile([-1.0, 1.0], k), pairs, _ends(k, 2)), shape=(k, m + 1))]
    for x, y in [(x, y) for x in (-1.0, 1.0) for y in (-1.0, 1.0)] if c.n_tangents.any() else []:
        values = np.stack([-c.mu, x * one, y * one, one], 1).ravel()
        columns = np.stack([normal, normal + 1, normal + 2, np.full(k, m)], 1).ravel()
        facets.append(sp.csr_array((values, columns, _ends(k, 4)), shape=(k, m + 1)))
    found = linprog(
        np.append(np.zeros(m), -1.0),
        A_ub=sp.vstack(facets),
        b_ub=np.zeros(k * len(facets)),
        A_eq=sp.hstack([balance, sp.csr_array((len(momentum), 1))]),
        b_eq=momentum / scale,
        bounds=[(None, None)] * m + [(0.0, scale.min() / scale.max())],
        method="highs",
    )
    return scale.max() * found.x[:m] if found.status == 0 else None


def _ends(k: int, each: int) -> IntArray:
    return np.arange(0, each * k + 1, each, dtype=np.int32)


def _in_cones(problem: Problem, impulse: FloatArray) -> bool:
    c = problem.cones
    normal = impulse[c.ptr[:-1]]
    if not c.n_tangents.any():
        return bool(normal.min(initial=0.0) >= 0.0)
    t = np.stack([impulse[c.ptr[:-1] + 1], impulse[c.ptr[:-1] + 2]])
    return bool(np.all(normal >= 0.0) and np.all(np.hypot(*t) <= c.mu * normal))


def _solve_rows(problem: Problem, wide: Wide, rows: np.ndarray, start: FloatArray) -> Pair:
    """Solve w = 0 on `rows`, the other entries as in `start`; the smallest change where those rows depend."""
    index = np.flatnonzero(rows)
    if len(index) == 0:
        return start.copy(), np.zeros_like(start)
    for solve in _solvers(sp.csc_matrix(problem.csr[index][:, index])):
        found = _refined(wide, index, start, solve)
        if found is not None:
            return found
    raise InputError("the refinement does not settle: the rows are singular to float64")


def _refined(
    wide: Wide, index: np.ndarray, start: FloatArray, solve: Callable[[FloatArray], FloatArray]
) -> Pair | None:
    hi, lo = start.copy(), np.zeros_like(start)
    last = np.inf
    for _ in range(MAX_STEPS):
        step = solve(-wide.slack(hi, lo)[index])
        change = float(np.abs(step).max())
        if not np.isfinite(change):
            return None
        # hi + lo + step, renormalised.
        x, y = hi[index], lo[index] + step
        hi[index] = total = x + y
        back = total - x
        lo[index] = (x - (total - back)) + (y - back)
        size = float(np.abs(hi).max())
        if change <= 2.0**-60 * size:
            return hi, lo
        if change > 0.5 * last and change <= 2.0**-53 * size:
            return hi, lo  # dependent rows: what is left lies in the noise of the data
        last = change
    return None


def _solvers(a: sp.csc_matrix) -> Iterator[Callable[[FloatArray], FloatArray]]:
    """A factorisation, then inverses on ever smaller ranges of A, for rows that depend on each other."""
    if a.shape[0] <= DENSE_ROWS:
        dense = a.toarray()
        d = 1.0 / np.sqrt(np.maximum(np.abs(dense.diagonal()), LEAST))
        u, s, vt = np.linalg.svd(dense * d[:, None] * d[None, :])
        for cut in (4e-15, 1e-12):
            keep = s > cut * s[0]
            inverse = (vt[keep].T / s[keep]) @ u[:, keep].T
            yield lambda r, inverse=inverse: d * (inverse @ (d * r))  # type: ignore[misc]
        return
    try:
        yield sparse_lu(a).solve
    except RuntimeError as error:
        raise InputError(f"the rows cannot be factorised ({error})") from None
