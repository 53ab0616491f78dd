"""Newton's method over the velocities of generalised coordinates; equations in `lavender_ext/generalized/newton.pxd`.

One compiled call solves every island of trees; here stand the clock and the words of the claim.
"""

from __future__ import annotations

from time import perf_counter

import numpy as np

from lavender._arrays import FloatArray
from lavender.problem import Problem
from lavender.residuals import reference
from lavender.solution import Claim, Status
from lavender_ext.generalized.newton import ENDS, Newton

CLOCK = 64  # steps between two looks at the clock and at Ctrl-C
LIMIT = 3000  # velocities of one island up to which N is kept dense: 144 MB with its factor
_STATUS = {
    ENDS["done"]: Status.CONVERGED,
    ENDS["spent"]: Status.MAX_ITERATIONS,
    ENDS["stuck"]: Status.STALLED,
    ENDS["failed"]: Status.NUMERICAL_ERROR,
    ENDS["lost"]: Status.DIVERGED,
}
_WORDS = ("factorisations", "updates", "Coulomb rounds", "line evaluations")


def prepare(problem: Problem) -> Newton:
    """Islands and room for them."""
    reference(problem)
    return Newton(problem.metric)


def run(
    problem: Problem, kernel: Newton, impulse: FloatArray, n: int, tol: float, time_limit: float | None
) -> Claim:
    """At most n Newton steps on `impulse`, in place, until the judge's test at tol is met."""
    deadline = np.inf if time_limit is None else perf_counter() + time_limit
    cold = not impulse.any() or bool(np.array_equal(impulse, problem._start))
    counts = np.zeros(5, np.int64)
    status = Status.MAX_ITERATIONS
    while counts[0] < n:
        end, done = kernel.run(impulse, tol, min(CLOCK, n - int(counts[0])), cold)
        counts += done
        status = _STATUS[end]
        if status is not Status.MAX_ITERATIONS:
            break
        if perf_counter() > deadline:
            status = Status.TIME_LIMIT
            break
        cold = False
    work = {word: int(c) for word, c in zip(_WORDS, counts[1:], strict=True) if c or word == _WORDS[0]}
    return Claim(status, int(counts[0]), work, form="generalized velocities")
