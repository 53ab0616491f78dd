"""Sweep solvers against a dense slow twin and each other."""

import judge_twin
import numpy as np
import pytest
from hypothesis import given
from random_problems import CONTACTS, FORMS, random_contact_problem, random_lcp, seeds, sweeps

import lavender as lv
from lavender.problem.ordering import SWEEP_ORDERS
from lavender_ext.sweep import serial


@pytest.mark.parametrize("kind", CONTACTS)
@given(seed=seeds)
def test_sweep_in_every_form_equals_the_dense_update(kind, seed):
    problem = CONTACTS[kind](seed)
    lam = problem.start()
    twin = judge_twin.Problem(judge_twin.spec_of(problem))
    for _ in range(5):
        judge_twin.sweep(problem, twin, lam, range(problem.n_blocks))
    # 1e-12 of the largest impulse: a few hundred roundings, none amplified; of J and M those of their inverses.
    size = np.abs(lam).max()
    if lv.get("sequential_impulses").refuses(problem) is None:
        np.testing.assert_allclose(
            sweeps(problem, "sequential_impulses", 5), lam, atol=1e-12 * size, rtol=0
        )
    for form, given_by in FORMS.items():
        atol = 1e-9 * size if form == "J and M" else 1e-12 * size
        np.testing.assert_allclose(sweeps(given_by(problem), "pgs", 5), lam, atol=atol, rtol=0)


@pytest.mark.parametrize("order", SWEEP_ORDERS)
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
    np.testing.assert_allclose(
        sweeps(permuted, name, 7), x[permutation], atol=1e-12 * np.abs(x).max()
    )


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
        np.testing.assert_allclose(
            sweeps(linear, name, 3, **options), lam, atol=1e-12 * np.abs(lam).max()
        )


@pytest.mark.parametrize("k", [2, 3, 5])
def test_jacobi_without_damping_diverges_on_coincident_contacts(k):
    """k contacts at one place: A is all ones. Unprojected factor k - 1; projected from 0, period 2."""
    a = np.ones((k, k))
    b = np.ones(k)
    free = lv.Problem.linear(a, b)
    size = [abs(lv.solve(free, "jacobi", omega=1.0, tol=0.0, max_iter=n).slack[0]) for n in (3, 4)]
    assert size[1] / size[0] == pytest.approx(k - 1.0)
    lcp = lv.Problem.lcp(a, b)
    for n in range(4):
        np.testing.assert_array_equal(sweeps(lcp, "jacobi", n, omega=1.0), np.full(k, float(n % 2)))
    assert lv.solve(lcp, "jacobi", omega=1.0, tol=1e-6).status is lv.Status.STALLED
    assert lv.solve(lcp, "jacobi", tol=1e-9).success


@given(seed=seeds)
def test_jacobi_safe_damping_is_below_the_limit_of_convergence(seed):
    # omega < 2 / L, L the largest eigenvalue of D^-1 A, for symmetric positive semidefinite A.
    problem = random_lcp(seed, m=12)
    scaled = problem.dense() / np.sqrt(np.outer(problem.d, problem.d))
    assert (
        0.0
        < serial.jacobi_damping_of_matrix(problem.csr_data) * np.linalg.eigvalsh(scaled).max()
        < 2.0
    )


@given(seed=seeds)
def test_jacobi_damping_is_the_same_in_every_unit(seed):
    problem = random_lcp(seed, m=12)
    rng = np.random.default_rng(seed)
    size = 2.0 ** rng.integers(
        -8, 9, 12
    )  # each row in a unit of its own; rounds by the square roots alone
    other = lv.Problem.lcp(size[:, None] * problem.dense() * size, size * problem.b)
    assert serial.jacobi_damping_of_matrix(other.csr_data) == pytest.approx(
        serial.jacobi_damping_of_matrix(problem.csr_data), rel=1e-12
    )


@pytest.mark.parametrize("name", lv.available(order=True))
def test_the_order_of_a_sweep_is_in_the_solution_and_its_text(name):
    problem = random_contact_problem(1, tangents=2, spin=False)
    if name not in lv.available(problem):
        problem = lv.Problem.linear(np.eye(4), np.ones(4))
    shifted = np.roll(np.arange(problem.n_blocks), 1)
    for order, words in (("given", "given"), ("reverse", "reverse"), (shifted, "permutation")):
        solution = lv.solve(problem, name, order=order, max_iter=3)
        assert solution.solver.order == words and f", order {words}" in str(solution)
    assert lv.solve(problem, name, max_iter=3).solver.order == "given"
