"""auto: what it chooses, that it says so, islands, certificates, and that it gets there."""

import numpy as np
import pytest
from hypothesis import given, settings
from random_problems import (
    FORMS,
    as_matrix,
    random_contact_problem,
    seeds,
)

import lavender as lv
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
