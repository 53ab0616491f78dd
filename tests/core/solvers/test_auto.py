"""auto: what it chooses, that it says so, islands, certificates, and that it gets there."""

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from random_problems import (
    FORMS,
    as_matrix,
    random_contact_problem,
    random_lcp,
    seeds,
)

import lavender as lv
from lavender.judge import residuals
from lavender.solvers.islands import islands, restrict, rows_of
from lavender.solvers.solve_log import SolveLog


@pytest.mark.parametrize("form", FORMS)
@given(seed=seeds)
@settings(max_examples=25)
def test_islands_are_those_of_the_matrix_and_each_can_stand_alone(form, seed):
    rolls = bool(seed % 2)
    problem = FORMS[form](
        random_contact_problem(seed, spin=not rolls, rolling=rolls, bodies=9, joints=2, contacts=6)
    )
    count, label = islands(problem)
    # Blocks that share a body may still not touch in A, where rows happen to be orthogonal; not at random.
    count_of_matrix, label_of_matrix = islands(as_matrix(problem))
    assert count == count_of_matrix
    assert np.array_equal(label, label_of_matrix)
    assert np.array_equal(np.unique(label), np.arange(count))
    a, lam = problem.dense(), np.random.default_rng(seed).normal(size=problem.m)
    for i in range(count):
        blocks = np.flatnonzero(label == i)
        rows = rows_of(problem, blocks)
        part = restrict(problem, blocks, rows)
        assert part.operator == problem.operator
        # Sums over one body in another order: a few roundings.
        np.testing.assert_allclose(part.dense(), a[np.ix_(rows, rows)], rtol=0, atol=1e-13 * np.abs(a).max())
        np.testing.assert_array_equal(part.b, problem.b[rows])
        alone, whole = lv.residual(part, lam[rows]).error, lv.residual(problem, lam).error[rows]
        np.testing.assert_allclose(alone, whole, rtol=0, atol=1e-9 * np.abs(whole).max())
        others = np.setdiff1d(np.arange(problem.m), rows)
        assert not a[np.ix_(rows, others)].any()


def twice_touching(n):
    """n masses in a line, each in contact with the next at two points: A is singular, of half bandwidth 3."""
    jac = sp.lil_array((2 * n, n))
    for i in range(2 * n):
        jac[i, i // 2] = 1.0
        if i >= 2:
            jac[i, i // 2 - 1] = -1.0
    return lv.Problem.lcp((jac @ jac.T).tocsr(), np.repeat(np.random.default_rng(0).uniform(0.5, 2.0, n), 2))


def test_a_singular_band_is_shifted_once_where_it_stands():
    """Every contact given twice, which sweeps hardly notice: what `direct` does with one shift, once."""
    problem = twice_touching(60)
    solution = lv.solve(problem, tol=1e-6)
    assert solution.success
    assert solution.message.startswith("direct")
    assert solution.message.count("direct") == 1
    assert solution.work["shifts"] == 1
    assert solution.work == lv.solve(problem, "direct", tol=1e-6).work


@pytest.mark.parametrize("problem", [random_lcp(1), random_contact_problem(2)], ids=["lcp", "bodies"])
def test_a_start_at_its_floor_is_told_as_one(problem):
    # The precision is the floor's, and there was no limit.
    start = lv.solve(problem, tol=1e-30)
    again = lv.solve(problem, tol=1e-30, impulse=start.impulse)
    assert (again.status, again.iterations) == (lv.Status.FLOOR, 0)
    assert "at its floor" in again.message and "time" not in again.message


def test_a_start_that_solves_a_as_it_was_formed_is_judged_by_the_problem():
    # Masses over 15 decades: forming A of J and M rounds more than the tolerance, which lies between both residuals.
    rng = np.random.default_rng(40)
    jac, q = rng.normal(size=(30, 90)), np.linalg.qr(rng.normal(size=(90, 90)))[0]
    mass = (q * 10.0 ** -rng.uniform(0, 15, 90)) @ q.T
    problem = lv.Problem.from_jacobian(
        jac, 0.5 * (mass + mass.T) + 1e-15 * np.eye(90), rng.normal(size=90), cones=lv.Cones.free(30)
    )
    formed = lv.Problem(problem.b, problem.cones, problem.delassus())
    start = lv.solve(formed, "direct", tol=1e-14).impulse
    exact, rounded = lv.residual(problem, start).relative, lv.residual(formed, start).relative
    assert rounded < exact
    log = SolveLog(problem, (exact * rounded) ** 0.5, 100, by=formed.metric)
    assert log.offer(start) == log.best == exact


@pytest.mark.parametrize("solver", ["auto", "pgs"])
def test_the_result_is_not_judged_twice(solver, monkeypatch):
    problem = lv.Problem.contact(4.0 * np.eye(90) + 0.01, np.linspace(-1.0, 1.0, 90), np.full(30, 0.5))
    found = []
    judged = residuals.judged
    monkeypatch.setattr("lavender.judge.residuals.judged", lambda *given: found.append(1) or judged(*given))
    assert lv.solve(problem, solver, max_iter=150, time_limit=10.0).success
    assert not found  # what the solver had judged last is what it hands over
