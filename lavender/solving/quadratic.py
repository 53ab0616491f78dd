"""`solve_qp`: quadratic programs through `solve`, and the proximal point method where P is singular.

    x_(k+1) = argmin 1/2 x.P x + q.x + 1/2 (x - x_k).D (x - x_k)   under the program's constraints

A program of more than a few rows `auto` solves by an interior point on x and the impulses themselves, which needs no D,
after the compiled call over velocities where that ends sooner; where it fails, these steps follow.
Each step is a problem of the same J and M = P + D, started from the impulses of the step before. Its answer solves the
program but for a dual residual of D (x_k - x_(k+1)) (Rockafellar 1976).
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, number, read_only
from lavender.base.deadline import Deadline, Stopwatch
from lavender.base.errors import InputError
from lavender.base.lazy_import import sparse as sp
from lavender.judge.certificates import prove
from lavender.judge.residuals import Residual, residual
from lavender.judge.solution import CONFIRMED, CONVERGED, Claim, Solution, Status, Turn
from lavender.problem import Problem, QPSolution
from lavender.problem.generalized import Generalized
from lavender.problem.quadratic import QuadraticProgram
from lavender.solvers.certify import without_dust
from lavender.solvers.interior_point import NAME, InteriorPoint
from lavender.solvers.registry import SMALL_ROWS, get
from lavender.solvers.setup_times import LAID_OUT, loading
from lavender.solvers.small import told
from lavender.solving.outcome import finish
from lavender.solving.solve import judged_later, seconds_of, solve, solve_small

STEPS = 50  # proximal steps
SLOW = 0.1  # where a step leaves more than this of the error, the next has
SOFTER = 0.1  # this share of D, as long as
ROUNDING = 1e-13  # of v*, over |x|, is less than the error; where it is more, the next step has more of D
SOFTEST = 1e-10  # of the unit of each variable, up to which D is made softer: M stays definite
IDLE = 10  # steps in a row without a smaller error, after which no other is made,
FAILED = 3  # and so many that stall
TIGHTEST = 1e-15  # tol of a step
CENTRED = 1e-9  # tol of a step around a centre, at most: a ray shows only to UNBOUNDED
SET_UP = 5e-3  # s of an interior point before its first step, in Python, whatever the size
SOONER = 5e6  # counted cost [ns] of a compiled call, in which an interior point would hardly have begun
HARD = (Status.FLOOR, Status.STALLED)  # after which the next step has more of D, too: M is nearly singular
FINAL_STATUSES = (
    Status.FLOOR,
    Status.INTERRUPTED,
)  # of the constraint problem, whatever the program's error is
UNBOUNDED = 1e-7  # relative: a direction along which the objective falls for ever; a point where it may begin


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
        Of the solver; impulse= starts from the impulses of a program before (`answer.solution.impulse`).

    Returns
    -------
    QPSolution
        x, y, z, z_box; `error` says how wrong they are, `solution.status` how it ended: CONVERGED if the error is at
        most `tol`. `solution.setup_time` and `solution.solve_time` add up to the time of this call. INFEASIBLE: no x
        fulfils the constraints, and `problem.qp.multipliers(answer.solution.certificate)` proves it, if
        `solution.claim_check` is "confirmed". An unbounded program has a `ray`.

    Raises
    ------
    InputError
        A problem that was made otherwise.

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
            "problem is not a quadratic program: make it with Problem.from_qp; what updated() or a file gives "
            "knows the constraint problem alone"
        )
    begun = perf_counter()
    tol, end = number("tol", tol, low=0.0), begun + seconds_of(time_limit)
    answer = _solve(problem, qp, solver, tol, time_limit, end, options)
    _complete(answer, perf_counter() - begun)
    return answer


def _complete(answer: QPSolution, seconds: float) -> None:
    """Set the time of the whole call, and CONVERGED if the program's error is within `tol`, in the answer's solution.

    Residuals of the constraint problem are relative to that of x = v*; those of the program decide.
    """
    solution: Solution = answer.solution
    values = solution.__dict__
    values["solve_time"] = seconds - solution.setup_time
    if solution.status in FINAL_STATUSES or (solution.status is CONVERGED and not solution.is_contradicted):
        return
    if answer.ray is None and answer.error <= answer.tol:
        relative = solution.residual.relative
        if solution.certificate is None and relative < math.inf:
            values |= {"status": CONVERGED, "tol": max(solution.tol, relative)}
            values |= {"claim_check": CONFIRMED, "status_conflict": ""}


def _solve(
    problem: Problem,
    qp: QuadraticProgram,
    solver: str,
    tol: float,
    time_limit: float | None,
    end: float,
    options: dict[str, Any],
) -> QPSolution:
    start = options.pop("impulse", None)
    large = (
        isinstance(solver, str) and solver == "auto" and tol > 0.0 and not options and problem.m > SMALL_ROWS
    )
    first = _by_interior_point if large else _over_velocities
    solution, x = first(problem, solver, tol, time_limit, start, options)
    answer = best = qp.solution(solution, tol, x)
    centre, tightest, before, idle, failed, point = None, tol, np.inf, 0, 0, None
    if answer.error <= tol and qp.proximal is None:
        return answer
    for _ in range(STEPS):
        if solution.status is Status.INTERRUPTED:
            return answer
        if solution.status is Status.INFEASIBLE:
            return answer if solution.claim_check == CONFIRMED else best
        ray = qp.ray(answer.x if centre is None else answer.x - centre, UNBOUNDED)
        left = end - perf_counter()
        if ray is not None and point is None and left > 0.0:
            limit = None if time_limit is None else left
            point = solve(_nearest(problem, qp), solver, tol=UNBOUNDED, time_limit=limit, **options)
            if point.status is Status.INFEASIBLE and point.claim_check == "confirmed":
                return replace(answer, solution=point)
            if point.success or point.residual.at_floor:
                return replace(answer, ray=ray)
            left = end - perf_counter()
        if answer.error <= tol or left <= 0.0 or solution.status is Status.TIME_LIMIT:
            break
        if qp.proximal is None and solution.status not in (Status.CONVERGED, *HARD):
            break  # a budget that is spent; of another centre something better may come
        # Residuals are relative to doing nothing, x = v*, which may be far from the solution.
        far = max(1.0, _distance(answer))
        inner = max(0.1 * tightest / far, TIGHTEST)
        if qp.proximal is not None or solution.status in HARD or ROUNDING * far > tol or inner >= tightest:
            slow, centre, before = answer.error > SLOW * before, answer.x, answer.error
            d = qp.proximal
            if d is None:
                d = qp.nearer(centre, answer.impulse)
            elif solution.status in HARD or ROUNDING * far > answer.error:
                d = d / SOFTER
            elif slow and (qp.unit is None or (d / qp.unit).max() > SOFTEST):
                d = SOFTER * d
            try:
                problem = _around(problem, qp, centre, d)
            except InputError:  # units so far apart that M has no factor
                break
            qp = problem.qp
            inner = max(min(tol, CENTRED) / far, TIGHTEST)
        tightest, limit = inner, None if time_limit is None else left
        if idle == 0:  # as long as steps gain, none is asked for what rounding hides
            inner = max(inner, residual(problem, solution.impulse).floor)
        solution, x = _over_velocities(problem, solver, inner, limit, solution.impulse, options)
        answer = qp.solution(solution, tol, x)
        idle = 0 if answer.error < best.error else idle + 1
        best = min(best, answer, key=lambda one: one.error)
        failed = failed + 1 if solution.status is Status.STALLED else 0
        if idle == IDLE or failed == FAILED:
            break
    return best


def _nearest(problem: Problem, qp: QuadraticProgram) -> Problem:
    """min sum unit_i x_i^2 under the same constraints: a solution is a feasible point, a certificate the program's."""
    assert qp.unit is not None
    general = Generalized(qp.generalized.jac, sp.diags_array(qp.unit), np.zeros(len(qp.q)))
    return replace(problem, generalized=general, b=qp.target, qp=None, guess=None, copy=False)


def _around(problem: Problem, qp: QuadraticProgram, centre: FloatArray, d: FloatArray) -> Problem:
    """The proximal step from a centre (n,) with this D (n,)."""
    qp = qp.around(centre, d)
    general = qp.generalized
    return replace(problem, generalized=general, b=general.bias(qp.target), qp=qp, copy=False)


Step = tuple[Solution, FloatArray | None]  # and x, where it is known better than by the impulses


def _over_velocities(
    problem: Problem, solver: str, tol: float, time_limit: float | None, impulse: Any, options: dict[str, Any]
) -> Step:
    return solve(problem, solver, tol=tol, time_limit=time_limit, impulse=impulse, **options), None


def _by_interior_point(
    problem: Problem, solver: str, tol: float, time_limit: float | None, impulse: Any, options: dict[str, Any]
) -> Step:
    """The compiled call over velocities if it ends sooner, then an interior point; where neither ends, velocities."""
    qp, deadline, watch = problem.qp, Deadline(time_limit), Stopwatch()
    made = solve_small(problem, get(solver), impulse, tol, seconds_of(time_limit), SOONER)
    if made is not None:
        return made, None
    answer, of = None, qp.generalized.operator
    entries = 2 * len(of.mass[1]) + len(of.jac[1])
    if not deadline.passed(loading("scipy.sparse") + SET_UP + LAID_OUT * entries):
        point = InteriorPoint(qp)
        answer, proof = point.run(tol, deadline, lambda lam: _proof(problem, lam, tol, deadline))
    if answer is None or not (
        answer.found or proof is not None or point.late or qp.ray(answer.x, UNBOUNDED) is not None
    ):
        return _over_velocities(problem, solver, tol, deadline.left(1e-6), impulse, options)
    lam = read_only(answer.impulse)
    judged = residual(problem, lam)
    if answer.found and judged.relative > tol:
        # P^-1 makes more of the dual residual: the step around x itself, with a D that has no such inverse.
        with suppress(InputError):  # units so far apart that M has no factor, or v* no numbers
            near = _around(problem, qp, answer.x, read_only(point.unit))
            problem, judged = min(((one, residual(one, lam)) for one in (problem, near)), key=_wrong)
    if proof is not None:
        status = Status.INFEASIBLE
    elif judged.relative <= tol:
        status = Status.CONVERGED
    else:
        left = Status.STALLED if answer.found or not point.late else Status.TIME_LIMIT
        status = Status.FLOOR if judged.at_floor else left
    work = {"factorisations": point.factorisations}
    turn = Turn(NAME, work, problem.metric.start_relative, judged.relative)
    claim = Claim(status, point.factorisations, work, told([turn]), certificate=proof, turns=(turn,))
    if proof is not None:  # with an impulse within its bounds, which `finish` chooses
        spec = get(solver)
        return finish(problem, spec, {}, lam.copy(), claim, tol, 0.0, watch.seconds, None), answer.x
    rest: tuple[Any, ...] = judged_later, (problem, get(solver), {}, lam, claim, tol)
    return Solution.late(lam, status, tol, watch.seconds, rest), answer.x


def _proof(problem: Problem, impulse: FloatArray, tol: float, deadline: Deadline) -> FloatArray | None:
    """What impulses (m,) that grow without end prove, by the rows that take part."""
    found = prove(problem, without_dust(impulse, problem.d), tol, deadline)
    return None if found.reason else found.y


def _wrong(found: tuple[Problem, Residual]) -> float:
    return found[1].relative


def _distance(answer: QPSolution) -> float:
    """|v*| over |x|."""
    x, free = answer.x, answer.qp.generalized.v_free
    size = np.sqrt(x @ x)
    return float(np.sqrt(free @ free) / size) if size > 0.0 else 0.0
