"""Friction with a bound for each tangent, as a problem of bounded rows, for solvers that accept only these.

Of a contact with the normal impulse n and bounds |t_i| <= c_i n, lambda = E z:

    coulomb   t_i = p_i - q_i,  p, q, s >= 0                  (Stewart, Trinkle 1996; Anitescu, Potra 1997)
              w_i + d_i s_i      complementary to p_i
             -w_i + d_i s_i      complementary to q_i                                          (1)
              d_i (c_i n - p_i - q_i)     complementary to s_i [N s], d_i s_i the speed of sliding along i
    cone      (n, t) = sum over signs z_k (1, +-c_1, +-c_2),  z >= 0: its edges, two for each axis with c_i > 0,
              E^T w complementary to z                                                         (2)

(1) is the matrix E^T A E and what couples s to the rest, copositive where A is positive semidefinite: Lemke's path ends
at a solution of every problem that has no joint to hold back. (2) is symmetric where A is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline
from lavender.base.errors import InputError
from lavender.base.lazy_import import sparse as sp
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import compute_relative
from lavender.judge.solution import Claim, Status, summed
from lavender.problem import Problem
from lavender.problem.cones import project
from lavender.solvers.registry import Solver

# Of (1) and (2): times that they have the problem's rows, and s of making them for each of those.
FEW, ROW_TIME = 3.0, 2e-5


@dataclass(frozen=True)
class AsRows:
    """A problem of bounded rows in z (n,), and lambda = E z of the one it stands for."""

    problem: Problem
    rows: Problem
    back: sp.csr_array  # E (m, n)

    def start(self, impulse: FloatArray) -> FloatArray:
        """Some z (n,) of a feasible impulse (m,), or of the nearest feasible one."""
        c, out = self.problem.cones, []
        x, contact = project(c, impulse), c.is_contact
        for i, sides in _blocks(self.problem):
            j = c.ptr[i]
            if not sides:
                out += list(x[j : j + 1] if contact[i] else x[j : c.ptr[i + 1]])
            elif self.problem.law == "cone":
                share = [np.divide(x[j + t], s * x[j]) if s * x[j] > 0.0 else 0.0 for t, s in sides]
                for signs in product((1.0, -1.0), repeat=len(sides)):
                    out.append(
                        x[j] * np.prod([0.5 * (1.0 + a * b) for a, b in zip(signs, share, strict=True)])
                    )
            else:
                out.append(x[j])
                for t, _ in sides:
                    out += [max(x[j + t], 0.0), max(-x[j + t], 0.0), 0.0]
        return np.clip(np.array(out, float), self.rows.cones.lower, self.rows.cones.upper)


def _blocks(problem: Problem) -> list[tuple[int, list[tuple[int, float]]]]:
    """Blocks, and of each the offset and the c_i of every row that its normal bounds, where c_i > 0."""
    c = problem.cones
    reach = c.reach
    return [
        (i, [(t, float(reach[j + t])) for t in range(1, end - j) if reach[j + t] > 0.0])
        for i, (j, end) in enumerate(zip(c.ptr[:-1].tolist(), c.ptr[1:].tolist(), strict=True))
    ]


def as_rows(problem: Problem) -> AsRows:
    """(1) or (2) of a problem without disks."""
    c, d, contact = problem.cones, problem.d, problem.cones.is_contact
    entries: list[tuple[int, int, float]] = []  # of E
    more: list[tuple[int, int, float]] = []  # couplings of s
    low: list[float] = []
    high: list[float] = []
    for i, sides in _blocks(problem):
        j, n = int(c.ptr[i]), len(low)
        if not contact[i]:
            size = int(c.ptr[i + 1]) - j
            entries += [(j + k, n + k, 1.0) for k in range(size)]
            low += c.lower[j : j + size].tolist()
            high += c.upper[j : j + size].tolist()
            continue
        if problem.law == "cone":
            for k, signs in enumerate(product((1.0, -1.0), repeat=len(sides))):
                entries.append((j, n + k, 1.0))
                entries += [(j + t, n + k, sign * s) for sign, (t, s) in zip(signs, sides, strict=True)]
            count = 2 ** len(sides)
        else:
            entries.append((j, n, 1.0))
            for k, (t, s) in enumerate(sides):
                p, q, slide, x = n + 1 + 3 * k, n + 2 + 3 * k, n + 3 + 3 * k, float(d[j + t])
                entries += [(j + t, p, 1.0), (j + t, q, -1.0)]
                more += [(p, slide, x), (q, slide, x), (slide, n, s * x), (slide, p, -x), (slide, q, -x)]
            count = 1 + 3 * len(sides)
        low += [0.0] * count
        high += [np.inf] * count
    n = len(low)
    e = _sparse(entries, (problem.m, n))
    with np.errstate(all="ignore"):
        a = sp.csr_array(e.T @ (problem.csr @ e)) + _sparse(more, (n, n))
        b = e.T @ problem.b
    try:
        rows = Problem.lcp(sp.csr_array(a), b, np.array(low), np.array(high), copy=False)
    except (
        InputError
    ) as error:  # The given problem is valid: only these sums of its entries are out of range.
        raise OverflowError("A or b, times coefficients of friction, is out of range") from error
    return AsRows(problem, rows, e)


def count_rows(problem: Problem) -> int:
    """Upper bound of the number of rows n of (1) or (2), for a problem without disks."""
    c = problem.cones
    if problem.law == "cone":
        sides = np.where(c.is_contact, np.diff(c.ptr) - 1, 0)
        return int(np.where(c.is_contact, 2**sides, np.diff(c.ptr)).sum())
    return problem.m + (2 * int((np.diff(c.ptr) - 1)[c.is_contact].sum()) if problem.law == "coulomb" else 0)


def _sparse(entries: list[tuple[int, int, float]], shape: tuple[int, int]) -> sp.csr_array:
    i, j, x = (list(part) for part in zip(*entries, strict=True)) if entries else ([], [], [])
    return sp.csr_array((np.array(x, float), (np.array(i, int), np.array(j, int))), shape=shape)


def _whole(y: FloatArray) -> FloatArray:
    """A direction with its largest entry at 1, and without what rounding left of sums that cancel."""
    size = np.abs(y).max(initial=0.0)
    y = y / size if size > 0.0 else y
    return np.where(np.abs(y) < 1e-13, 0.0, y)


@dataclass
class Held:
    """State of the solver inside, and what its rows stand for."""

    form: AsRows
    state: Any


class ThroughRows(Solver):
    """A solver of bounded rows that also takes friction of boxes.

    The one of its `otherwise()` follows where it did not end at a solution.
    """

    def __init__(self, solver: Solver) -> None:
        self.solver, self.needs_scipy = solver, solver.needs_scipy

    def setup_time(self, problem: Problem) -> float:
        """What `prepare` takes [s], as counted."""
        own = self.solver.setup_time(problem)
        return own if problem.law in ("linear", "lcp") else FEW * own + ROW_TIME * problem.m

    def start_workers(self, held: Any, time_limit: float) -> None:
        """Start processes."""
        self.solver.start_workers(held.state if isinstance(held, Held) else held, time_limit)

    def prepare(self, problem: Problem) -> Any:
        """Its state, of the problem or of (1), (2)."""
        if problem.law in ("linear", "lcp"):
            return self.solver.prepare(problem)
        form = as_rows(problem)
        return Held(form, self.solver.prepare(form.rows))

    def update(self, held: Any, problem: Problem) -> Any:
        """The same structure with new numbers; coefficients that became 0 change that of the rows."""
        return self.prepare(problem) if isinstance(held, Held) else self.solver.update(held, problem)

    def run(
        self, held: Any, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None = None
    ) -> Claim:
        """Run at most n iterations; the claim refers to the original problem, at no worse an impulse than the start."""
        if not isinstance(held, Held):
            return self.solver.run(held, impulse, max_iter, tol, time_limit)
        given = impulse.copy()
        claim = self._through(held, impulse, max_iter, tol, time_limit)
        if claim.status in (Status.CONVERGED, Status.ROUNDOFF_LIMIT):
            return claim
        room = np.empty_like(given), np.empty_like(given)
        before, after = (compute_relative(held.form.problem, x, *room)[0] for x in (given, impulse))
        if before < after:
            impulse[:] = given
        return replace(claim, status=Status.CONVERGED, certificate=None) if before <= tol else claim

    def _through(
        self, held: Held, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None
    ) -> Claim:
        form = held.form
        z, deadline = form.start(impulse), Deadline(time_limit)
        claim = self.solver.run(held.state, z, max_iter, tol, time_limit)
        claim = self._judged(form, claim, z, impulse, tol)
        if claim.status not in (Status.STALLED, Status.NUMERICAL_ERROR):
            return claim
        path = self.solver.fallback()
        if path is None:
            return claim
        z = form.start(impulse)
        more = self._judged(
            form,
            path.run(path.prepare(form.rows), z, max_iter, tol, deadline.remaining(1e-3)),
            z,
            impulse,
            tol,
        )
        work = summed((claim.work, more.work))
        words = f"{claim.message or 'no exchange helped'}, then complementary pivots"
        return replace(more, work=work, message=f"{words}: {more.message}" if more.message else words)

    def _judged(self, form: AsRows, claim: Claim, z: FloatArray, impulse: FloatArray, tol: float) -> Claim:
        """The claim of z (n,) as one of the problem, lambda (m,) in place."""
        found = project(form.problem.cones, form.back @ z)
        if not np.isfinite(found).all():
            return replace(claim, status=Status.NUMERICAL_ERROR, certificate=None, dual=None)
        impulse[:] = found
        relative, above = compute_relative(
            form.problem, impulse, np.empty_like(found), np.empty_like(found), floor=True
        )
        status, words, proof = claim.status, claim.message, None
        if relative <= tol:
            status = Status.CONVERGED
        elif above <= tol:
            status = Status.ROUNDOFF_LIMIT
        elif status is Status.INFEASIBLE and claim.certificate is not None:
            proof = _whole(form.back @ claim.certificate)
            if check_certificate(form.problem, proof, tol) is not None:
                status, proof = Status.STALLED, None
                words += ": of the friction as rows, which proves nothing of the problem itself"
        elif status in (Status.CONVERGED, Status.ROUNDOFF_LIMIT):
            status = Status.STALLED
        name = "edges of the cones" if form.problem.law == "cone" else "rows with slack"
        return replace(
            claim,
            status=status,
            message=words,
            form=", ".join(filter(None, (claim.form, name))),
            certificate=proof,
            dual=None,
        )
