"""Proofs that a problem has no solution, checked on the problem's own data.

A certificate y (m,) is a direction in the recession cone of the admissible impulses: nonzero on free rows, positive on
rows without an upper bound, negative on rows without a lower bound, and in the cone of a contact (Coulomb: along its
normal only). Every solution then has w.y >= 0, so with z = A^T y

    0 <= w.y = z.lambda - b.y,    and no solution exists if   b.y > max z.lambda                  (1)

over all lambda within the bounds, for any A and every law. If |z| <= s in the directions in which lambda is unbounded,
and the support S is the maximum of z.lambda over the bounded rows,

    every solution has   sum |lambda| >= (b.y - S) / s                                            (2)

which is infinite if s is 0 in exact arithmetic. A slack s > 0 is accepted as a proof if rounding of the data explains
it, in the metric of D = diag(d), with k the number of nonzeros of y:

    A given           |z_i| <= (k + 2) 2^-53 sqrt(d_i) sum_j sqrt(d_j) |y_j|                      (3)
    J, M and R given  |J^T y|_M^-1 <= (k + 2) 2^-53 sum_j sqrt(d_j) |y_j|,   R y = 0 exactly      (4)
    bodies            as J, M and R, with J as rounded to float64

A solution would then have an impulse as large as (2), and could not be distinguished from a failure, because its
round-off floor would exceed 1e-6. The errors E and V of any impulse (`lavender.judge.residuals`) are

    E >= net / (|y|_D + |z|_D^-1),    V >= net / sum sqrt(d / nu) |y|,    net = b.y - S           (5)

If these bounds are within tol, or within the rounding of b as computed from target and J v*, an answer may meet tol,
and y proves nothing. b of an empty row may therefore be rounding noise, and repeated equations may differ by rounding
noise.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import NEVER, Deadline
from lavender.judge.residuals import divide_by_reference, get_zero_impulse_reference
from lavender.problem import Problem
from lavender_ext.factor.linear import LinearSystem

__all__ = [
    "Proof",
    "check_certificate",
    "format_lower_bound",
    "list_conflicting_blocks",
    "prove_infeasibility",
]

UNIT_ROUNDOFF = 2.0**-53
VELTKAMP_FACTOR = 2.0**27 + 1.0  # Splits a float64 into two halves of 26 bits.
# |z| counts as rounding if it does not exceed this fraction of b.y. The floor of a solution (2) is then above 1e-6.
MAX_ROUNDING_SLACK = 1e-10
SAFE_SUM_RATIO = 1e3  # A sum below this multiple of its rounding bound is recomputed exactly.
# y is polished if |z| = |A^T y| is at most this fraction of the sum of its terms, so that rounding may explain z.
MAX_POLISHED_SLACK = 1e-6
# Up to this many rows, a valid certificate is also polished in search of A^T y = 0 exactly.
MAX_EXACT_ROWS = 16
MIN_NAMED_SHARE = (
    1e-6  # A message names only rows above this fraction of the largest |y| in the metric of D.
)
MAX_NAMED_BLOCKS = 6  # Number of blocks of each kind that a message names.
# Certificates with more rows are not polished: the dense least squares would be too large.
MAX_POLISHED_ROWS = 1000
# [-] Shift s of the normal equations, relative to their trace. It is above the rounding of their factor.
LEAST_SQUARES_SHIFT = 1e-14
# Number of proximal iterations. Each divides the error of a component by 1 + (singular value)^2 / shift.
LEAST_SQUARES_ITERATIONS = 6
# Matrix products are computed for this many columns at a time, because OpenBLAS starts threads above 262,144
# multiply-adds.
PRODUCT_COLUMNS = 8


@dataclass(frozen=True)
class Proof:
    """Result of checking a direction y as a certificate of infeasibility."""

    y: FloatArray  # (m,): the direction, as given or polished.
    # [N s] Lower bound (2) of sum |lambda| over all solutions: inf if none exists, 0 if y implies no bound.
    impulse_bound: float
    # Reason why y does not prove that no impulse meets the tolerance; empty if it proves this.
    reason: str = ""
    conflict: str = ""  # If y is a proof: names of the conflicting blocks.

    @property
    def message(self) -> str:
        """The proved statement, with the names of the conflicting blocks."""
        names = f": {self.conflict}" if self.conflict else ""
        if self.impulse_bound == math.inf:
            return f"no solution, proved{names}"
        return (
            "no solution for data within rounding of yours; for yours every solution has an impulse of at least "
            f"{format_lower_bound(self.impulse_bound)} N s{names}"
        )


def format_lower_bound(bound: float) -> str:
    """Format a lower bound with one digit, rounded down."""
    digits, power = f"{bound:.17e}".split("e")
    return f"{float(f'{digits[0]}e{power}'):.1g}"


def check_certificate(
    problem: Problem, y: Any, tol: float = 0.0, deadline: Deadline = NEVER
) -> str | None:
    """Return the reason why y (m,) does not prove that no impulse meets `tol`, or None if y proves this."""
    return prove_infeasibility(problem, y, tol, deadline).reason or None


def prove_infeasibility(
    problem: Problem, y: Any, tol: float = 0.0, deadline: Deadline = NEVER
) -> Proof:
    """Check whether y (m,) proves that no impulse meets `tol`, and bound the impulse of every solution.

    The scale of y does not matter. If y fails only by a solver's rounding, y is polished: replaced by the nearest
    direction on the same rows with A^T y = 0, unless the deadline has passed. The last result is stored with the
    problem, because a solver and the check of its claim make the same call; after the deadline, only a proof is stored.
    """
    y = np.array(y, float)
    y.setflags(write=False)
    key = tol, y.shape, y.tobytes()
    stored: tuple[Any, Proof] | None = problem.derived.cache.get(__name__)
    if stored is not None and stored[0] == key:
        return stored[1]
    proof = _prove_with_polished_directions(problem, y, tol, deadline)
    if not (proof.reason and deadline.has_passed()):
        problem.derived.cache[__name__] = key, proof
    return proof


def _prove_with_polished_directions(
    problem: Problem, y: FloatArray, tol: float, deadline: Deadline
) -> Proof:
    """Check y, and then polished directions if y fails only by rounding or if an exact proof may be found."""
    with np.errstate(
        all="ignore"
    ):  # Directions with numbers that overflow are not accepted as proofs.
        inner = problem.disk
        if y.shape != (problem.m,) or not np.isfinite(y).all() or not np.any(y):
            reason = (
                f"certificate of shape {y.shape} must be {problem.m} finite numbers, not all zero"
            )
            return Proof(y, 0.0, reason)
        proof = _check_infeasibility_direction(inner, problem.on_disk(y), tol)
        if 0.0 < proof.impulse_bound < math.inf and (
            proof.reason or np.count_nonzero(y) <= MAX_EXACT_ROWS
        ):
            for polished in _polish_direction(inner, proof.y, deadline):
                candidate = _check_infeasibility_direction(inner, polished, tol)
                if not candidate.reason and (proof.reason or candidate.impulse_bound == math.inf):
                    proof = candidate
                    break
        if inner is not problem:
            proof = replace(proof, y=problem.cones.stretch * proof.y)
        if proof.reason:
            return proof
        sides = (
            _format_block_names(problem, blocks)
            for blocks in list_conflicting_blocks(problem, proof.y)
        )
        return replace(
            proof, conflict=" against ".join(filter(None, sides))
        )  # "joint 7 against contact 11"


def list_conflicting_blocks(problem: Problem, y: Any) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the blocks in which a direction y (m,) is not negligible: joints and bounded rows, and contacts."""
    size = np.sqrt(problem.d) * np.abs(np.asarray(y, float))
    rows = np.flatnonzero(size > MIN_NAMED_SHARE * size.max(initial=0.0))
    is_contact = problem.cones.contact_rows
    joints, contacts = (
        np.unique([problem.block_of(int(i)) for i in rows[is_contact[rows] == kind]])
        for kind in (False, True)
    )
    return tuple(map(int, joints)), tuple(map(int, contacts))


def _format_block_names(problem: Problem, blocks: tuple[int, ...]) -> str:
    """Return the names of blocks as one text, shortened if all are of one kind."""
    names = [problem.row_name(int(problem.cones.ptr[i])).rsplit(", ", 1)[0] for i in blocks]
    # Remove repeated names: each free row of a joint is a block of that name.
    names = list(dict.fromkeys(names))
    matches = [re.fullmatch(r"(.*\S) (\d+)", name) for name in names[:MAX_NAMED_BLOCKS]]
    kinds = {match[1] for match in matches if match}
    if len(names) > 1 and all(matches) and len(kinds) == 1:  # Write "joints 7 and 9".
        return f"{kinds.pop()}s " + _join_names(
            [match[2] for match in matches if match], len(names)
        )
    return _join_names(names[:MAX_NAMED_BLOCKS], len(names))


def _join_names(names: list[str], count: int) -> str:
    """Join the first of `count` names by commas and "and"."""
    if count > len(names):
        return f"{', '.join(names)} and {count - len(names)} more"
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1]))) if names else ""


def _check_infeasibility_direction(problem: Problem, y: FloatArray, tol: float) -> Proof:
    """Check y (m,) by (1) to (5) on a problem without ellipses."""
    # Read only rows with y != 0, because numbers of other rows may have overflown.
    rows = np.flatnonzero(y)
    vanished = np.intersect1d(rows, problem.vanished_rows)
    if len(vanished):
        name = problem.row_name(int(vanished[0]))
        return Proof(y, 0.0, f"products of {name} vanish in float64: its row of A is not zero")
    unscaled = y
    y = y / _round_down_to_power_of_two(y)
    # Compute b.y and the sum of the absolute values of its terms.
    gain = float(problem.b @ y)
    gain_size = float(np.abs(problem.b) @ np.abs(y))
    if not gain > 0.0:
        return Proof(y, 0.0, f"b.y = {gain:.2e} is not positive")
    violation = _explain_recession_violation(problem, y)
    if violation:
        return Proof(y, 0.0, violation)
    low, high, size = _bound_transposed_product(problem, y, rows)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return Proof(y, 0.0, "A^T y overflows")
    rounding_factor = min((len(rows) + 2.0) * UNIT_ROUNDOFF, MAX_ROUNDING_SLACK * gain / gain_size)
    support, slack, rounding = _compute_support_and_slack(
        problem, low, high, rounding_factor * size
    )
    # (1)
    net = gain - float(support.sum())
    sum_rounding = (len(rows) + 4.0) * UNIT_ROUNDOFF
    if not net > sum_rounding * (gain_size + float(np.abs(support).sum())):
        return Proof(
            y, 0.0, f"A^T y reaches {high.max():.2e}; impulses within the bounds can meet b.y"
        )
    # (2)
    max_slack = float(slack.max())
    bound = net / max_slack if max_slack > 0.0 else math.inf
    if np.any(slack > rounding):
        reason = f"A^T y reaches {max_slack:.2e}, above rounding: impulses within the bounds can meet b.y"
        return Proof(unscaled, bound, f"{reason}, of at least {format_lower_bound(bound)} N s")
    # (5)
    z = np.where(slack > 0.0, 0.0, np.maximum(-low, high))
    min_residual, b_rounding = _compute_min_residual(problem, net, y, z)
    if min_residual > max(tol, b_rounding):
        return Proof(unscaled, bound)
    reason = f"no exact solution, but one to a relative residual of {min_residual:.1g} may exist"
    return Proof(unscaled, bound, reason)


def _bound_transposed_product(
    problem: Problem, y: FloatArray, rows: Any
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return bounds of z (m,) from below and above, and the sizes (m,) of the terms in (3) or (4) that are rounded.

    The sums of z are exact. The sizes are 0 if R y is not exactly 0.
    """
    length = np.sqrt(problem.d)
    size = length * float(length @ np.abs(y))
    if problem.matrix is not None:
        z = _multiply_transposed(problem.csr[rows], y[rows])
        n = len(z) - len(problem.qp.target) if problem.has_singular_program else 0
        if n and not y[:n].any():  # d has the unit of the cost, which has no part in J^T y.
            ptr, columns, entries = problem.qp.jacobian
            scale = problem.qp.scales[1]
            size = np.zeros(len(z))
            np.maximum.at(size, columns, np.abs(entries) * np.repeat(scale, np.diff(ptr)))
            size *= float(np.sum(np.abs(y[n:]) / scale))
        return z, z, size
    r = _multiply_transposed(problem.jacobian[rows], y[rows])
    if problem.rows is None:
        x = problem.generalized.solve(r)  # type: ignore[union-attr]
    else:
        x = problem.rows.inverse_mass_matrix() @ r
    # Rounding can make an M^-1 of bodies indefinite, so that r.x is not a squared norm: use |J x| if it is larger.
    radius = np.maximum(length * math.sqrt(max(0.0, float(r @ x))), np.abs(problem.jacobian @ x))
    soft = problem.compliance * y  # type: ignore[operator]
    return soft - radius, soft + radius, 0.0 * size if np.any(soft) else size


def _multiply_transposed(a: Any, y: FloatArray) -> FloatArray:
    """Compute A^T y of a CSR matrix (k, m), with sums that cancel rounded only once.

    Such sums are formed from products of 26-bit halves, which are exact.
    """
    out = a.T @ y
    size = abs(a).T @ np.abs(y)
    safe_sum = SAFE_SUM_RATIO * (len(y) + 2.0) * UNIT_ROUNDOFF * size
    cancels = np.flatnonzero((size > 0.0) & ~(np.abs(out) > safe_sum))
    if not len(cancels):
        return out
    columns = a[:, cancels].tocsc()
    halves = []
    for x in (columns.data, y[columns.indices]):
        # Veltkamp's splitting: both halves have 26 bits.
        high = VELTKAMP_FACTOR * x - (VELTKAMP_FACTOR * x - x)
        halves.append((high, x - high))
    terms = np.array([p * q for p, q in product(*halves)]).T.ravel().tolist()
    out[cancels] = [
        math.fsum(terms[4 * at : 4 * end]) for at, end in pairwise(columns.indptr.tolist())
    ]
    return out


def _round_down_to_power_of_two(x: FloatArray) -> float:
    """Return the largest power of two up to max |x|, for exact divisions; x must not be zero."""
    return float(2.0 ** np.floor(np.log2(np.abs(x).max())))


def _compute_friction_norms(problem: Problem, x: FloatArray) -> tuple[Any, FloatArray, FloatArray]:
    """Return three arrays with one entry per friction component: normal row, friction coefficient, Euclidean norm of x.

    The norm is taken over the rows of the component; x has shape (m,).
    """
    c = problem.cones
    components = list(c.friction_components())
    coefficient_of_row = c.friction_coefficient
    normal = c.ptr[np.array([block for block, _ in components], int)]
    coefficient = np.array([coefficient_of_row[rows[0]] for _, rows in components])
    return normal, coefficient, np.array([np.hypot.reduce(x[rows]) for _, rows in components])


def _compute_support_and_slack(
    problem: Problem, low: FloatArray, high: FloatArray, rounding: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute support, slack and rounding of the slack, all (m,), for low <= z <= high.

    The support is the maximum of z_i lambda_i on bounded rows. The slack is |z_i| on rows where lambda_i is unbounded,
    and on bounded rows with |z_i| within rounding; their support counts as 0. A contact has one value for all of its
    rows, at its normal row.
    """
    c = problem.cones
    size = np.maximum(-low, high)
    corners = [
        np.multiply(z, bound, out=np.zeros(problem.m), where=z != 0.0)
        for z in (low, high)
        for bound in (c.lower, c.upper)
    ]
    support = np.maximum.reduce(corners)
    first = c.normal_rows
    normal, coefficient, friction_norm = _compute_friction_norms(problem, size)
    support[c.contact_rows] = 0.0
    # The maximum of z.lambda over a cone with lambda_n = 1 is z_n + sum of a_g |z_g|.
    cone_max, rounding = high.copy(), rounding.copy()
    np.add.at(cone_max, normal, coefficient * friction_norm)
    np.add.at(rounding, normal, coefficient * _compute_friction_norms(problem, rounding)[2])
    support[first] = np.where(cone_max[first] > 0.0, np.inf, 0.0)
    size[first] = cone_max[first]
    is_slack = (support > 0.0) & ((size <= rounding) | np.isinf(support))
    return np.where(is_slack, 0.0, support), np.where(is_slack, size, 0.0), rounding


def _compute_min_residual(
    problem: Problem, net: float, y: FloatArray, z: FloatArray
) -> tuple[float, float]:
    """Return the minimum relative residual (5) of any impulse, and the residual that rounding of b can cause.

    If b was computed, its rounding is the rounding of target and J v*.
    """
    data = problem.metric
    size = np.abs(problem.b)
    rows = np.flatnonzero(y)
    get_zero_impulse_reference(problem)
    energy = net / (_compute_energy_norm(data, y * data.d) + _compute_energy_norm(data, z))
    velocity = 0.0 if np.any(z) else net / np.sum(data.d * np.abs(y) / data.weight)
    if not energy + velocity < math.inf:
        return 0.0, 0.0
    if problem.matrix is None:
        free = problem.generalized.v_free if problem.rows is None else problem.rows.v_free  # type: ignore[union-attr]
        size = size + 2.0 * (abs(problem.jacobian) @ np.abs(free.ravel()))
    b_rounding = np.where(y != 0.0, 4.0 * UNIT_ROUNDOFF * size, 0.0)
    max_velocity = np.max(data.weight * b_rounding / data.d)
    return (
        divide_by_reference(data, energy, velocity, rows),
        divide_by_reference(data, _compute_energy_norm(data, b_rounding), max_velocity, rows),
    )


def _compute_energy_norm(data: Any, w: FloatArray) -> Any:
    """Compute the norm of velocities w (m,) [m/s] in the metric of D^-1 [sqrt J]."""
    return np.sqrt(np.sum(w * w / data.d))


def _polish_direction(problem: Problem, y: FloatArray, deadline: Deadline) -> Iterator[FloatArray]:
    """Yield the direction nearest to y in the metric of D, on the rows of y, for which small entries of A^T y are 0.

    Nothing is yielded after the deadline. The direction is yielded twice: rounded to 26 bits, and unrounded. With 26
    bits, sums of halves and thirds of simple numbers can be exactly 0.
    """
    length = np.sqrt(problem.d)
    is_used = np.abs(y) * length > MAX_ROUNDING_SLACK * float(length @ np.abs(y))
    if problem.matrix is not None:
        a = problem.csr
        weight = 1.0 / length
    elif problem.rows is None:
        a = problem.jacobian
        weight = 1.0 / np.sqrt(problem.generalized.mass.diagonal())  # type: ignore[union-attr]
    else:
        a = problem.jacobian
        weight = np.sqrt(problem.rows.inverse_mass_matrix().diagonal())
    if problem.compliance is not None:
        is_used &= problem.compliance == 0.0
    rows = np.flatnonzero(is_used)
    y = np.where(is_used, y, 0.0)
    if not 0 < len(rows) <= MAX_POLISHED_ROWS:
        return
    a = a[rows]
    required = rows if problem.matrix is not None else slice(None)
    for _ in range(2):
        z = weight * _multiply_transposed(a, y[rows])
        max_z = MAX_POLISHED_SLACK * float(length @ np.abs(y))
        columns = np.flatnonzero((z != 0.0) & (np.abs(z) <= max_z))
        if np.any(np.abs(z[required]) > max_z) or len(columns) * len(rows) > MAX_POLISHED_ROWS**2:
            return
        if deadline.has_passed():
            return
        system = (a[:, columns].toarray() / length[rows][:, None] * weight[columns]).T
        y[rows] -= solve_least_squares(system, z[columns]) / length[rows]
    spacing = 2.0**-25 * _round_down_to_power_of_two(y)
    yield np.rint(y / spacing) * spacing
    yield y


def solve_least_squares(matrix: FloatArray, rhs: FloatArray) -> FloatArray:
    """Return the shortest x (n,) that minimises |S x - z|, for S (k, n) and z (k,).

    Components with relative singular values below about 1e-7 are left out. The method is the proximal iteration
    x += S^T (S S^T + s I)^-1 (z - S x), or with (S^T S + s I)^-1 S^T if n < k. It takes a tenth of the time of
    LAPACK's singular value decomposition, and starts no threads.
    """
    wide = matrix.shape[0] < matrix.shape[1]
    product = np.zeros(2 * (min(matrix.shape),))
    short = matrix if wide else matrix.T
    for first in range(
        0, short.shape[1], PRODUCT_COLUMNS
    ):  # Larger products would start threads of BLAS.
        part = np.ascontiguousarray(short[:, first : first + PRODUCT_COLUMNS])
        product += part @ part.T
    size = float(np.trace(product))
    x = np.zeros(matrix.shape[1])
    if not 0.0 < size < math.inf:
        return x
    factor = LinearSystem(len(product))
    factor.factor(product, None, LEAST_SQUARES_SHIFT * size)
    for _ in range(LEAST_SQUARES_ITERATIONS):
        error = rhs - matrix @ x
        x += matrix.T @ factor.solve(error) if wide else factor.solve(matrix.T @ error)
    return x


def _explain_recession_violation(problem: Problem, y: FloatArray) -> str | None:
    """Return the reason why y (m,) is not in the recession cone of the admissible impulses, or None if it is."""
    c = problem.cones
    bad = ((y > 0.0) & np.isfinite(c.upper)) | ((y < 0.0) & np.isfinite(c.lower))
    bad[c.contact_rows] = False
    if bad.any():
        i = int(np.flatnonzero(bad)[0])
        return f"y[{i}] = {y[i]:.2e} leaves the bounds of {problem.row_name(i)}"
    normal, coefficient, size = _compute_friction_norms(problem, y)
    if problem.law == "coulomb":
        tangential = normal[size > 0.0]
        if len(tangential):
            name = problem.row_name(int(tangential[0]))
            return f"y is not along the normal of {name}, as Coulomb friction needs"
    first = c.normal_rows
    outside = np.concatenate(
        [first[y[first] < 0.0], normal[size > coefficient * y[normal] * (1 + 1e-12)]]
    )
    if len(outside):
        return f"y leaves the cone of {problem.row_name(int(outside.min()))}"
    return None
