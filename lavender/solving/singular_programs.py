"""Solve quadratic programs with a singular P, for `auto`: by solvers of other packages, one after the other."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import BREAKDOWN, format_error
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender.solvers.certify import certify_by_linear_programs
from lavender.solvers.registry import SolverSpec, get, specs
from lavender.solving.log import SolveLog

# Solvers of quadratic programs with a singular P, which are tried in this order if they are installed; osqp always is.
PROGRAM_BACKENDS = ("piqp", "clarabel", "osqp")


def program_backends() -> list[SolverSpec]:
    """Return the specs of the installed `PROGRAM_BACKENDS`."""
    return [get(name) for name in PROGRAM_BACKENDS if not specs()[name].missing()]


@np.errstate(all="ignore")  # Results that overflow are judged.
def run_program_backends(log: SolveLog, impulse: FloatArray) -> Claim:
    """Solve a program with a singular P by the first backend that reaches tol, or search for a certificate.

    If no backend reaches tol, the result with the smallest error of the program is returned.
    """
    problem = log.problem
    tol = log.tol
    start = impulse.copy()
    log.judge_and_store_best(impulse)
    error = program_error(problem, log.impulse)
    best = log.impulse
    try:
        for spec in program_backends():
            if log.done() and (log.status is not Status.ROUNDOFF_LIMIT or error <= tol):
                break
            solver = spec.load()()
            before = log.best
            trial = start.copy()
            state = solver.prepare(problem)
            claim = solver.run(
                state, trial, min(log.remaining_iterations, spec.max_iter), tol, log.time_left
            )
            log.judge_and_store_best(trial)
            log.record_stage(spec.name, claim, before)
            for result in (trial, log.impulse if log.best <= tol else log.result):
                if program_error(problem, result) < error:
                    error = program_error(problem, result)
                    best = result.copy()
            if tol == 0.0:
                break
        if error > tol > 0.0 and not log.done():
            certify_by_linear_programs(log)
    except KeyboardInterrupt:
        log.interrupted = True
    except BREAKDOWN as failure:
        log.failure = format_error(failure)
    claim = log.make_claim()
    impulse[:] = log.impulse if log.best <= tol else best
    if log.best > tol and claim.status is Status.ROUNDOFF_LIMIT:
        # That status belongs to the impulse with the best residual.
        return replace(claim, status=Status.STALLED)
    return claim


def program_error(problem: Problem, impulse: FloatArray) -> float:
    """Return `QPSolution.error` of x and the multipliers (n + m,); inf if it is not a number."""
    error = float(problem.qp.solution(impulse).error)
    return error if error == error else inf
