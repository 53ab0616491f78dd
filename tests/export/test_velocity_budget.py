"""`velocity_tol` of a budget: the rule of `lavender.solve`, with its bits."""

import pytest
from clib import SWEEPS
from random_problems import as_matrix, random_contact_problem, random_lcp
from tower import self_test_problem

import lavender as lv

OUTCOMES = {0: "MAX_ITERATIONS", 1: "CONVERGED", 3: "STALLED", 4: "ROUNDOFF_LIMIT"}


def accepted(method):
    """Problems that the library and the package solve by this method over the same form."""
    drawn = [self_test_problem(), *(random_contact_problem(seed) for seed in range(3))]
    matrices = [random_lcp(seed, m=8) for seed in range(3)] + [as_matrix(p) for p in drawn]
    problems = [*drawn, *matrices] if method == "sequential_impulses" else matrices
    return [p for p in problems if method in lv.available(p)]


@pytest.mark.parametrize(
    "velocity_tol", [1e3, 1e-2, 1e-4, 1e-7]
)  # 1e3 m/s: zero impulses are accepted
@pytest.mark.parametrize("method", (*SWEEPS, "newton", "direct"))
def test_c_library_to_a_velocity_error_has_the_bits_of_the_package(library, method, velocity_tol):
    problems = accepted(method)
    assert problems
    for problem in problems:
        solver = library.open(library.problem(problem), library.options(method))
        out = solver.run(3000, 0.5, velocity_tol)  # tol is not used
        solution = lv.solve(problem, method, velocity_tol=velocity_tol, max_iter=3000)
        assert OUTCOMES[out.outcome] == solution.status.name
        assert (out.verdict.velocity <= velocity_tol) == solution.success
        worst = lv.residual(problem, solver.impulse()).velocity
        assert out.verdict.velocity == worst
        if method in SWEEPS:
            assert solver.impulse().tobytes() == solution.impulse.tobytes()


def test_c_library_to_a_velocity_error_accepts_a_larger_relative_residual(library):
    problem = as_matrix(self_test_problem())
    reference = lv.residual(problem, problem.start()).velocity_at_zero
    exceeds_guarantee = []  # whether the relative residual was above the one that guarantees the velocity error
    for n in range(1, 60):
        solver = library.open(library.problem(problem), library.options("pgs"))
        verdict = solver.run(n, 0.0).verdict
        solver = library.open(library.problem(problem), library.options("pgs"))
        asked = solver.run(n, 1e-6, verdict.velocity)  # exactly the error after n sweeps
        assert asked.outcome == 1 and asked.verdict.velocity <= verdict.velocity
        exceeds_guarantee.append(verdict.relative > verdict.velocity / reference)
    assert any(exceeds_guarantee), (
        "every answer meets the guaranteeing tolerance, so the velocity error decided nothing"
    )
