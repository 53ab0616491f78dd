"""Newton's method step by step, over every form, with checks of Ctrl-C and of certificates between the steps.

For J and M the compiled driver selects velocities (`velocity_newton/newton.pxd`) or a dense A (`newton/rows.pxd`); it
solves every island of trees. Kernels read the deadline, between steps and inside of a factorisation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import NEVER, Deadline
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import get_zero_impulse_reference, judge_impulse
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender.solvers.costs import RATES
from lavender_ext.core.method import OUTCOMES
from lavender_ext.driver.driver import Driver

FORM = "generalized coordinates"
# Between two checks for Ctrl-C, an island does at most this many steps, and at most as many as are estimated for
# CHECK_INTERVAL [s].
MAX_STEPS_PER_CHECK = 64
CHECK_INTERVAL = 4.0
SPARSE_FLOP_TIME = 1e-9 * RATES["sparse velocities"]  # Time [s] per multiply-add of a sparse factor.
# If the judge does not confirm the result over velocities, the kernel runs again with a smaller tolerance, down to this
# fraction of tol.
MIN_TOLERANCE_RATIO = 1e-2
# Largest number of values of an island's N. 3,000 velocities with a dense N take 144 MB with the factor.
MAX_MATRIX_ENTRIES = 9e6
MORE, REACHED, STUCK, CERTIFICATE, SPENT = (
    OUTCOMES[name] for name in ("more", "reached", "stuck", "certificate", "spent")
)
_STATUS = {
    OUTCOMES["reached"]: Status.CONVERGED,
    OUTCOMES["floor"]: Status.ROUNDOFF_LIMIT,
    OUTCOMES["more"]: Status.MAX_ITERATIONS,
    OUTCOMES["stuck"]: Status.STALLED,
    # Over velocities, certificates are not computed; the method over rows of A or bodies continues.
    OUTCOMES["certificate"]: Status.STALLED,
    OUTCOMES["broken"]: Status.NUMERICAL_ERROR,
    OUTCOMES["lost"]: Status.DIVERGED,
    OUTCOMES["spent"]: Status.MAX_ITERATIONS,
}
UNLIMITED_STEPS = 2**31 - 1  # Budget of a kernel whose steps are limited by its calls.
_WORK_KINDS = ("factorisations", "Coulomb rounds", "line evaluations")


def prepare_islands(problem: Problem, work: float = inf) -> Driver | None:
    """Prepare the islands and their workspace.

    Returns
    -------
    Driver or None
        None if N of an island is too large, or if its factor needs more than `work` multiply-adds.
    """
    get_zero_impulse_reference(problem)
    kernel = Driver(problem.metric, MAX_MATRIX_ENTRIES, work)
    return kernel if kernel.fits else None


class NewtonRun(NamedTuple):
    """Result of `run_newton_method`."""

    status: Status
    counts: Sequence[
        int
    ]  # Steps; over velocities also factorisations, friction updates and line search evaluations.
    # Proof that no solution exists if the status is INFEASIBLE, else a direction that gives a lower bound of every
    # solution's impulse, or None.
    certificate: FloatArray | None = None
    judged: Any = None  # The judge's pass over a result over velocities.


def run_newton_method(
    problem: Problem,
    method: Any,
    impulse: FloatArray,
    max_iter: int,
    tol: float,
    deadline: Deadline,
    steps_per_check: int,
    max_total: int | None = None,
    is_continued: bool = False,
) -> NewtonRun:
    """Run up to `max_iter` steps of a compiled method on `impulse` (m,) in place, until the judge's test at tol is met.

    Parameters
    ----------
    method : lavender_ext.core.method.Method
    steps_per_check : int
        Number of steps between two checks for Ctrl-C.
    max_total : int, optional
        If given, later calls may continue where this one stops, with at most this many steps in all calls.
    is_continued : bool
        Whether to continue a run to the same tol that used up its steps.
    """
    is_over_velocities, tolerance_ratio = isinstance(method, Driver), 1.0
    certificate: FloatArray | None = None
    judged: Any = None
    proven = False
    method.set_deadline(deadline)
    if not is_continued:
        method.start(impulse, tol, max_iter if max_total is None else UNLIMITED_STEPS)
    if max_total is not None and max_total < UNLIMITED_STEPS:
        method.limit_work(max_total)
    begin = list(method.counts) if is_over_velocities else [method.done]
    last = begin[0] + max_iter

    def count_work() -> list[int]:
        """Return the counts of this call."""
        if not is_over_velocities:
            return [method.done - begin[0]]
        return [x - y for x, y in zip(method.counts, begin, strict=True)]

    try:
        while True:
            before = method.done
            deadline.has_passed()  # Kernels read the clock after some work only.
            steps = steps_per_check if max_total is None else min(steps_per_check, last - before)
            end = method.step(max(steps, 1), impulse)
            if end == CERTIFICATE and not is_over_velocities:
                certificate = method.direction
                with np.errstate(all="ignore"):
                    proven = check_certificate(problem, certificate, tol, deadline) is None
                if proven:
                    method.confirm_certificate()
                continue
            if end == REACHED and is_over_velocities:
                judged = judge_impulse(problem, impulse.copy())
                if not judged.relative <= tol:
                    # The judge does not confirm the kernel's test, which adds in another order and whose squares may
                    # underflow.
                    end = MORE if tolerance_ratio > MIN_TOLERANCE_RATIO else STUCK
                    tolerance_ratio *= 0.25
                    begin = [-x for x in count_work()]
                    last, before = max_iter + begin[0], -1
                    method.start(impulse, tolerance_ratio * tol, UNLIMITED_STEPS)
            if end != MORE or (max_total is not None and (method.done >= last or method.done == before)):
                break
    except KeyboardInterrupt:  # Return the best iterate.
        method.request_stop()
        method.step(1, impulse)
        return NewtonRun(Status.INTERRUPTED, count_work())
    status = _STATUS[end]
    if proven:
        status = Status.INFEASIBLE
    elif end in (MORE, SPENT) and method.done < last and deadline.has_passed():
        status = Status.TIME_LIMIT
    elif (end == SPENT and max_total is not None) or (end == MORE and method.done == before):
        status = Status.STALLED  # All `max_total` steps have been used, or a call did none.
    return NewtonRun(status, count_work(), None if end == MORE else certificate, judged)


def run_newton_steps(
    problem: Problem,
    kernel: Driver,
    impulse: FloatArray,
    max_iter: int,
    tol: float,
    deadline: Deadline = NEVER,
    is_continued: bool = False,
) -> Claim:
    """Run at most `max_iter` Newton steps over velocities on `impulse` (m,) in place; see `run_newton_method`."""
    if max_iter <= 0:
        return make_claim(Status.MAX_ITERATIONS, (0, 0, 0, 0))
    steps = min(MAX_STEPS_PER_CHECK, CHECK_INTERVAL / max(SPARSE_FLOP_TIME * kernel.work, 1e-9))
    # The kernel applies the step limit to each island separately.
    steps = max(1, int(max(1, kernel.islands) * steps))
    run = run_newton_method(
        problem, kernel, impulse, max_iter, tol, deadline, steps, UNLIMITED_STEPS, is_continued
    )
    return replace(make_claim(run.status, run.counts), judged=run.judged)


def make_claim(status: Status, counts: Any) -> Claim:
    """Return the claim for counts of (steps, factorisations, Coulomb rounds, line evaluations)."""
    done, *parts = counts
    work = {kind: n for kind, n in zip(_WORK_KINDS, parts, strict=True) if n or kind == _WORK_KINDS[0]}
    return Claim(status, done, work, form=FORM)
