"""Convert friction with a separate bound for each tangent to bounded rows, for solvers that accept only these.

For a contact with the normal impulse n and bounds |t_i| <= c_i n, lambda = E z:

    coulomb   t_i = p_i - q_i,  p, q, s >= 0                  (Stewart, Trinkle 1996; Anitescu, Potra 1997)
              w_i + d_i s_i      complementary to p_i
             -w_i + d_i s_i      complementary to q_i                                          (1)
              d_i (c_i n - p_i - q_i)     complementary to s_i [N s], d_i s_i the speed of sliding along i
    cone      (n, t) = sum over signs z_k (1, +-c_1, +-c_2),  z >= 0: its edges, two for each axis with c_i > 0,
              E^T w complementary to z                                                         (2)

The matrix of (1) is E^T A E, extended by the couplings of s. It is copositive if A is positive semidefinite: Lemke's
path then ends at a solution of every problem without joints. The matrix of (2) is E^T A E, symmetric if A is.
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
from lavender.judge.residuals import judge_impulse
from lavender.judge.solution import Claim, Status, sum_work_counts
from lavender.problem import Problem
from lavender.problem.cones import project_impulse
from lavender.solvers.registry import Solver


@dataclass(frozen=True)
class BoundedRowForm:
    """A problem with friction and its conversion to bounded rows in z (n,), with lambda = E z."""

    problem: Problem
    rows: Problem  # The converted problem.
    to_impulse: sp.csr_array  # (m, n) sparse array: E.

    def convert_start(self, impulse: FloatArray) -> FloatArray:
        """Return a z (n,) of a feasible impulse (m,), or of its projection."""
        c = self.problem.cones
        out = []
        x = project_impulse(c, impulse)
        contact = c.is_contact
        for i, sides in _list_rows_bounded_by_normals(self.problem):
            j = c.ptr[i]
            if not sides:
                out += list(x[j : j + 1] if contact[i] else x[j : c.ptr[i + 1]])
            elif self.problem.law == "cone":
                fractions = [
                    np.divide(x[j + t], s * x[j]) if s * x[j] > 0.0 else 0.0 for t, s in sides
                ]
                for signs in product((1.0, -1.0), repeat=len(sides)):
                    out.append(
                        x[j]
                        * np.prod(
                            [0.5 * (1.0 + a * b) for a, b in zip(signs, fractions, strict=True)]
                        )  # pyright: ignore[reportArgumentType, reportCallIssue]
                    )
            else:
                out.append(x[j])
                for t, _ in sides:
                    out += [max(x[j + t], 0.0), max(-x[j + t], 0.0), 0.0]
        return np.clip(np.array(out, float), self.rows.cones.lower, self.rows.cones.upper)


def _list_rows_bounded_by_normals(problem: Problem) -> list[tuple[int, list[tuple[int, float]]]]:
    """Return (block, [(row offset, c_i)]) with the rows of each block that its normal impulse bounds and c_i > 0."""
    c = problem.cones
    friction_bound = c.friction_coefficient
    return [
        (
            i,
            [
                (t, float(friction_bound[j + t]))
                for t in range(1, end - j)
                if friction_bound[j + t] > 0.0
            ],
        )
        for i, (j, end) in enumerate(zip(c.ptr[:-1].tolist(), c.ptr[1:].tolist(), strict=True))
    ]


def convert_to_bounded_rows(problem: Problem) -> BoundedRowForm:
    """Build (1) or (2) of a problem without disks.

    Raises
    ------
    OverflowError
        A number of the converted problem is out of range.
    """
    c = problem.cones
    d = problem.d
    contact = problem.cones.is_contact
    entries: list[tuple[int, int, float]] = []  # Entries of E in (1) or (2).
    couplings: list[tuple[int, int, float]] = []  # Couplings of s in (1).
    low: list[float] = []
    high: list[float] = []
    for i, sides in _list_rows_bounded_by_normals(problem):
        j = int(c.ptr[i])
        n = len(low)
        if not contact[i]:
            size = int(c.ptr[i + 1]) - j
            entries += [(j + k, n + k, 1.0) for k in range(size)]
            low += c.lower[j : j + size].tolist()
            high += c.upper[j : j + size].tolist()
            continue
        if problem.law == "cone":
            for k, signs in enumerate(product((1.0, -1.0), repeat=len(sides))):
                entries.append((j, n + k, 1.0))
                entries += [
                    (j + t, n + k, sign * s) for sign, (t, s) in zip(signs, sides, strict=True)
                ]
            count = 2 ** len(sides)
        else:
            entries.append((j, n, 1.0))
            for k, (t, s) in enumerate(sides):
                p = n + 1 + 3 * k
                q = n + 2 + 3 * k
                slide = n + 3 + 3 * k
                x = float(d[j + t])
                entries += [(j + t, p, 1.0), (j + t, q, -1.0)]
                couplings += [
                    (p, slide, x),
                    (q, slide, x),
                    (slide, n, s * x),
                    (slide, p, -x),
                    (slide, q, -x),
                ]
            count = 1 + 3 * len(sides)
        low += [0.0] * count
        high += [np.inf] * count
    n = len(low)
    e = _make_sparse_matrix(entries, (problem.m, n))
    with np.errstate(all="ignore"):
        a = sp.csr_array(e.T @ (problem.csr @ e)) + _make_sparse_matrix(couplings, (n, n))
        b = e.T @ problem.b
    try:
        rows = Problem.lcp(sp.csr_array(a), b, np.array(low), np.array(high), copy=False)
    except InputError as error:
        # The problem is valid; only sums of its entries in the conversion are out of range.
        raise OverflowError("A or b, times coefficients of friction, is out of range") from error
    return BoundedRowForm(problem, rows, e)


def bound_converted_row_count(problem: Problem) -> int:
    """Upper bound of the number of rows n of (1) or (2), for a problem without disks."""
    c = problem.cones
    if problem.law == "cone":
        sides = np.where(c.is_contact, np.diff(c.ptr) - 1, 0)
        return int(np.where(c.is_contact, 2**sides, np.diff(c.ptr)).sum())
    return problem.m + (
        2 * int((np.diff(c.ptr) - 1)[c.is_contact].sum()) if problem.law == "coulomb" else 0
    )


def _make_sparse_matrix(
    entries: list[tuple[int, int, float]], shape: tuple[int, int]
) -> sp.csr_array:
    i, j, x = (list(part) for part in zip(*entries, strict=True)) if entries else ([], [], [])
    return sp.csr_array((np.array(x, float), (np.array(i, int), np.array(j, int))), shape=shape)


@dataclass
class ConvertedState:
    """State of the inner solver, and the conversion of its rows."""

    form: BoundedRowForm
    state: Any


class BoundedRowSolver(Solver):
    """Wrapper of a solver of bounded rows that also accepts box friction.

    If it does not end at a solution, the solver of its `fallback()` continues.
    """

    def __init__(self, solver: Solver) -> None:
        self.solver = solver

    def start_workers(self, converted: Any, time_limit: float) -> None:
        """Start the worker processes of the inner solver."""
        state = converted.state if isinstance(converted, ConvertedState) else converted
        self.solver.start_workers(state, time_limit)

    def prepare(self, problem: Problem) -> Any:
        """Prepare the inner solver for the problem, or for its conversion (1) or (2)."""
        if problem.law in ("linear", "lcp"):
            return self.solver.prepare(problem)
        form = convert_to_bounded_rows(problem)
        return ConvertedState(form, self.solver.prepare(form.rows))

    def update(self, converted: Any, problem: Problem) -> Any:
        """Return the state for new numbers; a conversion is built again, because coefficients may become 0."""
        if isinstance(converted, ConvertedState):
            return self.prepare(problem)
        return self.solver.update(converted, problem)

    def run(
        self,
        converted: Any,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None = None,
    ) -> Claim:
        """Run at most `max_iter` iterations; the claim is for the original problem, not worse than at the start."""
        if not isinstance(converted, ConvertedState):
            return self.solver.run(converted, impulse, max_iter, tol, time_limit)
        start = impulse.copy()
        claim = self._run_converted(converted, impulse, max_iter, tol, time_limit)
        if claim.status in (Status.CONVERGED, Status.ROUNDOFF_LIMIT):
            return claim
        before, after = (
            judge_impulse(converted.form.problem, x).relative for x in (start, impulse.copy())
        )
        if before < after:
            impulse[:] = start
        return replace(claim, status=Status.CONVERGED, certificate=None) if before <= tol else claim

    def _run_converted(
        self,
        converted: ConvertedState,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None,
    ) -> Claim:
        """Run the solver of bounded rows on the converted problem, and its fallback if that solver stalls."""
        form = converted.form
        z = form.convert_start(impulse)
        deadline = Deadline(time_limit)
        claim = self.solver.run(converted.state, z, max_iter, tol, time_limit)
        claim = self._convert_claim(form, claim, z, impulse, tol)
        if claim.status not in (Status.STALLED, Status.NUMERICAL_ERROR):
            return claim
        fallback = self.solver.fallback()
        if fallback is None:
            return claim
        z = form.convert_start(impulse)
        second = fallback.run(
            fallback.prepare(form.rows), z, max_iter, tol, deadline.get_remaining_seconds(1e-3)
        )
        second = self._convert_claim(form, second, z, impulse, tol)
        work = sum_work_counts((claim.work, second.work))
        message = f"{claim.message or 'no exchange helped'}, then complementary pivots"
        return replace(
            second, work=work, message=f"{message}: {second.message}" if second.message else message
        )

    def _convert_claim(
        self, form: BoundedRowForm, claim: Claim, z: FloatArray, impulse: FloatArray, tol: float
    ) -> Claim:
        """Convert a claim about z (n,) to one about the problem, and store lambda = E z in `impulse` (m,)."""
        projected = project_impulse(form.problem.cones, form.to_impulse @ z)
        if not np.isfinite(projected).all():
            return replace(claim, status=Status.NUMERICAL_ERROR, certificate=None, dual=None)
        impulse[:] = projected
        judged = judge_impulse(form.problem, projected)
        relative, above = judged.relative, judged.above_floor
        status = claim.status
        message = claim.message
        proof = None
        if relative <= tol:
            status = Status.CONVERGED
        elif above <= tol:
            status = Status.ROUNDOFF_LIMIT
        elif status is Status.INFEASIBLE and claim.certificate is not None:
            proof = form.to_impulse @ claim.certificate
            proof = proof / (np.abs(proof).max(initial=0.0) or 1.0)
            proof = np.where(np.abs(proof) < 1e-13, 0.0, proof)  # Set rounding noise to 0.
            if check_certificate(form.problem, proof, tol) is not None:
                status = Status.STALLED
                proof = None
                message += ": of the friction as rows, which proves nothing of the problem itself"
        elif status in (Status.CONVERGED, Status.ROUNDOFF_LIMIT):
            status = Status.STALLED
        name = "edges of the cones" if form.problem.law == "cone" else "rows with slack"
        form_name = ", ".join(filter(None, (claim.form, name)))
        return replace(
            claim, status=status, message=message, form=form_name, certificate=proof, dual=None
        )
