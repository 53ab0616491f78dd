"""Answers of backends by this package against the KKT conditions and against the backend called alone."""

import numpy as np
import pytest
from backend_truth import MAX_RATIO, TOL, call_alone, call_here, draw_lcp, draw_program
from calls import BACKENDS, installed
from random_problems import spd

import lavender as lv
from lavender.programs.forms import build_form, choose_program_form, get_program


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("draw", [draw_program, draw_lcp])
def test_backend_answer_is_at_most_ten_times_worse_than_the_backend_alone(name, draw):
    for seed in range(8):
        program = draw(seed)
        is_lcp = draw is draw_lcp
        try:
            here, solution = call_here(program, name, is_lcp)
        except lv.CapabilityError:
            continue
        assert here <= max(MAX_RATIO * call_alone(program, name), TOL), f"{seed}: {solution}"
        assert not (solution.is_contradicted and here <= TOL), f"{seed}: {solution}"


@pytest.mark.parametrize("name", installed("osqp", "proxqp"))
@pytest.mark.parametrize("kind", ["lcp", "program"])
def test_backend_started_near_its_answer_needs_at_most_half_of_the_iterations(name, kind):
    program = draw_lcp(0) if kind == "lcp" else draw_program(0)
    problem = (
        lv.Problem.lcp(program["P"], -program["q"])
        if kind == "lcp"
        else lv.Problem.from_qp(**program)
    )
    start = lv.solve(problem, "clarabel", tol=1e-9).impulse * (1.0 + 1e-12)
    cold = lv.solve(problem, name)
    warm = lv.solve(problem, name, impulse=start)
    assert warm.success and warm.work.get("iterations", 0) <= cold.work["iterations"] / 2


@pytest.mark.parametrize("cost", [1e-10, 1.0, 1e10])
@pytest.mark.parametrize("size", [1e-8, 1.0, 1e6])
def test_scaled_program_has_numbers_near_one_and_powers_of_two_as_scales(cost, size):
    program = {k: np.array(v) for k, v in draw_program(4).items()}
    program["P"], program["q"] = cost * program["P"], cost * size * program["q"]
    for name in ("b", "h", "lb", "ub"):
        if name in program:
            program[name] = size * program[name]
    convex = get_program(lv.Problem.from_qp(**program).qp)
    scaled = convex.scaled
    for scale in convex.scales:
        assert (np.frexp(scale)[0] == 0.5).all()
    assert 0.25 <= max(np.abs(scaled.P[2]).max(), np.abs(scaled.q).max()) <= 4.0
    assert 0.25 <= np.abs(scaled.J[2]).max() <= 4.0
    assert np.abs(scaled.t).max() <= 100.0  # drawn numbers differ by this factor


def test_backend_form_is_the_named_one_or_that_of_the_problem():
    program = draw_program(0)
    definite = lv.Problem.from_qp(**program)
    singular = lv.Problem.from_qp(**draw_program(1))
    assert (
        choose_program_form(definite, "auto") == choose_program_form(singular, "auto") == "program"
    )
    for form in ("impulse", "velocity", "program"):
        solution = lv.solve(definite, "clarabel", form=form)
        assert solution.success and solution.solver.form == form
    for form in ("impulse", "velocity"):
        with pytest.raises(lv.CapabilityError, match="P of this program is singular"):
            lv.solve(singular, "clarabel", form=form)
    with pytest.raises(lv.CapabilityError, match="needs a quadratic program"):
        lv.solve(lv.Problem.lcp(*spd(3)), "clarabel", form="program")
    jac = np.eye(2, 3)
    regular, repeated = (
        lv.Problem.from_jacobian(
            rows, np.eye(3), np.ones(3), cones=lv.Cones.bounded(np.zeros(len(rows)), np.inf)
        )
        for rows in (jac, np.vstack([jac, jac[:1]]))
    )
    assert choose_program_form(regular, "auto") == "impulse"
    assert choose_program_form(repeated, "auto") == "velocity"


@pytest.mark.parametrize("name", installed("osqp", "daqp", "clarabel", "highs"))
def test_solve_qp_of_an_ill_conditioned_program_is_solved_by_named_backends(name):
    program = draw_program(
        47
    )  # P has rank 17 of 18, and rounding makes it definite with a condition of 1e13
    assert not lv.Problem.from_qp(**program).has_singular_program
    here, solution = call_here(program, name, False)
    assert here <= TOL and solution.success


def test_backend_form_has_a_p_that_is_symmetric_in_every_bit():
    problem = lv.Problem.lcp(*spd(9, seed=1))
    for program in (
        build_form(problem, "impulse").program,
        get_program(lv.Problem.from_qp(**draw_program(6)).qp),
    ):
        P = program.scaled.get_hessian(True)
        assert (P == P.T).all()


@pytest.mark.skipif("highs" not in BACKENDS, reason="highspy is not installed")
def test_highs_does_not_round_small_numbers_to_zero():
    for b in ([1.0, 5e-5], [1.0, 1e-8]):
        assert lv.solve(lv.Problem.linear(np.eye(2), b), "highs", tol=1e-9).success
        assert lv.solve(lv.Problem.lcp(np.eye(2), b), "highs", tol=1e-9).success
