"""Drawn problems are legal, the same bits every time, solvable, and cover what their page says they draw."""

import numpy as np
import pytest

import lavender as lv
from lavender import suite
from lavender.suite.wild import FORMS, LAWS, MASSES, STRUCTURES

SEEDS = range(400)


@pytest.fixture(scope="module")
def cases():
    return [suite.wild(seed=seed, rows=300) for seed in SEEDS]


def test_a_seed_gives_the_same_bits(cases):
    for seed in (0, 7, 31):
        again = suite.case(cases[seed].name)
        assert again.problem == cases[seed].problem
        assert again.problem.b.tobytes() == cases[seed].problem.b.tobytes()
    assert cases[0].problem != cases[1].problem


@pytest.mark.parametrize("words", [tuple(STRUCTURES), MASSES, LAWS, FORMS])
def test_everything_that_is_named_is_drawn(cases, words):
    reasons = [f" {case.reason.replace(',', ' ').replace(':', ' ')} " for case in cases]
    assert [word for word in words if not any(f" {word} " in reason for reason in reasons)] == []


def test_sizes_spread_over_decades(cases):
    m = np.array([case.problem.m for case in cases])
    assert m.min() < 20
    assert 150 < m.max() < 1200  # the number of rows that is asked for is met within a factor of 4
    assert {case.problem.law for case in cases} == {"linear", "lcp", "coulomb", "cone"}


@pytest.mark.parametrize("seed", range(0, 400, 20))
def test_a_drawn_problem_can_be_solved(cases, seed):
    problem = cases[seed].problem
    solution = lv.solve(problem, "auto", tol=1e-6, time_limit=20.0)
    # What rounding alone costs bounds what can be asked for at mass ratios of 1e8.
    assert solution.residual.relative <= max(1e-6, 2.0 * solution.residual.floor)


def test_rows_of_matrix_forms_are_those_of_the_rows_form():
    dense = [c for c in (suite.wild(seed=s, rows=60) for s in range(60)) if "given as dense" in c.reason]
    assert dense
    for case in dense:
        a = case.problem.dense()
        # A = J M^-1 J^T is formed symmetric up to rounding.
        np.testing.assert_allclose(a, a.T, rtol=0.0, atol=1e-12 * np.abs(a).max())
