"""Estimate costs [ns]: operations, counted from the data, times the rates of `lavender.base.rates`. No clock is read.

`auto` and `explain` read them by the methods `estimate_..._cost` of solvers. There are two kinds of costs.

Costs of iterations, which `auto` compares. Their rates are fitted means:

    Newton   start + n (row m + entry e + work w)                                                             (1)
    sweep    sweep_row m + entry e, with other rates of e over J and M, and under the cone law over bodies or J  (2)
    direct   n (row m + work w)                                                                               (3)

m is the number of rows; e the multiply-adds of a sweep, or the entries of A that one step reads; w the multiply-adds
of one factorisation and its solves, from the solver's own analysis (`NewtonState.count`) or from the band of A. n is
the number of factorisations: 1 for linear problems, `DECISIONS.pivot_factorisations` for bounded rows of a matrix or
of bodies, otherwise `DECISIONS.factorisations`. Newton's method over generalised velocities has its own estimate,
without a start and with two rates of rows (`lavender_ext/small/limits.pxd`).

Costs of set-ups, which are not interrupted. `auto` estimates them under a time limit; their rates are 1.5 times the
fitted means. `python -m benchmarks rates` measures the rates and writes the file. The rates from "band work" on in the
file were measured once: they select a factorisation. A problem has the same cost on all machines with the same file.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from lavender.base.rates import RATES as RATES
from lavender.problem import Problem
from lavender.solvers.decisions import DECISIONS
from lavender_ext.factor.sparse import bandwidth

# The analysis of A costs 1 + bandwidth / ANALYSIS_BANDWIDTH times its rate per entry.
ANALYSIS_BANDWIDTH = 1500.0
# [ns, ns per entry of a full A] If a time limit exceeds LOOSE_LIMIT + LOOSE_LIMIT_PER_ENTRY m^2, it is about a hundred
# times the cost of the set-ups, and `auto` does not estimate these.
LOOSE_LIMIT, LOOSE_LIMIT_PER_ENTRY = 1e7, 1e3


@dataclass(frozen=True)
class Count:
    """Operation counts of one step of Newton's method over rows or bodies."""

    form: str  # Matrix that is factored: "bodies", "dense" or "panels".
    work: float  # Multiply-adds of one factorisation.
    entries: float  # Number of additional values that a step reads.
    rows: float
    set_up: float = 0.0  # [ns] Cost to form A from J and M.


# -- iterations ----------------------------------------------------------------------------------


def estimate_factorisation_count(problem: Problem) -> float:
    """Return the expected number of factorisations of Newton's method: 1 for linear problems."""
    if problem.law == "linear":
        return 1.0
    pivots = problem.law == "lcp" and problem.generalized is None
    return DECISIONS.pivot_factorisations if pivots else DECISIONS.factorisations


def estimate_newton_cost(count: Count, problem: Problem) -> float:
    """Estimate the cost of Newton's method over rows or bodies [ns], (1)."""
    r = RATES
    step_cost = (
        r["row"] * count.rows + r["entry"] * count.entries + r["work"][count.form] * count.work
    )
    return float(r["start"] + count.set_up + estimate_factorisation_count(problem) * step_cost)


def get_sweep_rate_name(problem: Problem) -> str:
    """Return the name of the rate of a sweep's multiply-adds."""
    if problem.matrix is not None:
        return "entry"
    if problem.law == "cone":
        return "sweep cone" if problem.rows is None else "sweep body cone"
    return "entry" if problem.generalized is None else "sweep velocities"


def count_dense_work(m: int) -> float:
    """Return the number of multiply-adds of one factor of a full matrix of m rows."""
    return m**3 / 3.0


def estimate_sparse_work(entries: float, m: int) -> float:
    """Estimate the multiply-adds of a sparse factorisation from the size of A, without an analysis of its fill-in."""
    return 100.0 * entries * (1.0 + m / 1000.0)


# -- set-ups -------------------------------------------------------------------------------------


def get_loose_limit(problem: Problem) -> float:
    """Return the time limit [ns] above which `auto` estimates no set-ups: about a hundred times their cost."""
    return LOOSE_LIMIT + LOOSE_LIMIT_PER_ENTRY * float(len(problem.b)) ** 2


def is_formed(problem: Problem) -> bool:
    """Return whether A is known already, or has no rows."""
    return problem.m == 0 or problem.matrix is not None or "_compressed" in problem.__dict__


def estimate_formation_cost(problem: Problem, known: bool | None = None) -> float:
    """Estimate the cost to form A from J and M or from bodies [ns]; 0 if A is known.

    `known` states whether A is known; None checks the problem's cache.
    """
    if is_formed(problem) if known is None else known:
        return 0.0
    if problem.rows is None:
        entries = RATES["form product"] * float(problem.metric.products_of_matrix)
    else:
        entries = RATES["form entry"] * problem.max_entries
    return float(RATES["set-up"] + RATES["form row"] * problem.m + entries)


def estimate_matrix_setup_cost(problem: Problem) -> float:
    """Estimate the cost to form A, check its symmetry, and copy it into a solver's layout [ns]."""
    entries = problem.max_entries
    if entries == float(problem.m) ** 2:
        layout = RATES["full layout entry"] * entries
    else:
        layout = RATES["scipy calls"] + RATES["layout entry"] * entries
    form = estimate_formation_cost(problem)
    is_symmetry_known = problem.matrix is None or "_matrix_asymmetry" in problem.__dict__
    symmetry = 0.0 if is_symmetry_known else float(RATES["judge entry"] * problem.max_entries)
    return float(RATES["set-up"] + form + symmetry + layout)


def estimate_analysis_cost(problem: Problem) -> float:
    """Estimate the cost to compute an elimination order of A and its fill [ns]; a block is one node."""
    entries = problem.max_entries
    m = float(problem.m)
    if entries == m * m:
        return float(RATES["full analysis entry"] * entries)
    is_known = problem.matrix is not None or "_compressed" in problem.__dict__
    band = max(bandwidth(*problem._compressed[:2])) if is_known else m
    return float(
        RATES["analysis entry"]
        * entries
        * (problem.n_blocks / m)
        * (1.0 + band / ANALYSIS_BANDWIDTH)
    )


def estimate_first_factor_cost(m: int, entries: float = inf) -> float:
    """Estimate the cost of a first factorisation of m rows [ns]: dense, or sparse if that costs less.

    `entries` is the number of entries of the matrix.
    """
    dense = RATES["dense factor"] * count_dense_work(m)
    return float(min(dense, RATES["sparse factor"] * estimate_sparse_work(entries, m)))


def estimate_dense_factor_cost(m: int) -> float:
    """Return the cost of one dense Cholesky factorisation of m rows [ns], without the overhead of the call.

    LAPACK on one thread takes 0.7 to 1 times as long.
    """
    return float(RATES["dense work"] * count_dense_work(m) + RATES["dense entry"] * float(m) ** 2)


def estimate_elimination_cost(problem: Problem, kind: str) -> float:
    """Estimate the cost to prepare an elimination of bodies or of generalised velocities [ns], by its rate."""
    return float(RATES["set-up"] + RATES[kind] * problem.metric.work)
