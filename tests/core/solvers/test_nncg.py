"""NNCG and Anderson mixing: the same answers as the sweeps they accelerate, in fewer sweeps."""

import numpy as np
import pytest
from random_problems import random_contact_problem, random_lcp

import lavender as lv


def stack(n, ratio=1.0):
    """n equal spheres in a column, the top one heavier: tridiagonal, impulse i carries all above it."""
    mass = np.ones(n)
    mass[-1] = ratio
    below = np.r_[0.0, 1.0 / mass[:-1]]
    a = np.diag(below + 1.0 / mass) - np.diag(1.0 / mass[:-1], 1) - np.diag(1.0 / mass[:-1], -1)
    b = np.r_[0.1, np.zeros(n - 1)]
    return lv.Problem.lcp(a, b, name=f"stack {n}"), np.cumsum(mass[::-1])[::-1] * 0.1


@pytest.mark.parametrize("name", ["nncg", "anderson"])
@pytest.mark.parametrize("sweep", ["pgs", "blocks"])
def test_stack_has_its_closed_form(name, sweep):
    problem, exact = stack(20)
    solution = lv.solve(problem, name, sweep=sweep, tol=1e-10, max_iter=20_000)
    assert solution.success
    # cond(A) is near 650 for 20 bodies
    np.testing.assert_allclose(solution.impulse, exact, rtol=1e-7)


def test_fewer_sweeps_than_pgs():
    problem, _ = stack(20)
    sweeps = {
        key: lv.solve(problem, *key[:1], tol=1e-9, max_iter=50_000, **dict(key[1:])).work["sweeps"]
        for key in (("pgs",), ("nncg",), ("nncg", ("order", "symmetric")), ("anderson",))
    }
    # Gauss-Seidel contracts by cos^2(pi / 40) a sweep: 3,360 sweeps for nine digits. A conjugate gradient's count
    # goes with the square root of the condition.
    assert sweeps["pgs",] > 3000
    assert sweeps["nncg",] < sweeps["pgs",] / 2
    assert sweeps["nncg", ("order", "symmetric")] < sweeps["pgs",] / 6
    assert sweeps["anderson",] < sweeps["pgs",] / 12


@pytest.mark.parametrize("name", ["nncg", "anderson"])
def test_symmetric_order_is_two_sweeps_an_iteration(name):
    problem, _ = stack(8)
    solution = lv.solve(problem, name, order="symmetric", tol=0.0, max_iter=7)
    assert (solution.iterations, solution.work["sweeps"]) == (7, 14)


def sliding_pile():
    base = random_contact_problem(77, tangents=2, spin=False, contacts=20, bodies=8, joints=0)
    return lv.Problem(base.b, base.cones, rows=base.rows, compliance=base.compliance + 0.05)


@pytest.mark.parametrize(("restart", "kept"), [("growth", 0), ("against", 2)])
def test_first_iterations_by_hand(restart, kept):
    """Iterations of nncg against the formulas written in NumPy over single sweeps of pgs."""
    problem = random_lcp(5, m=9) if restart == "growth" else sliding_pile()
    d, count = problem.d, 0

    def sweep(x):
        return np.array(lv.solve(problem, "pgs", impulse=x, tol=0.0, max_iter=1).impulse)

    x = problem.start()
    p = norm = None
    for k in range(4 if restart == "growth" else 40):
        y = sweep(x)
        g = x - y
        beta = 0.0 if p is None else g @ (d * g) / norm
        if beta > 1.0:
            keeps = restart == "against" and p @ (d * g) <= 0.0
            beta, count = (1.0, count + 1) if keeps else (0.0, count)
        norm = g @ (d * g)
        q = np.zeros_like(g) if p is None else beta * p
        p = q - g
        got = lv.solve(problem, "nncg", tol=0.0, max_iter=k + 1, restart=restart).impulse
        np.testing.assert_allclose(got, y, rtol=1e-9, atol=1e-12 * np.abs(y).max())  # sums in another order
        x = y + q
    assert count >= kept


@pytest.mark.parametrize("name", ["nncg", "anderson"])
def test_starting_from_the_convex_answer(name):
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
    np.testing.assert_allclose(convex.impulse, inside, atol=1e-7)  # eigenvalues of A from 0.05 to about 30
    # And where contacts slide, the Coulomb iterations that follow correct it.
    slippery = lv.solve(base, name, convex=10, tol=1e-8, max_iter=50_000)
    assert slippery.success
