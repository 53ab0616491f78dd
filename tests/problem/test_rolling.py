"""Contacts that resist rolling: what they are, how they are judged, saved and solved."""

import itertools
import pickle

import numpy as np
import pytest
from hypothesis import assume, given, settings
from random_problems import as_matrix, random_contact_problem, seeds

import lavender as lv
from lavender import registry
from lavender.certificates import check_certificate
from lavender.measures import siconos_error
from lavender.motion.unique import uniqueness

TAKES = [n for n in lv.available(law="coulomb") if registry.specs()[n].rolling]
CONVEX = [n for n in lv.available(law="cone") if registry.specs()[n].rolling]


def general(problem):
    """The same problem by J and M."""
    minv = problem.rows.inverse_mass_matrix().toarray()
    return lv.Problem.from_jacobian(
        problem.jacobian, np.linalg.inv(minv), problem.rows.v_free.ravel(),
        target=problem.b + problem.jacobian @ problem.rows.v_free.ravel(), cones=problem.cones,
        compliance=problem.compliance, friction=problem.friction,
    )  # fmt: skip


def soft_problem(seed, law, spin=True, **sizes):
    """With compliance on every row: A is definite, and sweeps converge."""
    base = random_contact_problem(seed, law, spin=spin, rolling=True, **sizes)
    return lv.Problem(base.b, base.cones, rows=base.rows, compliance=base.compliance + 0.3, friction=law)


GIVEN = {"rows": lambda p: p, "matrix": as_matrix, "generalized": general}


def parts_of(problem, i):
    """(rows within the block, bound over lambda_n) of what a block bounds together, after its normal."""
    c = problem.cones
    size, mu = int(np.diff(c.ptr)[i]), c.mu[i]
    found = [([1, 2], mu)]
    if size == 6:
        found.append(([3], mu * c.patch_radius[i]))
    return [*found, ([size - 2, size - 1], c.rolling[i])]


def nearest(y, parts):
    """Projection on |y_g| <= a_g y_n by search over the normal part: the distance is convex in it."""

    def distance(s):
        return (s - y[0]) ** 2 + sum(max(0.0, np.linalg.norm(y[r]) - a * s) ** 2 for r, a in parts)

    low, high = 0.0, 4.0 * np.abs(y).sum() + 1.0
    for _ in range(200):
        a, b = low + (high - low) / 3.0, high - (high - low) / 3.0
        low, high = (a, high) if distance(a) > distance(b) else (low, b)
    out = y.copy()
    out[0] = 0.5 * (low + high)
    for r, a in parts:
        size = np.linalg.norm(y[r])
        if size > a * out[0]:
            out[r] = y[r] * (a * out[0] / size)
    return out


def twin(problem, lam):
    """(E, V) of contacts with rolling alone, dense and slow."""
    a, c = problem.dense(), problem.cones
    w = a @ lam - problem.b
    energy, fastest = 0.0, 0.0
    for i in range(c.n_blocks):
        at = np.arange(c.ptr[i], c.ptr[i + 1])
        parts = parts_of(problem, i)
        d = np.diag(a)[at].copy()
        for r, _ in parts:
            d[r] = d[r].mean()
        nu = d.copy()
        nu[3:] = d[0]
        y = lam[at] - w[at] / d
        if problem.law == "cone":
            root = np.sqrt(d)
            scaled = [(r, bound * root[r[0]] / root[0]) for r, bound in parts]
            e = lam[at] - nearest(root * y, scaled) / root
        else:
            e = lam[at] - np.concatenate([[max(0.0, y[0])], y[1:]])
            for r, bound in parts:
                most, size = bound * max(0.0, lam[at][0]), np.linalg.norm(y[r])
                if size > most:
                    e[r] = lam[at][r] - y[r] * (most / size)
        energy += np.sum(d * e * e)
        fastest = max(
            fastest, *(np.sqrt(nu[r[0]] * d[r[0]]) * np.linalg.norm(e[r]) for r, _ in [([0], 0), *parts])
        )
    return np.sqrt(energy), fastest


@pytest.mark.parametrize("law", ["coulomb", "cone"])
@pytest.mark.parametrize("spin", [False, True])
@given(seed=seeds)
@settings(max_examples=30)
def test_the_judge_equals_a_dense_twin_in_every_form(law, spin, seed):
    problem = random_contact_problem(seed, law, spin=spin, rolling=True, joints=0)
    lam = np.random.default_rng(seed + 1).normal(size=problem.m)
    energy, velocity = twin(problem, lam)
    # The twin of the cone finds its projection by search: to the square root of rounding of a minimum.
    rtol = 1e-6 if law == "cone" else 1e-11
    for given_by in GIVEN.values():
        found = lv.residual(given_by(problem), lam)
        np.testing.assert_allclose([found.energy, found.velocity], [energy, velocity], rtol=rtol)


@given(seed=seeds)
def test_rows_matrix_and_generalised_coordinates_have_one_slack_and_one_jacobian(seed):
    problem = random_contact_problem(seed, rolling=True, spin=bool(seed % 2))
    lam = np.random.default_rng(seed).normal(size=problem.m)
    jac = problem.jacobian.toarray()
    a = jac @ problem.rows.inverse_mass_matrix().toarray() @ jac.T + np.diag(problem.compliance)
    size = np.abs(a) @ np.abs(lam) + np.abs(problem.b)
    for given_by in GIVEN.values():
        # 1e-12: of some dozen terms, one form with M and its inverse.
        np.testing.assert_allclose(given_by(problem).slack(lam), a @ lam - problem.b, atol=1e-12 * size.max())
    c = problem.cones
    i = c.n_blocks - 1
    names = [problem.row_name(k) for k in range(c.ptr[i], c.ptr[i + 1])]
    assert [n.rsplit(", ")[1] for n in names[-2:]] == ["roll 1", "roll 2"]
    assert ("spin" in names[3]) == bool(seed % 2)


@pytest.mark.parametrize("given_by", sorted(GIVEN))
@pytest.mark.parametrize("name", TAKES)
@given(seed=seeds)
@settings(max_examples=4)
def test_every_solver_that_takes_rolling_solves_it(name, given_by, seed):
    spec = registry.get(name)
    problem = soft_problem(seed, "coulomb", spin=bool(seed % 2))
    asked = GIVEN[given_by](problem)
    if spec.refuses(asked):
        assert name in ("sequential_impulses",), spec.refuses(asked)
        return
    found = lv.solve(asked, name, tol=1e-8, max_iter=20_000 if spec.resumable else None)
    assert found.success, str(found)
    assert not found.contradicted


@pytest.mark.parametrize("given_by", sorted(GIVEN))
@pytest.mark.parametrize("name", CONVEX)
@given(seed=seeds)
@settings(max_examples=4)
def test_the_cone_law_has_one_velocity_whoever_solves_it(name, given_by, seed):
    """Clarabel, another project's conic solver, among them, in impulses and in velocities."""
    spec = registry.get(name)
    problem = soft_problem(seed, "cone", spin=bool(seed % 2))
    best = lv.solve(problem, "block_gauss_seidel", tol=1e-11, max_iter=50_000)
    assume(best.success)
    asked = GIVEN[given_by](problem)
    if spec.refuses(asked):
        return
    found = lv.solve(asked, name, tol=1e-9, max_iter=20_000 if spec.resumable else None)
    if not spec.external:
        assert found.success, str(found)
    # w is unique; an error e moves it by at most A e, and backends of others end near 1e-8.
    size = np.abs(problem.slack(problem.start())).max()
    np.testing.assert_allclose(found.slack, best.slack, atol=(1e-4 if spec.external else 1e-6) * size)


def test_whoever_does_not_take_rolling_says_so():
    for law in ("coulomb", "cone"):
        problem = soft_problem(3, law)
        for name, reason in lv.known(problem).items():
            spec = registry.specs()[name]
            if problem.law in spec.laws and not spec.rolling:
                assert reason and ("rolling" in reason or "pip install" in reason), (name, reason)
    with pytest.raises(lv.CapabilityError):
        lv.solve(soft_problem(3, "coulomb"), "lemke")


@pytest.mark.parametrize("law", ["coulomb", "cone"])
@pytest.mark.parametrize("spin", [False, True])
@given(seed=seeds)
@settings(max_examples=60)
def test_one_contact_alone_is_solved_to_rounding_by_one_sweep(law, spin, seed):
    rng = np.random.default_rng(seed)
    n = 5 + spin
    g = rng.normal(size=(n, n + int(rng.integers(0, 4))))
    mu, reach = rng.choice([0.0, 0.05, 0.6, 2.0]), rng.choice([0.0, 0.01, 0.3])
    cones = lv.Cones.contacts(mu, patch_radius=0.2 if spin else None, rolling=reach)
    problem = lv.Problem(rng.normal(size=n), cones, g @ g.T, friction=law)
    found = lv.solve(problem, "block_gauss_seidel", tol=0.0, max_iter=1)
    if found.work["fallbacks"] == 0:
        assert found.residual.relative <= max(1e-9, 4.0 * found.residual.floor), str(found)
    else:  # Newton's method did not end; Coulomb's law may then have several answers, and sweeps go on
        assert law == "coulomb"


def test_contacts_alone_seldom_fall_back():
    """Of 400 single contacts of either law in nineteen of twenty Newton's method ends."""
    rng = np.random.default_rng(5)
    for law in ("coulomb", "cone"):
        fell = 0
        for _ in range(400):
            g = rng.normal(size=(5, 7))
            cones = lv.Cones.contacts(rng.uniform(0.05, 1.0), rolling=rng.uniform(0.01, 0.5))
            problem = lv.Problem(rng.normal(size=5), cones, g @ g.T, friction=law)
            fell += lv.solve(problem, "block_gauss_seidel", tol=0.0, max_iter=1).work["fallbacks"]
        assert fell <= 20, (law, fell)


@pytest.mark.parametrize(("speed", "held"), [(1e-3, True), (1.0, False)])
def test_a_ball_that_rolls_loses_what_the_moment_takes(speed, held):
    """In a step h: held where mu_r N h is enough, else the spin falls by mu_r N h / (7/5 m R^2) and v follows it."""
    radius, mass, h, reach, g = 0.5, 2.0, 1 / 120, 0.02, 9.81
    inertia = 0.4 * mass * radius**2
    rows = lv.Rows(
        inv_mass=[1 / mass], inv_inertia=[np.eye(3) / inertia],
        v_free=[[speed, 0.0, -g * h, 0.0, speed / radius, 0.0]], contact_body=[(-1, 0)], normal=[(0.0, 0.0, 1.0)],
        tangent=[(1.0, 0.0, 0.0)], arm_a=[(0.0, 0.0, 0.0)], arm_b=[(0.0, 0.0, -radius)],
    )  # fmt: skip
    problem = lv.Problem.from_rows(rows, mu=0.5, rolling=reach)
    for name in TAKES:
        if registry.get(name).refuses(problem) or registry.specs()[name].external:
            continue
        v = problem.velocity(lv.solve(problem, name, tol=1e-12, max_iter=20_000).impulse)[0]
        slower = reach * mass * g * h / (inertia + mass * radius**2)
        turned = 0.0 if held else speed / radius - slower
        np.testing.assert_allclose([v[4], v[0], v[2]], [turned, radius * turned, 0.0], atol=1e-9)


def test_no_velocity_is_found_infeasible_or_not_alike():
    """b along the normal's own push beyond any cone: rows of A that are zero but for the normal's offset."""
    cones = lv.Cones.contacts(0.5, rolling=0.1)
    problem = lv.Problem(np.array([1.0, 0, 0, 0, 0]), cones, np.zeros((5, 5)), friction="cone")
    assert check_certificate(problem, np.array([1.0, 0.1, 0.0, 0.05, 0.0])) is None
    reason = check_certificate(problem, np.array([1.0, 0.0, 0.0, 0.08, 0.08]))
    assert reason and "cone" in reason


@pytest.mark.parametrize("name", ["pgs", "sequential_impulses"])
def test_threads_and_forms_keep_the_bits(name):
    problem = soft_problem(11, "coulomb", bodies=40, contacts=150, joints=0)
    asked = as_matrix(problem) if name == "pgs" else problem
    one, two = (
        lv.solve(asked, name, tol=0.0, max_iter=30, order="colored", threads=k).impulse for k in (1, 2)
    )
    np.testing.assert_array_equal(one, two)
    # Sweeps over rows and over A are the same to rounding of thirty sweeps.
    np.testing.assert_allclose(
        lv.solve(problem, "sequential_impulses", tol=0.0, max_iter=30).impulse,
        lv.solve(as_matrix(problem), "pgs", tol=0.0, max_iter=30).impulse, atol=1e-11,
    )  # fmt: skip


def test_without_a_moment_it_is_the_contact_it_was():
    """mu_r = 0: the same impulses as without the rows, bit for bit from sweeps."""
    problem = soft_problem(17, "coulomb", joints=0)
    c = problem.cones
    still = lv.Cones(c.ptr, c.kind, c.lower, c.upper, c.mu, c.patch_radius)
    plain = lv.Cones.contacts(c.mu, patch_radius=c.patch_radius)
    keep = np.concatenate([np.arange(j, j + 4) for j in c.ptr[:-1]])
    rolling = lv.Problem(problem.b, still, rows=problem.rows, compliance=problem.compliance)
    without = lv.Problem(problem.b[keep], plain, rows=problem.rows, compliance=problem.compliance[keep])
    a, b = (lv.solve(p, "sequential_impulses", tol=0.0, max_iter=20).impulse for p in (rolling, without))
    np.testing.assert_array_equal(a[keep], b)
    for name in ("newton", "anderson", "nncg", "admm"):
        found = lv.solve(rolling, name, tol=1e-9, max_iter=20_000)
        assert found.success, str(found)
        rest = np.setdiff1d(np.arange(problem.m), keep)
        assert not found.impulse[rest].any(), name


def test_the_motion_error_of_a_wrong_answer_lies_within_its_bound():
    problem = soft_problem(29, "cone", joints=0)
    exact = lv.solve(problem, "newton", tol=1e-12)
    rough = lv.solve(problem, "block_gauss_seidel", tol=0.0, max_iter=3)
    error = lv.motion_error(problem, rough.impulse)
    moved = problem.velocity(rough.impulse) - problem.velocity(exact.impulse)
    np.testing.assert_allclose(error.speed, np.linalg.norm(moved[:, :3], axis=1).max(), rtol=1e-6)
    assert error.bound is None or error.kinetic <= error.bound * (1 + 1e-12)


def test_where_one_motion_is_proven_starts_find_no_other():
    """Small friction and a small moment: one motion by the criterion; with much of both each one found is one."""
    rng = np.random.default_rng(3)
    g = rng.normal(size=(10, 12))
    a, b = g @ g.T + 2.0 * np.eye(10), rng.normal(size=10)
    few = lv.Problem(b, lv.Cones.contacts(0.01, rolling=0.01, count=2), a)
    assert uniqueness(few)
    assert not uniqueness(lv.Problem(b, lv.Cones.contacts(0.01, rolling=5.0, count=2), a))
    assert len(lv.motions(few)) == 1
    for motion in lv.motions(lv.Problem(b, lv.Cones.contacts(2.0, rolling=3.0, count=2), a)):
        assert motion.reference.residual.relative <= 1e-9


def test_siconos_error_is_zero_at_the_solution_alone():
    problem = as_matrix(soft_problem(31, "coulomb", spin=False, joints=0))
    found = lv.solve(problem, "newton", tol=1e-12)
    assert siconos_error(problem, found.impulse)["relative"] < 1e-10
    assert siconos_error(problem, found.impulse + 0.01)["relative"] > 1e-3


@pytest.mark.parametrize("given_by", sorted(GIVEN))
def test_saved_and_loaded_to_the_bit(given_by, tmp_path):
    problem = GIVEN[given_by](soft_problem(37, "coulomb"))
    path = tmp_path / "rolling.npz"
    lv.io.save(problem, path)
    assert lv.load(path) == problem
    assert pickle.loads(pickle.dumps(problem.cones)) == problem.cones


CONTACTS = lv.Cones.contacts(0.5, rolling=0.1, count=2)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: lv.Cones.contacts(0.5, rolling=-0.1), "rolling.*-0.1"),
        (lambda: lv.Cones.contacts(0.5, rolling=np.nan), "rolling"),
        (lambda: lv.Cones.contacts(0.5, 1, rolling=0.1), "tangents=2"),
        (lambda: lv.Cones.contacts(0.5, 5, rolling=0.1), "round cone"),
        (lambda: lv.Cones.contacts([0.5, 0.5], rolling=[0.1]), "rolling"),
        (
            lambda: lv.Cones([0, 4], [lv.CONTACT_ROLLING], np.zeros(4), np.ones(4), [0.5], [0.0], [0.1]),
            "5 rows or 6",
        ),
        (
            lambda: lv.Cones([0, 5], [lv.CONTACT_ROLLING], np.zeros(5), np.ones(5), [0.5], [0.0], [-1.0]),
            "rolling.*-1",
        ),
    ],
)
def test_what_is_no_rolling_contact_is_told(make, words):
    with pytest.raises(lv.InputError, match=words):
        make()


def test_cones_join_restrict_and_project():
    both = CONTACTS + lv.Cones.contacts(0.3, patch_radius=0.1, rolling=0.2) + lv.Cones.free(1)
    assert both.has_rolling and both.n_tangents.tolist() == [2, 2, 2, 0]
    assert both.rolling_rows.tolist() == [3, 8, 14, -1]
    assert both.spin_rows.tolist() == [-1, -1, 13, -1]
    assert both.rolling.tolist() == [0.1, 0.1, 0.2, 0.0]
    x = lv.cones.project(both, np.ones(both.n_rows))
    for i, j in itertools.product(range(3), range(1)):
        r = both.rolling_rows[i]
        np.testing.assert_allclose(np.hypot(x[r + j], x[r + 1]), both.rolling[i])
