"""A bound of the distance between an impulse and the solution, proved from any other impulse without trusting it.

Let A be symmetric positive semidefinite, C the convex set that impulses are restricted to (laws linear, lcp and
cone), and D = diag(d) the judge's metric. Take any impulse y, the witness, and the error that the judge computes for
it:

    w = A y - b,   p = Pi_C(y - D^-1 w) in the metric of D,   e = y - p                              (1)

Let y* be a solution of the problem with targets shifted by D e [m/s], so that b' = b + D e. Then

    |y - y*|_A <= |e|_A          and so, for every impulse x,    |x - y*|_A <= |x - y|_A + |e|_A     (2)

Proof. The projection (1) implies (p - y + D^-1 w).D (c - p) >= 0 for every c in C, that is

    (A y - b').(c - p) >= 0;     take c = y*:   (A y - b').(y* - p) >= 0.

y* solves the problem with b', so (A y* - b').(p - y*) >= 0. With X = y - y* and p = y - e, the sum of the last two
inequalities is A X.(e - X) >= 0, hence |X|_A^2 <= X.A e <= |X|_A |e|_A. The second part of (2) is the triangle
inequality. If no impulse attains the infimum of the dual, as may happen with cones, y* is a minimising sequence, along
which velocities converge. y only has to be finite; a good y makes |x - y|_A and |e|_A small.

1/2 |x - y*|_A^2 is the kinetic energy of the difference of velocities dv plus the energy of the difference of impulses
in compliance. With E the right-hand side of (2) times sqrt(1/2), 1/2 m |dv|^2 <= E^2 for the speed of every body.

Rounding goes outward: w, p, |x - y|_A and |e|_A are computed with bounds of their float64 rounding errors, so (2)
holds for real numbers, with A = J M^-1 J^T + diag(theta) of the numbers as stored. For a witness at its round-off
floor, the targets move by about 1e-16 of themselves, and |e|_A is as small relative to the motion.

A bound by the duality gap, |x - y*|_A^2 <= 2 gap, needs no metric but is a square root: a gap known to 1e-16 gives
only 1e-8. (2) is linear in e.

Two answers l1, l2 with errors e1, e2, Delta = l1 - l2 and eps = e1 - e2 satisfy

    |Delta|_A^2 <= |Delta|_A |eps|_A + |eps|_D |Delta|_D                                          (3)

Both p = l - e are projections of l - w/d in the metric of D, so (w1 - w2 - D eps).(Delta - eps) <= 0; expand and use
Cauchy-Schwarz. If A is not symmetric, as in a quadratic program with a singular P, Delta.A Delta >= 0 all the same:

    Delta.A Delta <= |eps.A Delta| + |eps|_D |Delta|_D                                            (4)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.lab.motion.operator import Operator, Size, U
from lavender.problem import Problem
from lavender_ext.judge import measure


@dataclass(frozen=True, eq=False)
class Witness:
    """An impulse y, and a bound of its distance from the solution: equation (2).

    Parameters
    ----------
    impulse : (m,) N s
        y.
    radius : float, sqrt J
        Upper bound of sqrt(1/2) |e|_A.
    moved : float, m/s (rad/s on angular rows)
        Upper bound of max d |e|, the largest shift of a target.
    shift : (m,) m/s
        D e as computed.
    """

    impulse: FloatArray
    radius: float
    moved: float
    shift: FloatArray


def compute_witness(problem: Problem, operator: Operator, impulse: FloatArray) -> Witness:
    """Compute the witness (2) of an impulse y (m,) [N s], for law linear, lcp or cone.

    `operator.explain_refusal()` must be None.
    """
    d = problem.d
    w, off = operator.compute_slack_with_rounding_bound(impulse)
    e = np.empty(problem.m)
    measure.score_slack_array(problem.metric, impulse, w, e)
    uncertainty = _bound_projection_rounding(problem, impulse, w)
    radius = operator.compute_energy_norm(e, uncertainty).upper_bound
    shift = d * e
    moved = float(np.max(np.abs(shift) * (1.0 + 4.0 * U) + d * uncertainty + off, initial=0.0))
    return Witness(impulse, radius, moved, shift)


def subtract_impulses(operator: Operator, x: FloatArray, y: FloatArray) -> tuple[FloatArray, Size]:
    """Compute x - y (m,) [N s] and its energy norm, including the rounding of the subtraction."""
    delta = x - y
    return delta, operator.compute_energy_norm(delta, U * np.abs(delta))


def _bound_projection_rounding(problem: Problem, y: FloatArray, w: FloatArray) -> FloatArray:
    """Return an upper bound (m,) [N s] of the rounding error of e = y - Pi(y - w / d), for exact y, w and d."""
    d, c = problem.d, problem.cones
    size = np.abs(y) + np.abs(w) / d
    uncertainty = 8.0 * U * size
    # The projection of a contact takes about twenty operations on entries of sqrt(d) (y - w / d); each may mix its
    # rows.
    count = np.diff(c.ptr)
    coupled = np.repeat(c.is_contact & (count > 1), count)
    if coupled.any():
        block = np.repeat(np.arange(len(count)), count)
        with np.errstate(over="ignore", invalid="ignore"):
            energy = np.bincount(block, d * size * size, minlength=len(count))
            block_norm = np.sqrt(energy[block] / d)
            largest = float(size.max(initial=0.0))
            if not np.isfinite(block_norm).all() and np.isfinite(largest):
                energy = np.bincount(block, d * (size / largest) ** 2, minlength=len(count))
                block_norm = largest * np.sqrt(energy[block] / d)
        uncertainty[coupled] = (64.0 * U * block_norm)[coupled]
    return uncertainty


def compute_separation(problem: Problem, one: Any, two: Any) -> tuple[float, float]:
    """Compute |Delta|_A [sqrt J] of two judged answers and the largest value that (3), (4) allow, with rounding."""
    delta = problem.on_disk(one.impulse - two.impulse)
    eps = problem.on_disk(one.residual.error - two.residual.error)
    problem = problem.disk
    d: Any = problem.d
    a_delta, a_eps = _multiply_by_a(problem, delta), _multiply_by_a(problem, eps)
    delta_norm = float(np.sqrt(max(delta @ a_delta, 0.0)))
    # The errors e are known up to the round-off floors of both residuals, in the norm of D.
    uncertainty = float(sum(s.residual.floor_energy for s in (one, two)))
    root = 1.0 / np.sqrt(d)
    max_stiffness = float(np.sqrt(np.max(root * _multiply_by_a(problem, root, abs), initial=0.0)))
    eps_d = float(np.sqrt(np.sum(d * eps * eps))) + uncertainty
    eps_a = float(np.sqrt(max(eps @ a_eps, 0.0))) + max_stiffness * uncertainty
    delta_d = float(np.sqrt(np.sum(d * delta * delta)))
    if problem.has_singular_program:
        allowed_square = (
            abs(eps @ a_delta) + uncertainty * np.sqrt(np.sum((root * a_delta) ** 2)) + eps_d * delta_d
        )
        rounding_square = 2.0**-50 * (max_stiffness * delta_d) ** 2
        return delta_norm, float(np.sqrt((1.0 + 1e-9) * allowed_square + rounding_square))
    # x^2 <= x eps_a + eps_d delta_d bounds x = |Delta|_A by the larger root. `rounding` is the error of Delta.A Delta.
    rounding = 2.0**-50 * max_stiffness * delta_d
    allowed = 0.5 * (eps_a + np.sqrt(eps_a * eps_a + 4.0 * eps_d * delta_d))
    return delta_norm, float(allowed * (1.0 + 1e-9) + np.sqrt(rounding * max_stiffness * delta_d))


def _multiply_by_a(problem: Problem, x: Any, transform: Callable[[Any], Any] = lambda a: a) -> Any:
    """Compute A x (m,), without forming A if J and M are known.

    `transform` is applied to the entries of each factor; with `abs`, the result is a bound of |A| x for x >= 0.
    """
    if problem.generalized is not None:
        y = transform(problem.whitened)
        return y @ (y.T @ x) + problem.compliance * x
    if problem.rows is None:
        return transform(problem.csr) @ x
    assert problem.compliance is not None
    jac = transform(problem.jacobian)
    return jac @ (transform(problem.rows.inverse_mass_matrix()) @ (jac.T @ x)) + problem.compliance * x
