"""`solve_qp`: quadratic programs through `solve`, to an error of the program itself.

`solve` stops at a residual relative to the zero impulse's, while `QPSolution.error` is relative to the terms of
the program. While the error is above tol, the solve is continued from its result with a smaller tol. If `auto` does
not reach tol in this way for a positive definite P, the backend for a singular P solves the program in the form (5) of
`problem/program.py`.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace
from time import perf_counter
from types import MappingProxyType
from typing import Any

import numpy as np

from lavender.base.arrays import check_float, mark_read_only
from lavender.base.errors import InputError
from lavender.base.lazy_import import sparse as sp
from lavender.judge.solution import CONFIRMED, CONVERGED, Claim, Solution, Status, sum_work_counts
from lavender.problem import Problem, QPSolution
from lavender.problem.generalized import Generalized
from lavender.problem.program import QuadraticProgram
from lavender.solvers.registry import get
from lavender.solvers.small import describe_stages
from lavender.solving.finish import FinishedRun, finish
from lavender.solving.limits import check_time_limit
from lavender.solving.solve import solve

MAX_SOLVES = 5  # Maximum number of solves of one constraint problem, each with a smaller tol.
MIN_TOL = 1e-15  # Smallest tol of a solve of the constraint problem.
# The next tol is this fraction of the tol that would suffice if the program's error were proportional to tol.
TOL_RATIO = 0.1
# The backend is called first if n 2^-53 cond(M) is above this fraction of tol: solving with M then loses digits that
# tol needs.
MAX_LOSS = 0.1
# A solve that ended with one of these statuses is continued. After any other status the budget is used up, or a
# smaller tol does not change the result.
CONTINUED = (Status.CONVERGED, Status.STALLED)
# Statuses of the constraint problem that are returned unchanged, whatever the program's error is.
FINAL_STATUSES = (Status.ROUNDOFF_LIMIT, Status.INTERRUPTED)
FEASIBLE_TOL = 1e-7  # An unbounded program counts as feasible at a point of at most this relative residual.


def solve_qp(
    problem: Problem,
    solver: str = "auto",
    *,
    tol: float = 1e-9,
    time_limit: float | None = None,
    **options: Any,
) -> QPSolution:
    """Solve a quadratic program made by `Problem.from_qp`.

    Parameters
    ----------
    problem : Problem
    solver : str
        As in `lavender.solve`.
    tol : float
        `QPSolution.error` to reach.
    time_limit : float, optional, s
    **options
        Options of the solver. `impulse` starts from the impulses of an earlier program (`answer.solution.impulse`).

    Returns
    -------
    QPSolution
        x, y, z, z_box with their `error`; `solution.status` is CONVERGED if the error does not exceed `tol`.
        `solution.setup_time` and `solution.solve_time` add up to the time of this call. INFEASIBLE: no x satisfies the
        constraints, and `problem.qp.multipliers(answer.solution.certificate)` proves it, if `solution.claim_check` is
        "confirmed". An unbounded program has a `ray`.

    Raises
    ------
    InputError
        `problem` was not made by `Problem.from_qp`.
    CapabilityError
        P is singular, and the solver needs a positive definite P.

    Examples
    --------
    A linear program, P = 0:

    >>> import numpy as np
    >>> import lavender as lv
    >>> problem = lv.Problem.from_qp(np.zeros((2, 2)), [-1.0, -2.0], G=[[1.0, 1.0]], h=[1.0], lb=[0.0, 0.0])
    >>> (lv.solve_qp(problem).x.round(9) + 0.0).tolist()
    [0.0, 1.0]
    """
    qp = getattr(problem, "qp", None)
    if qp is None:
        raise InputError(
            "the problem does not contain a quadratic program; a problem of Problem.from_qp is needed "
            "(results of updated() and problems read from files contain only the constraint problem)"
        )
    begun = perf_counter()
    tol, end = check_float("tol", tol, low=0.0), begun + check_time_limit(time_limit)
    start = options.pop("impulse", None)
    is_auto = isinstance(solver, str) and solver == "auto"
    if is_auto and tol > 0.0 and not options and not qp.is_singular:
        answer = _solve_definite(problem, tol, end, start)
    elif _needs_saddle_form(qp, solver, tol, options):
        answer = _solve_by_backend(problem, tol, end, start, solver, options)
    else:
        answer = _solve_to_error(problem, solver, tol, end, start, options)
    if qp.is_singular:
        answer = _add_ray_if_unbounded(problem, answer, end)
    return _accept_program(answer, perf_counter() - begun)


def _accept_program(answer: QPSolution, seconds: float) -> QPSolution:
    """Return the answer with the time of the whole call, as CONVERGED if the program's error is within `tol`.

    The status is CONVERGED if the program's error is within `tol`, whatever the residual of the constraint problem is.
    """
    solution: Solution = answer.solution
    values: dict[str, Any] = {"solve_time": seconds - solution.setup_time}
    is_final = solution.status in FINAL_STATUSES or (
        solution.status is CONVERGED and not solution.is_contradicted
    )
    if not is_final and answer.ray is None and answer.error <= answer.tol:
        relative = solution.residual.relative
        if solution.certificate is None and relative < math.inf:
            values |= {"status": CONVERGED, "tol": max(solution.tol, relative)}
            values |= {"claim_check": CONFIRMED, "status_conflict": ""}
    accepted = copy(answer)  # It keeps the errors that have been computed.
    object.__setattr__(accepted, "solution", solution.with_fields(**values))
    return accepted


def _solve_to_error(
    problem: Problem, solver: str, tol: float, end: float, impulse: Any, options: dict[str, Any]
) -> QPSolution:
    """Solve the constraint problem, with smaller tol until the error of the program does not exceed `tol`."""
    best: QPSolution | None = None
    inner = tol
    for _ in range(MAX_SOLVES):
        left = None if end == math.inf else max(end - perf_counter(), 1e-6)
        solution = solve(problem, solver, impulse=impulse, tol=inner, time_limit=left, **options)
        answer = problem.qp.solution(solution, tol)
        if best is None or answer.error < best.error or _is_proved_infeasible(answer):
            best = answer
        if answer.error <= tol or not _should_continue(answer, end):
            break
        smaller = max(TOL_RATIO * inner * tol / answer.error, MIN_TOL)
        if not smaller < inner:
            break
        inner, impulse = smaller, solution.impulse
    assert best is not None
    return best


def _is_proved_infeasible(answer: QPSolution) -> bool:
    """Whether a certificate that the judge has checked shows that no solution exists."""
    solution = answer.solution
    return bool(solution.status is Status.INFEASIBLE and solution.claim_check == CONFIRMED)


def _should_continue(answer: QPSolution, end: float) -> bool:
    """Return whether another solve may lower the error, and time remains for it."""
    return answer.solution.status in CONTINUED and perf_counter() < end


def _solve_definite(problem: Problem, tol: float, end: float, impulse: Any) -> QPSolution:
    """Solve a program with a positive definite P over J and M and, if that fails, in the form (5) by a backend.

    The backend comes first if M is so ill-conditioned that a solve by its factor loses the digits that tol needs.
    """
    first, second = _solve_over_velocities, _solve_by_backend
    if _loses_digits(problem.qp, tol):
        first, second = second, first
    answer = first(problem, tol, end, impulse)
    if answer.error <= tol or _is_proved_infeasible(answer) or answer.solution.status is Status.INTERRUPTED:
        return answer
    if not perf_counter() < end:
        return answer
    other = second(problem, tol, end, answer.impulse)
    ran = [answer.solution, other.solution]
    if other.error < answer.error or _is_proved_infeasible(other):
        answer = other
    stages = tuple(stage for solution in ran for stage in solution.stages)
    work = MappingProxyType(sum_work_counts(solution.work for solution in ran))
    message = f"{describe_stages(stages)}; {answer.solution.message}".rstrip("; ")
    solution = replace(answer.solution, stages=stages, work=work, message=message)
    return replace(answer, solution=solution)


def _loses_digits(qp: QuadraticProgram, tol: float) -> bool:
    """Return whether P is definite, and a solve by its factor loses the digits that `tol` needs."""
    if qp.is_singular:
        return False
    operator = qp.generalized.operator
    return bool(operator.n * 2.0**-53 * operator.condition > MAX_LOSS * tol)


def _needs_saddle_form(qp: QuadraticProgram, solver: str, tol: float, options: dict[str, Any]) -> bool:
    """Return whether to solve the form (5) of a program with a definite P, because the inverse of P loses digits."""
    is_default = options.get("form", "auto") in ("auto", "program")
    return tol > 0.0 and is_default and _loses_digits(qp, tol) and get(solver).singular_programs


def _solve_over_velocities(problem: Problem, tol: float, end: float, impulse: Any) -> QPSolution:
    return _solve_to_error(problem, "auto", tol, end, impulse, {})


def _solve_by_backend(
    problem: Problem,
    tol: float,
    end: float,
    impulse: Any,
    solver: str = "auto",
    options: dict[str, Any] | None = None,
) -> QPSolution:
    """Solve the program in the form (5) by a backend, which works on P instead of its inverse."""
    qp: QuadraticProgram = problem.qp.convert_to_saddle_form()
    program = Problem(**qp.problem_fields(), qp=qp, copy=False)
    start = None
    if impulse is not None:
        given = problem.impulse_array(impulse)
        start = np.concatenate([problem.qp.recover_variables(given), given])
        start = start if np.isfinite(start).all() else None
    answer = _solve_to_error(program, solver, tol, end, start, options or {})
    solution: Solution = answer.solution
    certificate = solution.certificate if _is_proved_infeasible(answer) else None
    claim = Claim(
        solution.status if certificate is not None else Status.STALLED,
        solution.iterations,
        solution.work,
        describe_stages(solution.stages) or solution.message,
        certificate=None if certificate is None else qp.select_row_multipliers(certificate),
        form=solution.solver.form,
        stages=solution.stages,
    )
    impulse = qp.select_row_multipliers(answer.impulse).copy()
    judged = finish(
        FinishedRun(
            problem, get(solver), options or {}, impulse, claim, tol=tol, setup_time=solution.setup_time
        )
    )
    return replace(answer, solution=judged, impulse=judged.impulse, qp=problem.qp)


def _add_ray_if_unbounded(problem: Problem, answer: QPSolution, end: float) -> QPSolution:
    """Return the answer with its ray, if a certificate shows that the objective decreases without end.

    A certificate of (5) consists of a direction of x and of multipliers. If the multipliers do not prove by themselves
    that the rows contradict each other, the direction is a ray, and the program is unbounded if it has a feasible
    point.
    """
    solution, qp = answer.solution, problem.qp
    if not _is_proved_infeasible(answer) or solution.certificate is None:
        return answer
    direction, rows = solution.certificate[: len(qp.q)], qp.select_row_multipliers(solution.certificate)
    if qp.target @ rows > 0.0 or not qp.q @ direction < 0.0:
        return answer
    # Search a feasible point: minimise the sum of unit_i x_i^2 under the program's constraints.
    unit = problem.d[: len(qp.q)]
    general = Generalized(qp.generalized.jac, sp.diags_array(unit), np.zeros(len(unit)))
    cones = problem.cones.select(np.arange(len(qp.q), problem.n_blocks))
    nearest = Problem(qp.target, cones, generalized=general, copy=False)
    left = None if end == math.inf else max(end - perf_counter(), 1e-6)
    point = solve(nearest, tol=FEASIBLE_TOL, time_limit=left)
    if point.certificate is not None and point.status is Status.INFEASIBLE and point.claim_check == CONFIRMED:
        certificate = np.concatenate([np.zeros(len(unit)), point.certificate])
        return replace(answer, solution=replace(solution, certificate=certificate, message=point.message))
    if not (point.success or point.residual.at_floor):
        return answer
    return replace(answer, ray=mark_read_only(direction / np.abs(direction).max()))
