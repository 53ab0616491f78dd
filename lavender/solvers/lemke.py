"""Lemke's method: complementary pivoting along one path, for any small dense A.

    w = q + M s + c z,   w, s >= 0,  w_i s_i = 0,   z from the smallest value with w >= 0 at s = 0 down to 0

M and q are A and -b of bounded rows that are transformed to nonnegative unknowns s; c > 0 is the covering vector. The
path ends at z = 0, a solution, or on a secondary ray. For copositive-plus M (which includes positive semidefinite M) a
ray proves that there is no solution; its direction is the certificate, which is checked before INFEASIBLE is returned.
The method runs in `lavender_ext/pivot/lemke.pyx`. After each path, the exchanges of `direct` start at the end of the
path and solve for the free rows with A. If they do not end at a solution, another path with another covering vector c
follows. Ties are broken lexicographically, which excludes cycles in exact arithmetic.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import CHUNK_TIME, Deadline
from lavender.judge.certificates import check_certificate
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender.solvers.certify import CERTIFICATE_ROWS, find_certificate_by_linear_program
from lavender.solvers.costs import RATES
from lavender.solvers.pivoting import PivotState
from lavender.solvers.polyhedral import bound_converted_row_count
from lavender.solvers.registry import Solver, SolverSpec
from lavender_ext.pivot import lemke
from lavender_ext.pivot.lemke import DONE, EXCHANGES, LATE, RAY

RAY_MESSAGE = "ended on a secondary ray: this method cannot continue, but a solution may exist"
MAX_LEMKE_ROWS = (
    2000  # Problems with more rows are refused; the dictionary of this many rows takes 32 MB.
)


@dataclass(frozen=True)
class Lemke(Solver):
    """Lemke's complementary pivoting, without options."""

    lazy_modules = ("scipy.sparse.linalg", "scipy.optimize")

    def prepare(self, problem: Problem) -> PivotState:
        return PivotState(problem)

    def update(self, state: PivotState, problem: Problem) -> PivotState:
        return PivotState(problem, state)

    def run(
        self,
        state: PivotState,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None,
    ) -> Claim:
        if max_iter == 0 or state.problem.m == 0:
            return Claim(
                Status.MAX_ITERATIONS if state.problem.m else Status.CONVERGED, 0, {"pivots": 0}
            )
        deadline = Deadline(time_limit)
        state.set_deadline(deadline)
        paths = lemke.Lemke(state.rows)
        paths.set_start(impulse)
        try:
            c = state.problem.cones
            rows = len(c.lower) + int(np.count_nonzero(np.isfinite(c.lower) & np.isfinite(c.upper)))
            entries = rows**2  # of the dictionary
            chunk = max(1, int(CHUNK_TIME / (1e-9 * RATES["dictionary pivot"] * entries)))
            claim = self._follow_paths(state, paths, max_iter, tol, deadline, chunk)
        finally:
            paths.judge()
            best = state.rows.best
            if best is not None:
                impulse[:] = best.impulse
        return replace(claim, judged=best)

    def _follow_paths(
        self,
        state: PivotState,
        paths: lemke.Lemke,
        max_iter: int,
        tol: float,
        deadline: Deadline,
        chunk: int,
    ) -> Claim:
        """Do up to `max_iter` pivots and return the claim; Ctrl-C is checked after each `chunk` pivots or exchanges."""
        rows = state.rows
        message = ""
        certificate: FloatArray | None = None
        while True:
            code = paths.run(min(chunk, max_iter - paths.pivots))
            if code == RAY:
                message = RAY_MESSAGE
                size = np.abs(paths.ray).max(initial=0.0)
                certificate = paths.ray / size if 0.0 < size < np.inf else None
            is_proof = certificate is not None and (
                check_certificate(state.problem, certificate, tol, deadline) is None
            )
            if is_proof:
                status = Status.INFEASIBLE
                message = "ended on a secondary ray: no impulse meets every row"
            elif code == DONE and rows.relative <= tol:
                status = Status.CONVERGED
                message = ""
            elif code == DONE:
                status = Status.ROUNDOFF_LIMIT if rows.above_floor <= tol else Status.STALLED
            elif code == LATE or deadline.has_passed():
                status = Status.TIME_LIMIT
            elif code != EXCHANGES and paths.pivots >= max_iter:
                status = Status.MAX_ITERATIONS
            else:
                continue
            problem = state.problem
            if (
                status is Status.STALLED
                and problem.m <= CERTIFICATE_ROWS
                and not deadline.has_passed()
            ):
                proof = find_certificate_by_linear_program(problem, deadline)
                if proof is not None and check_certificate(problem, proof, tol, deadline) is None:
                    status = Status.INFEASIBLE
                    certificate = proof
                    message = "a linear program found a certificate"
            work = rows.work | {"pivots": paths.pivots, "paths": paths.paths}
            return Claim(status, paths.pivots, work, message, form="dense", certificate=certificate)


def _get_refusal_reason(problem: Problem) -> str | None:
    """Return a reason not to accept the problem if its dictionary is too large, else None."""
    rows = bound_converted_row_count(problem)
    if rows > MAX_LEMKE_ROWS:
        converted = "" if rows == problem.m else f", its friction as bounded rows {rows}"
        return (
            f"holds a dense dictionary, for at most {MAX_LEMKE_ROWS} rows; this problem has {problem.m}{converted}: "
            "use direct, newton or pgs"
        )
    return None


SPEC = SolverSpec(
    name="lemke",
    factory=Lemke,
    laws=frozenset({"linear", "lcp"}),
    box_friction_laws=frozenset({"coulomb", "cone"}),
    operators=frozenset({"matrix"}),
    exact=True,
    resumable=False,
    impulse=False,
    max_iter=20_000,
    refusal=_get_refusal_reason,
    summary="Lemke's complementary pivoting, dense, any A",
    reference="Lemke 1965; Cottle, Pang, Stone 1992, section 4.4, and 4.9 for degeneracy",
)
