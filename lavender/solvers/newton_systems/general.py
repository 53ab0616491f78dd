"""Newton's method over the velocities of J and M: its islands, its steps between two checks of Ctrl-C, and its claim.

The compiled driver selects velocities (`velocity_newton/newton.pxd`) or a dense A (`newton/rows.pxd`); it solves every
island of trees.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Any

from lavender.base.arrays import FloatArray
from lavender.base.deadline import NEVER, Deadline
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender.solvers.costs import RATES
from lavender.solvers.newton_systems.systems import UNLIMITED_STEPS, run_newton_method
from lavender_ext.driver.driver import Driver

FORM = "generalized coordinates"
# Between two checks for Ctrl-C, an island does at most this many steps, and at most as many as are estimated for
# CHECK_INTERVAL [s].
MAX_STEPS_PER_CHECK = 64
CHECK_INTERVAL = 4.0
SPARSE_FLOP_TIME = (
    1e-9 * RATES["sparse velocities"]
)  # Time [s] per multiply-add of a sparse factor.
# Largest number of values of an island's N. 3,000 velocities with a dense N take 144 MB with the factor.
MAX_MATRIX_ENTRIES = 9e6
_WORK_KINDS = ("factorisations", "Coulomb rounds", "line evaluations")


def prepare_islands(problem: Problem, work: float = inf) -> Driver | None:
    """Prepare the islands and their workspace.

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
    done, *parts = counts[:4]
    work = {
        kind: n for kind, n in zip(_WORK_KINDS, parts, strict=True) if n or kind == _WORK_KINDS[0]
    }
    return Claim(status, done, work, form=FORM)
