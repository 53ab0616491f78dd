"""Block Gauss-Seidel: the exact local problem against oracles that share nothing with it, and the sweeps."""

import numpy as np
import pytest
from enumeration import enumerate_lcp
from hypothesis import given, settings
from random_problems import random_contact_problem, seeds

import lavender as lv
from lavender_ext.local import gauss_seidel

COULOMB, CONE = 0, 1
FAILED, OPEN, STICK, SLIP = -1, 0, 1, 2
N = 100_000


def blocks_of(kind, rng, n, m):
    """n local matrices (m, m) of a kind that contacts have, or may be given."""
    g = rng.standard_normal((n, m, m))
    w = g @ g.transpose(0, 2, 1)
    if kind == "asymmetric":
        k = rng.standard_normal((n, m, m))
        return w + 0.3 * (k - k.transpose(0, 2, 1))
    if kind == "diag(1, 100)":
        w = np.zeros((n, m, m))
        w[:, range(m), range(m)] = rng.uniform(0.5, 2.0, (n, m))
        w[:, 2, 2] *= 100.0
    if kind == "rank one":
        u = rng.standard_normal((n, m))
        u[:, 0] = 0.0
        w = u[:, :, None] * u[:, None, :]
        w[:, 0, 0] = 1.0
    if kind == "condition 1e6":
        q = np.linalg.qr(g)[0]
        w = q @ (10.0 ** rng.uniform(-6, 0, (n, m))[:, :, None] * q.transpose(0, 2, 1))
    return np.ascontiguousarray(w)


def contacts(kind, seed, n=N, tangents=2, spin=False):
    rng = np.random.default_rng(seed)
    m = 1 + tangents + spin
    w = blocks_of(kind, rng, n, m)
    q = rng.standard_normal((n, m))
    if kind == "rank one":  # a contact can stick only where q_t lies in the range of W_tt
        q[::2, 1:] = np.einsum("nij,nj->ni", w, q)[::2, 1:]
    mu = 10.0 ** rng.uniform(-2, 1, n)
    mu[::10] = 0.0
    return w, q, mu, rng.uniform(0.0, 1.0, n)


def solve(law, w, q, mu, radius, tangents, spin):
    lam = np.zeros_like(q)
    found = gauss_seidel.solve_contacts(law, tangents, spin, w, q, mu, radius, lam)
    return found, lam


def scale(w, q, lam):
    """Size of the terms that make up the slack [m/s]: rounding is relative to this."""
    return np.maximum(np.abs(q).max(1), (np.abs(w) * np.abs(lam)[:, None, :]).sum(2).max(1))


def coulomb_error(w, q, mu, radius, lam, tangents, spin):
    """Largest violation of Signorini and Coulomb, relative to `scale`: projections by NumPy alone."""
    slack = np.einsum("nij,nj->ni", w, lam) + q
    bound = mu * lam[:, 0]
    e = np.abs(np.minimum(w[:, 0, 0] * lam[:, 0], slack[:, 0]))
    if tangents:
        d = np.maximum(w[:, 1:, 1:].reshape(len(w), -1).max(1), 1e-300)
        y = lam[:, 1 : 1 + tangents] - slack[:, 1 : 1 + tangents] / d[:, None]
        size = np.linalg.norm(y, axis=1)
        y *= np.minimum(1.0, bound / np.maximum(size, 1e-300))[:, None]
        e = np.maximum(e, d * np.linalg.norm(lam[:, 1 : 1 + tangents] - y, axis=1))
    if spin:
        d = w[:, -1, -1]
        y = np.clip(lam[:, -1] - slack[:, -1] / d, -bound * radius, bound * radius)
        e = np.maximum(e, d * np.abs(lam[:, -1] - y))
    return e / scale(w, q, lam)


def cone_error(w, q, mu, radius, lam, tangents, spin):
    """Largest violation of lam in K, w in K*, lam.w = 0, relative to `scale`."""
    slack = np.einsum("nij,nj->ni", w, lam) + q
    size = scale(w, q, lam)
    bound = mu * lam[:, 0]
    excess = np.linalg.norm(lam[:, 1 : 1 + tangents], axis=1) - bound
    dual = mu * np.linalg.norm(slack[:, 1 : 1 + tangents], axis=1) - slack[:, 0]
    if spin:
        excess = np.maximum(excess, np.abs(lam[:, -1]) - bound * radius)
        dual = dual + mu * radius * np.abs(slack[:, -1])
    product = np.abs((lam * slack).sum(1)) / np.maximum(np.abs(lam).sum(1), 1e-300)
    product[lam[:, 0] == 0.0] = 0.0
    return np.maximum(np.maximum(excess * w[:, 0, 0], dual / (1.0 + mu)), product) / size


@pytest.mark.parametrize("kind", ["full", "asymmetric", "diag(1, 100)", "rank one", "condition 1e6"])
def test_a_coulomb_contact_is_solved_exactly(kind):
    w, q, mu, radius = contacts(kind, seed=1)
    found, lam = solve(COULOMB, w, q, mu, radius, 2, False)
    # W is positive definite (or its rank-one part aside): a bracket of the slip's equation always exists.
    # Rounding alone may hide it where W is singular.
    assert np.sum(found == FAILED) <= (20 if kind == "rank one" else 0)
    assert min(np.sum(found == s) for s in (OPEN, STICK, SLIP)) > N // 20
    ok = found >= 0
    # The direction is refined to rounding; 1e-11 leaves four digits for W of condition 1e6.
    assert coulomb_error(w[ok], q[ok], mu[ok], radius[ok], lam[ok], 2, False).max() < 1e-11
    # What it says is what it found.
    slack = np.einsum("nij,nj->ni", w, lam) + q
    assert np.all(lam[found == OPEN] == 0.0)
    assert np.all(slack[found == OPEN, 0] >= 0.0)
    stick = found == STICK
    assert np.abs(slack[stick] / scale(w, q, lam)[stick, None]).max() < 1e-11
    slip = (found == SLIP) & (mu > 0.0)
    tangent = np.linalg.norm(lam[slip, 1:], axis=1)
    np.testing.assert_allclose(tangent, mu[slip] * lam[slip, 0], rtol=1e-12)


@pytest.mark.parametrize(
    ("law", "kind", "most", "allowed"),
    [
        (CONE, "full", 0, 1e-10),
        (CONE, "diag(1, 100)", 0, 1e-10),
        # Adjugates of W lose as many digits as its condition has; what they spoil is refused, not returned.
        (CONE, "condition 1e6", 2e-4, 1e-10),
        (CONE, "one tangent", 0, 1e-12),
        (COULOMB, "one tangent", 0, 1e-12),
    ],
)
def test_a_contact_is_solved_exactly(law, kind, most, allowed):
    tangents = 1 if kind == "one tangent" else 2
    w, q, mu, radius = contacts("full" if tangents == 1 else kind, seed=2, tangents=tangents)
    found, lam = solve(law, w, q, mu, radius, tangents, False)
    assert np.mean(found == FAILED) <= most
    assert min(np.sum(found == s) for s in (OPEN, STICK, SLIP)) > N // 20
    ok, error = found >= 0, coulomb_error if law == COULOMB else cone_error
    assert error(w[ok], q[ok], mu[ok], radius[ok], lam[ok], tangents, False).max() < allowed


@pytest.mark.parametrize("law", [COULOMB, CONE])
@pytest.mark.parametrize("tangents", [0, 1, 2])
def test_contacts_with_spin_are_solved_or_refused(law, tangents):
    w, q, mu, radius = contacts("full", seed=3, tangents=tangents, spin=True)
    # As on bodies, where the moment about the normal is nearly independent of the contact's force.
    w[:, -1, :-1] *= 0.2
    w[:, :-1, -1] *= 0.2
    found, lam = solve(law, w, q, mu, radius, tangents, True)
    # Above mu = 1 a contact may slide in several ways, of which the one tried may need another spin: rare.
    assert np.mean(found == FAILED) < 2e-3
    assert np.mean((found == FAILED) & (mu <= 1.0)) < 1e-4
    ok = found >= 0
    error = coulomb_error if law == COULOMB else cone_error
    # Spin is weighed against the normal at the border of sticking, to 1e-14 of the slack, over W_nn +- mu r W_ns.
    assert error(w[ok], q[ok], mu[ok], radius[ok], lam[ok], tangents, True).max() < 1e-9


def test_blocks_without_an_exact_answer_are_refused():
    # Negative diagonal, and a Painleve contact whose normal row pulls: nothing to divide by.
    w = np.array([[[-1.0, 0, 0], [0, 1, 0], [0, 0, 1]], [[0.0, 0, 0], [0, 1, 0], [0, 0, 1]]])
    q = np.full((2, 3), -1.0)
    found, lam = solve(COULOMB, w, q, np.ones(2), np.zeros(2), 2, False)
    assert found.tolist() == [FAILED, FAILED]
    assert np.all(lam == 0.0)


def test_a_painleve_contact_gets_a_solution_that_the_judge_accepts():
    # W positive definite, W_tn so large that W_nn + mu W_nt s <= 0 for some directions s.
    a = np.array([[1.0, 0.9, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 1.0]])
    for angle in np.linspace(0.0, 2.0 * np.pi, 17):
        b = np.array([1.0, 3.0 * np.cos(angle), 3.0 * np.sin(angle)])
        problem = lv.Problem.contact(a, b, [2.0])
        solution = lv.solve(problem, "block_gauss_seidel", tol=1e-12)
        assert solution.success
        assert solution.iterations == 1
        assert solution.work["fallbacks"] == 0


@pytest.mark.parametrize("n", [2, 3, 4, 6])
def test_boxed_rows_against_enumeration(n):
    rng = np.random.default_rng(7 + n)
    cases = 200 if n < 6 else 30
    g = rng.standard_normal((cases, n, n))
    w = np.ascontiguousarray(g @ g.transpose(0, 2, 1) + 0.1 * np.eye(n))
    b = rng.standard_normal((cases, n))
    low = np.where(rng.random((cases, n)) < 0.3, -np.inf, -rng.uniform(0.0, 0.5, (cases, n)))
    high = np.where(rng.random((cases, n)) < 0.3, np.inf, rng.uniform(0.0, 0.5, (cases, n)))
    lam = np.zeros((cases, n))
    step = np.ascontiguousarray(1.0 / np.einsum("nii->ni", w))
    found = gauss_seidel.solve_boxed(w, np.ascontiguousarray(-b), step, low, high, lam)
    assert np.all(found == 1)
    for i in range(cases):
        ((x, _),) = enumerate_lcp(w[i], b[i], low[i], high[i])  # positive definite: one
        np.testing.assert_allclose(lam[i], x, atol=1e-9 * np.abs(x).max() + 1e-12)  # condition 1e3 of W


def test_dependent_rows_of_a_joint_are_solved():
    # A redundant row twice in one block, and a block that contradicts itself: the best of it, finite.
    a = np.array([[2.0, 2.0, 0.3], [2.0, 2.0, 0.3], [0.3, 0.3, 1.0]])
    cones = lv.Cones(
        np.array([0, 3]), np.zeros(1, int), np.full(3, -np.inf), np.full(3, np.inf), [0.0], [0.0]
    )
    solution = lv.solve(lv.Problem(np.array([1.0, 1.0, 0.5]), cones, a), "block_gauss_seidel", tol=1e-12)
    assert solution.success
    contradiction = lv.solve(lv.Problem(np.array([1.0, 2.0, 0.5]), cones, a), "block_gauss_seidel")
    assert np.isfinite(contradiction.impulse).all()
    assert not contradiction.success
    assert contradiction.work["fallbacks"] > 0


def test_blocks_of_many_rows_are_swept_row_by_row_and_counted():
    rng = np.random.default_rng(8)
    m = 12
    g = rng.standard_normal((m, 2 * m))
    a = g @ g.T
    cones = lv.Cones(np.array([0, m]), np.zeros(1, int), np.zeros(m), np.full(m, np.inf), [0.0], [0.0])
    problem = lv.Problem(rng.standard_normal(m), cones, a)
    solution = lv.solve(problem, "block_gauss_seidel", tol=1e-10, max_iter=20_000)
    assert solution.success
    assert solution.work["fallbacks"] == solution.iterations


#: Cones of one contact of each kind, of friction mu and an arm [m] for what turns.
ALONE = {
    "disk": lambda mu, arm: lv.Cones.contacts(mu),
    "spin": lambda mu, arm: lv.Cones.contacts(mu, patch_radius=arm),
    "box": lambda mu, arm: lv.Cones.contacts([(mu, 2.0 * arm)], shape="box"),
    "ellipse": lambda mu, arm: lv.Cones.contacts([(mu + 0.1, 0.3)]),
    "rolling": lambda mu, arm: lv.Cones.contacts(mu, rolling=arm),
    "rolling and spin": lambda mu, arm: lv.Cones.contacts(mu, patch_radius=0.2, rolling=arm),
    "round": lambda mu, arm: lv.Cones.contacts(mu, 5),
}


@pytest.mark.parametrize("law", ["coulomb", "cone"])
@pytest.mark.parametrize("kind", ALONE)
@given(seed=seeds)
@settings(max_examples=60)
def test_one_contact_alone_is_solved_to_rounding_by_one_sweep(kind, law, seed):
    rng = np.random.default_rng(seed)
    cones = ALONE[kind](rng.choice([0.0, 0.05, 0.6, 2.0]), rng.choice([0.0, 0.01, 0.3]))
    g = rng.normal(size=(cones.n_rows, cones.n_rows + int(rng.integers(0, 4))))
    law = "cone" if kind == "round" else law
    problem = lv.Problem(rng.normal(size=cones.n_rows), cones, g @ g.T, friction=law)
    found = lv.solve(problem, "block_gauss_seidel", tol=0.0, max_iter=1)
    if found.work["fallbacks"]:  # Newton's method did not end; Coulomb's law may then have several answers
        assert law == "coulomb"
    else:
        assert found.residual.nothing_to_do or found.residual.relative <= max(
            1e-9, 4.0 * found.residual.floor
        )


def test_a_bounded_joint_takes_one_sweep():
    problem = random_contact_problem(13, contacts=0, joints=1, bodies=2)
    solution = lv.solve(problem, "block_gauss_seidel", tol=1e-12)
    assert solution.success
    assert solution.iterations == 1
