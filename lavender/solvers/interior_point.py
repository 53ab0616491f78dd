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
from lavender.base.later import sparse as sp
from lavender.problem.quadratic import QPSolution, QuadraticProgram
from lavender.solvers.factors import TINY, WIDE, Panels, rows_of
from lavender.solvers.setup_times import DENSE, SPARSE, dense_work
from lavender_ext.core.checks import MOST, largest
from lavender_ext.factor.sparse import FullCholesky

NAME = "interior point"  # in turns and messages
STEPS = 50
IDLE = 8  # steps in a row that leave no smaller error, after which none follows
PROXIMAL = 1e-8  # rho and delta, of balanced rows
REFINED = 3  # solves with one factor of (1)
EXACT = 1e-14  # of the right-hand side, that refinement leaves
BALANCED = 5  # passes of Ruiz
LARGE = 0.9  # share of targets that are at most the unit of x: a few may stand for no bound at all
FULL = 0.2  # share of entries from which P and J are full matrices,
FULL_SIZE = 3000  # of at most so many variables
CLOSER = 0.01  # of tol, as its norms are other ones than the judge's
WATCHED = 4.0  # s of one factor, at most: Ctrl-C is heard between two
SHORT, INSIDE = 0.99, 1.0 - 1e-10  # of the way to the boundary: at first, and at most
FARKAS = 1e-6  # |J^T lambda| over the sums of its terms, from which lambda may prove that there is no x
Solve = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]


class InteriorPoint:
    """The balanced program, and the iterate."""

    late = False  # it ended for want of time

    @np.errstate(all="ignore")  # what overflows in these units is left to velocities
    def __init__(self, qp: QuadraticProgram) -> None:
        self.qp, of = qp, qp.generalized
        p, j = sp.csr_array(of.mass), sp.csr_array(of.jac)
        if qp.proximal is not None:
            p = sp.csr_array(p - sp.diags_array(qp.proximal))
        self.column, self.row = _balanced(p, j, sp.csr_array(j.T))  # x = column x', lambda = size row lambda'
        self.p, self.j = _scaled(p, self.column, self.column), _scaled(j, self.row, self.column)
        self.jt = sp.csr_array(self.j.T)
        self.terms = abs(self.jt)
        q, target = self.column * qp.q, self.row * qp.target
        curved, steep = np.abs(self.p.data).max(initial=0.0), np.abs(q).max(initial=0.0)
        some = np.abs(target[target != 0.0])
        # x in units of a large target: then P stands beside J as Ruiz left it, whatever the units of x and of q.
        self.far = 1.0
        if len(some):
            self.far = float(np.quantile(some, LARGE))
        elif steep > 0.0 and curved > 0.0:
            self.far = float(steep / curved)
        self.size = float(max(curved, steep / self.far)) or 1.0
        self.p, self.q, self.target = self.p / self.size, q / (self.size * self.far), target / self.far
        n = len(q)
        many = np.diff(self.j.indptr) > 1
        full = dense_work(n) + 0.5 * np.count_nonzero(many) * float(n) ** 2
        self.seconds = DENSE * full if n <= FULL_SIZE else np.inf  # of one factor
        self.system: Any = None
        if self.p.nnz + self.j.nnz < FULL * n * (n + np.count_nonzero(many)) or n > FULL_SIZE:
            entries = _Sparse(self.p, self.j)
            if SPARSE * entries.work < self.seconds:
                self.system, self.seconds = entries, SPARSE * entries.work
        if self.system is None and self.seconds < WATCHED:
            self.system = _Full(self.p, self.j, many)
        self.factorisations = 0

    @property
    def unit(self) -> FloatArray:
        """(n,) What stands for P_ii, with J beside it: 1 / sqrt(unit) is a unit of each variable."""
        return self.size / self.column**2

    @np.errstate(all="ignore")  # an iterate that overflows is none
    def run(
        self, tol: float, deadline: Deadline, proof: Callable[[FloatArray], FloatArray | None]
    ) -> tuple[QPSolution | None, FloatArray | None]:
        """The answer with the least error, and the `proof` (m,) that its impulses hold where there is no solution.

        Step by step they come nearer to such a proof, so it is asked for anew.
        """
        if self.seconds > WATCHED or deadline.passed(self.seconds):
            return None, None
        free, m = self.qp.free, len(self.target)
        theta, watch = np.ones(m), Stopwatch()
        theta[:free] = 0.0
        x, lam = self._factored(theta)(-self.q, self.target)
        w = self.j @ x - self.target
        w[:free] = 0.0
        _push_inside(w[free:], lam[free:])
        best: tuple[FloatArray, FloatArray] | None = None
        least, nearest, idle = np.inf, np.inf, 0
        for _ in range(STEPS):
            if not (largest(self._impulse(lam)) <= MOST and largest(self.far * self.column * x) <= MOST):
                break  # nor NaN: no answer has such numbers
            dual = self.p @ x + self.q - self.jt @ lam
            primal = self.j @ x - self.target - w
            error = self._error(x, lam, w, dual, primal)
            if not error < np.inf:
                break
            left = max(np.abs(dual).max(), np.abs(primal).max(initial=0.0), w @ lam / max(1, m))
            idle = 0 if error < 0.9 * least or left < 0.9 * nearest else idle + 1
            if error < least:
                best = x, lam
            least, nearest = min(least, error), min(nearest, left)
            if error <= CLOSER * tol:
                answer = self._answer(x, lam, tol)
                if answer.found:
                    return answer, None
            found = proof(self._impulse(lam)) if self._may_prove(lam) else None
            if found is not None:
                return self._answer(x, lam, tol), found
            self.late = deadline.passed(watch.seconds / max(1, self.factorisations))
            if idle > IDLE or self.late:
                break
            x, lam, w = self._step(x, lam, w, dual, primal)
        return (None if best is None else self._answer(*best, tol)), None

    def _step(
        self, x: FloatArray, lam: FloatArray, w: FloatArray, dual: FloatArray, primal: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        free = self.qp.free
        z, s = lam[free:], w[free:]
        theta = np.zeros(len(lam))
        theta[free:] = s / z
        solve = self._factored(theta)
        right = -primal - w
        dx, dlam = solve(-dual, right)
        if not len(z):
            return x + dx, lam + dlam, w
        dz = dlam[free:]
        ds = -s - theta[free:] * dz
        mu, most = float(s @ z) / len(z), min(1.0, _boundary(s, ds), _boundary(z, dz))
        left = float((s + most * ds) @ (z + most * dz)) / len(z)
        second = (ds * dz - mu * (left / mu) ** 3) / z
        right[free:] -= second
        dx, dlam = solve(-dual, right)
        dz = dlam[free:]
        ds = -s - second - theta[free:] * dz
        t = min(1.0, min(max(SHORT, 1.0 - mu), INSIDE) * min(_boundary(s, ds), _boundary(z, dz)))
        w = w.copy()
        w[free:] += t * ds
        return x + t * dx, lam + t * dlam, w

    def _factored(self, theta: FloatArray) -> Solve:
        """What solves (1) with this W, rho and delta refined away."""
        self.system.factor(theta)
        self.factorisations += 1

        def solve(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
            x, lam = self.system.solve(a, b)
            most = EXACT * max(np.abs(a).max(initial=0.0), np.abs(b).max(initial=0.0))
            for _ in range(REFINED - 1):
                c = a - (self.p @ x - self.jt @ lam)
                d = b - (self.j @ x + theta * lam)
                if max(np.abs(c).max(initial=0.0), np.abs(d).max(initial=0.0)) <= most:
                    break
                dx, dlam = self.system.solve(c, d)
                x, lam = x + dx, lam + dlam
            return x, lam

        return solve

    def _error(
        self, x: FloatArray, lam: FloatArray, w: FloatArray, dual: FloatArray, primal: FloatArray
    ) -> float:
        """The largest of four relative residuals; min(w, lambda) is sqrt(mu) where neither is large.

        Where q is 0 all forces may vanish, and dual and gap with them: the judge knows beside what.
        """
        free, along = self.qp.free, self.j @ x
        short = _relative(np.minimum(w[free:], lam[free:]), along, self.target)
        if not self.q.any():
            return max(short, self._answer(x, lam, 0.0).error)
        force = dual + self.jt @ lam - self.q  # P x
        gap = np.array([x @ force, self.q @ x, -self.target @ lam])
        return max(
            short,
            _relative(dual, force, self.q, dual - force - self.q),
            _relative(primal, along, self.target),
            _relative(gap.sum(keepdims=True), gap),
        )

    def _may_prove(self, lam: FloatArray) -> bool:
        """Whether J^T lambda vanishes beside its terms and target.lambda > 0: with 0 no x has J x >= target."""
        if not self.target @ lam > 0.0:
            return False
        sums = self.terms @ np.abs(lam)
        return bool((np.abs(self.jt @ lam) <= FARKAS * sums.max(initial=0.0)).all())

    def _answer(self, x: FloatArray, lam: FloatArray, tol: float) -> QPSolution:
        return self.qp.solution(self._impulse(lam), tol, self.far * self.column * x)

    def _impulse(self, lam: FloatArray) -> FloatArray:
        """(m,) In the program's own units."""
        return self.far * self.size * self.row * lam


class _Sparse:
    """(1) by its entries, LDL^T in an order of least degree."""

    def __init__(self, p: sp.csr_array, j: sp.csr_array) -> None:
        self.n, m = p.shape[0], j.shape[0]
        whole = sp.block_array([[p + sp.eye_array(self.n), j.T], [None, -sp.eye_array(m)]], format="csc")
        self.upper = sp.csc_matrix(sp.triu(whole, format="csc"))
        self.upper.sort_indices()
        pattern = sp.csr_array(whole + whole.T)
        self.work = Panels(*rows_of(pattern)[:2]).work()  # multiply-adds of a factor
        self.diagonal, self.own = self.upper.indptr[1:] - 1, p.diagonal() + PROXIMAL
        self.made: Any = None

    def factor(self, theta: FloatArray) -> None:
        import qdldl

        self.upper.data[self.diagonal[: self.n]] = self.own
        self.upper.data[self.diagonal[self.n :]] = -(theta + PROXIMAL)
        if self.made is None:
            self.made = qdldl.Solver(self.upper, upper=True)
        else:
            self.made.update(self.upper, upper=True)

    def solve(self, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        both = self.made.solve(np.concatenate([a, b]))
        return both[: self.n], -both[self.n :]


class _Full:
    """x alone, by a full matrix; rows of one variable stand on its diagonal."""

    def __init__(self, p: sp.csr_array, j: sp.csr_array, many: Any) -> None:
        self.p, self.j, self.jt = p.toarray(), j, sp.csr_array(j.T)
        self.many, self.rows = many, j[np.flatnonzero(many)].toarray()
        single = np.flatnonzero(np.diff(j.indptr) == 1)
        self.single, self.at, self.square = single, j.indices[j.indptr[single]], j.data[j.indptr[single]] ** 2

    def factor(self, theta: FloatArray) -> None:
        self.v = 1.0 / (theta + PROXIMAL)
        root = np.sqrt(self.v[self.many])[:, None] * self.rows
        matrix = self.p + root.T @ root
        diagonal = np.bincount(self.at, self.v[self.single] * self.square, len(matrix))
        matrix.flat[:: len(matrix) + 1] += diagonal + PROXIMAL
        self.full = FullCholesky(matrix, TINY * matrix.diagonal(), WIDE)

    def solve(self, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        x = self.full.solve(a + self.jt @ (self.v * b))
        return x, self.v * (b - self.j @ x)


def _balanced(p: sp.csr_array, j: sp.csr_array, jt: sp.csr_array) -> tuple[FloatArray, FloatArray]:
    """Factors of columns and rows with which the largest entry of each in (1) comes near 1."""
    column, row = np.ones(p.shape[0]), np.ones(j.shape[0])
    for _ in range(BALANCED):
        of_column = column * np.maximum(_largest(p, column), _largest(jt, row))
        of_row = row * _largest(j, column)
        column /= np.sqrt(np.where(of_column > 0.0, of_column, 1.0))
        row /= np.sqrt(np.where(of_row > 0.0, of_row, 1.0))
    return column, row


def _largest(a: sp.csr_array, right: FloatArray) -> FloatArray:
    """max_k |A_ik| right_k of each row i."""
    out, some = np.zeros(a.shape[0]), np.flatnonzero(np.diff(a.indptr))
    if len(some):
        out[some] = np.maximum.reduceat(np.abs(a.data) * right[a.indices], a.indptr[some])
    return out


def _scaled(a: sp.csr_array, left: FloatArray, right: FloatArray) -> sp.csr_array:
    at = np.repeat(left, np.diff(a.indptr))
    return sp.csr_array((at * a.data * right[a.indices], a.indices, a.indptr), shape=a.shape)


def _relative(left: FloatArray, *terms: FloatArray) -> float:
    """What is left over the largest of the terms it is the sum of."""
    return float(np.abs(left).max(initial=0.0) / (max(np.abs(x).max(initial=0.0) for x in terms) or 1.0))


def _boundary(x: FloatArray, dx: FloatArray) -> float:
    """t at which the first of x + t dx is 0; inf where none is."""
    most = float((-dx / x).max(initial=0.0))
    return 1.0 / most if most > 0.0 else np.inf


def _push_inside(w: FloatArray, z: FloatArray) -> None:
    """Mehrotra's start, in place: both positive, and their products of one size."""
    if not len(w):
        return
    for x in (w, z):
        x += max(-1.5 * x.min(), 0.0) + 1e-10
    product = 0.5 * (w @ z)
    for x, share in ((w, product / z.sum()), (z, product / w.sum())):
        x += share
        np.maximum(x, 1e-4, out=x)
