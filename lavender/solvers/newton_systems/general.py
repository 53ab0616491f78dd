"""Newton's method for J and M: over velocities (`velocity_newton/newton.pxd`) or over a dense A (`newton/rows.pxd`).

The compiled driver selects one. It solves every island of trees; this module checks the clock and builds the claim.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Any

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline, Stopwatch
from lavender.judge.residuals import get_zero_impulse_reference, judge_impulse
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender.solvers.costs import RATES
from lavender_ext.core.method import OUTCOMES
from lavender_ext.driver.driver import Driver

FORM = "generalized coordinates"
# Between two checks of the clock and Ctrl-C, an island does at most this many steps, and at most as many as are
# estimated for CHECK_INTERVAL [s] with SPARSE_FLOP_TIME. With a time limit, the steps use at most CALL_TIME_FRACTION of
# the remaining time, at the measured speed or at FLOP_TIME, whichever is slower, because the first steps may be cheap.
MAX_STEPS_PER_CHECK = 64
CHECK_INTERVAL = 4.0
CALL_TIME_FRACTION = 0.5
FLOP_TIME = 1e-9 * RATES["work"]["velocities"]  # Time [s] per multiply-add of a dense factor.
SPARSE_FLOP_TIME = 1e-9 * RATES["sparse velocities"]  # Time [s] per multiply-add of a sparse factor.
# If the judge does not confirm the kernel's result, the kernel runs again with a smaller tolerance, down to this
# fraction of tol.
MIN_TOLERANCE_RATIO = 1e-2
# Largest number of values of an island's N. 3,000 velocities with a dense N take 144 MB with the factor.
MAX_MATRIX_ENTRIES = 9e6
_STATUS = {
    OUTCOMES["reached"]: Status.CONVERGED,
    OUTCOMES["floor"]: Status.ROUNDOFF_LIMIT,
    OUTCOMES["more"]: Status.MAX_ITERATIONS,
    OUTCOMES["stuck"]: Status.STALLED,
    OUTCOMES[
        "certificate"
    ]: Status.STALLED,  # The method over rows of A or bodies continues, and checks certificates.
    OUTCOMES["broken"]: Status.NUMERICAL_ERROR,
    OUTCOMES["lost"]: Status.DIVERGED,
}
UNLIMITED_STEPS = 2**31 - 1  # Step limit that is passed to the kernel, because `run` limits the steps.
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


def run_newton_steps(
    problem: Problem,
    kernel: Driver,
    impulse: FloatArray,
    max_iter: int,
    tol: float,
    time_limit: float | None,
    is_continued: bool = False,
) -> Claim:
    """Run at most `max_iter` Newton steps on `impulse` (m,) in place, until the judge's test at tol is met.

    With `is_continued`, continue a run to the same tol that used up its steps.
    """
    deadline, watch = Deadline(time_limit), Stopwatch()
    counts = [0, 0, 0, 0]
    status, tolerance_ratio = Status.MAX_ITERATIONS, 1.0
    judged: Any = None
    now = 0.0
    islands = max(1, kernel.islands)
    step = counted = FLOP_TIME * kernel.work
    slow = max(SPARSE_FLOP_TIME * kernel.work, 1e-9)
    # The kernel applies the step limit to each island separately.
    steps = clock = max(1, int(islands * min(MAX_STEPS_PER_CHECK, CHECK_INTERVAL / slow)))
    if time_limit is not None:
        steps = max(1, int(min(CALL_TIME_FRACTION * time_limit / slow, clock)))
    while counts[0] < max_iter:
        if deadline.has_passed(min(step, 1e6)):
            status = Status.TIME_LIMIT
            break
        if not is_continued:
            kernel.start(impulse, tolerance_ratio * tol, UNLIMITED_STEPS)
        before = kernel.counts
        status = _STATUS[kernel.step(min(steps, max_iter - counts[0]), impulse)]
        done = [now - then for now, then in zip(kernel.counts, before, strict=True)]
        counts = [total + new for total, new in zip(counts, done, strict=True)]
        if status is Status.CONVERGED:
            judged = judge_impulse(problem, impulse.copy())
        if status is Status.CONVERGED and not judged.relative <= tol:
            # The judge does not confirm the kernel's test, which adds in another order and whose squares may underflow.
            status = Status.MAX_ITERATIONS if tolerance_ratio > MIN_TOLERANCE_RATIO else Status.STALLED
            tolerance_ratio *= 0.25
            is_continued = False
        elif status is Status.MAX_ITERATIONS:
            is_continued = True
            if done[0] <= 0:
                status = Status.STALLED
        if status is not Status.MAX_ITERATIONS:
            break
        last, now = now, watch.elapsed_seconds
        left = deadline.get_remaining_seconds()
        if left is not None and left <= 0.0:
            status = Status.TIME_LIMIT
            break
        if left is not None:
            step = max(now / max(1, counts[0]), (now - last) / max(1, done[0]))
            steps = max(1, int(min(clock, CALL_TIME_FRACTION * left / max(step, counted, 1e-9))))
    return replace(make_claim(status, counts), judged=judged)


def make_claim(status: Status, counts: Any) -> Claim:
    """Return the claim for counts of (steps, factorisations, Coulomb rounds, line evaluations)."""
    done, *parts = counts
    work = {kind: n for kind, n in zip(_WORK_KINDS, parts, strict=True) if n or kind == _WORK_KINDS[0]}
    return Claim(status, done, work, form=FORM)
