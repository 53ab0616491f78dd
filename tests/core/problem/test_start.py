"""`impulse=` of every function: an array, a Solution, or a pair of a problem and its impulse."""

import numpy as np
import pandas as pd
import pytest
from random_problems import random_contact_problem

import lavender as lv


def make_steps():
    """Return two problems of one model, the blocks of the second in another order, and a solution of the first."""
    first = random_contact_problem(3)
    first = lv.Problem(first.b, first.cones, first.csr, key=np.arange(first.n_blocks))
    joints, contacts = (np.flatnonzero(first.cones.is_contact == x) for x in (False, True))
    blocks = np.concatenate(
        [joints, contacts[::-1][1:]]
    )  # One contact has ended, the others are in another order.
    rows = np.concatenate([np.arange(*first.cones.ptr[i : i + 2]) for i in blocks])
    matrix = first.csr[rows][:, rows]
    second = lv.Problem(
        1.1 * first.b[rows], first.cones.select(blocks), matrix, key=first.key[blocks]
    )
    return first, second, lv.solve(first, "pgs", max_iter=30), rows


CALLS = {
    "solve": lambda problem, impulse: lv.solve(problem, "pgs", impulse=impulse, max_iter=3).impulse,
    "compiled call": lambda problem, impulse: lv.solve(problem, impulse=impulse).impulse,
    "prepare": lambda problem, impulse: (
        lv.prepare(problem, "pgs").solve(impulse=impulse, max_iter=3).impulse
    ),
    "list": lambda problem, impulse: lv.solve_many([problem], impulses=[impulse])[0].impulse,
    "residual": lambda problem, impulse: lv.residual(problem, impulse).error,
    "residuals": lambda problem, impulse: lv.residual_many([problem], [impulse])[0].error,
    "slack": lambda problem, impulse: problem.slack(impulse),
    "motion error": lambda problem, impulse: np.array([lv.motion_error(problem, impulse).relative]),
}


@pytest.mark.parametrize("name", CALLS)
def test_solution_and_pair_as_impulse_are_carried_by_their_keys(name):
    first, second, solution, rows = make_steps()
    expected = CALLS[name](second, solution.impulse[rows])
    for given in (
        solution,
        (first, solution.impulse),
        second.carry(solution),
        solution.impulse[rows].tolist(),
    ):
        np.testing.assert_array_equal(CALLS[name](second, given), expected)
    assert not np.array_equal(CALLS[name](second, np.zeros(second.m)), expected)


def test_solution_without_keys_is_a_start_of_the_same_blocks():
    problem = random_contact_problem(3)
    solution = lv.solve(problem, tol=1e-9)
    again = lv.solve(problem, "pgs", impulse=solution, tol=1e-6)
    assert again.success and not again.iterations


def test_solve_qp_and_batches_start_from_a_result():
    P = np.diag([1.0, 2.0])
    q = np.array([-1.0, -2.0])
    G = np.array([[1.0, 1.0]])
    h = np.array([0.5])
    problem = lv.Problem.from_qp(P, q, G, h)
    solution = lv.solve(problem, tol=1e-9)
    np.testing.assert_array_equal(
        lv.solve(problem, "pgs", impulse=solution).impulse, solution.impulse
    )
    batch = lv.Batch(
        np.ones((2, 1, 1)),
        np.ones((2, 1, 1)),
        -np.ones((2, 1)),
        cones=lv.Cones.bounded([0.0], [9.0]),
    )
    result = lv.solve_many(batch, "pgs", tol=1e-9)
    again = lv.solve_many(batch, "pgs", tol=1e-6, impulse=result)
    assert not np.any(again.iterations)
    np.testing.assert_array_equal(again.impulse, result.impulse)


LABELLED = [
    lambda p, x: lv.residual(p, x).relative,
    lambda p, x: lv.solve(p, "pgs", impulse=x, max_iter=0, tol=0.0).residual.relative,
    lambda p, x: lv.prepare(p, "pgs").solve(impulse=x, max_iter=0, tol=0.0).residual.relative,
    lambda p, x: float(lv.residual_many([p], [x]).relative[0]),
    lambda p, x: lv.motion_error(p, x).relative,
    lambda p, x: p.energy_change(x),
]


@pytest.mark.parametrize("call", LABELLED)
def test_series_as_impulse_is_aligned_by_names_or_numbers_of_rows(call):
    problem = lv.suite.case("box_stack(n=4)").problem
    x = lv.solve(problem, tol=1e-10).impulse
    names = [problem.row_name(i) for i in range(problem.m)]
    shuffled = np.random.default_rng(0).permutation(problem.m)
    for index in (range(problem.m), names):
        series = pd.Series(x, index=list(index)).iloc[shuffled]
        assert call(problem, series) == call(problem, x)
    for index in (np.arange(problem.m) + 1, ["row"] * problem.m, [*names[1:], "another row"]):
        with pytest.raises(lv.InputError, match="index"):
            call(problem, pd.Series(x, index=index))


def test_array_with_an_index_that_would_be_ignored_is_refused():
    b = pd.Series([3.0, 1.0, 2.0])
    np.testing.assert_array_equal(lv.Problem.lcp(np.eye(3), b).b, b)
    A = pd.DataFrame(np.eye(3))
    np.testing.assert_array_equal(lv.Problem.lcp(A, b).dense(), np.eye(3))
    for make in (
        lambda: lv.Problem.lcp(np.eye(3), b.sort_values()),
        lambda: lv.Problem.lcp(A.loc[[2, 0, 1]], b),
        lambda: lv.solve_qp(np.eye(3), b.sort_values()),
        lambda: lv.Cones.contacts(b.sort_values()),
    ):
        with pytest.raises(lv.InputError, match="whose index would be ignored"):
            make()
