"""Anderson mixing against its formula; what it shares with nncg is tested in test_nncg.py."""

import numpy as np
import pytest
from random_problems import random_lcp

import lavender as lv


def test_anderson_is_exact_after_as_many_sweeps_as_unknowns():
    # On a linear problem the mixed iterate is that of GMRES: with memory >= m - 1 it ends.
    rng = np.random.default_rng(3)
    a = rng.standard_normal((5, 7))
    problem = lv.Problem.linear(a @ a.T, rng.standard_normal(5))
    mixed = lv.solve(problem, "anderson", memory=8, tol=1e-9, max_iter=40)
    assert mixed.success
    assert mixed.iterations <= 16  # 6 in exact arithmetic; normal equations lose half the digits
    assert lv.solve(problem, "gauss_seidel", tol=1e-9, max_iter=10_000).iterations > 3 * mixed.iterations


@pytest.mark.parametrize("memory", [1, 5, 16])
def test_every_memory_finds_the_same_answer(memory):
    problem = random_lcp(0, m=10)
    solution = lv.solve(problem, "anderson", memory=memory, tol=1e-10, max_iter=100_000)
    assert solution.success
    # Slack is unique for positive semidefinite A; its error is about cond(A) <= 1e3 times tol.
    exact = lv.solve(problem, "direct")
    np.testing.assert_allclose(solution.slack, exact.slack, atol=1e-6 * np.abs(problem.b).max())


def sweep(problem, x):
    return np.array(lv.solve(problem, "pgs", impulse=x, tol=0.0, max_iter=1).impulse)


@pytest.mark.parametrize("memory", [1, 2, 5])
def test_first_iterations_are_least_squares_over_the_last_sweeps(memory):
    # x <- y - sum gamma_i (y_{i+1} - y_i), gamma from least squares of f = D^1/2 (y - x), written with lstsq.
    rng = np.random.default_rng(3)
    a = rng.standard_normal((8, 12))
    problem = lv.Problem.linear(a @ a.T + np.eye(8), rng.standard_normal(8))
    root = np.sqrt(problem.d)
    x, ys, fs = problem.start(), [], []
    for k in range(5):
        y = sweep(problem, x)
        got = lv.solve(problem, "anderson", memory=memory, tol=0.0, max_iter=k + 1).impulse
        # Normal equations lose half the digits.
        np.testing.assert_allclose(got, y, rtol=1e-6, atol=1e-8 * np.abs(y).max())
        ys.append(y)
        fs.append(root * (y - x))
        ys, fs = ys[-memory - 1 :], fs[-memory - 1 :]
        dy, df = (np.diff(v, axis=0).T for v in (ys, fs))
        gamma = np.linalg.lstsq(df, fs[-1], rcond=None)[0] if df.size else np.zeros(0)
        x = y - dy @ gamma if gamma.size else y
