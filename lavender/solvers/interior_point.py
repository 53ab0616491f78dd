"""A primal-dual interior point on a quadratic program itself: x and the impulses of its rows, whatever P is.

    min 1/2 x.P x + q.x   subject to   J x = target on the first rows, J x - target = w >= 0 on the others

    [ P + rho   J^T          ] [  dx      ]   [ -(P x + q - J^T lambda)                ]
    [ J        -(W + delta)  ] [ -dlambda ] = [ -(J x - target - w) - w + mu / lambda  ],   W = w / lambda      (1)

by Mehrotra (1992, On the implementation of a primal-dual interior point method): a step to mu = 0 tells how much of mu
the next one keeps, and its second order. rho and delta are proximal terms around the iterate (Altman, Gondzio 1999,
Regularized symmetric indefinite systems in interior point methods), refined away; P, J and target are balanced first
(Ruiz 2001), then x and the objective get units of their own. What has few entries is factored as (1) stands,
quasidefinite, in one order for all steps; else x alone is left, with P + rho + J^T (W + delta)^-1 J.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline, Stopwatch
from lavender.base.lazy_import import sparse as sp
from lavender.problem.generalized import Compressed
from lavender.problem.quadratic import QPSolution, QuadraticProgram
from lavender.solvers.factors import TINY, WIDE, Panels
from lavender.solvers.setup_times import DENSE, SPARSE, dense_work
from lavender_ext.core.assemble import mirrored, transposed
from lavender_ext.core.checks import MOST, largest
from lavender_ext.factor.sparse import FullCholesky
from lavender_ext.newton.program import Iterate, balanced, entries, scaled

NAME = "interior point"  # in turns and messages
STEPS = 100
IDLE = 8  # steps in a row that leave neither a smaller error nor smaller forces, after which none follows
PROXIMAL = 1e-8  # rho and delta, of balanced rows
REFINED = 10  # solves with one factor of (1)
EXACT = 1e-14  # of the right-hand side, that refinement leaves,
INEXACT = 1e-6  # or of this right-hand side times the error of the iterate, if that is more
BALANCED = 5  # passes of Ruiz
LARGE = 0.9  # share of targets that are at most the unit of x: a few may stand for no bound at all
FULL = 0.2  # share of entries from which P and J are full matrices,
FULL_SIZE = 3000  # of at most so many variables
CLOSER = 0.01  # of tol, as its norms are other ones than the judge's
WATCHED = 4.0  # s of one factor, at most: Ctrl-C is heard between two
FARKAS = 1e-6  # |J^T lambda| over the sums of its terms, from which lambda may prove that there is no x


class InteriorPoint:
    """The balanced program, variables in the order of M's factor, and the iterate."""

    late = False  # it ended for want of time
    error = 0.0  # of the iterate, relative

    @np.errstate(all="ignore")  # what overflows in these units is left to velocities
    def __init__(self, qp: QuadraticProgram) -> None:
        self.qp, of = qp, qp.generalized
        n, self.order = of.nv, of.order
        p, j = mirrored(*of.operator.mass), of.operator.jac
        if qp.proximal is not None:
            of_row = np.repeat(np.arange(n), np.diff(p[0]))
            p[2][p[1] == of_row] -= self._ordered(qp.proximal)
        column, self.row = balanced(p, j, BALANCED)  # x = column x', lambda = size row lambda'
        p, j = scaled(p, column, column), scaled(j, self.row, column)
        q, target = column * self._ordered(qp.q), self.row * qp.target
        curved, steep = largest(p[2]), largest(q)
        some = np.abs(target[target != 0.0])
        # x in units of a large target: then P stands beside J as Ruiz left it, whatever the units of x and of q.
        self.far = 1.0
        if len(some):
            some.sort()
            self.far = float(some[int(LARGE * (len(some) - 1))])
        elif steep > 0.0 and curved > 0.0:
            self.far = steep / curved
        self.size, self.column = max(curved, steep / self.far) or 1.0, column
        p = p[0], p[1], p[2] / self.size
        self.q = q / (self.size * self.far)
        jt = transposed(*j, n)
        self.iterate = Iterate(p, j, jt, self.q, target / self.far, qp.free)
        many = np.diff(j[0]) > 1
        full = dense_work(n) + 0.5 * np.count_nonzero(many) * float(n) ** 2
        self.seconds = DENSE * full if n <= FULL_SIZE else np.inf  # of one factor
        self.system: Any = None
        if len(p[1]) + len(j[1]) < FULL * n * (n + np.count_nonzero(many)) or n > FULL_SIZE:
            by_entries = _Sparse(p, j, jt)
            if SPARSE * by_entries.work < self.seconds:
                self.system, self.seconds = by_entries, SPARSE * by_entries.work
        if self.system is None and self.seconds < WATCHED:
            self.system = _Full(p, j, many)
        self.factorisations = 0

    @property
    def unit(self) -> FloatArray:
        """(n,) What stands for P_ii, with J beside it: 1 / sqrt(unit) is a unit of each variable."""
        return self.qp.generalized._given(self.size / self.column**2)

    def _ordered(self, x: FloatArray) -> FloatArray:
        return x if self.order is None else x[self.order]

    @np.errstate(all="ignore")  # an iterate that overflows is none
    def run(
        self, tol: float, deadline: Deadline, proof: Callable[[FloatArray], FloatArray | None]
    ) -> tuple[QPSolution | None, FloatArray | None]:
        """The answer with the least error, and the `proof` (m,) that its impulses hold where there is no solution.

        Step by step they come nearer to such a proof, so it is asked for anew.
        """
        if self.seconds > WATCHED or deadline.passed(self.seconds):
            return None, None
        at, watch, flat = self.iterate, Stopwatch(), not self.q.any()
        self._factor()
        at.begin(self._solved())
        best: tuple[FloatArray, FloatArray] | None = None
        least = nearest = lightest = np.inf
        asked, idle = FARKAS, 0
        for _ in range(STEPS):
            x, lam = self.far * self.column * at.x, self._impulse()
            if not (largest(lam) <= MOST and largest(x) <= MOST):
                break  # nor NaN: no answer has such numbers
            rows, forces, gap, left, proves = at.measure()
            error = max(rows, forces, gap)
            if not (rows < np.inf and forces < np.inf and gap < np.inf):
                break
            if rows <= tol and flat:
                # All forces may vanish, and dual and gap with them: the judge knows beside what.
                error = max(rows, self._answer(x, lam, 0.0).error)
            self.error = error
            # While lambda grows (an unstable plant) forces come down long before the gap does.
            gains = error < 0.9 * least or left < 0.9 * nearest or forces < 0.9 * lightest
            idle = 0 if gains else idle + 1
            if error < least:
                best = x, lam
            least, nearest, lightest = min(least, error), min(nearest, left), min(lightest, forces)
            if error <= CLOSER * tol:
                answer = self._answer(x, lam, tol)
                if answer.found:
                    return answer, None
            found = None
            if proves <= asked:
                asked = 0.5 * proves
                found = proof(lam)
            if found is not None:
                return self._answer(x, lam, tol), found
            self.late = deadline.passed(watch.seconds / max(1, self.factorisations))
            if idle > IDLE or self.late:
                break
            self._step()
        return (None if best is None else self._answer(*best, tol)), None

    def _step(self) -> None:
        self._factor()
        u = self._solved()
        if self.qp.free < len(self.row):
            self.iterate.correct(u)
            u = self._solved()
        self.iterate.step(u)

    def _factor(self) -> None:
        """Of (1) with the W of the iterate."""
        self.system.factor(self.iterate.theta)
        self.factorisations += 1

    def _solved(self) -> FloatArray:
        """(dx, -dlambda) (n + m,) of (1), rho and delta refined away."""
        at = self.iterate
        u: FloatArray = self.system.solve(at.right)
        for _ in range(REFINED - 1):
            if at.left_of(u) <= max(EXACT, INEXACT * self.error):
                break
            u = u + self.system.solve(at.rest)
        return u

    def _answer(self, x: FloatArray, lam: FloatArray, tol: float) -> QPSolution:
        return self.qp.solution(lam, tol, self.qp.generalized._given(x))

    def _impulse(self) -> FloatArray:
        """(m,) In the program's own units."""
        return self.far * self.size * self.row * self.iterate.lam


class _Sparse:
    """(1) by its entries, LDL^T in an order of least degree."""

    def __init__(self, p: Compressed, j: Compressed, jt: Compressed) -> None:
        (indptr, indices, data), pattern = entries(p, j, jt)
        self.work = Panels(*pattern).work()  # multiply-adds of a factor
        self.upper = sp.csc_matrix((data, indices, indptr))
        self.n, self.diagonal = len(p[0]) - 1, indptr[1:] - 1
        self.own = data[self.diagonal[: self.n]] + PROXIMAL
        self.made: Any = None

    def factor(self, theta: FloatArray) -> None:
        import qdldl

        self.upper.data[self.diagonal[: self.n]] = self.own
        self.upper.data[self.diagonal[self.n :]] = -(theta + PROXIMAL)
        if self.made is None:
            self.made = qdldl.Solver(self.upper, upper=True)
        else:
            self.made.update(self.upper, upper=True)

    def solve(self, right: FloatArray) -> FloatArray:
        u: FloatArray = self.made.solve(right)
        return u


class _Full:
    """x alone, by a full matrix; rows of one variable stand on its diagonal."""

    def __init__(self, p: Compressed, j: Compressed, many: Any) -> None:
        self.n, self.m = n, m = len(p[0]) - 1, len(many)
        self.p = sp.csr_array((p[2], p[1], p[0]), shape=(n, n)).toarray()
        self.many = np.flatnonzero(many)
        self.rows = sp.csr_array((j[2], j[1], j[0]), shape=(m, n))[self.many].toarray()
        self.single = np.flatnonzero(np.diff(j[0]) == 1)
        self.at, self.value = j[1][j[0][self.single]], j[2][j[0][self.single]]

    def factor(self, theta: FloatArray) -> None:
        self.v = 1.0 / (theta + PROXIMAL)
        root = np.sqrt(self.v[self.many])[:, None] * self.rows
        matrix = self.p + root.T @ root
        diagonal = np.bincount(self.at, self.v[self.single] * self.value**2, self.n)
        matrix.flat[:: self.n + 1] += diagonal + PROXIMAL
        self.full = FullCholesky(matrix, TINY * matrix.diagonal(), WIDE)

    def solve(self, right: FloatArray) -> FloatArray:
        a, b = right[: self.n], right[self.n :]
        force = self.v * b
        singles = np.bincount(self.at, force[self.single] * self.value, self.n)
        x = self.full.solve(a + self.rows.T @ force[self.many] + singles)
        along = np.zeros(self.m)
        along[self.many], along[self.single] = self.rows @ x, self.value * x[self.at]
        return np.concatenate([x, self.v * (along - b)])
