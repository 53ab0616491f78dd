"""Estimate the times of set-ups [s] from a problem's size, before they start; only used with a time limit.

A set-up cannot be interrupted, so one that does not fit in the remaining time is not started. The rates are for one
core of 2023, 1.5 times the values that `python -m benchmarks limits` measures on problems of the suite, dense matrices,
and J and M.
"""

from __future__ import annotations

import sys
from math import inf

from lavender.judge import residuals
from lavender.problem import Problem
from lavender.solvers.registry import SMALL_ROWS, SolverSpec
from lavender_ext.factor.sparse import bandwidth

START_TIME = 5e-5  # Constant part of each set-up [s].
# Forming A [s]: per row, per entry of A of bodies, and per product of entries of J and M.
FORM_ROW_TIME, FORM_ENTRY_TIME, FORM_PRODUCT_TIME = 1.2e-7, 1.2e-8, 2.5e-9
# Time per entry of A [s]: to lay it out for a factor by Python, the same for a full matrix, and to sum its rows.
LAYOUT_ENTRY_TIME, FULL_LAYOUT_ENTRY_TIME, ROW_SUM_ENTRY_TIME = 3e-8, 9e-9, 6e-9
SCIPY_CALLS_TIME = 3e-4  # Time of SciPy's calls to lay out a sparse A [s].
# Analysis of A for a factor: time per entry [s], which grows by 1 + bandwidth / ANALYSIS_BANDWIDTH; time per entry [s]
# of a full matrix, which is one panel.
ANALYSIS_ENTRY_TIME, ANALYSIS_BANDWIDTH, FULL_ANALYSIS_ENTRY_TIME = 6e-8, 1500.0, 1e-9
# Time per multiply-add of a sweep (`Data.work`) [s]: of an elimination of bodies, of velocities, and of an order.
BODY_ELIMINATION_TIME, VELOCITY_ELIMINATION_TIME, ORDER_TIME = 3e-8, 4.5e-8, 1e-7
SWEEP_SETUP_TIME = 1.5e-9  # Time per multiply-add of a sweep [s], for its workspace and the first sweep.
# Time to import a module of SciPy [s], and the modules that factorisations need.
IMPORT_TIME, SCIPY_MODULES = 0.3, ("scipy.sparse", "scipy.linalg.lapack")
# Time per multiply-add of a first factor [s].
DENSE_FACTOR_WORK_TIME, SPARSE_FACTOR_WORK_TIME = 1.5e-10, 1e-9
# Time of `Problem.disk` [s] over J and M: constant, per row, per entry of J; and over a matrix, per entry of A.
DISK_J, DISK_J_ROW, DISK_J_ENTRY = 1e-4, 3e-8, 2.5e-9
DISK_A, DISK_A_ROW, DISK_A_ENTRY = 1.5e-4, 4e-8, 8e-9


# The time of `tight_limit` [s]: constant, and per entry of a full A.
TIGHT_LIMIT, TIGHT_LIMIT_PER_ENTRY = 1e-2, 1e-6


def tight_limit(problem: Problem) -> float:
    """Return a time [s] that is about a hundred times set-up and judge together, from the number of rows alone.

    A longer limit needs no other estimate before the solve. Estimates would take longer than a small problem.
    """
    return TIGHT_LIMIT + TIGHT_LIMIT_PER_ENTRY * float(len(problem.b)) ** 2


def forming_time(problem: Problem) -> float:
    """Estimate the time [s] to form A; 0 if it is known."""
    if problem.m == 0 or problem.matrix is not None or "_compressed" in problem.__dict__:
        return 0.0
    return formation_time(problem)


def formation_time(problem: Problem) -> float:
    """Estimate the time [s] to form A of J and M or of bodies, from the data only, whether A is known or not."""
    if problem.rows is None:
        entries = FORM_PRODUCT_TIME * float(problem.metric.products_of_a)
    else:
        entries = FORM_ENTRY_TIME * problem.max_entries
    return START_TIME + FORM_ROW_TIME * problem.m + entries


def estimate_disk_time(problem: Problem) -> float:
    """Estimate the time [s] to build `problem.disk`; 0 if it is known, or if the problem has no ellipses.

    The estimate itself computes only the couplings of bodies, whose time the caller has checked before.
    """
    if not problem.cones.has_ellipse or "_disk" in problem.__dict__:
        return 0.0
    if problem.generalized is not None:
        of_j = len(problem.generalized.operator.jac[1])
        return DISK_J + DISK_J_ROW * problem.m + DISK_J_ENTRY * of_j
    entries = problem.max_entries if problem.matrix is None else problem.matrix.size
    setup = DISK_A + DISK_A_ROW * problem.m + DISK_A_ENTRY * entries
    return setup + forming_time(problem) + loading_time("scipy.sparse")


def estimate_refusal_time(problem: Problem, spec: SolverSpec) -> float:
    """Estimate the time [s] of `SolverSpec.refusal`: adapters of other packages read a complete matrix."""
    if not spec.external or problem.matrix is None or "_scan" in problem.__dict__:
        return 0.0
    return residuals.estimate_judge_setup_time(problem) + residuals.READ_TIME_PER_ENTRY * float(
        problem.matrix.size
    )


def loading_time(*modules: str) -> float:
    """Estimate the time [s] to import the modules of SciPy that are not imported yet."""
    return IMPORT_TIME * sum(module not in sys.modules for module in modules)


def comparison_time(problem: Problem) -> float:
    """Estimate the time [s] to check whether A is symmetric; 0 if it is known."""
    find_known_relative = problem.matrix is None or "_scan" in problem.__dict__
    return 0.0 if find_known_relative else residuals.READ_TIME_PER_ENTRY * problem.max_entries


def matrix_setup_time(problem: Problem) -> float:
    """Estimate the time [s] to form A, check its symmetry, and lay it out for a solver."""
    entries = problem.max_entries
    imports = loading_time(*SCIPY_MODULES) if problem.m > SMALL_ROWS else 0.0
    full = entries == float(problem.m) ** 2
    layout = FULL_LAYOUT_ENTRY_TIME * entries if full else SCIPY_CALLS_TIME + LAYOUT_ENTRY_TIME * entries
    return START_TIME + forming_time(problem) + comparison_time(problem) + layout + imports


def analysis_time(problem: Problem) -> float:
    """Estimate the time [s] of an elimination order of A and its fill; the rows of a block are one node."""
    entries, m = problem.max_entries, float(problem.m)
    if entries == m * m:
        return FULL_ANALYSIS_ENTRY_TIME * entries
    is_known = problem.matrix is not None or "_compressed" in problem.__dict__
    band = max(bandwidth(*problem._compressed[:2])) if is_known else m
    return ANALYSIS_ENTRY_TIME * entries * (problem.n_blocks / m) * (1.0 + band / ANALYSIS_BANDWIDTH)


def row_sums_time(problem: Problem) -> float:
    """Estimate the time [s] to form A and to sum its rows with SciPy."""
    return (
        forming_time(problem)
        + ROW_SUM_ENTRY_TIME * problem.max_entries
        + START_TIME
        + loading_time("scipy.sparse")
    )


def first_solve_time(problem: Problem) -> float:
    """Estimate the time [s] of `matrix_setup_time` and the first factor of all rows."""
    return matrix_setup_time(problem) + first_factor_time(problem.m, problem.max_entries)


def dense_work(m: int) -> float:
    """Return the multiply-adds of one factor of a full matrix of m rows."""
    return m**3 / 3.0


def sparse_work(entries: float, m: int) -> float:
    """Estimate the multiply-adds of a sparse factor from its size, before an analysis; fill grows with the size."""
    return 100.0 * entries * (1.0 + m / 1000.0)


def first_factor_time(m: int, entries: float = inf) -> float:
    """Estimate the time [s] of a first factor of m rows; sparse if `entries` is given and that is faster."""
    return min(DENSE_FACTOR_WORK_TIME * dense_work(m), SPARSE_FACTOR_WORK_TIME * sparse_work(entries, m))


def body_setup_time(problem: Problem) -> float:
    """Estimate the time [s] to prepare an elimination of bodies, with the scaled J."""
    return START_TIME + BODY_ELIMINATION_TIME * problem.metric.work


def velocity_setup_time(problem: Problem) -> float:
    """Estimate the time [s] to prepare an elimination of generalised velocities."""
    return START_TIME + VELOCITY_ELIMINATION_TIME * problem.metric.work


def first_sweep_time(problem: Problem) -> float:
    """Estimate the time [s] to prepare sweeps over the given form, with the first sweep."""
    return START_TIME + SWEEP_SETUP_TIME * problem.metric.work


def order_time(problem: Problem, order: object) -> float:
    """Estimate the time [s] to compute an order of blocks; 0 for the given order."""
    return (
        0.0 if isinstance(order, str) and order == "given" else START_TIME + ORDER_TIME * problem.metric.work
    )
