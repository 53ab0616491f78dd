"""Proofs that an exact solution lies within a computed distance of an answer, in interval arithmetic (balls).

Each block has a case: a row is inside its bounds or at one of them; a contact is open or loaded, and each of its
friction components sticks or slides. The case fixes some impulses; the others satisfy the equations

    free, loaded, sticks     w_i = A_i lambda - b_i = 0
    loaded, cone law         w_n = sum_g s_g,    s_g = |c w_g| over sliding components g, c their friction coefficients
    slides                   lambda_i s_g + c_i^2 w_i lambda_n = 0                                        (1)

and the inequalities lambda within its bounds, w >= 0 at a lower bound, |lambda_g / c| <= lambda_n, and, if a contact
is open, w_n >= 0 (Coulomb) or w_n >= sum |c w_g| (cone law). Let F(x) = 0 be the equations (1) in the unknown impulses
x. With x~ an approximate zero, Y ~ F'(x~)^-1 and a box X around x~,

    K(X) = x~ - Y F(x~) + (I - Y F'(X)) (X - x~)  inside X   =>   F has one zero in X                      (2)

(Krawczyk 1969; Neumaier 1990, theorem 5.1.8). F is evaluated in ball arithmetic, and the problem's float64 numbers
count as exact. If each inequality holds over the box of the zero, the zero is a solution. Rows that depend on others
exactly, target included, keep the impulse of the answer. The solution is then one of a family: a set of impulses that
all give the same velocities.

Ball arithmetic cannot distinguish a zero from a small number. That a row has both zero impulse and w = 0 is proven if
it depends exactly on rows with non-zero impulse, or if a solution in rational numbers shows it (nothing slides, at
most MAX_RATIONAL_UNKNOWNS unknowns). Otherwise the row is named as on the boundary of two cases, unless a proof
succeeds that starts from an answer of INTERIOR_SOLVERS, inside a family.

Needs python-flint (extra `proof`).
"""

from __future__ import annotations

import math
from typing import Any

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError
from lavender.judge import certificates
from lavender.judge.residuals import residual
from lavender.judge.solution import Solution
from lavender.lab.motion.reference import PROOF, get_motion_cache, get_reference, make_reference
from lavender.lab.proof.numbers import set_ball_precision
from lavender.lab.proof.search import Enclosure, Search
from lavender.problem import Problem, check_problem
from lavender.solving.solve import solve

__all__ = ["Enclosure", "enclose_reference", "prove", "require_python_flint"]

# [bits] A case that is undecided with the first precision is tried again with the second.
BALL_PRECISIONS = (128, 256)
# If several impulses give the same velocities, an answer at the edge of that set is between two cases. These solvers
# end in its interior.
INTERIOR_SOLVERS = ("newton", "admm")
INTERIOR_SOLVERS_MAX_ROWS = 2000  # Larger problems are not solved again with INTERIOR_SOLVERS.
PROOF_SOLVE_TIME_LIMIT = 10.0  # [s] Time limit of each additional solve.
# A proof from another answer counts only if its velocities agree with the first answer to this fraction of max |b|.
SAME_VELOCITY_TOL = 1e-6
# If an answer without a proof has a larger relative residual, the problem may have no solution.
UNSOLVED_RESIDUAL = 1e-6


def prove(problem: Problem, solution: Any) -> Enclosure:
    """Enclose an exact solution of the problem near an answer, or show that the problem has none, with a proof.

    Parameters
    ----------
    problem : Problem
        Its float64 numbers count as exact: A and b, or J, M^-1 or M, compliance, b, bounds and coefficients; for
        bodies, J as computed in float64.
    solution : Solution or (m,) array_like, N s
        The answer of any solver, accurate enough to show which contacts stick, slide and are open.

    Returns
    -------
    Enclosure
        If nothing is proven, `reason` names the undecided block, or the obstacle. If `infeasible` is true, a
        certificate of the answer or of `auto` proves that the problem has no solution.

    Raises
    ------
    SolverUnavailable
        python-flint is not installed.
    CapabilityError
        More than 2,000 unknowns of J and M are coupled with each other.

    Notes
    -----
    python-flint has one precision for the whole process. Proofs in several threads therefore run one after the other,
    and balls that another thread computes meanwhile have the precision of the proof.

    R. Krawczyk 1969, Computing 4, 187-201; A. Neumaier 1990, Interval Methods for Systems of Equations; F. Johansson
    2017, Arb, IEEE Trans. Computers 66, 1281-1292.

    Examples
    --------
    >>> import lavender as lv
    >>> problem = lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0])
    >>> found = lv.prove(problem, lv.solve(problem, "pgs", tol=1e-9))
    >>> found.proven, found.unique, found.velocity_radius < 1e-8
    (True, True, True)
    """
    check_problem(problem)
    answer = solution.impulse if isinstance(solution, Solution) else solution
    start = problem.impulse_array(answer)
    if isinstance(solution, Solution) and solution.certificate is not None:
        refuted = _check_certificate(problem, solution.certificate)
        if refuted.infeasible:
            return refuted
    enclosure = _prove_from(problem, start, start)
    if enclosure.boundary and problem.m <= INTERIOR_SOLVERS_MAX_ROWS:
        for name in INTERIOR_SOLVERS:
            try:
                other = solve(problem, name, tol=1e-12, time_limit=PROOF_SOLVE_TIME_LIMIT)
            except CapabilityError:
                continue
            # The velocities must agree: under Coulomb's law, another motion proves nothing about this answer.
            again = _prove_from(problem, other.impulse, start)
            if again.proven and again.velocity_radius <= SAME_VELOCITY_TOL * float(abs(problem.b).max()):
                return again
    if not enclosure.proven and not residual(problem, start).relative <= UNSOLVED_RESIDUAL:
        other = solve(problem, time_limit=PROOF_SOLVE_TIME_LIMIT)
        if other.certificate is not None:
            refuted = _check_certificate(problem, other.certificate)
            return refuted if refuted.infeasible else enclosure
    return enclosure


def _check_certificate(problem: Problem, certificate: FloatArray) -> Enclosure:
    """Check a certificate of infeasibility (m,) in exact arithmetic on the problem's numbers."""
    proof = certificates.prove_infeasibility(problem, certificate)
    holds = not proof.reason and proof.impulse_bound == math.inf
    return Enclosure(False, reason=proof.reason or proof.message, infeasible=holds)


def _prove_from(problem: Problem, start: FloatArray, answer: FloatArray) -> Enclosure:
    """Search an enclosure from the impulse `start` (m,) [N s] and measure its distance from `answer` (m,) [N s]."""
    for bits in BALL_PRECISIONS:
        with set_ball_precision(bits) as flint:
            search = Search(flint, problem, start, answer)
            enclosure = search.search_solution()
        if enclosure.proven or search.singular:
            break
    return enclosure


def enclose_reference(problem: Problem) -> Enclosure:
    """Enclose an exact solution near the problem's motion reference and store it as that reference."""
    problem = problem.disk
    enclosure = prove(problem, get_reference(problem).impulse)
    if enclosure.impulse is not None:
        get_motion_cache(problem).reference = make_reference(
            problem, enclosure.impulse, f"{PROOF}an exact solution within {enclosure.velocity_radius:.1e} m/s"
        )
    return enclosure


def require_python_flint() -> None:
    """Raise SolverUnavailable if python-flint is not installed."""
    with set_ball_precision(BALL_PRECISIONS[0]):
        pass
