"""Backends of other packages on built-in problems: redundant, large, slow."""

import numpy as np
import pytest
from calls import BACKENDS, DEFINITE, installed

import lavender as lv
from lavender import suite
from lavender.programs import qp_solver


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("mass_ratio", [1.0, 1e4])
def test_redundant_contacts_in_the_form_that_suits_them(name, mass_ratio):
    # Singular A, and at 1e4 ill-conditioned: the velocity form is definite, so quadprog takes it too.
    problem = suite.box_stack(10, mass_ratio).problem
    solution = lv.solve(problem, name)
    assert solution.solver.form == (
        "velocity" if mass_ratio > 1.0 or name in DEFINITE else "impulse"
    )
    assert solution.success, str(solution)
    # The boxes come to rest: A is singular, so the velocities are what is unique.
    speed = np.abs(problem.velocity(solution.impulse)).max()
    assert speed <= 1e-5 * 9.81 / 60.0


@pytest.mark.parametrize("name", installed("quadprog", "ecos"))
def test_impulse_form_with_singular_a_is_solved_with_a_shift_that_the_message_names(name):
    problem = suite.box_stack(3).problem
    solution = lv.solve(problem, name, form="impulse", impulse=np.full(problem.m, 0.01))
    assert solution.success, str(solution)
    assert "1e-07 was added to the diagonal of the singular P" in solution.message


def refuse_call(*_):
    pytest.fail("the backend is set up after the deadline")


@pytest.mark.parametrize("name", BACKENDS)
def test_backend_under_a_limit_below_its_set_up_is_not_called(name, monkeypatch):
    """The deadline has passed before the set-up, and the start is judged."""
    problem = suite.case("granular(n=6)").problem
    lv.residual(problem, problem.start())
    with monkeypatch.context() as patch:
        patch.setattr(qp_solver.QPSolver, "prepare", refuse_call)
        late = lv.solve(problem, name, time_limit=1e-9)
    assert late.status is lv.Status.TIME_LIMIT and "time limit" in late.message
    assert not late.work
    assert late.impulse.tobytes() == problem.start().tobytes()


def test_backend_that_exceeds_its_limit_is_ended(clock):
    """DAQP looks at it rarely: on these rows it takes seconds. All else is outside the clock, which stands still."""
    if "daqp" not in BACKENDS:
        pytest.skip("daqp is not installed")
    problem = suite.case("granular(n=7)").problem
    late = lv.solve(problem, "daqp", form="impulse", time_limit=0.02)
    assert late.status is lv.Status.TIME_LIMIT and "ended at the time limit" in late.message


@pytest.mark.parametrize(
    "name", installed("osqp", "clarabel", "piqp", "qpalm", "scs", "proxqp", "clarabel_cone")
)
def test_backend_receives_the_iteration_budget(name):
    problem = suite.box_stack(10, 1e4).problem
    solution = lv.solve(problem, name, max_iter=2, form="impulse")
    assert solution.work["iterations"] <= 3  # qpalm counts the step it stops in
    assert solution.status is not lv.Status.CONVERGED or solution.success
    none = lv.solve(problem, name, max_iter=0)
    assert none.status is lv.Status.MAX_ITERATIONS
    assert none.work == {"backend_calls": 0}
