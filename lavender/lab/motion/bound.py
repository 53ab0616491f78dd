"""How far an impulse can be from the solution, proved from any other impulse: no reference need be trusted.

Let A be symmetric positive semidefinite, C the convex set that impulses are bounded to (laws linear, lcp
and cone), D = diag(d) the judge's metric. Take any impulse y, the witness, and the judge's error of it:

    w = A y - b,   p = Pi_C(y - D^-1 w) in the metric of D,   e = y - p                              (1)

Let y* be a solution of the problem whose targets are moved by D e [m/s], so that b' = b + D e. Then

    |y - y*|_A <= |e|_A          and so, for every impulse x,    |x - y*|_A <= |x - y|_A + |e|_A     (2)

Proof. The projection (1) says (p - y + D^-1 w).D (c - p) >= 0 for every c in C, that is

    (A y - b').(c - p) >= 0;     take c = y*:   (A y - b').(y* - p) >= 0.

y* solves its problem, so (A y* - b').(p - y*) >= 0. The sum of both, with X = y - y* and p = y - e, is
A X.(e - X) >= 0, hence |X|_A^2 <= X.A e <= |X|_A |e|_A. The second part is the triangle inequality. Where
cones leave the infimum of the dual unattained, y* stands for a minimising sequence, along which velocities
converge. Nothing is asked of y but that it is finite; a good one makes both numbers small.

Half the square of (2) is the energy of the difference of velocities and of what compliance stores. The
kinetic part of any difference is at most the whole, which bounds the speed of every body: 1/2 m |dv|^2 <= E^2.

Rounding goes outward: w, p, |x - y|_A and |e|_A are taken with bounds of what float64 may have lost in them,
so (2) holds for real numbers, with A = J M^-1 J^T + diag(theta) of the numbers as they are stored. Two
sums of this kind meet where nobody's arithmetic can: at a witness at the floor the targets move by about
1e-16 of themselves and |e|_A is as small beside the motion.

A bound by the duality gap, |x - y*|_A^2 <= 2 gap, needs no metric but is a square root: a gap known to
1e-16 says 1e-8. (2) is linear in e.

Between two answers l1, l2 with errors e1, e2, and Delta = l1 - l2, eps = e1 - e2:

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
    """An impulse y, and how far the solution can be from it: equation (2)."""

    impulse: FloatArray  # (m,) N s, y
    radius: float  # sqrt J, no less than sqrt(1/2) |e|_A
    moved: float  # m/s (rad/s on angular rows), no less than max d |e|: what the targets are moved by
    shift: FloatArray  # (m,) m/s, D e as computed


def witness(problem: Problem, operator: Operator, impulse: FloatArray) -> Witness:
    """What (2) says of an impulse y (m,) [N s]; law linear, lcp or cone, `operator.refusal()` None."""
    d = problem.d
    w, off = operator.slack(impulse)
    e = np.empty(problem.m)
    measure.score(problem.metric, impulse, w, e)
    fuzz = _rounding_of_projection(problem, impulse, w)
    radius = operator.size(e, fuzz).most
    shift = d * e
    moved = float(np.max(np.abs(shift) * (1.0 + 4.0 * U) + d * fuzz + off, initial=0.0))
    return Witness(impulse, radius, moved, shift)


def difference(operator: Operator, x: FloatArray, y: FloatArray) -> tuple[FloatArray, Size]:
    """x - y (m,) [N s] and its energy norm, the rounding of the subtraction included."""
    delta = x - y
    return delta, operator.size(delta, U * np.abs(delta))


def _rounding_of_projection(problem: Problem, y: FloatArray, w: FloatArray) -> FloatArray:
    """(m,) N s: no less than what rounding changes in e = y - Pi(y - w / d) of the numbers y, w, d."""
    d, c = problem.d, problem.cones
    size = np.abs(y) + np.abs(w) / d
    fuzz = 8.0 * U * size
    # A contact: about twenty operations on the entries of sqrt(d) (y - w / d), in any of which they may meet.
    count = np.diff(c.ptr)
    together = np.repeat(c.is_contact & (count > 1), count)
    if together.any():
        block = np.repeat(np.arange(len(count)), count)
        with np.errstate(over="ignore", invalid="ignore"):
            energy = np.bincount(block, d * size * size, minlength=len(count))
            whole = np.sqrt(energy[block] / d)
            top = float(size.max(initial=0.0))
            if not np.isfinite(whole).all() and np.isfinite(top):
                energy = np.bincount(block, d * (size / top) ** 2, minlength=len(count))
                whole = top * np.sqrt(energy[block] / d)
        fuzz[together] = (64.0 * U * whole)[together]
    return fuzz


def separation(problem: Problem, one: Any, two: Any) -> tuple[float, float]:
    """|Delta|_A of two judged answers and the largest value of it that (3), (4) allow, rounding included [sqrt J]."""
    delta = problem.on_disk(one.impulse - two.impulse)
    eps = problem.on_disk(one.residual.error - two.residual.error)
    problem = problem.disk
    d: Any = problem.d
    a_delta, a_eps = _apply(problem, delta), _apply(problem, eps)
    apart = float(np.sqrt(max(delta @ a_delta, 0.0)))
    # The errors e themselves are known to the floor of both residuals, in the norm of D.
    fuzz = float(sum(s.residual.floor_energy for s in (one, two)))
    root = 1.0 / np.sqrt(d)
    stiff = float(np.sqrt(np.max(root * _apply(problem, root, abs), initial=0.0)))
    eps_d = float(np.sqrt(np.sum(d * eps * eps))) + fuzz
    eps_a = float(np.sqrt(max(eps @ a_eps, 0.0))) + stiff * fuzz
    delta_d = float(np.sqrt(np.sum(d * delta * delta)))
    if problem.has_singular_program:
        most = abs(eps @ a_delta) + fuzz * np.sqrt(np.sum((root * a_delta) ** 2)) + eps_d * delta_d
        return apart, float(np.sqrt((1.0 + 1e-9) * most + 2.0**-50 * (stiff * delta_d) ** 2))
    # x^2 <= x eps_a + eps_d delta_d bounds x by the larger root. Rounding of Delta.A Delta itself:
    rounding = 2.0**-50 * stiff * delta_d
    allowed = 0.5 * (eps_a + np.sqrt(eps_a * eps_a + 4.0 * eps_d * delta_d))
    return apart, float(allowed * (1.0 + 1e-9) + np.sqrt(rounding * stiff * delta_d))


def _apply(problem: Problem, x: Any, part: Callable[[Any], Any] = lambda a: a) -> Any:
    """A x (m,), without forming A where J and M are known; with `abs` a bound of abs(A) x for x >= 0."""
    if problem.generalized is not None:
        y = part(problem.whitened)
        return y @ (y.T @ x) + problem.compliance * x
    if problem.rows is None:
        return part(problem.csr) @ x
    assert problem.compliance is not None
    jac = part(problem.jacobian)
    return jac @ (part(problem.rows.inverse_mass_matrix()) @ (jac.T @ x)) + problem.compliance * x
