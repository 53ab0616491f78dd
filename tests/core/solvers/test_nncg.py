"""NNCG and Anderson mixing: the same answers as the sweeps they accelerate, by their formulas."""

import numpy as np
import pytest
from random_problems import random_contact_problem, random_lcp, sweeps

import lavender as lv


@pytest.mark.parametrize("name", ["nncg", "anderson"])
@pytest.mark.parametrize("sweep", ["pgs", "blocks"])
def test_nncg_on_a_stack_gives_its_closed_form(name, sweep):
    case = lv.suite.stack(n=20)
    solution = lv.solve(case.problem, name, sweep=sweep, tol=1e-10, max_iter=20_000)
    assert solution.success
    # cond(A) is near 650 for 20 bodies
    np.testing.assert_allclose(solution.impulse, case.reference.impulse, rtol=1e-7)


def sliding_pile():
    base = random_contact_problem(77, tangents=2, spin=False, contacts=20, bodies=8, joints=0)
    return lv.Problem(base.b, base.cones, rows=base.rows, compliance=base.compliance + 0.05)


@pytest.mark.parametrize(("restart", "kept"), [("growth", 0), ("against", 2)])
def test_nncg_first_iterations_equal_a_dense_twin(restart, kept):
    """Iterations of nncg against the formulas written in NumPy over single sweeps of pgs."""
    problem = random_lcp(5, m=9) if restart == "growth" else sliding_pile()
    d = problem.d
    count = 0

    x = problem.start()
    p = norm = None
    for k in range(4 if restart == "growth" else 40):
        y = sweeps(problem, "pgs", 1, impulse=x)
        g = x - y
        beta = 0.0 if p is None else g @ (d * g) / norm
        if beta > 1.0:
            keeps = restart == "against" and p @ (d * g) <= 0.0
            beta, count = (1.0, count + 1) if keeps else (0.0, count)
        norm = g @ (d * g)
        q = np.zeros_like(g) if p is None else beta * p
        p = q - g
        got = lv.solve(problem, "nncg", tol=0.0, max_iter=k + 1, restart=restart).impulse
        np.testing.assert_allclose(
            got, y, rtol=1e-9, atol=1e-12 * np.abs(y).max()
        )  # sums in another order
        x = y + q
    assert count >= kept


@pytest.mark.parametrize("name", ["nncg", "anderson"])
def test_nncg_starts_from_the_answer_of_the_cone_law(name):
    # b is that of impulses well inside their cones: nothing slides, and the cone law's answer is Coulomb's.
    rng = np.random.default_rng(3)
    base = random_contact_problem(78, tangents=2, spin=False, contacts=20, bodies=8, joints=0)
    compliance = base.compliance + 0.05
    inside = np.c_[np.ones(20), rng.uniform(-0.1, 0.1, (20, 2))].ravel()
    cones = lv.Cones.contacts(np.full(20, 0.8))
    b = lv.Problem(base.b, cones, rows=base.rows, compliance=compliance).slack(inside) + base.b
    problem = lv.Problem(b, cones, rows=base.rows, compliance=compliance)
    convex = lv.solve(problem, name, convex=500, tol=1e-10, max_iter=50_000)
    assert convex.success
    assert convex.iterations < 500
    np.testing.assert_allclose(
        convex.impulse, inside, atol=1e-7
    )  # eigenvalues of A from 0.05 to about 30
    # And where contacts slide, the Coulomb iterations that follow correct it.
    slippery = lv.solve(base, name, convex=10, tol=1e-8, max_iter=50_000)
    assert slippery.success


@pytest.mark.parametrize("memory", [1, 2, 5])
def test_anderson_first_iterations_are_least_squares_over_the_last_sweeps(memory):
    # x <- y - sum gamma_i (y_{i+1} - y_i), gamma from least squares of f = D^1/2 (y - x), written with lstsq.
    rng = np.random.default_rng(3)
    a = rng.standard_normal((8, 12))
    problem = lv.Problem.linear(a @ a.T + np.eye(8), rng.standard_normal(8))
    root = np.sqrt(problem.d)
    x = problem.start()
    ys = []
    fs = []
    for k in range(5):
        y = sweeps(problem, "pgs", 1, impulse=x)
        got = lv.solve(problem, "anderson", memory=memory, tol=0.0, max_iter=k + 1).impulse
        # Normal equations lose half the digits.
        np.testing.assert_allclose(got, y, rtol=1e-6, atol=1e-8 * np.abs(y).max())
        ys.append(y)
        fs.append(root * (y - x))
        ys, fs = ys[-memory - 1 :], fs[-memory - 1 :]
        dy, df = (np.diff(v, axis=0).T for v in (ys, fs))
        gamma = np.linalg.lstsq(df, fs[-1], rcond=None)[0] if df.size else np.zeros(0)
        x = y - dy @ gamma if gamma.size else y


@pytest.mark.parametrize("name", ["granularF(n=6)", "granularF(n=6, sliding=0.5)"])
def test_anderson_large_pile_at_rest_converges_from_the_cone_law(name):
    """Under Coulomb's law alone, the sweeps end at a residual of about 1e-3."""
    problem = lv.suite.case(name).problem
    assert lv.solve(problem, "anderson", tol=1e-6, max_iter=100).success
    assert not lv.solve(problem, "anderson", convex=0, tol=1e-6, max_iter=1000).success


def test_anderson_warm_start_of_slipping_contacts_stays_under_coulomb():
    """From close to a solution with slip, the sweeps stay under Coulomb's law: the cone law would move away from it."""
    problem = lv.suite.case("pyramidF(k=10)").problem
    start = lv.solve(problem, "newton", tol=1e-8).impulse * (1.0 + 1e-4)
    found, exact = (
        lv.solve(problem, "anderson", impulse=start, tol=1e-6, max_iter=100, **options)
        for options in ({}, {"convex": 0})
    )
    assert exact.success
    assert exact.iterations > 16  # The law has been tested after 16 sweeps.
    assert found.iterations == exact.iterations


def test_anderson_slipping_pyramid_leaves_the_cone_law():
    """The tests of the law cost a few sweeps, not the 512 sweeps that the cone law may take."""
    problem = lv.suite.case("pyramidF(k=10)").problem
    found = lv.solve(problem, "anderson", tol=1e-6, max_iter=2000)
    assert found.success
    assert (
        found.iterations
        < 1.3 * lv.solve(problem, "anderson", convex=0, tol=1e-6, max_iter=2000).iterations
    )
