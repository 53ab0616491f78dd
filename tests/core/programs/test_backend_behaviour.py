"""Adapters of backends do what the table of `lavender/programs/backends.py` promises."""

from dataclasses import replace

import numpy as np
import pytest
from backend_truth import TOL, call_here, draw_kind
from calls import BACKENDS

import lavender as lv
from lavender.programs import backends
from lavender.report.check import compare_with_reference
from lavender.report.timing import make_row
from lavender.solvers import registry

OBSERVED = {b.name: b for b in backends.BACKENDS if b.behaviour is not None}
N_DRAWS = 12  # Three programs of each kind.


def mark_slow(names):
    """Mark backends in JAX, which compiles each of 40 programs for 1 s or more, as tests of the night."""
    is_jax = {b.name: b.jax for b in backends.BACKENDS}
    return [pytest.param(name, marks=[pytest.mark.nightly] * is_jax[name]) for name in names]


@pytest.mark.parametrize("name", mark_slow(BACKENDS))
def test_backend_multipliers_of_active_bounds_are_not_zero(name):
    """pyqpmad returns zeros for multipliers of bounds."""
    problem = lv.Problem.from_qp(
        [[2.0, 0.5], [0.5, 1.0]], [0.0, 1.0], lb=[1.0, -2.0], ub=[1.0, 2.0]
    )
    if registry.get(name).refuses(problem) is not None:
        pytest.skip(f"{name} does not accept programs")
    answer = lv.solve_qp(problem, name, tol=1e-6)
    if "license" in answer.solution.message:
        pytest.skip(f"{name} has no licence")
    assert answer.found
    np.testing.assert_allclose(
        answer.z_box, [-1.25, 0.0], atol=1e-5
    )  # of a relative residual of 1e-6


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


def test_explanation_of_a_contradicted_claim_quotes_the_entry_that_fits():
    singular = lv.Problem.from_qp(np.diag([1.0, 0.0]), [0.0, -1.0], lb=[0.0, 0.0], ub=[1.0, 1.0])
    explain = backends.explain_contradicted_claim
    assert "gives x2 = 0.03; 1 is right" in explain("daqp", singular, lv.Status.CONVERGED)
    assert "primal infeasible" in explain("proxqp", singular, lv.Status.INFEASIBLE)
    far = lv.Problem.from_qp(np.eye(2), [-1.0, -1.0], lb=[-1e12, -1e12], ub=[1e12, 1e12])
    assert "Inactive bounds of 1e+09" in explain("piqp", far, lv.Status.CONVERGED)
    assert explain("newton", singular, lv.Status.CONVERGED) == ""


def test_description_of_a_backend_has_its_observations_and_what_its_adapter_does():
    observations, measures = backends.describe_backend("highs")
    assert any("1e+15" in sentence for sentence in observations)
    assert any("Far bounds are left out" in sentence for sentence in measures)
    assert not {*observations} & {*measures}
    assert backends.describe_backend("clarabel_cone") == backends.describe_backend("clarabel")
    assert backends.describe_backend("mosek") == ([], [])


def test_note_of_a_contradicted_row_of_the_check_quotes_the_table():
    problem = lv.Problem.from_qp(np.diag([1.0, 0.0]), [0.0, -1e-7], lb=[0.0, 0.0], ub=[1.0, 1.0])
    solution = lv.solve(problem, "auto", max_iter=0)
    contradicted = replace(
        solution, status=lv.Status.CONVERGED, claim_check="contradicted", status_conflict="x"
    )
    row = compare_with_reference(problem, "daqp", contradicted, None)
    assert "observed with daqp" in row.note and "x2 = 0.03" in row.note
    task = {"solver": "daqp", "mode": "tol"}
    for judged, is_quoted in ((contradicted, True), (solution, False)):
        conflict = make_row(problem, task, judged)["status_conflict"]
        assert ("observed with daqp" in conflict and "x2 = 0.03" in conflict) == is_quoted
