"""Newton's method over the velocities of generalised coordinates (`lavender_ext/velocity_newton/newton.pxd`).

One compiled call solves every island of trees; here stand the clock and the words of the claim.
"""

from __future__ import annotations

from math import inf
from typing import Any

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline, Stopwatch
from lavender.judge.residuals import get_reference, judge_impulse, store_result
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender_ext.core.method import OUTCOMES
from lavender_ext.driver.driver import Driver

FORM = "generalized velocities"
# Steps for each island between two looks at the clock and at Ctrl-C, at most as many as are counted for WATCHED [s]: at
# FLOP, LOOKED_UP times as much where a factor looks for its entries. With a time limit at most as many as a
# share of what is left is for: counted so, then at the pace so far, and at FLOP at least: the first may be cheap ones.
CLOCK = 64
WATCHED = 4.0
TIME_SHARE = 0.5
LOOKED_UP = 20.0
FLOP = 1e-10  # s for each multiply-add of a dense factor
CLOSEST = 1e-2  # of tol, up to which the kernel is asked again where the judge does not find what it found
MAX_MATRIX_ENTRIES = 9e6  # values of one island's N: 3,000 velocities dense, 144 MB with its factor
_STATUS = {
    OUTCOMES["reached"]: Status.CONVERGED,
    OUTCOMES["more"]: Status.MAX_ITERATIONS,
    OUTCOMES["stuck"]: Status.STALLED,
    OUTCOMES["broken"]: Status.NUMERICAL_ERROR,
    OUTCOMES["lost"]: Status.DIVERGED,
}
NO_END = 2**31 - 1  # steps: who leads them counts them
_WORDS = ("factorisations", "Coulomb rounds", "line evaluations")


def prepare(problem: Problem, work: float = inf) -> Driver | None:
    """Islands and room for them; None where N of one is too large to be kept, or seen to need more multiply-adds."""
    get_reference(problem)
    kernel = Driver(problem.metric, MAX_MATRIX_ENTRIES, work)
    return kernel if kernel.fits else None


def run(
    problem: Problem,
    kernel: Driver,
    impulse: FloatArray,
    max_iter: int,
    tol: float,
    time_limit: float | None,
    again: bool = False,
) -> Claim:
    """At most n Newton steps on `impulse`, in place, until the judge's test at tol is met.

    `again`: on from where a run before, to the same tol, has used up its steps.
    """
    deadline, watch = Deadline(time_limit), Stopwatch()
    counts = [0, 0, 0, 0]
    status, closer = Status.MAX_ITERATIONS, 1.0
    now = 0.0
    islands = max(1, kernel.islands)
    step = counted = FLOP * kernel.work
    slow = max(LOOKED_UP * step, 1e-9)
    steps = clock = max(1, int(islands * min(CLOCK, WATCHED / slow)))  # a step is one of an island
    if time_limit is not None:
        steps = max(1, int(min(TIME_SHARE * time_limit / slow, clock)))
    while counts[0] < max_iter:
        if deadline.passed(min(step, 1e6)):
            status = Status.TIME_LIMIT
            break
        if not again:
            kernel.start(impulse, closer * tol, NO_END)
        before = kernel.counts
        status = _STATUS[kernel.step(min(steps, max_iter - counts[0]), impulse)]
        done = [now - then for now, then in zip(kernel.counts, before, strict=True)]
        counts = [count + more for count, more in zip(counts, done, strict=True)]
        if status is Status.CONVERGED and not confirmed(problem, impulse, tol):
            # Its sums are rounded in another order, and vanish where squares do.
            status = Status.MAX_ITERATIONS if closer > CLOSEST else Status.STALLED
            closer *= 0.25
            again = False
        elif status is Status.MAX_ITERATIONS:
            again = True
            if done[0] <= 0:
                status = Status.STALLED
        if status is not Status.MAX_ITERATIONS:
            break
        last, now = now, watch.seconds
        left = deadline.remaining()
        if left is not None and left <= 0.0:
            status = Status.TIME_LIMIT
            break
        if left is not None:
            step = max(now / max(1, counts[0]), (now - last) / max(1, done[0]))
            steps = max(1, int(min(clock, TIME_SHARE * left / max(step, counted, 1e-9))))
    return claim(status, counts)


def confirmed(problem: Problem, impulse: FloatArray, tol: float) -> bool:
    """Whether the judge finds what the kernel found; his pass is kept for the one who returns the impulse."""
    found = judge_impulse(problem, impulse.copy())
    store_result(problem, found)
    return bool(found.relative <= tol)


def claim(status: Status, counts: Any) -> Claim:
    """What (steps, factorisations, rounds, evaluations) come to in words."""
    done, *parts = counts
    work = {word: c for word, c in zip(_WORDS, parts, strict=True) if c or word == _WORDS[0]}
    return Claim(status, done, work, form=FORM)
