"""ADMM: mass ratios, redundancy, friction and every kind of factorisation."""

import numpy as np
import pytest
import scipy.sparse as sp
from random_problems import random_contact_problem, random_lcp, side_by_side

import lavender as lv
from lavender.base.deadline import Deadline
from lavender.solvers import admm


@pytest.mark.parametrize("law", ["linear", "lcp", "coulomb", "cone"])
def test_admm_with_every_factorisation_gives_the_same_impulse(law):
    base = random_contact_problem(
        51, friction="cone" if law == "cone" else "coulomb", contacts=14, bodies=4
    )
    cones = base.cones
    if law == "linear":
        cones = lv.Cones.free(base.m)
    elif law == "lcp":
        cones = lv.Cones.bounded(
            np.where(np.isfinite(cones.lower), cones.lower, -1.0), np.full(base.m, np.inf)
        )
    a = base.dense() + 0.3 * np.eye(base.m)
    problem = lv.Problem(base.b, cones, a, friction=base.friction)
    assert problem.law == law
    dense = lv.solve(problem, "admm", tol=1e-10, max_iter=20_000)
    assert dense.solver.form == "Cholesky"
    results = [dense]
    slightly = a + 1e-13 * np.abs(a).max() * np.triu(np.ones_like(a), 1)
    lu = lv.solve(
        lv.Problem(base.b, cones, slightly, friction=base.friction),
        "admm",
        tol=1e-10,
        max_iter=20_000,
    )
    assert lu.solver.form == "LU"
    results.append(lu)
    # Eight of them side by side make a matrix of few entries.
    eight = lv.solve(side_by_side([problem] * 8), "admm", tol=1e-10, max_iter=20_000)
    assert eight.solver.form == "Cholesky"
    for solution in results:
        assert solution.success
        # Eigenvalues of A from 0.3 to about 30.
        np.testing.assert_allclose(
            solution.impulse, dense.impulse, atol=1e-7 * np.abs(dense.impulse).max()
        )
    assert eight.success
    np.testing.assert_allclose(
        eight.impulse[: base.m], dense.impulse, atol=1e-7 * np.abs(dense.impulse).max()
    )


def test_factor_after_breakdown_of_panels_is_full_and_ends_at_the_deadline(clock):
    # A chain of whose diagonal rho = 0.1 leaves nothing: every pivot is a neighbour's.
    m = 60
    a = sp.diags_array(
        [np.full(m, -0.1), np.ones(m - 1), np.full(m - 1, -0.999)], offsets=[0, 1, -1]
    )
    problem = lv.Problem(np.linspace(0.5, 1.5, m), lv.Cones.free(m), sp.csr_array(a))
    prepared = lv.prepare(problem, "admm")
    state = prepared.state
    prepared.solver.set_deadline(state, Deadline(1.0))
    assert state.full
    r = np.linspace(-1.0, 1.0, m)
    x = state.factor[0].solve(r)
    np.testing.assert_allclose(state.matrix @ x + state.splitting.rho * x, r, atol=1e-12)
    clock.now = 2.0
    late = prepared.solver.prepare(problem)
    prepared.solver.set_deadline(late, Deadline(1.0, 0.5))
    assert late.factor is None


def test_admm_without_memory_equals_plain_admm_by_hand():
    """Five iterations against the formulas in NumPy with a dense inverse."""
    problem = random_lcp(4, m=7)
    root = np.sqrt(problem.d)
    b_ = problem.dense() / root[:, None] / root
    c = problem.b / root
    low, high = problem.cones.lower * root, problem.cones.upper * root
    rho = 0.1
    inverse = np.linalg.inv(b_ + rho * np.eye(7))
    start = problem.start()
    u = root * start + (c - b_ @ (root * start)) / rho
    for n in range(1, 6):
        z = np.clip(u, low, high)
        y = rho * (u - z)
        x = inverse @ (c + rho * z - y)
        got = lv.solve(problem, "admm", memory=0, tol=0.0, max_iter=n)
        np.testing.assert_allclose(
            got.impulse, z / root, rtol=1e-10, atol=1e-12
        )  # the inverse loses some digits
        u = u + 1.6 * (x - z)


@pytest.mark.parametrize("slide", [0.6, 6.0])
def test_admm_residual_that_rises_first_is_not_divergence(slide):
    """A contact that hardly presses, and slides: residuals are large beside that of doing nothing."""
    problem = lv.Problem.contact(np.diag([2.4, 4.4, 0.9]), [3.7e-7, 0.2 * slide, -slide], [1.0])
    solution = lv.solve(problem, "admm", tol=1e-8)
    assert solution.success and solution.iterations > 8


def test_admm_conjugate_gradients_give_the_answer_of_a_factor(monkeypatch):
    """A pile that sticks has one solution of its velocities, which both forms of the linear solve must reach."""
    problem = lv.suite.case("granularF(n=5)").problem
    factored = lv.solve(problem, "admm", tol=1e-10)
    monkeypatch.setattr(admm, "MAX_FACTOR_WORK_PER_ENTRY", 0.0)
    iterated = lv.solve(problem, "admm", tol=1e-10)
    assert factored.success
    assert iterated.success
    assert factored.work["factorisations"] >= 1
    assert "inner" not in factored.work
    assert iterated.work["factorisations"] == 0
    # Each solve takes at least one iteration; piles take 4 to 10.
    assert 1 <= iterated.work["inner"] / iterated.work["solves"] <= 10
    assert iterated.iterations <= 1.5 * factored.iterations
    velocity = [problem.velocity(s.impulse) for s in (factored, iterated)]
    # The residual 1e-10 of a velocity of order 0.2 m/s, times the condition of A, of about 1e3.
    np.testing.assert_allclose(*velocity, atol=1e-7)


def test_admm_large_pile_with_a_costly_factor_is_solved_without_one():
    """14,046 rows: a factor takes 5e8 multiply-adds, 3,400 for each entry of K; some contacts slip."""
    found = lv.solve(lv.suite.case("granularF(n=10)").problem, "admm", tol=1e-6, max_iter=400)
    assert found.success
    assert found.work["factorisations"] == 0


def test_admm_warm_start_with_slip_is_not_lost():
    """Close to a solution with slip, the shift is on from the start: the convex iteration would move away."""
    problem = lv.suite.case("pyramidF(k=10)").problem
    start = lv.solve(problem, "newton", tol=1e-9).impulse * (1.0 + 1e-6)
    cold, warm = (lv.solve(problem, "admm", impulse=x, tol=1e-8) for x in (None, start))
    assert cold.success
    assert warm.success
    assert 2 * warm.iterations < cold.iterations
