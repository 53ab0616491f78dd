"""`velocity_tol`: a velocity error in m/s in place of a relative residual, for every call that solves."""

import numpy as np
import pytest
from random_problems import dragged

import lavender as lv


def contact_problem(seed):
    return dragged(seed, 4)


def problems(n=6):
    return [contact_problem(seed) for seed in range(n)]


SOLVERS = ("auto", "newton", "pgs", "anderson", "admm", "block_gauss_seidel")


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("velocity_tol", [1e-3, 1e-6])
def test_every_row_is_within_the_velocity_error(solver, velocity_tol):
    for problem in problems():
        solution = lv.solve(problem, solver, velocity_tol=velocity_tol)
        worst = np.abs(lv.residual(problem, solution.impulse).velocity)
        assert solution.success == (worst <= velocity_tol)
        assert solution.velocity_tol == velocity_tol
        if solution.status is lv.Status.CONVERGED:
            assert worst <= velocity_tol
        assert solution.success, (solver, solution.status, worst)


def test_a_looser_error_takes_no_more_sweeps():
    problem = contact_problem(1)
    sweeps = [lv.solve(problem, "pgs", velocity_tol=v).iterations for v in (1e-2, 1e-4, 1e-6)]
    assert sweeps == sorted(sweeps)


def test_units_do_not_change_the_meaning():
    # The same scene with all masses times 1,000 and all speeds times 10 meets ten times the velocity error alike.
    A, b = np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([1.0, 0.5])
    own = lv.solve(lv.Problem.lcp(A, b), "pgs", velocity_tol=1e-4)
    scaled = lv.solve(lv.Problem.lcp(A / 1000.0, 10.0 * b), "pgs", velocity_tol=1e-3)
    assert own.iterations == scaled.iterations


def test_an_answer_that_meets_it_with_a_larger_residual_is_converged():
    problem = contact_problem(2)
    reference = lv.residual(problem, problem.start()).velocity
    exact = lv.solve(problem, tol=1e-10)
    one = lv.solve(problem, "pgs", impulse=exact.impulse, velocity_tol=1e-3 * reference, max_iter=1)
    assert one.success and one.status is lv.Status.CONVERGED


def test_zero_impulses_are_accepted_if_their_error_is_small_enough():
    problem = contact_problem(3)
    reference = lv.residual(problem, problem.start()).velocity
    solution = lv.solve(problem, "pgs", velocity_tol=2.0 * reference)
    assert solution.success and solution.iterations <= 1


def test_prepared_and_many_take_it():
    prepared = lv.prepare(contact_problem(0), "pgs")
    assert prepared.solve(velocity_tol=1e-5).success
    assert prepared.solve(contact_problem(1), velocity_tol=1e-5).success
    many = lv.solve_many(problems(), velocity_tol=1e-5)
    assert many.success.all() and many[2].velocity_tol == 1e-5 and many[2].success
    jac = np.broadcast_to(np.eye(2)[::-1], (4, 2, 2)).copy()
    v_free = np.array([[0.5, -1.0], [0.0, -9.0], [1.0, 1.0], [2.0, -0.1]])
    batch = lv.Batch(jac, np.eye(2), v_free, cones=lv.Cones.contacts(0.5, tangents=1))
    many = lv.solve_many(batch, velocity_tol=1e-6)
    assert many.success.all() and (lv.residual_many(batch, many.impulse).velocity_error <= 1e-6).all()


def test_a_tolerance_and_a_velocity_error_together_raise_an_error_that_names_both():
    problem = contact_problem(0)
    calls = (
        lambda **more: lv.solve(problem, **more),
        lambda **more: lv.prepare(problem, "pgs").solve(**more),
        lambda **more: lv.solve_many([problem], **more),
    )
    for call in calls:
        for tol in (0.0, 1e-9):
            with pytest.raises(lv.InputError, match=f"tol is {tol:g} and velocity_tol is 0.001; .*leave one"):
                call(tol=tol, velocity_tol=1e-3)
        call(velocity_tol=1e-3)
