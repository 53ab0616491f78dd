"""What set-ups take [s], counted from a problem's size before any of it is done: asked under a time limit alone.

A set-up cannot be stopped, so one that does not fit in the time left is not begun. Rates are of one core of 2023, half
as much again as `python -m benchmarks limits` finds on problems of the suite, dense matrices, and J and M.
"""

from __future__ import annotations

import sys
from math import inf

from lavender.judge import residuals
from lavender.problem import Problem
from lavender.solvers.registry import SMALL_ROWS, SolverSpec
from lavender_ext.factor.sparse import bandwidth

START = 5e-5  # s, of each
EACH, FORMED, PRODUCT = 1.2e-7, 1.2e-8, 2.5e-9  # of A: each row and entry of bodies, each product of J and M
# s for each entry of A: laid out for a factor by Python, all of them at once where there are no others; row sums.
LAID_OUT, WHOLE, SUMMED = 3e-8, 9e-9, 6e-9
CALLS = 3e-4  # s of SciPy's calls where A is laid out by its entries
# s for each entry of A with an order of its own and what it fills, as many times more as its band has some thousand
# rows; where every entry is there, which is one panel.
ANALYSED, BAND, PANEL = 6e-8, 1500.0, 1e-9
# s for each multiply-add of a sweep (`Data.work`): of an elimination of bodies, one of velocities, and an order.
BODIES, VELOCITIES, ORDERED = 3e-8, 4.5e-8, 1e-7
SWEPT = 1.5e-9  # s for each multiply-add of a sweep, of its room and of itself
LOADING, SCIPY = 0.3, ("scipy.sparse", "scipy.linalg.lapack")  # s of a part of SciPy; what factors need
DENSE, SPARSE = 1.5e-10, 1e-9  # s for each multiply-add of a first factor
# s of `Problem.disk` over J and M: its calls, each row, each entry of J; and over a matrix, each entry of A.
DISK_J, DISK_J_ROW, DISK_J_ENTRY = 1e-4, 3e-8, 2.5e-9
DISK_A, DISK_A_ROW, DISK_A_ENTRY = 1.5e-4, 4e-8, 8e-9


def forming(problem: Problem) -> float:
    """A, where it is not known yet."""
    if problem.m == 0 or problem.matrix is not None or "_compressed" in problem.__dict__:
        return 0.0
    return formed_once(problem)


def formed_once(problem: Problem) -> float:
    """A of J and M or bodies, known or not: a count of the data alone."""
    if problem.rows is None:
        entries = PRODUCT * float(problem.metric.products_of_a)
    else:
        entries = FORMED * problem.max_entries
    return START + EACH * problem.m + entries


def estimate_disk_time(problem: Problem) -> float:
    """Estimate the time [s] of making `problem.disk`; 0 if it is known, or if the problem has no ellipses.

    Nothing is worked out for the estimate but the numbers of bodies, and these only after their own time is counted.
    """
    if not problem.cones.has_ellipse or "_disk" in problem.__dict__:
        return 0.0
    if problem.generalized is not None:
        of_j = len(problem.generalized.operator.jac[1])
        return DISK_J + DISK_J_ROW * problem.m + DISK_J_ENTRY * of_j
    entries = problem.max_entries if problem.matrix is None else problem.matrix.size
    made = DISK_A + DISK_A_ROW * problem.m + DISK_A_ENTRY * entries
    return made + forming(problem) + loading("scipy.sparse")


def estimate_refusal_time(problem: Problem, spec: SolverSpec) -> float:
    """Estimate the time [s] of `SolverSpec.refusal`: adapters of other packages read a whole matrix."""
    if not spec.external or problem.matrix is None or "_scan" in problem.__dict__:
        return 0.0
    return residuals.setup_time(problem) + residuals.READ_TIME_PER_ENTRY * float(problem.matrix.size)


def loading(*modules: str) -> float:
    """Parts of SciPy that this process has not loaded yet."""
    return LOADING * sum(module not in sys.modules for module in modules)


def compared(problem: Problem) -> float:
    """Whether A is symmetric, where it is not known yet."""
    known = problem.matrix is None or "_scan" in problem.__dict__
    return 0.0 if known else residuals.READ_TIME_PER_ENTRY * problem.max_entries


def over_rows(problem: Problem) -> float:
    """A, whether it is symmetric, and a matrix that a solver makes of it."""
    entries = problem.max_entries
    loaded = loading(*SCIPY) if problem.m > SMALL_ROWS else 0.0
    full = entries == float(problem.m) ** 2
    laid_out = WHOLE * entries if full else CALLS + LAID_OUT * entries
    return START + forming(problem) + compared(problem) + laid_out + loaded


def analysed(problem: Problem) -> float:
    """An order of elimination of A, and what it fills; rows of one block are one node."""
    entries, m = problem.max_entries, float(problem.m)
    if entries == m * m:
        return PANEL * entries
    is_known = problem.matrix is not None or "_compressed" in problem.__dict__
    band = max(bandwidth(*problem._compressed[:2])) if is_known else m
    return ANALYSED * entries * (problem.n_blocks / m) * (1.0 + band / BAND)


def summed(problem: Problem) -> float:
    """A, and sums of its rows by SciPy."""
    return forming(problem) + SUMMED * problem.max_entries + START + loading("scipy.sparse")


def factored(problem: Problem) -> float:
    """The same with its first factor, of all rows."""
    return over_rows(problem) + first_factor(problem.m, problem.max_entries)


def dense_work(m: int) -> float:
    """Multiply-adds of one factor of m rows, every entry a number."""
    return m**3 / 3.0


def sparse_work(entries: float, m: int) -> float:
    """Those of one in an order of its own, as size tells before an analysis counts them: fill grows with it."""
    return 100.0 * entries * (1.0 + m / 1000.0)


def first_factor(m: int, entries: float = inf) -> float:
    """A first factor of m rows, of few entries where these are given."""
    return min(DENSE * dense_work(m), SPARSE * sparse_work(entries, m))


def over_bodies(problem: Problem) -> float:
    """An elimination of bodies, and J scaled for it."""
    return START + BODIES * problem.metric.work


def over_velocities(problem: Problem) -> float:
    """An elimination of generalised velocities."""
    return START + VELOCITIES * problem.metric.work


def sweeping(problem: Problem) -> float:
    """Sweeps over the form that is given, and the first of them."""
    return START + SWEPT * problem.metric.work


def ordered(problem: Problem, order: object) -> float:
    """An order of blocks, other than the one given."""
    return 0.0 if isinstance(order, str) and order == "given" else START + ORDERED * problem.metric.work
