"""Jacobi: its formula, the damping that makes it safe, and what it does without."""

import numpy as np
import pytest
from hypothesis import given
from random_problems import random_lcp, seeds, sweeps

import lavender as lv
from lavender_ext.sweep import serial


@pytest.mark.parametrize("k", [2, 3, 5])
def test_coincident_contacts_defeat_undamped_jacobi(k):
    """k contacts at one place: A is all ones. Unprojected factor k - 1; projected from 0, period 2."""
    a, b = np.ones((k, k)), np.ones(k)
    free = lv.Problem.linear(a, b)
    size = [abs(lv.solve(free, "jacobi", omega=1.0, tol=0.0, max_iter=n).slack[0]) for n in (3, 4)]
    assert size[1] / size[0] == pytest.approx(k - 1.0)
    lcp = lv.Problem.lcp(a, b)
    for n in range(4):
        np.testing.assert_array_equal(sweeps(lcp, "jacobi", n, omega=1.0), np.full(k, float(n % 2)))
    assert lv.solve(lcp, "jacobi", omega=1.0, tol=1e-6).status is lv.Status.STALLED
    assert lv.solve(lcp, "jacobi", tol=1e-9).success


@given(seed=seeds)
def test_safe_damping_is_below_the_limit_of_convergence(seed):
    # omega < 2 / L, L the largest eigenvalue of D^-1 A, for symmetric positive semidefinite A.
    problem = random_lcp(seed, m=12)
    scaled = problem.dense() / np.sqrt(np.outer(problem.d, problem.d))
    assert 0.0 < serial.damping(problem.csr_data) * np.linalg.eigvalsh(scaled).max() < 2.0


@given(seed=seeds)
def test_the_damping_is_the_same_in_every_unit(seed):
    problem, rng = random_lcp(seed, m=12), np.random.default_rng(seed)
    size = 2.0 ** rng.integers(-8, 9, 12)  # each row in a unit of its own; rounds by the square roots alone
    other = lv.Problem.lcp(size[:, None] * problem.dense() * size, size * problem.b)
    assert serial.damping(other.csr_data) == pytest.approx(serial.damping(problem.csr_data), rel=1e-12)
