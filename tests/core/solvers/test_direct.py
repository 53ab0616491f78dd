"""`direct`: every factorisation, pivoting against enumeration, singular and infeasible problems."""

from collections import Counter

import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import assume, given
from random_problems import good, random_lcp, seeds, without_solution

import lavender as lv
from lavender.judge.certificates import check_certificate


def spd(rng, m, spread=2.0):
    q, _ = np.linalg.qr(rng.normal(size=(m, m)))
    return q @ np.diag(10.0 ** rng.uniform(-spread, 0.0, m)) @ q.T


def symmetric(a):
    return 0.5 * (a + a.T)


def laplacian(n, diagonal=2.5):
    """n x n grid: half bandwidth n, sparse."""
    t = sp.diags_array(
        [-np.ones(n - 1), diagonal * np.ones(n), -np.ones(n - 1)], offsets=[-1, 0, 1]
    )
    return sp.csr_array(sp.kron(sp.eye_array(n), t) + sp.kron(t, sp.eye_array(n)))


def tridiagonal(m, diagonal=2.01):
    return sp.csr_array(
        sp.diags_array(
            [-np.ones(m - 1), diagonal * np.ones(m), -np.ones(m - 1)], offsets=[-1, 0, 1]
        )
    )


def shuffled(rng, a):
    order = rng.permutation(a.shape[0])
    return sp.csr_array(a[order][:, order])


RNG = np.random.default_rng(5)
LINEAR = {
    "tridiagonal": (tridiagonal(500), "band"),
    "pentadiagonal": (sp.csr_array(tridiagonal(300) @ tridiagonal(300)), "band"),
    "shuffled tridiagonal": (shuffled(RNG, tridiagonal(500)), "sparse"),
    **{f"tridiagonal of {m}": (tridiagonal(m), "band") for m in (1, 2, 3, 4, 9)},  # from both ends
    "diagonal": (sp.csr_array(sp.diags_array(np.arange(1.0, 100.0))), "band"),
    "small": (symmetric(spd(RNG, 20)), "band"),
    "dense": (symmetric(spd(RNG, 150)), "dense"),
    "sparse": (laplacian(60), "sparse"),
    "asymmetric": (spd(RNG, 30) + np.triu(RNG.normal(size=(30, 30))), "LU"),
    "asymmetric sparse": (
        sp.csr_array(laplacian(20) + sp.diags_array(np.ones(399), offsets=1)),
        "LU",
    ),
    "indefinite": (symmetric(RNG.normal(size=(40, 40))), "LU"),
    "indefinite dense": (symmetric(RNG.normal(size=(120, 120))), "LU"),
    "indefinite sparse": (sp.csr_array(laplacian(60) - 3.3 * sp.eye_array(3600)), "LU"),
    "zero diagonal": (np.array([[0.0, 1.0], [1.0, 0.0]]), "LU"),
}


@pytest.mark.parametrize("case", LINEAR)
def test_direct_with_every_factorisation_reaches_rounding(case):
    a, form = LINEAR[case]
    problem = lv.Problem.linear(a, np.random.default_rng(1).normal(size=a.shape[0]))
    solution = lv.solve(problem, "direct", tol=1e-9)
    assert solution.solver.form == form
    assert solution.status in (lv.Status.CONVERGED, lv.Status.ROUNDOFF_LIMIT)
    assert solution.claim_check == "confirmed"
    assert good(solution), solution
    assert solution.work["factorisations"] >= 1


@pytest.mark.parametrize("a", [tridiagonal(400), sp.csr_array(tridiagonal(400) @ tridiagonal(400))])
def test_direct_on_a_shuffled_strip_uses_a_band_factor(a):
    problem = lv.Problem.lcp(shuffled(np.random.default_rng(2), a), np.ones(400))
    assert lv.solve(problem, "direct").solver.form == "band"


@pytest.mark.parametrize("m", [90, 300])
@pytest.mark.parametrize("shape", ["dense", "sparse"])
def test_larger_semidefinite_problems_need_descent(m, shape):
    rng = np.random.default_rng(m)
    if shape == "dense":
        g = rng.normal(size=(m, m // 2))
    else:
        g = np.where(rng.random((m, m // 2)) < 3.0 / m, rng.random((m, m // 2)), 0.0)
    a = sp.csr_array(g @ g.T)
    b = a @ np.maximum(rng.uniform(-0.3, 1.0, m), 0.0) - np.where(
        rng.random(m) < 0.5, rng.random(m), 0.0
    )
    problem = lv.Problem.lcp(a, b)
    solution = lv.solve(problem, "direct", tol=1e-9)
    assert solution.success, solution
    assert "singular" in solution.message
    assert solution.work["shifts"] >= 1


def test_direct_on_a_stack_takes_one_factorisation():
    """Impulses pass through the whole stack in the sweeps that guess the free rows."""
    m = 2000
    a = sp.lil_array(tridiagonal(m, 2.0))
    a[0, 0] = 1.0
    b = np.zeros(m)
    b[0] = 0.1
    solution = lv.solve(lv.Problem.lcp(sp.csr_array(a), b), "direct", tol=1e-9)
    assert solution.residual.relative <= 2.0 * solution.residual.roundoff_floor
    assert solution.work["factorisations"] == 1
    np.testing.assert_allclose(solution.impulse, 0.1 * np.arange(m, 0, -1), rtol=1e-6)


@pytest.mark.parametrize("m", [5, 30, 120, 900])
def test_direct_on_a_singular_system_reports_its_rank(m):
    rng = np.random.default_rng(m)
    if m == 900:
        grid = laplacian(30)
        a = sp.csr_array(sp.diags_array(np.full(900, 1.0)) @ grid)
        a = a - sp.diags_array(a @ np.ones(900))  # a graph's Laplacian: rank m - 1
        rank = m - 1
    else:
        rank = m // 2
        g = rng.normal(size=(m, rank))
        a = symmetric(g @ g.T)
    problem = lv.Problem.linear(a, a @ rng.normal(size=m))
    solution = lv.solve(problem, "direct", tol=1e-9)
    assert solution.success, solution
    assert f"rank {rank} of {m}" in solution.message
    assert solution.work["rank"] == rank


@pytest.mark.parametrize(
    ("kind", "solver"), [("symmetric", "direct"), ("symmetric", "newton"), ("asymmetric", "direct")]
)
@given(seed=seeds, m=st.integers(2, 12))
def test_direct_on_an_inconsistent_linear_system_returns_a_certificate(kind, solver, seed, m):
    rng = np.random.default_rng(seed)
    g = rng.normal(size=(m, m - 1))
    a = symmetric(g @ g.T) if kind == "symmetric" else g @ rng.normal(size=(m - 1, m))
    left = np.linalg.svd(a)[0][:, -1]
    problem = lv.Problem.linear(a, a @ rng.normal(size=m) + left)
    assume(
        check_certificate(problem, left) is None
    )  # where not even this is a proof to rounding, nothing is
    solution = lv.solve(problem, solver)
    assert solution.status is lv.Status.INFEASIBLE, solution
    assert check_certificate(problem, solution.certificate) is None


@pytest.mark.parametrize("solver", ["direct", "lemke", "newton", "auto"])
@given(seed=seeds, m=st.integers(2, 14))
def test_direct_on_an_lcp_without_solution_returns_a_certificate(solver, seed, m):
    problem = without_solution(seed, m)
    left = np.abs(np.linalg.svd(problem.dense())[0][:, -1])
    assume(
        check_certificate(problem, left) is None
    )  # where not even this is a proof to rounding, nothing is
    solution = lv.solve(problem, solver)
    assert solution.status is lv.Status.INFEASIBLE, solution
    assert check_certificate(problem, solution.certificate) is None
    assert solver != "lemke" or "ray" in solution.message or "row of A is zero" in solution.message


@pytest.mark.parametrize(
    ("m", "density"), [(2, 1.0), (40, 1.0), (64, 0.1), (65, 1.0), (200, 1.0), (200, 0.02)]
)
@pytest.mark.parametrize("bounds", [(0.0, np.inf), (-0.3, 0.3), (-np.inf, np.inf)])
def test_direct_solves_asymmetric_bounded_rows(m, density, bounds):
    """Positive definite and not symmetric, as recorded problems are and more: compiled and LAPACK's LU, SuperLU."""
    rng = np.random.default_rng(m)
    a = sp.random_array(
        (m, m), density=density, rng=rng, data_sampler=rng.standard_normal
    ).toarray()
    mass = 10.0 ** rng.uniform(-3.0, 3.0, m)  # rows of any unit: the factor is of D^-1/2 A D^-1/2
    a = mass[:, None] * (a @ a.T / m + 0.1 * (a - a.T) + np.eye(m)) * mass
    problem = lv.Problem.lcp(a, mass * rng.normal(size=m), *(x / mass for x in bounds))
    assert not problem.is_symmetric
    solution = lv.solve(problem, "direct")
    assert good(solution), solution
    assert solution.solver.form == "LU"
    long = lv.solve(problem, "direct", max_iter=1000)  # never the one compiled call
    # Both to rounding: D^-1/2 A D^-1/2 has a condition of 1.2 to 5.6, 1e-9 is a margin of six digits.
    np.testing.assert_allclose(long.impulse, solution.impulse, rtol=1e-9, atol=1e-12 / mass.min())


def test_direct_with_cycling_exchanges_is_stalled():
    # No solution at all: w = -lambda_other - 1 < 0 whatever the impulse.
    for more in (0, 80):
        a = np.eye(2 + more)
        a[:2, :2] = [[0.0, -1.0], [-2.0, 0.0]]
        solution = lv.solve(lv.Problem.lcp(a, np.ones(2 + more)), "direct")
        assert solution.status in (lv.Status.STALLED, lv.Status.NUMERICAL_ERROR)
        assert solution.claim_check == "confirmed"
    # Nearly skew, so that an exchange puts right as many rows as it puts wrong.
    rng = np.random.default_rng(0)
    circled = 0
    for _ in range(20):
        a = rng.normal(size=(8, 8))
        solution = lv.solve(
            lv.Problem.lcp(a - a.T + 0.05 * np.eye(8), rng.normal(size=8)), "direct"
        )
        assert solution.claim_check == "confirmed"
        assert solution.success or (
            solution.status is lv.Status.STALLED and "cycle" in solution.message
        )
        assert solution.residual.relative <= 1.0
        circled += not solution.success
    assert circled > 0


def test_direct_with_a_lost_pivot_counts_and_names_it():
    m = 100
    a = 2.0 * np.eye(m)
    a[:2, :2] = [[1.0, 1.0], [2.0, 2.0]]
    solution = lv.solve(lv.Problem.linear(sp.csr_array(a), a @ np.ones(m)), "direct", tol=1e-9)
    assert solution.success
    words = "A is not symmetric; LU by panels lost a pivot; A is singular, rank 99 of 100"
    assert solution.message == words


@pytest.mark.parametrize("bound", [np.inf, 0.05])
@pytest.mark.parametrize(("m", "half"), [(40, 39), (60, 1), (100, 5), (900, 20)])
def test_direct_with_a_good_factor_is_not_refined(m, half, bound):
    """Refinement would hide a wrong half of a factor's solve, at the price of its work."""
    rng = np.random.default_rng(m)
    diagonals = [rng.normal(size=m - abs(k)) for k in range(-half, half + 1)]
    a = sp.diags_array(diagonals, offsets=list(range(-half, half + 1)))
    a = sp.csr_array(a + a.T)
    a = sp.csr_array(a + sp.diags_array(4.0 * np.abs(a).sum(axis=1)))
    solution = lv.solve(lv.Problem.lcp(a, rng.normal(size=m), -bound, bound), "direct", tol=1e-12)
    assert solution.residual.relative < 1e-14
    assert "refinements" not in solution.work


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("m", [8, 80])
def test_direct_shifts_a_singular_asymmetric_matrix_once(seed, m):
    """Free sets of more than m / 2 rows are singular; exchanges may cycle, but no pivot is lost with the shift."""
    rng = np.random.default_rng(seed)
    g = rng.normal(size=(m, m // 2))
    skew = rng.normal(size=(m // 2, m // 2))
    a = g @ (np.eye(m // 2) + 0.7 * (skew - skew.T)) @ g.T
    x = np.maximum(rng.normal(size=m), 0.0)
    b = a @ x - np.where(x > 0.0, 0.0, rng.random(m))
    solution = lv.solve(
        lv.Problem.lcp(a, b, 0.0, np.where(rng.random(m) < 0.5, 5.0, np.inf)), "direct", tol=1e-8
    )
    assert solution.status in (lv.Status.CONVERGED, lv.Status.STALLED), str(solution)
    assert solution.work["shifts"] == 1


@pytest.mark.parametrize("seed", range(4))
def test_direct_of_a_singular_problem_ends_at_rounding(seed):
    """The shift of 1e-10 is centred at the last point, so that it does not remain in the answer."""
    solution = lv.solve(random_lcp(seed, m=30, rank=12), "direct", tol=1e-12)
    assert solution.success and solution.work["shifts"] >= 1, str(solution)


@pytest.mark.parametrize("seed", range(4))
def test_direct_never_exchanges_rows_with_equal_limits(seed):
    rng = np.random.default_rng(seed)
    m = 20
    a = spd(rng, m, 1.0)
    b = rng.normal(size=m)
    fixed = np.where(np.arange(m) % 2 == 0, rng.normal(size=m), np.nan)
    low = np.where(np.isnan(fixed), 0.0, fixed)
    high = np.where(np.isnan(fixed), np.inf, fixed)
    solution = lv.solve(lv.Problem.lcp(a, 3.0 * b, low, high), "direct", tol=1e-12)
    assert solution.success and solution.work.get("pivots", 0) <= 3, str(solution)


def test_direct_ends_with_a_solution_or_a_proof_on_singular_problems_with_rows_of_equal_limits():
    count = Counter()
    for seed in range(150):
        rng = np.random.default_rng(seed)
        m = int(rng.integers(6, 20))
        jac = rng.normal(size=(m, int(rng.integers(2, 5))))
        lower = np.where(rng.random(m) < 0.2, -np.inf, 0.0)
        upper = np.where(rng.random(m) < 0.3, 1.0, np.inf)
        fixed = rng.random(m) < 0.3
        lower[fixed] = upper[fixed] = rng.uniform(-1.0, 1.0, fixed.sum())
        problem = lv.Problem(rng.normal(size=m), lv.Cones.bounded(lower, upper), jac @ jac.T)
        found = lv.solve(problem, "direct", tol=1e-9)
        count[found.status.name] += 1
        assert found.claim_check == "confirmed", (seed, found)
    assert count.keys() == {"CONVERGED", "INFEASIBLE"} and min(count.values()) > 30
