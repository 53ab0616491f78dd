"""Checks of results: the same bits, the same result in other units, true claims, and problems without a solution."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from lavender.base.errors import CapabilityError
from lavender.contract.enumeration import enumerate_lcp, random_bounds
from lavender.contract.problems import (
    make_problem_with_other_numbers,
    make_touching_bodies,
)
from lavender.contract.requirement import (
    CHECKED_DRAWS,
    MAX_DRAWN_ROWS,
    OWN_TOLERANCE,
    THREADS,
    are_bit_identical,
    choose_iteration_budget,
    describe_difference,
    describe_problem,
    make_well_posed_problems,
    raise_unless,
    register_check,
)
from lavender.judge.certificates import check_certificate
from lavender.judge.solution import Solution, Status
from lavender.problem import Problem
from lavender.solvers.registry import SolverSpec
from lavender.solving.prepared import prepare
from lavender.solving.solve import solve

# -- reproducible results -----------------------------------------------------------------------------


def _make_short_options(spec: SolverSpec) -> dict[str, Any]:
    return {"tol": 1e-7, "max_iter": 60 if spec.resumable else None}


@register_check("all solvers except code of another project", lambda spec: not spec.external)
def require_results_are_reproducible(spec: SolverSpec) -> None:
    """Require that the same call gives the same bits, also from several threads at once."""
    options = _make_short_options(spec)
    for problem in make_well_posed_problems(spec):
        first = solve(problem, spec.name, **options)

        def repeat(_: int, problem: Problem = problem) -> Solution:
            return solve(problem, spec.name, **options)

        again = repeat(0)
        raise_unless(
            are_bit_identical(again, first),
            f"for {describe_problem(problem)} the same call gave another result: {describe_difference(again, first)}",
        )
        with ThreadPoolExecutor(THREADS) as pool:
            for other in pool.map(repeat, range(THREADS)):
                raise_unless(
                    are_bit_identical(other, first),
                    f"for {describe_problem(problem)} a call from one of {THREADS} threads gave another result: "
                    f"{describe_difference(other, first)}. The object of the factory holds options only",
                )


@register_check("all solvers except code of another project", lambda spec: not spec.external)
def require_update_equals_prepare(spec: SolverSpec) -> None:
    """Require that `update` to new numbers gives the bits of a new `prepare`."""
    options = _make_short_options(spec)
    for problem in make_well_posed_problems(spec):
        changed = make_problem_with_other_numbers(problem)
        if spec.refuses(changed) is not None:
            continue
        prepared = prepare(changed, spec.name)
        prepared.solve(**options)
        updated, fresh = prepared.solve(problem, **options), solve(problem, spec.name, **options)
        raise_unless(
            are_bit_identical(updated, fresh),
            f"for {describe_problem(problem)}, the result after `update` is not the one after `prepare`: "
            f"{describe_difference(updated, fresh)}",
        )


@register_check("all solvers except code of another project", lambda spec: not spec.external)
def require_units_do_not_matter(spec: SolverSpec) -> None:
    """Require that impulses scale with the units of mass and velocity."""
    mass, velocity = 2.0**10, 2.0**-20  # Units are scaled by powers of two, which are exact in float64.
    for problem in make_well_posed_problems(spec):
        if problem.operator != "matrix":
            continue
        cones, matrix = problem.cones, problem.matrix
        assert matrix is not None
        scaled = Problem(
            problem.b * velocity,
            replace(cones, lower=cones.lower * (mass * velocity), upper=cones.upper * (mass * velocity)),
            matrix / mass,
            friction=problem.friction,
        )
        if spec.refuses(scaled) is not None:
            continue
        first, second = (
            solve(p, spec.name, tol=OWN_TOLERANCE, max_iter=choose_iteration_budget(spec))
            for p in (problem, scaled)
        )
        description = f"{describe_problem(problem)} in other units of mass (2^10) and velocity (2^-20)"
        text = f"for {description} the result is: {second}"
        raise_unless(second.success or not first.success, f"{text}. CONVERGED is required, as in SI units")
        error = np.abs(second.impulse / (mass * velocity) - first.impulse).max()
        limit = 1e4 * OWN_TOLERANCE * max(1.0, np.abs(first.impulse).max())
        raise_unless(
            not first.success or error <= limit,
            f"{text}. Its impulse, in SI units, differs by {error:.3g} N s from the one of SI units",
        )


# -- problems that are unusual, hard or have no solution ----------------------------------------------


def make_soft_static_contacts() -> Problem:
    """Return two contacts of a body that cannot move: compliance alone makes A = diag(1, 2, 1, 2)."""
    rows = make_touching_bodies([[-1, 0], [-1, 0]], inv_mass=[0.0], inv_inertia=np.zeros((1, 3, 3)))
    return Problem.from_rows(rows, [1.0, 2.0, 1.0, -2.0], mu=0.5, tangents=1, compliance=[1.0, 2.0, 1.0, 2.0])


def make_unusual_problems() -> dict[str, Problem]:
    """Return unusual but valid problems by their description."""
    return {
        "0 rows (linear)": Problem.linear(np.zeros((0, 0)), []),
        "0 rows (lcp)": Problem.lcp(np.zeros((0, 0)), []),
        "1 free row": Problem.linear([[2.0]], [1.0]),
        "1 active row": Problem.lcp([[2.0]], [1.0]),
        "1 inactive row": Problem.lcp([[2.0]], [-1.0]),
        "1 row with a negative A": Problem.lcp([[-2.0]], [1.0]),
        "a zero row of A that is inactive": Problem.lcp(np.diag([1.0, 0.0]), [1.0, -1.0]),
        "a zero row of A with an upper bound": Problem.lcp(np.diag([1.0, 0.0]), [1.0, 1.0], upper=3.0),
        "three equal bounded rows": Problem.lcp(np.ones((3, 3)), [1.0, 1.0, 1.0]),
        "three equal free rows": Problem.linear(np.ones((3, 3)), [1.0, 1.0, 1.0]),
        "a zero diagonal": Problem.lcp([[0.0, 1.0], [1.0, 0.0]], [1.0, 1.0]),
        "an indefinite A": Problem.lcp([[-1.0, 2.0], [2.0, -1.0]], [1.0, 1.0]),
        "an asymmetric A": Problem.lcp([[2.0, 1.0], [-1.0, 2.0]], [1.0, 1.0]),
        "a contact with tangents that cannot move": Problem.contact(
            np.diag([1.0, 0.0, 0.0]), [1.0, 0.2, 0.1], [0.5]
        ),
        "two soft contacts of a static body": make_soft_static_contacts(),
    }


@register_check("all solvers")
def require_unusual_problems_have_a_result(spec: SolverSpec) -> None:
    """Require that unusual but valid problems have a finite result, or are refused with a CapabilityError."""
    for name, problem in make_unusual_problems().items():
        try:
            solution = solve(problem, spec.name)
        except CapabilityError:
            continue
        raise_unless(
            bool(np.isfinite(solution.impulse).all()), f"for {name} the impulse is {solution.impulse}"
        )
        raise_unless(
            spec.external or solution.claim_check == "confirmed",
            f"for {name} the judge does not confirm the claim ({solution.claim_check}): {solution}",
        )
        raise_unless(problem.m > 0 or solution.success, f"{name} are not CONVERGED: {solution}")


@register_check("all solvers except code of another project", lambda spec: not spec.external)
def require_claims_are_true(spec: SolverSpec) -> None:
    """Require that every claim about a small random matrix is true: solutions, and that there is none."""

    def compare(seed: int, m: int) -> None:
        rng = np.random.default_rng(seed)
        a = np.rint(2.0 * rng.normal(size=(m, m)))
        low, high = random_bounds(rng, m)
        problem = Problem.lcp(a, np.rint(3.0 * rng.normal(size=m)), low, high)
        if spec.refuses(problem):
            return
        solution = solve(problem, spec.name, tol=1e-9)
        text = f"for A = {a.tolist()}, b = {problem.b.tolist()}, bounds {low.tolist()} and {high.tolist()}: {solution}"
        raise_unless(
            solution.claim_check == "confirmed",
            f"{text}. The judge does not confirm the claim: {solution.claim_check}",
        )
        raise_unless(bool(np.isfinite(solution.impulse).all()), f"{text}. The impulse is not finite")
        if solution.status is Status.INFEASIBLE:
            exact = enumerate_lcp(a, problem.b, low, high)
            raise_unless(not exact, f"{text}. But {exact and exact[0][0].tolist()} N s is a solution")

    check_on_random_problems(compare)


def check_on_random_problems(compare: Callable[[int, int], None]) -> None:
    """Call `compare(seed, m)` for random small problems of m rows.

    If Hypothesis is installed, it reduces a failure to a small example.
    """
    try:
        import hypothesis
        from hypothesis import strategies
    except ImportError:
        for seed in range(CHECKED_DRAWS):
            compare(seed, 1 + seed % MAX_DRAWN_ROWS)
        return
    draw = hypothesis.given(seed=strategies.integers(0, 2**32 - 1), m=strategies.integers(1, MAX_DRAWN_ROWS))
    settings = hypothesis.settings(
        max_examples=CHECKED_DRAWS,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(hypothesis.HealthCheck),  # pyright: ignore[reportArgumentType]
    )

    def call(seed: int, m: int) -> None:
        compare(seed, m)

    settings(draw(call))()


@register_check("all solvers")
def require_failures_have_a_message(spec: SolverSpec) -> None:
    """Require that DIVERGED, STALLED and NUMERICAL_ERROR come with a message."""
    for matrix in UNSOLVABLE_MATRICES:
        for build, second in itertools.product((Problem.linear, Problem.lcp), (1.0, -1.0)):
            problem = build(matrix, [1.0, second])
            if spec.refuses(problem) is not None:
                continue
            solution = solve(problem, spec.name, tol=1e-6)
            failed = solution.status in (Status.DIVERGED, Status.STALLED, Status.NUMERICAL_ERROR)
            raise_unless(
                bool(solution.message) or not failed,
                f"for A = {matrix}, b = {[1.0, second]} the status is {solution.status.name} without a message",
            )


#: Matrices with a zero and a negative diagonal entry, and an indefinite one: sweeps do not solve these problems.
UNSOLVABLE_MATRICES = ([[0.0, 1.0], [1.0, 2.0]], [[2.0, 3.0], [3.0, -1.0]], [[1.0, 3.0], [3.0, 1.0]])


@register_check("all solvers")
def require_infeasible_rows_are_reported(spec: SolverSpec) -> None:
    """Require that a row that no impulse can satisfy gives INFEASIBLE with a certificate that names the row."""
    problem = Problem.lcp(np.diag([1.0, 0.0]), [1.0, 1.0])
    if spec.refuses(problem):
        return
    solution = solve(problem, spec.name)
    text = f"for A = diag(1, 0), b = (1, 1) and impulses >= 0 the result is: {solution}"
    raise_unless(
        solution.status is Status.INFEASIBLE,
        f"{text}. INFEASIBLE is required: no impulse satisfies row 1",
    )
    raise_unless("row 1" in solution.message, f"{text}. Its message must name row 1: {solution.message!r}")
    raise_unless(
        solution.certificate is not None and check_certificate(problem, solution.certificate) is None,
        f"{text}. Its certificate is not valid",
    )
    raise_unless(solution.claim_check == "confirmed", f"{text}. The judge does not confirm it")
