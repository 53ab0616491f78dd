"""Proofs that a quadratic program has no solution, by linear programs on the equilibrated rows.

infeasible   lambda with J^T lambda = 0, lambda >= 0 on inequalities, t.lambda > 0
unbounded    d with P d = 0, J d = 0 on equations, J d >= 0 on inequalities, q.d < 0, and a feasible point
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline, stop_clock
from lavender.base.lazy_import import import_module_under_lock
from lavender.base.lazy_import import sparse as sp
from lavender.judge.certificates import Proof, prove_infeasibility
from lavender.problem import Problem
from lavender.programs.convex import ConvexProgram
from lavender_ext.program.error import MAX_TERM_GROWTH, MIN_PROOF_SHARE, TERM_ROUNDING

RAY_TOLERANCE = 1e-8  # [-] P d, J d and q.d count as 0 up to this multiple of their largest terms.
# [-] Largest violation of a row by the feasible point of an unbounded program, as a multiple of its right-hand side.
FEASIBLE_TOLERANCE = 1e-6
# Linear programs for a feasible point, each for the violations that the last one left.
FEASIBLE_STEPS = 3
# Matrices of more rows or columns are projected by a sparse factor with this shift, which repetitions remove.
MAX_DENSE_PROJECTION, PROJECTION_SHIFT, PROJECTIONS = 100, 1e-10, 3
# [-] t.lambda of a proof is positive by more than this multiple of the sum of |lambda| in scaled units; the rest is
# rounding of right-hand sides (2^10 unit roundoffs).
PROOF_ROUNDING = 2.0**-43
NEGLIGIBLE_SHARE = (
    1e-9  # [-] Entries of a proof below this fraction of the largest one are set to 0.
)


@np.errstate(all="ignore")  # Proofs that overflow are not accepted.
def find_infeasibility_proof(
    problem: Problem,
    program: ConvexProgram,
    x: FloatArray | None,
    tol: float,
    multipliers: FloatArray | None,
    deadline: Deadline,
    *,
    only_small: bool = False,
) -> Proof | None:
    """Return a proof that no x satisfies the rows, or None.

    Rows of the size of those that fail at x are searched first, with their own scales, so that larger
    numbers of other rows do not hide a contradiction of theirs.

    Parameters
    ----------
    multipliers : (m,), optional
        A backend's multipliers, which may be a proof.
    only_small : bool
        Whether the other rows are not searched.
    """
    m, n = len(program.t), len(program.q)
    if not m:
        return None
    if x is not None:
        rows = program.find_rows_of_failing_size(x, tol)
        if 0 < len(rows) < m:
            part = program.select_rows_and_columns(rows, np.arange(n, dtype=np.int32))
            rounding = MIN_PROOF_SHARE * (program.get_reached_side(x) / program.scales[1])[rows]
            proof = _search_rows(problem, part, rows, None, deadline, rounding)
            if proof is not None or only_small:
                return proof
    rows = np.arange(m, dtype=np.int32)
    return _search_rows(problem, program, rows, multipliers, deadline)


def _search_rows(
    problem: Problem,
    program: ConvexProgram,
    rows: Any,
    multipliers: FloatArray | None,
    deadline: Deadline,
    rounding: Any = 0.0,
) -> Proof | None:
    """Return a proof that no x satisfies these rows, from multipliers of them or a linear program, or None.

    Parameters
    ----------
    program : ConvexProgram
        The rows, without others and without a cost.
    rows : (k,) int
        Their numbers in the problem.
    rounding : (k,), optional
        Rounding of their right-hand sides, which counts against a proof.
    """
    program = program.without_cost()
    scaled, e = program.scaled.without_far_rows(), program.scales[1]
    is_equation = np.arange(len(program.t)) < program.free
    candidates = [] if multipliers is None else [multipliers]
    for attempt in range(2):
        for lam in candidates:
            y = _remove_small_entries(np.where(is_equation, lam, np.maximum(lam, 0.0)) / e) * e
            scaled_y = y / e
            if not program.scaled.t @ scaled_y > PROOF_ROUNDING * np.abs(scaled_y).sum():
                continue
            if not program.t @ y > np.sum(rounding * np.abs(y)):
                continue
            if deadline.has_passed():
                return None
            direction = np.zeros(problem.m)
            direction[problem.m - len(problem.qp.target) + rows] = y
            proof = prove_infeasibility(problem, direction, 0.0, deadline)
            if not proof.reason:
                return proof
        if attempt or deadline.has_passed():
            break
        matrix = scaled.jacobian.T
        # A row without coefficients is violated, which is a proof itself, or has no part in one.
        high = (np.asarray(abs(matrix).sum(axis=0)).ravel() > 0.0).astype(float)
        if scaled.is_kept is not None:
            high *= scaled.is_kept
        t = scaled.t * high
        found = _solve_linear_program(
            -t, matrix, None, np.where(is_equation, -high, 0.0), high, deadline
        )
        if found is None:
            return None
        candidates = [found * e]
        if not deadline.has_passed():
            candidates.insert(0, _project_to_kernel(found, matrix) * e)
    return None


@np.errstate(all="ignore")
def find_ray(
    program: ConvexProgram,
    x: FloatArray | None,
    deadline: Deadline,
    tolerances: tuple[tuple[float, float], ...] = ((RAY_TOLERANCE, RAY_TOLERANCE),),
) -> tuple[FloatArray, FloatArray | None] | None:
    """Return a ray d (n,) with a largest entry of 1 and a feasible point (n,), or None without a ray.

    The program is unbounded if it has both. With a ray alone, it has no solution, whatever the point.

    A ray of one component is a ray of the program. All components are searched by one linear program,
    in which each has its own units of the cost, and each direction is checked alone.

    Parameters
    ----------
    tolerances : tuple of (level, slope)
        Largest P d and J d, and smallest -q.d, as multiples of their terms; one pair must hold.
    """
    scaled, scale = program.scaled, program.scales[0]
    n, free = scaled.n, program.free
    hessian, jac = scaled.hessian, scaled.jacobian
    part, count = program.components
    column_part, row_part = part[:n], part[n:]
    q = scaled.q / _get_sizes(scaled.q, column_part, count)[column_part]
    largest = _get_sizes(abs(hessian).max(axis=1).toarray().ravel(), column_part, count)
    hessian = sp.csr_matrix(sp.diags_array(1.0 / largest[column_part]) @ hessian)
    level = sp.vstack([hessian, jac[:free]])
    found = _solve_linear_program(q, level, jac[free:], -1.0, 1.0, deadline)
    if found is None:
        return None
    slopes = np.bincount(column_part, q * found, minlength=count)
    for c in np.argsort(slopes, kind="stable"):
        if not slopes[c] < 0.0 or deadline.has_passed():
            return None
        columns = np.flatnonzero(column_part == c)
        rows = np.flatnonzero(row_part == c)
        direction = _find_component_ray(
            found[columns],
            q[columns],
            hessian[columns][:, columns],
            jac[rows][:, columns],
            int(np.count_nonzero(rows < free)),
            tolerances,
        )
        if direction is not None:
            break
    else:
        return None
    ray = np.zeros(n)
    ray[columns] = direction
    if x is None or not _is_feasible(program, x):
        x = _find_feasible_point(program, deadline)
    ray = ray * scale
    return ray / np.abs(ray).max(), x


def _find_feasible_point(program: ConvexProgram, deadline: Deadline) -> FloatArray | None:
    """Return a feasible point (n,) or None, by linear programs for what the last one left, in units of that.

    Each component has its own units.
    """
    scaled, (scale, _, sigma, _) = program.scaled, program.scales
    n, free, jac = scaled.n, scaled.free, scaled.jacobian
    part, count = program.components
    column_part, row_part = part[:n], part[n:]
    none = np.full(n, np.inf)
    x = np.zeros(n)
    for _ in range(FEASIBLE_STEPS):
        rest = scaled.t - jac @ x
        violated = np.where(np.arange(len(rest)) < free, np.abs(rest), np.maximum(rest, 0.0))
        sizes = np.minimum(_get_sizes(violated, row_part, count), 1.0)
        rest = np.maximum(rest / sizes[row_part], -1.0 / FEASIBLE_TOLERANCE**2)
        found = _solve_linear_program(
            np.zeros(n), jac[:free], jac[free:], -none, none, deadline, rest[:free], rest[free:]
        )
        if found is None or deadline.has_passed():
            return None
        x += found * sizes[column_part]
        point: FloatArray = x * (scale * sigma)
        if _is_feasible(program, point):
            return point
    return None


def _find_component_ray(
    d: FloatArray,
    q: FloatArray,
    hessian: Any,
    jac: Any,
    free: int,
    tolerances: tuple[tuple[float, float], ...],
) -> FloatArray | None:
    """Return d or its projection if the objective of a component decreases without end along it, or None."""
    d = _remove_small_entries(d)
    at_bound = np.abs(jac @ d) <= RAY_TOLERANCE * (abs(jac) @ np.abs(d))
    at_bound[:free] = True
    for ray in (_project_to_kernel(d, sp.vstack([hessian, jac[at_bound]])), d):
        size = np.abs(ray)
        slope = jac @ ray
        # The largest error of a level row, and of an inequality that the ray leaves.
        error = np.append(np.abs(hessian @ ray), -slope)
        error[len(ray) : len(ray) + free] = np.abs(slope[:free])
        terms = np.append(abs(hessian) @ size, abs(jac) @ size)
        for tolerance, min_slope in tolerances:
            if (error <= tolerance * terms).all() and q @ ray < -min_slope * (np.abs(q) @ size):
                return ray
    return None


def _get_sizes(values: FloatArray, part: Any, count: int) -> FloatArray:
    """Return the power of two near the largest |value| of each component (count,); 1 if that is 0."""
    sizes = np.zeros(count)
    np.maximum.at(sizes, part, np.abs(values))
    sizes[sizes == 0.0] = 1.0
    return np.asarray(np.exp2(np.round(np.log2(sizes))))


def _is_feasible(program: ConvexProgram, x: FloatArray) -> bool:
    """Return whether x satisfies each row to FEASIBLE_TOLERANCE of its right-hand side, or of its terms if that is 0.

    Large x makes the rows of contradicting constraints hold relative to their terms, of which only rounding counts.
    """
    side = np.abs(program.t)
    violation = program.jacobian @ x - program.t
    violation[: program.free] = -np.abs(violation[: program.free])
    terms = abs(program.jacobian) @ np.abs(x) + side
    rounding = np.where(terms > MAX_TERM_GROWTH * side, 0.0, TERM_ROUNDING * terms)
    limit = FEASIBLE_TOLERANCE * np.where(side > 0.0, side, terms) + rounding
    return bool((-violation <= limit).all())


def _project_to_kernel(x: FloatArray, matrix: Any) -> FloatArray:
    """Return the nearest vector with the same zeros for which `matrix` x = 0, in the least-squares sense."""
    used = np.flatnonzero(x)
    part = matrix.tocsc()[:, used]
    out = np.zeros(len(x))
    if max(part.shape) <= MAX_DENSE_PROJECTION:
        dense = part.toarray()
        out[used] = x[used] - np.linalg.lstsq(dense, dense @ x[used], rcond=1e-10)[0]
        return out
    shift = -PROJECTION_SHIFT * sp.eye_array(part.shape[0])
    splu = import_module_under_lock("scipy.sparse.linalg").splu
    solve = splu(
        sp.csc_array(sp.block_array([[sp.eye_array(len(used)), part.T], [part, shift]]))
    ).solve
    out[used] = x[used]
    for _ in range(PROJECTIONS):
        correction = solve(np.concatenate([np.zeros(len(used)), -(part @ out[used])]))
        out[used] += correction[: len(used)]
    return out


def _remove_small_entries(x: FloatArray) -> FloatArray:
    return np.where(np.abs(x) >= NEGLIGIBLE_SHARE * np.abs(x).max(initial=0.0), x, 0.0)


def _solve_linear_program(
    cost: FloatArray,
    equations: Any,
    inequalities: Any,
    low: Any,
    high: Any,
    deadline: Deadline,
    equal_to: Any = 0.0,
    at_least: Any = 0.0,
) -> FloatArray | None:
    """Minimise cost.x with equations x = equal_to, inequalities x >= at_least and bounds; None without a point."""
    with stop_clock(deadline):  # It takes 0.1 s, and is seldom needed.
        linprog = import_module_under_lock("scipy.optimize").linprog
    n = len(cost)
    options: dict[str, Any] = {
        "primal_feasibility_tolerance": 1e-10,
        "dual_feasibility_tolerance": 1e-10,
    }
    if deadline.is_set:
        options["time_limit"] = deadline.get_remaining_seconds(1e-3)
    bounds = np.stack([np.broadcast_to(low, (n,)), np.broadcast_to(high, (n,))], 1)
    above: tuple[Any, Any] = (None, None)
    if inequalities is not None and inequalities.shape[0]:
        above = -inequalities, np.broadcast_to(-np.asarray(at_least), (inequalities.shape[0],))
    level: tuple[Any, Any] = (None, None)
    if equations.shape[0]:
        level = equations, np.broadcast_to(equal_to, (equations.shape[0],))
    size = float(np.abs(cost).max(initial=0.0)) or 1.0
    result = linprog(cost / size, *above, *level, bounds=bounds, method="highs", options=options)
    return None if result.x is None else np.asarray(result.x, float)
