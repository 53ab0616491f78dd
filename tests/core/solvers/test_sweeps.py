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


# -- projected successive over-relaxation ------------------------------------------------------------------


def run_psor(problem, omega, n):
    """Return lambda after n sweeps of PSOR in NumPy, row after row (Cryer 1971)."""
    A = problem.dense()
    x = problem.start().copy()
    for _ in range(n):
        for i in range(problem.m):
            step = omega * (A[i] @ x - problem.b[i]) / A[i, i]
            x[i] = np.clip(x[i] - step, problem.cones.lower[i], problem.cones.upper[i])
    return x


@pytest.mark.parametrize("omega", [0.3, 1.2, 1.9])
@pytest.mark.parametrize("form", ["matrix", "J and M"])
def test_pgs_with_omega_is_projected_sor(omega, form):
    rng = np.random.default_rng(1)
    J = rng.normal(size=(9, 12))
    cones = lv.Cones.bounded(-rng.random(9), rng.random(9))
    problem = lv.Problem.from_jacobian(J, np.eye(12), rng.normal(size=12), cones=cones)
    if form == "matrix":
        problem = lv.Problem(problem.b, cones, J @ J.T)
    found = lv.solve(problem, "pgs", omega=omega, tol=0.0, max_iter=7)
    # Rounding of sums of nine terms of size one.
    np.testing.assert_allclose(found.impulse, run_psor(problem, omega, 7), rtol=0.0, atol=1e-13)
    assert lv.solve(problem, "pgs", omega=omega, tol=1e-9, max_iter=20_000).success


def test_pgs_with_omega_one_has_the_bits_of_pgs_and_other_values_are_refused():
    problem = lv.suite.case("granular(n=3)").problem
    for omega in (1.0, 1):
        pair = [lv.solve(problem, "pgs", **more) for more in ({}, {"omega": omega})]
        assert pair[0].impulse.tobytes() == pair[1].impulse.tobytes()
        assert pair[0].iterations == pair[1].iterations
    for omega in (0.0, 2.0, -1.0):
        with pytest.raises(lv.InputError, match="omega is"):
            lv.solve(problem, "pgs", omega=omega)


def test_rate_of_pgs_with_the_best_omega_is_that_of_young():
    """On a chain, Gauss-Seidel multiplies the error by rho^2 and SOR at its best omega by omega - 1."""
    n = 30
    A = 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    problem = lv.Problem.lcp(A, np.random.default_rng(0).random(n))  # No row ends at its bound.
    rho = np.cos(np.pi / (n + 1))
    best = 2.0 / (1.0 + np.sqrt(1.0 - rho * rho))
    found = {w: lv.solve(problem, "pgs", omega=w, tol=1e-8, max_iter=20_000) for w in (1.0, best)}
    assert all(s.success and (s.impulse > 0.0).all() for s in found.values())
    for omega, rate in ((1.0, rho * rho), (best, best - 1.0)):
        sweeps = np.log(1e-8) / np.log(rate)
        # Twice for the polynomial factor of the double eigenvalue at the best omega, and for the checks.
        assert 0.5 * sweeps < found[omega].iterations < 2.0 * sweeps


@pytest.mark.parametrize("omega", [0.5, 1.5])
def test_pgs_with_omega_solves_contacts_with_friction(omega):
    problem = lv.suite.case("box_stackF(n=3)").problem
    assert lv.solve(problem, "pgs", omega=omega, tol=1e-6, max_iter=100_000).success
