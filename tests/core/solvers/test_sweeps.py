"""Sweep solvers against a dense slow twin, each other, and closed forms."""

import judge_twin
import numpy as np
import pytest
import twins
from hypothesis import given, settings
from random_problems import CONTACTS, FORMS, random_contact_problem, random_lcp, seeds, sweeps

import lavender as lv
from lavender.problem.ordering import ORDERS


@pytest.mark.parametrize("kind", CONTACTS)
@settings(max_examples=20)
@given(seed=seeds)
def test_a_sweep_is_the_update_written_densely_in_every_form(kind, seed):
    problem = CONTACTS[kind](seed)
    lam, twin = problem.start(), judge_twin.Problem(judge_twin.spec_of(problem))
    for _ in range(5):
        twins.sweep(problem, twin, lam, range(problem.n_blocks))
    # 1e-12 of the largest impulse: a few hundred roundings, none amplified; of J and M those of their inverses.
    size = np.abs(lam).max()
    if lv.get("sequential_impulses").refuses(problem) is None:
        np.testing.assert_allclose(sweeps(problem, "sequential_impulses", 5), lam, atol=1e-12 * size, rtol=0)
    for form, given_by in FORMS.items():
        atol = 1e-9 * size if form == "J and M" else 1e-12 * size
        np.testing.assert_allclose(sweeps(given_by(problem), "pgs", 5), lam, atol=atol, rtol=0)


@pytest.mark.parametrize("order", ORDERS)
@settings(max_examples=30)
@given(seed=seeds)
def test_sequential_impulses_equal_pgs_on_every_order(order, seed):
    """Twenty sweeps: where strong friction makes the sweeps chaotic, roundings grow tenfold in five."""
    problem = random_contact_problem(seed)
    x = sweeps(problem, "sequential_impulses", 20, order=order)
    y = sweeps(problem, "pgs", 20, order=order)
    np.testing.assert_allclose(x, y, atol=1e-12 * np.abs(y).max(), rtol=0)


@given(seed=seeds)
@pytest.mark.parametrize("name", ["pgs", "jacobi"])
def test_row_order_given_by_name_or_by_numbers_is_the_same(name, seed):
    problem = random_lcp(seed)
    if name == "pgs":
        np.testing.assert_array_equal(
            sweeps(problem, name, 7), sweeps(problem, name, 7, order=np.arange(problem.n_blocks))
        )
    permutation = np.random.default_rng(seed).permutation(problem.m)
    c = problem.cones
    permuted = lv.Problem.lcp(
        problem.matrix[np.ix_(permutation, permutation)],
        problem.b[permutation],
        c.lower[permutation],
        c.upper[permutation],
    )
    x = sweeps(problem, name, 7, **({"order": permutation} if name == "pgs" else {}))
    # Sweeping P A P^T forwards is sweeping A in the order P, up to the order of additions.
    np.testing.assert_allclose(sweeps(permuted, name, 7), x[permutation], atol=1e-12 * np.abs(x).max())


@given(seed=seeds)
def test_gauss_seidel_sor_and_jacobi_are_their_formulas(seed):
    problem = random_lcp(seed, boxed=False)
    a, b = problem.matrix, problem.b
    linear = lv.Problem.linear(a, b)
    for name, omega, options in (
        ("gauss_seidel", 1.0, {}),
        ("sor", 1.3, {"omega": 1.3}),
        ("jacobi", 0.3, {"omega": 0.3}),
    ):
        lam = np.zeros(len(b))
        for _ in range(3):
            seen = lam.copy() if name == "jacobi" else lam
            for i in range(len(b)):
                lam[i] -= omega * (a[i] @ seen - b[i]) / a[i, i]
        np.testing.assert_allclose(sweeps(linear, name, 3, **options), lam, atol=1e-12 * np.abs(lam).max())


# -- tangent blocks -------------------------------------------------------------------------------------

BLOCKS = {
    "diag(1, 10)": np.diag([1.0, 10.0]),
    "diag(1, 100)": np.diag([1.0, 100.0]),
    "rank 1": np.outer([1.0, 2.0], [1.0, 2.0]),
    "nearly rank 1": np.outer([1.0, 2.0], [1.0, 2.0]) + 1e-3 * np.eye(2),
}


@pytest.mark.parametrize("name", BLOCKS)
@pytest.mark.parametrize("slip", [0.0, 0.2, 30.0], ids=["rest", "stick", "slide"])
@pytest.mark.parametrize("solver", ["pgs", "jacobi"])
def test_anisotropic_tangents_converge_to_the_right_point(solver, name, slip):
    a = np.zeros((3, 3))
    a[0, 0], a[1:, 1:] = 1.0, BLOCKS[name]
    # Tangential velocity in the range of the block, so that sticking is possible where it is singular.
    b = np.concatenate([[1.0], -BLOCKS[name] @ [0.6 * slip, 0.3 * slip]])
    solution = lv.solve(lv.Problem.contact(a, b, [0.5]), solver, tol=1e-12, max_iter=200_000)
    assert solution.success, solution
    bound = 0.5 * solution.impulse[0]
    size = np.linalg.norm(solution.impulse[1:])
    w = solution.slack[1:]
    if slip == 30.0:
        assert size == pytest.approx(bound, rel=1e-12)
        # Sliding: the tangent impulse opposes the slip.
        cross = solution.impulse[1] * w[1] - solution.impulse[2] * w[0]
        assert abs(cross) <= 1e-9 * size * np.linalg.norm(w)
        assert solution.impulse[1:] @ w < 0.0
    else:
        assert size <= bound


# -- laws (closed forms) ----------------------------------------------------------------------------------


def stacked_boxes(n):
    """n equal masses, one point contact each, normals only: tridiagonal A = 1, 2, 2, ... / m."""
    a = 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    a[0, 0] = 1.0
    b = np.zeros(n)
    b[0] = 0.1
    return lv.Problem.lcp(a, b)


def contraction(problem, name, first, last, **options):
    exact = np.linalg.solve(problem.dense(), problem.b)
    x, y = (sweeps(problem, name, n, **options) - exact for n in (first, last))
    return (np.linalg.norm(y) / np.linalg.norm(x)) ** (1.0 / (last - first))


@pytest.mark.parametrize("n", [2, 5, 10, 20])
@pytest.mark.parametrize("order", ["given", "reverse"])
def test_stack_contracts_by_cos_squared(n, order):
    """n equal boxes, one point each: the asymptotic Gauss-Seidel factor is cos^2(pi / 2n)."""
    problem = stacked_boxes(n)
    rate = contraction(problem, "pgs", 2 * n * n, 3 * n * n, order=order)
    jacobi = np.eye(n) - problem.matrix / np.diag(problem.matrix)[:, None]
    # Consistently ordered: the Gauss-Seidel factor is the square of the Jacobi one (Young 1971).
    assert rate == pytest.approx(np.abs(np.linalg.eigvals(jacobi)).max() ** 2, rel=1e-3)
    assert rate == pytest.approx(np.cos(np.pi / (2 * n)) ** 2, rel=2e-3)
