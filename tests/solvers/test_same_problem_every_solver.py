"""One linear system and one LCP, by every solver that takes them, to the same answer."""

import numpy as np
import pytest
from random_problems import random_rows

import lavender as lv
from lavender import registry

TOL = 1e-8
BACKENDS = sorted(n for n in lv.available(law="lcp") if registry.specs()[n].external)
LINEAR_BACKENDS = [n for n in BACKENDS if "linear" in registry.specs()[n].laws]
LINEAR = ["direct", "gauss_seidel", "sor", "jacobi", "pgs", "sequential_impulses", *LINEAR_BACKENDS]
LCP = ["direct", "pgs", "jacobi", "sequential_impulses", *BACKENDS]


def chain():
    """Eight bodies, ten compliant joint rows: positive definite, condition number about 200."""
    rng = np.random.default_rng(8)
    rows = random_rows(rng, bodies=8, joints=5, contacts=0)
    return lv.Problem.from_rows(rows, target=rng.normal(size=len(rows.jac)), compliance=1.0, name="chain")


def pile():
    """Twelve frictionless contacts on six bodies, a third of them separating, slightly compliant."""
    rng = np.random.default_rng(9)
    rows = random_rows(rng, bodies=6, joints=0, contacts=12)
    target = rng.normal(size=12)
    return lv.Problem.from_rows(rows, target=target, compliance=0.5, name="pile")


def exact(problem):
    """Plain Gauss-Seidel in NumPy finds the active set; its equations are solved directly."""
    a, b, c = problem.dense(), problem.b, problem.cones
    x = np.clip(np.zeros(problem.m), c.lower, c.upper)
    for _ in range(20_000):
        for i in range(problem.m):
            x[i] = np.clip(x[i] - (a[i] @ x - b[i]) / a[i, i], c.lower[i], c.upper[i])
    inside = (x > c.lower) & (x < c.upper)
    x[inside] = np.linalg.solve(
        a[np.ix_(inside, inside)], b[inside] - a[np.ix_(inside, ~inside)] @ x[~inside]
    )
    return x


@pytest.fixture(scope="module")
def linear():
    problem = chain()
    return problem, np.linalg.solve(problem.dense(), problem.b)


@pytest.fixture(scope="module")
def lcp():
    problem = pile()
    x = exact(problem)
    assert (x > 0).sum() >= 3  # some contacts press
    assert (x == 0).sum() >= 3  # and some are open
    return problem, x


def check(problem, wanted, name):
    solution = lv.solve(problem, name, tol=TOL, max_iter=100_000 if registry.get(name).resumable else None)
    assert solution.success, str(solution)
    assert solution.contradicted == ""
    assert solution.work, "the work must show what ran"
    # The condition number (below 1e3 in the metric of d) turns a relative residual into an error of the impulse.
    assert np.abs(solution.impulse - wanted).max() <= 1e3 * TOL * np.abs(wanted).max()
    return solution


@pytest.mark.parametrize("name", LINEAR)
def test_linear(linear, name):
    check(*linear, name)


@pytest.mark.parametrize("name", LCP)
def test_lcp(lcp, name):
    check(*lcp, name)


@pytest.mark.parametrize(
    ("which", "name"), [*(("linear", n) for n in LINEAR_BACKENDS), *(("lcp", n) for n in BACKENDS)]
)
@pytest.mark.parametrize("form", ["impulse", "velocity"])
def test_backends_in_both_forms(request, which, name, form):
    problem, wanted = request.getfixturevalue(which)
    solution = lv.solve(problem, name, tol=TOL, form=form)
    assert solution.solver.form == form
    assert solution.success, str(solution)
    assert solution.work["backend_calls"] >= 1
    assert np.abs(solution.impulse - wanted).max() <= 1e3 * TOL * np.abs(wanted).max()


@pytest.mark.parametrize("name", BACKENDS)
def test_a_matrix_without_rows_gives_the_same(lcp, name):
    problem, wanted = lcp
    given = lv.Problem.lcp(problem.dense(), problem.b)
    solution = lv.solve(given, name, tol=TOL)
    assert solution.solver.form == "impulse"
    assert solution.success, str(solution)
    assert np.abs(solution.impulse - wanted).max() <= 1e3 * TOL * np.abs(wanted).max()
