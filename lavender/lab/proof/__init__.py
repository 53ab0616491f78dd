"""Proofs that an exact solution stands beside an answer: how far away at most, in balls of interval arithmetic.

On the case of each block (a row inside its bounds or at one of them; a contact open or loaded, each part of its
friction sticking or sliding) the conditions are equations in the impulses that are not fixed by the case,

    free, loaded, sticks     w_i = A_i lambda - b_i = 0
    loaded, cone law         w_n = sum_g s_g,    s_g = |c w_g| over the sliding parts g, c the reach of its rows
    slides                   lambda_i s_g + c_i^2 w_i lambda_n = 0                                        (1)

and inequalities in the rest: lambda within its bounds, w >= 0 at a lower one, |lambda_g / c| <= lambda_n, and where a
contact is open w_n >= 0 (Coulomb) or w_n >= sum |c w_g| (cone law). With x~ an approximate zero, Y ~ F'(x~)^-1 and a
box X around x~,

    K(X) = x~ - Y F(x~) + (I - Y F'(X)) (X - x~)  inside X   =>   F has one zero in X                      (2)

(Krawczyk 1969; Neumaier 1990, theorem 5.1.8), F in ball arithmetic on the problem's float64 numbers as exact ones;
where each inequality holds over the box of the zero, it is a solution. Rows that depend on others exactly, target
included, keep the impulse that they were given: the impulses are one of a family, the velocities are those of all.
Balls cannot tell a zero from a small number: a row that carries nothing and has w = 0 is proven where it depends, as
exactly, on rows that have, or where a solution in rational numbers says so (nothing slides, up to RATIONAL unknowns);
else it is named as on the boundary of two cases, unless a proof begins from an answer of OTHERS, inside of a family.

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
from lavender.lab.motion.reference import PROOF, judged, kept, reference
from lavender.lab.proof.numbers import balls
from lavender.lab.proof.search import Enclosure, Search
from lavender.problem import Problem, check_problem
from lavender.solving.solve import solve

__all__ = ["Enclosure", "enclosed", "prove", "require"]

BITS = (128, 256)  # of the balls: what the first leave undecided the second try
# Where impulses are a family, an answer at its edge is between two cases; these end inside of it.
OTHERS = ("newton", "admm")
OTHERS_ROWS = 2000
SECONDS = 10.0  # for each of them
NEAR = 1e-6  # of the largest b: from the velocities of the answer
# If an answer without a proof has a larger relative residual, the problem may have no solution.
UNSOLVED_RESIDUAL = 1e-6


def prove(problem: Problem, solution: Any) -> Enclosure:
    """Enclose an exact solution of the problem near an answer, or show that the problem has none, with a proof.

    Parameters
    ----------
    problem : Problem
        Its float64 numbers count as exact: A and b, or J, M^-1 or M, compliance, b, bounds and coefficients; of bodies
        J as float64 has it.
    solution : Solution or (m,) array_like, N s
        The answer, of any solver; near enough to tell which contacts stick, slide and are open.

    Returns
    -------
    Enclosure
        Not proven is a result: `reason` says which block is undecided, or what else was in the way. `infeasible`: a
        certificate, of the answer or of `auto`, proves that there is no solution.

    Raises
    ------
    SolverUnavailable
        python-flint is not installed.
    CapabilityError
        More than LARGEST unknowns of J and M that are coupled with each other.

    Notes
    -----
    python-flint has one precision for the whole process. Proofs in several threads therefore run one after the other,
    and another thread's own balls have the precision of the proof while one runs.

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
    given = problem.impulse_array(answer)
    if isinstance(solution, Solution) and solution.certificate is not None:
        refuted = _infeasible(problem, solution.certificate)
        if refuted.infeasible:
            return refuted
    found = _searched(problem, given, given)
    if found.boundary and problem.m <= OTHERS_ROWS:
        for name in OTHERS:
            try:
                other = solve(problem, name, tol=1e-12, time_limit=SECONDS)
            except CapabilityError:
                continue
            # Of the same motion: where Coulomb's law has several, another one says nothing of the answer.
            again = _searched(problem, other.impulse, given)
            if again.proven and again.velocity_radius <= NEAR * float(abs(problem.b).max()):
                return again
    if not found.proven and not residual(problem, given).relative <= UNSOLVED_RESIDUAL:
        other = solve(problem, time_limit=SECONDS)
        if other.certificate is not None:
            refuted = _infeasible(problem, other.certificate)
            return refuted if refuted.infeasible else found
    return found


def _infeasible(problem: Problem, certificate: FloatArray) -> Enclosure:
    """Check a certificate (m,) on the problem's numbers as exact ones."""
    proof = certificates.prove(problem, certificate)
    holds = not proof.reason and proof.impulse_bound == math.inf
    return Enclosure(False, reason=proof.reason or proof.message, infeasible=holds)


def _searched(problem: Problem, start: FloatArray, given: FloatArray) -> Enclosure:
    """The enclosure that a search from one answer ends with, beside another."""
    for bits in BITS:
        with balls(bits) as flint:
            search = Search(flint, problem, start, given)
            found = search.run()
        if found.proven or search.singular:
            break
    return found


def enclosed(problem: Problem) -> Enclosure:
    """Enclose an exact solution near the reference of the problem's motions, and keep it as that reference."""
    problem = problem.disk
    found = prove(problem, reference(problem).impulse)
    if found.impulse is not None:
        kept(problem).reference = judged(
            problem, found.impulse, f"{PROOF}an exact solution within {found.velocity_radius:.1e} m/s"
        )
    return found


def require() -> None:
    """Raise SolverUnavailable where python-flint is not installed."""
    with balls(BITS[0]):
        pass
