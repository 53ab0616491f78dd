"""`lemke`: its path, its pivots, rays, and what a budget or a clock cuts."""

import numpy as np
import pytest
import scipy.sparse as sp
from random_problems import good, random_lcp

import lavender as lv


def test_lemke_leaves_dependent_free_rows_at_zero():
    g = np.array([[1.0], [1.0], [2.0]])
    problem = lv.Problem.lcp(g @ g.T, [1.0, 1.0, 2.0], [-np.inf, -np.inf, 0.0])
    solution = lv.solve(problem, "lemke", tol=1e-9)
    assert good(solution), solution


def equality_program(seed):
    """A convex program of n >= 0 under equalities: the free multipliers have a zero block, and A is not symmetric."""
    rng = np.random.default_rng(seed)
    n, k = int(rng.integers(3, 12)), int(rng.integers(1, 3))
    g = rng.normal(size=(n, n // 2))
    e = rng.normal(size=(k, n))
    a = np.block([[g @ g.T, -e.T], [e, np.zeros((k, k))]])
    x = np.append(np.maximum(rng.normal(size=n), 0.0), rng.normal(size=k))
    w = np.append(np.where(x[:n] > 0.0, 0.0, rng.random(n)), np.zeros(k))
    return lv.Problem.lcp(a, a @ x - w, np.where(np.arange(n + k) < n, 0.0, -np.inf))


@pytest.mark.parametrize("seed", range(20))
def test_lemke_pivots_a_free_row_together_with_a_bounded_row(seed):
    """The path is then one of a monotone problem, which ends at a solution."""
    solution = lv.solve(equality_program(seed), "lemke", tol=1e-9)
    assert good(solution), solution
    assert solution.work["paths"] == 1


def test_lemke_with_another_covering_vector_avoids_the_first_ray():
    problem = lv.Problem.lcp([[1.0, 1.0], [1.0, -1.0]], [1.0, 1.0])
    solution = lv.solve(problem, "lemke", tol=1e-9)
    assert good(solution), solution
    assert solution.work["paths"] > 1


def test_lemke_exchanges_from_the_end_of_a_ray_reach_a_solution():
    m = [
        [0.0, 0.0, 10.0, 20.0],
        [0.0, 0.0, 30.0, 15.0],
        [10.0, 20.0, 0.0, 0.0],
        [30.0, 15.0, 0.0, 0.0],
    ]
    solution = lv.solve(lv.Problem.lcp(m, np.ones(4)), "lemke", tol=1e-9)
    assert good(solution), solution
    assert solution.work["paths"] == 1


def test_murtys_exponential_example_takes_all_its_pivots():
    """2^n of them: shows that Lemke's path was followed, and that long paths end."""
    n = 8
    a = np.triu(np.full((n, n), 2.0), 1) + np.eye(n)
    b = np.cumsum(2.0 ** np.arange(n)[::-1])[::-1]
    solution = lv.solve(lv.Problem.lcp(a, b), "lemke", tol=1e-9)
    assert solution.work["pivots"] == 2**n
    np.testing.assert_array_equal(solution.impulse, np.append(np.zeros(n - 1), b[-1]))


def test_lemke_stopped_by_its_budget_keeps_its_point():
    problem = random_lcp(3, m=60, rank=40)
    cut = [lv.solve(problem, "lemke", max_iter=n).residual.relative for n in range(1, 40, 2)]
    assert min(cut) < 0.5, "where the path stands, not the start"
    for cones, words in (
        (lv.Cones.contacts(0.0, 0, count=5001), "5001: use"),
        (
            lv.Cones.contacts(0.5, count=1667, shape="box"),
            r"5001, its friction as bounded rows \d+: use",
        ),
    ):
        with pytest.raises(lv.CapabilityError, match=words):
            lv.solve(lv.Problem(np.ones(5001), cones, sp.eye_array(5001, format="csr")), "lemke")


@pytest.mark.parametrize("n", [3, 5, 9])  # Even matrices have several solutions.
@pytest.mark.parametrize("transposed", [False, True])
def test_lemke_of_a_cyclic_matrix_whose_ratios_are_all_equal_ends_in_one_path(n, transposed):
    """Without a rule for equal ratios, bases of this matrix return (Kostreva 1979)."""
    a = np.eye(n) + 2.0 * np.roll(np.eye(n), 1, axis=0)
    solution = lv.solve(lv.Problem.lcp(a.T if transposed else a, np.ones(n)), "lemke")
    np.testing.assert_allclose(solution.impulse, 1.0 / 3.0)
    assert solution.work["paths"] == 1 and solution.work["pivots"] <= n * n


@pytest.mark.parametrize("seed", range(6))
def test_lemke_proves_that_free_and_bounded_rows_contradict_in_one_path(seed):
    """A y = 0 and b.y > 0, with y of both signs on the free rows."""
    rng = np.random.default_rng(seed)
    m = 8
    y = np.r_[rng.normal(size=3), rng.uniform(0.5, 1.0, 5)]
    half = rng.normal(size=(m, m - 1))
    b = rng.normal(size=m)
    half -= np.outer(y, y @ half) / (y @ y)
    b += y * (0.5 - b @ y) / (y @ y)
    solution = lv.solve(
        lv.Problem.lcp(half @ half.T, b, np.r_[np.full(3, -np.inf), np.zeros(5)], np.inf), "lemke"
    )
    assert solution.status is lv.Status.INFEASIBLE and solution.claim_check == "confirmed"
    assert solution.work["paths"] == 1
    direction = solution.certificate / np.abs(solution.certificate).max()
    np.testing.assert_allclose(direction, y / np.abs(y).max(), atol=1e-9)
