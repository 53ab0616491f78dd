"""Adapters of backends do what the table of `lavender/external/backends.py` promises."""

import numpy as np
import pytest
from backend_truth import TOL, call_here, draw_kind
from calls import BACKENDS

import lavender as lv
from lavender.external import backends
from lavender.solvers import registry

OBSERVED = {b.name: b for b in backends.BACKENDS if b.behaviour is not None}
N_DRAWS = 12  # Three programs of each kind; `python tests/backend_truth.py --kinds 200` draws more.


def mark_slow(names):
    """Mark backends in JAX, which compiles each of 40 programs for 1 s or more, as tests of the night."""
    is_jax = {b.name: b.jax for b in backends.BACKENDS}
    return [pytest.param(name, marks=[pytest.mark.nightly] * is_jax[name]) for name in names]


@pytest.mark.parametrize("name", mark_slow(BACKENDS))
def test_program_without_a_solution_is_no_success(name):
    P, rows = np.diag([1.0, 0.0]), np.ones((2, 2))
    programs = (
        lv.Problem.from_qp(np.eye(2), np.zeros(2), A=rows, b=[1.0, 2.0]),
        lv.Problem.from_qp(P, [0.0, -1.0], lb=[0.0, 0.0], ub=[np.inf, np.inf]),
    )
    for problem in programs:
        if registry.get(name).refuses(problem) is None:
            assert not lv.solve(problem, name).success


@pytest.mark.parametrize("name", mark_slow(BACKENDS))
def test_active_bounds_of_a_program_have_multipliers(name):
    """pyqpmad returns zeros for multipliers of bounds."""
    problem = lv.Problem.from_qp([[2.0, 0.5], [0.5, 1.0]], [0.0, 1.0], lb=[1.0, -2.0], ub=[1.0, 2.0])
    if registry.get(name).refuses(problem) is not None:
        pytest.skip(f"{name} does not accept programs")
    answer = lv.solve_qp(problem, name, tol=1e-6)
    if "license" in answer.solution.message:
        pytest.skip(f"{name} has no licence")
    assert answer.found
    np.testing.assert_allclose(answer.z_box, [-1.25, 0.0], atol=1e-5)  # of a relative residual of 1e-6


@pytest.mark.parametrize("name", mark_slow(BACKENDS))
def test_contradicted_claim_is_wrong_by_the_kkt_conditions_and_quotes_the_table(name):
    for seed in range(N_DRAWS):
        kind, program = draw_kind(seed)
        try:
            error, solution = call_here(program, name, False)
        except lv.CapabilityError:
            continue
        if solution.is_contradicted:
            quoted = backends.explain_contradicted_claim(name, solution.problem, solution.status)
            assert error > TOL, f"{seed}, {kind}: {solution}"
            assert OBSERVED[name].behaviour.version in quoted
