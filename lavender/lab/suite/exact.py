"""Compute reference solutions in about 100 bits of precision, with the same result on every machine.

Numbers are unevaluated sums of two float64, hi + lo. Products are split exactly (Dekker 1971) and rows are summed
without rounding (`math.fsum`), so a residual is correct to about 2^-100 of its terms, and a few refinement steps with
a float64 factorisation give impulses that are correct to the last bit of float64 up to condition numbers near 1e15.

A candidate from any source determines which rows are free. w = 0 is solved on these rows, and every condition of a
solution is then checked. An impulse that passes is a solution, whatever the source of the candidate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import fsum

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.base.errors import InputError
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import factor_sparse_lu
from lavender.problem import Problem
from lavender_ext.core.checks import MIN_MAGNITUDE

VELTKAMP_FACTOR = 2.0**27 + 1.0  # Multiplier that splits the 53 bits of a float64 into two halves.
MAX_SVD_ROWS = 2000  # Up to this many rows, dependent rows are solved by a singular value decomposition.
MAX_REFINEMENT_STEPS = 40
# A row is free if its impulse is farther from its bounds than this fraction of the largest impulse.
FREE_ROW_MARGIN = 1e-6

Pair = tuple[FloatArray, FloatArray]


def _split_bits(x: FloatArray) -> Pair:
    """Split 53 bits into 26 + 26 (Veltkamp); |x| must be below 2^996."""
    t = VELTKAMP_FACTOR * x
    high = t - (t - x)
    return high, x - high


def _multiply_exactly(x: FloatArray, y: FloatArray) -> Pair:
    """Compute x y = p + e exactly, unless it underflows."""
    p = x * y
    (xh, xl), (yh, yl) = _split_bits(x), _split_bits(y)
    return p, ((xh * yh - p) + xh * yl + xl * yh) + xl * yl


def _multiply_in_extended_precision(a: sp.csr_array, x: Pair, *added: FloatArray) -> Pair:
    """Compute A x plus vectors as hi + lo, each row summed without rounding."""
    hi, lo = (part[a.indices] for part in x)
    p, e = _multiply_exactly(a.data, hi)
    terms = np.stack([p, e, a.data * lo], axis=1).ravel().tolist()
    summands = np.stack(added, axis=1).tolist() if added else [[] for _ in range(a.shape[0])]
    ends = (3 * a.indptr).tolist()
    out_hi, out_lo = np.empty(a.shape[0]), np.empty(a.shape[0])
    for i in range(a.shape[0]):
        row = terms[ends[i] : ends[i + 1]] + summands[i]
        out_hi[i] = s = fsum(row)
        out_lo[i] = fsum([*row, -s])
    return out_hi, out_lo


class ExtendedOperator:
    """Operator that computes w = A lambda - b in about 100 bits.

    A is the matrix as given, or J M^-1 J^T + diag(compliance), which is never rounded to float64.
    """

    def __init__(self, problem: Problem) -> None:
        self.b = problem.b
        if problem.rows is None:
            self.factors = [problem.csr]
            self.compliance = np.zeros(problem.m)
        else:
            jac = problem.jacobian
            self.factors = [sp.csr_array(jac.T), problem.rows.inverse_mass_matrix().tocsr(), jac]
            assert problem.compliance is not None
            self.compliance = problem.compliance

    def compute_slack(self, hi: FloatArray, lo: FloatArray | None = None) -> FloatArray:
        """Compute w (m,) [m/s] of the impulse hi + lo."""
        lam = (hi, np.zeros_like(hi) if lo is None else lo)
        y = lam
        for factor in self.factors[:-1]:
            y = _multiply_in_extended_precision(factor, y)
        compliant_velocity = _multiply_exactly(self.compliance, lam[0])
        return _multiply_in_extended_precision(
            self.factors[-1], y, -self.b, *compliant_velocity, self.compliance * lam[1]
        )[0]

    def sum_term_magnitudes(self, impulse: FloatArray) -> FloatArray:
        """Sum the absolute values of the terms of each row of w (m,) [m/s], to which rounding errors are relative."""
        y = x = np.abs(impulse)
        for factor in self.factors:
            y = abs(factor) @ y
        return y + self.compliance * x + np.abs(self.b)


def solve_linear(problem: Problem) -> FloatArray:
    """Solve A lambda = b for the impulses (m,) [N s]: to the last bit if A is regular, else one of the solutions.

    Raises
    ------
    InputError
        The refinement does not converge (the condition number of A is above 1e15), or b is outside the range of A.
    """
    operator = ExtendedOperator(problem)
    hi, lo = _solve_rows(problem, operator, np.ones(problem.m, bool), np.zeros(problem.m))
    if np.any(np.abs(operator.compute_slack(hi, lo)) > 2.0**-49 * operator.sum_term_magnitudes(hi)):
        raise InputError(
            "the problem has no solution, because A is singular and b is outside of its range: give "
            "another b, or compliance"
        )
    return hi


def solve_boxed(problem: Problem, candidate: FloatArray) -> FloatArray:
    """Compute a boxed solution near `candidate` (m,) [N s] and prove it.

    Rows of the candidate that are farther from both bounds than FREE_ROW_MARGIN of the largest impulse are solved for
    w = 0, as close to the candidate as possible; the others are at their bounds.

    Raises
    ------
    InputError
        There is no solution with that active set: a bound or a slack has the wrong sign beyond rounding.
    """
    operator, c = ExtendedOperator(problem), problem.cones
    lam = np.clip(candidate, c.lower, c.upper)
    size = float(np.abs(lam).max(initial=0.0))
    inside = (lam - c.lower > FREE_ROW_MARGIN * size) & (c.upper - lam > FREE_ROW_MARGIN * size)
    nearest = np.where(lam - c.lower <= c.upper - lam, c.lower, c.upper)
    hi, lo = _solve_rows(problem, operator, inside, np.where(inside, lam, nearest))
    w = operator.compute_slack(hi, lo)
    violation = np.where(
        hi <= c.lower, np.maximum(-w, 0.0), np.where(hi >= c.upper, np.maximum(w, 0.0), np.abs(w))
    )
    excess = np.maximum(np.maximum(c.lower - hi, hi - c.upper), 0.0).max(initial=0.0)
    # Violations up to some units of 2^-53 of the terms are allowed: the data of an exactly tight row are rounded, too.
    rounding_scale = operator.sum_term_magnitudes(hi)
    if (
        np.any(violation > 2.0**-49 * rounding_scale + 2.0**-90 * rounding_scale.max(initial=0.0))
        or excess > 2.0**-49 * size
    ):
        worst = max(float(violation.max()), float(excess))
        raise InputError(f"the candidate's active set gives no solution: a condition fails by {worst:.1e}")
    return np.clip(hi, c.lower, c.upper)


def solve_rest_impulse(problem: Problem) -> FloatArray:
    """Compute and prove impulses (m,) [N s] within the friction cones that keep every body at rest, with w = 0.

    A linear program proposes impulses with J^T lambda = -M v* as far inside |t1| + |t2| <= mu n as possible. They are
    refined and checked like any candidate. Under every friction law, lambda in its cone with w = 0 is a solution.

    Raises
    ------
    InputError
        No such impulses were found: the bodies cannot stay at rest, or no margin for rounding is left.
    """
    c, rows = problem.cones, problem.rows
    if rows is None or np.any(~c.is_contact):
        raise InputError("at_rest needs a problem with rows (Problem.from_rows) that has contacts")
    normal = c.ptr[:-1]
    weight = np.repeat(np.stack([1.0 / rows.inv_mass, 1.0 / rows.inv_inertia[:, 0, 0]], 1), 3, axis=1)
    momentum = -weight * rows.v_free
    largest = np.abs(momentum).max(axis=1, initial=MIN_MAGNITUDE)
    operator = ExtendedOperator(problem)
    # Try two scales of the momentum balance: the largest weight of all bodies, which suits heavy on light bodies, and
    # each body's own weight, which suits light on heavy bodies.
    for scale in (np.full_like(largest, largest.max()), largest):
        candidate = _propose_rest_impulse(problem, momentum.ravel(), np.repeat(scale, 6))
        if candidate is None:
            continue
        inside = np.repeat(candidate[normal] > 1e-12 * np.abs(candidate).max(), np.diff(c.ptr))
        hi, lo = _solve_rows(problem, operator, inside, np.where(inside, candidate, 0.0))
        if np.all(
            np.abs(operator.compute_slack(hi, lo)) <= 2.0**-49 * operator.sum_term_magnitudes(hi)
        ) and _is_in_cones(problem, hi):
            return hi
    raise InputError("no impulses with a margin for rounding keep the bodies at rest")


def _propose_rest_impulse(problem: Problem, momentum: FloatArray, scale: FloatArray) -> FloatArray | None:
    """Solve J^T lambda = momentum (6 n,) [N s] by a linear program, with lambda as far inside the cones as possible.

    Each of the 6 n equations is divided by its entry of `scale`. Return None if the program has no solution.
    """
    from scipy.optimize import linprog

    c = problem.cones
    normal, k, m = c.ptr[:-1], problem.n_blocks, problem.m
    balance = sp.csr_array(sp.diags_array(scale.max() / scale) @ problem.jacobian.T)
    # Unknowns: lambda / scale.max() and the margin s. Facets: s - n <= 0, and +-t1 +- t2 - mu n + s <= 0.
    one = np.ones(k)
    columns_of_margin = np.stack([normal, np.full(k, m)], 1).ravel()
    facets = [
        sp.csr_array((np.tile([-1.0, 1.0], k), columns_of_margin, _make_row_pointers(k, 2)), shape=(k, m + 1))
    ]
    for x, y in [(x, y) for x in (-1.0, 1.0) for y in (-1.0, 1.0)] if c.n_tangents.any() else []:
        values = np.stack([-c.mu, x * one, y * one, one], 1).ravel()
        columns = np.stack([normal, normal + 1, normal + 2, np.full(k, m)], 1).ravel()
        facets.append(sp.csr_array((values, columns, _make_row_pointers(k, 4)), shape=(k, m + 1)))
    result = linprog(
        np.append(np.zeros(m), -1.0),
        A_ub=sp.vstack(facets),
        b_ub=np.zeros(k * len(facets)),
        A_eq=sp.hstack([balance, sp.csr_array((len(momentum), 1))]),
        b_eq=momentum / scale,
        bounds=[(None, None)] * m + [(0.0, scale.min() / scale.max())],
        method="highs",
    )
    return scale.max() * result.x[:m] if result.status == 0 else None


def _make_row_pointers(n_rows: int, entries_per_row: int) -> IntArray:
    """Return the row pointers of a CSR matrix with equally many entries in all rows."""
    return np.arange(0, entries_per_row * n_rows + 1, entries_per_row, dtype=np.int32)


def _is_in_cones(problem: Problem, impulse: FloatArray) -> bool:
    """Whether the impulses of all contacts satisfy their friction bounds."""
    c = problem.cones
    normal = impulse[c.ptr[:-1]]
    if not c.n_tangents.any():
        return bool(normal.min(initial=0.0) >= 0.0)
    t = np.stack([impulse[c.ptr[:-1] + 1], impulse[c.ptr[:-1] + 2]])
    return bool(np.all(normal >= 0.0) and np.all(np.hypot(*t) <= c.mu * normal))


def _solve_rows(problem: Problem, operator: ExtendedOperator, rows: np.ndarray, start: FloatArray) -> Pair:
    """Solve w = 0 on `rows` with the other impulses fixed at `start`.

    If the rows are dependent, the solution nearest to `start` is computed.
    """
    index = np.flatnonzero(rows)
    if len(index) == 0:
        return start.copy(), np.zeros_like(start)
    for solve in _iterate_solvers(sp.csc_matrix(problem.csr[index][:, index])):
        result = _refine_to_last_bit(operator, index, start, solve)
        if result is not None:
            return result
    raise InputError(
        f"the refinement of {problem.name} does not converge: its {len(index)} rows are linearly dependent in float64. "
        "Remove dependent rows (`redundancy(problem)` finds them), or give them compliance"
    )


def _refine_to_last_bit(
    operator: ExtendedOperator,
    index: np.ndarray,
    start: FloatArray,
    solve: Callable[[FloatArray], FloatArray],
) -> Pair | None:
    """Refine `start` until it is correct to the last bit; None if the refinement does not converge."""
    hi, lo = start.copy(), np.zeros_like(start)
    last = np.inf
    for _ in range(MAX_REFINEMENT_STEPS):
        step = solve(-operator.compute_slack(hi, lo)[index])
        change = float(np.abs(step).max())
        if not np.isfinite(change):
            return None
        # Add `step` to hi + lo, and renormalise so that hi is the rounded sum.
        x, y = hi[index], lo[index] + step
        hi[index] = total = x + y
        restored = total - x
        lo[index] = (x - (total - restored)) + (y - restored)
        size = float(np.abs(hi).max())
        if change <= 2.0**-60 * size:
            return hi, lo
        if change > 0.5 * last and change <= 2.0**-53 * size:
            return hi, lo  # The rows are dependent: the remaining change is within the rounding of the data.
        last = change
    return None


def _iterate_solvers(a: sp.csc_matrix) -> Iterator[Callable[[FloatArray], FloatArray]]:
    """Yield functions that solve linear systems with `a`.

    The first uses a factorisation. For dependent rows they use pseudo-inverses, each of which omits more of the small
    singular values.
    """
    if a.shape[0] <= MAX_SVD_ROWS:
        dense = a.toarray()
        d = 1.0 / np.sqrt(np.maximum(np.abs(dense.diagonal()), MIN_MAGNITUDE))
        u, s, vt = np.linalg.svd(dense * d[:, None] * d[None, :])
        for cut in (4e-15, 1e-12):
            kept_values = s > cut * s[0]
            inverse = (vt[kept_values].T / s[kept_values]) @ u[:, kept_values].T
            yield lambda r, inverse=inverse: d * (inverse @ (d * r))  # type: ignore[misc]
        return
    try:
        yield factor_sparse_lu(a).solve
    except RuntimeError as error:
        raise InputError(
            f"the {a.shape[0]} free rows cannot be factorised ({error}): remove linearly dependent rows, or give them "
            "compliance"
        ) from None
