"""The judge against a NumPy twin that shares nothing with it, and the laws its numbers must obey."""

import judge_twin
import numpy as np
import pytest
from drawn_worlds import draw_worlds
from hypothesis import given
from hypothesis import strategies as st
from judge_twin import spec_of
from kkt_truth import parts
from random_problems import (
    CONTACTS,
    FORMS,
    as_matrix,
    random_contact_problem,
    random_generalized_problem,
    seeds,
)

import lavender as lv
from lavender.judge import residuals
from lavender.judge.certificates import check_certificate


def equals_the_twin(problem, lam):
    """Everything the judge says of an impulse, and what it is made of; 1e-9: M and its inverse, roots of many terms."""
    twin = judge_twin.Problem(spec_of(problem))
    found = lv.residual(problem, lam)
    close = 1e-9 if problem.operator == "generalized" else 1e-12
    np.testing.assert_allclose(problem.disk.d, twin.d.astype(float), rtol=close)
    np.testing.assert_allclose(problem.disk.metric.nu, twin.nu.astype(float), rtol=close)
    x = lam / twin.stretch
    w = twin.slack(x)
    e = twin.error(x, w)
    size = (twin.size @ np.abs(x) + twin.b_size).astype(float)
    np.testing.assert_allclose(found.slack * twin.stretch, w, rtol=0, atol=close * size.max())
    np.testing.assert_allclose(found.error, twin.stretch * e, rtol=0, atol=1e-10 * np.abs(e).max())
    said = twin.judge(lam)
    np.testing.assert_allclose(
        [found.energy, found.velocity], [said.energy, said.velocity], rtol=1e-9
    )
    speeds = twin.speeds(e)
    assert speeds[found.worst_row] == pytest.approx(float(speeds.max()), rel=1e-9)
    for impulse in (lam, lv.solve(problem, tol=1e-9).impulse):
        found = lv.residual(problem, impulse, tol=0.0)
        said = twin.judge(impulse)
        first = min(said.unrefined, 0.1 * said.relative)  # of a pass that need not be refined
        assert abs(found.relative - said.relative) <= 1e-9 * said.relative + said.allowed + first
        # The floor takes absolute products of three factors; sizes of arms stand for those of their products here.
        assert (
            0.1 * found.roundoff_floor
            <= said.floors[max(found.worst_island, 0)]
            <= 100.0 * found.roundoff_floor
        )


@pytest.mark.parametrize("friction", ["coulomb", "cone"])
@pytest.mark.parametrize("kind", CONTACTS)
@given(seed=seeds)
def test_the_judge_equals_its_twin_in_every_form(kind, friction, seed):
    base = CONTACTS[kind](seed, friction)
    lam = np.random.default_rng(seed + 1).normal(size=base.m)
    for given_by in FORMS.values():
        equals_the_twin(given_by(base), lam)


@given(seed=seeds, tangents=st.integers(1, 5), soft=st.booleans())
def test_the_judge_equals_its_twin_on_round_cones(seed, tangents, soft):
    problem = random_generalized_problem(seed, "cone", tangents=tangents, compliance=soft)
    lam = np.random.default_rng(seed).normal(size=problem.m)
    for p in (problem, as_matrix(problem)):
        equals_the_twin(p, lam)


@pytest.mark.parametrize("seed", range(18))
def test_the_judge_equals_its_twin_in_all_units_and_ranges(seed):
    """Random impulses, none, a solution and one near it; the references of problems at rest are in these residuals."""
    rng = np.random.default_rng(seed)
    for world in draw_worlds(
        seed, 8, ("lcp", "coulomb", "cone")[seed % 3], precision=("f8", "f8", "f8")
    ):
        problem = world.make_problem()
        twin = judge_twin.Problem(spec_of(problem))
        solved = lv.solve(problem, tol=1e-9).impulse
        near = solved * (1.0 + 1e-5 * rng.normal(size=problem.m))
        # At b = 0, page and judge differ on impulses beyond the bounds of rows that no impulse moves.
        anywhere = np.where(
            world.jac.any(axis=1), rng.normal(size=problem.m) / problem.d, problem.start()
        )
        for lam in (anywhere, problem.start(), solved, near):
            found = lv.residual(problem, lam, tol=0.0)
            said = twin.judge(lam)
            if said.nothing:  # Near the line below which the terms of b stand in.
                continue
            first = min(said.unrefined, 0.1 * said.relative)
            if (
                found.relative != said.relative
            ):  # Both are infinite if a row at rest without terms is moved.
                assert (
                    abs(found.relative - said.relative)
                    <= 1e-9 * said.relative + said.allowed + first
                ), world.choice
            if found.relative == 0.0:  # Of any island.
                continue
            # Not 100 times below the twin's floor, nor above what the condition of M explains.
            at = int(np.argmax(said.relatives))
            assert said.floors[at] <= 100.0 * found.roundoff_floor, world.choice
            assert 0.1 * found.roundoff_floor <= said.floors_most[at], world.choice


def error_of_the_pass(problem, lam):
    """How far the judge's slack is from the exact one, as a relative residual, over its floor."""
    found = lv.residual(problem, lam)
    twin = judge_twin.Problem(spec_of(problem))
    lost = np.abs(found.slack * twin.stretch - twin.slack(lam / twin.stretch))
    energy = np.sqrt((lost**2 / twin.d).sum()) / found.energy_at_zero
    velocity = (lost * np.sqrt(twin.nu / twin.d)).max() / found.velocity_at_zero
    return float(max(energy, velocity)) / found.roundoff_floor


@pytest.mark.parametrize("m", [10, 100, 400])
@pytest.mark.parametrize("sign", [0.0, 1.0])
def test_floor_of_long_matrix_rows_grows_with_their_length(m, sign):
    """Twice: floors are sums of one rounding for each term, and long sums round once for each partial sum."""
    for seed in range(3 if m < 400 else 1):
        rng = np.random.default_rng(seed)
        a = rng.random((m, m)) - 0.5 * (1.0 - sign)
        a = a + a.T + m * np.eye(m)
        lam = np.abs(rng.normal(size=m))
        assert error_of_the_pass(lv.Problem.lcp(a, a @ lam), lam) <= 3.0


@pytest.mark.parametrize("friction", ["coulomb", "cone"])
@given(seed=seeds)
def test_floor_over_bodies_counts_their_rounding(friction, seed):
    problem = random_contact_problem(seed, friction, bodies=8, joints=4, contacts=20)
    for tol in (1e-3, 1e-12):
        assert error_of_the_pass(problem, lv.solve(problem, tol=tol).impulse) <= 3.0


@given(seed=seeds, kind=st.sampled_from(sorted(CONTACTS)))
def test_every_form_has_one_matrix_one_slack_and_one_velocity(seed, kind):
    problem = CONTACTS[kind](seed)
    lam = np.random.default_rng(seed).normal(size=problem.m)
    jac = problem.jacobian.toarray()
    minv = problem.rows.inverse_mass_matrix().toarray()
    a = jac @ minv @ jac.T + np.diag(problem.compliance)
    free = problem.rows.v_free.ravel()
    # 1e-13 of the size of what is added: a few roundings on a few dozen terms, of J and M those of M and its inverse.
    for form, given_by in FORMS.items():
        p = given_by(problem)
        atol = 1e-11 if form == "J and M" else 1e-13
        np.testing.assert_allclose(
            p.slack(lam), a @ lam - p.b, atol=atol * np.abs(a).sum() * np.abs(lam).max()
        )
        np.testing.assert_allclose(p.dense(), a, atol=atol * np.abs(a).max())
        assert p.csr.has_canonical_format
        np.testing.assert_array_equal(p.dense(), p.dense().T)
        if form != "matrix":
            np.testing.assert_allclose(
                p.velocity(lam).ravel(), free + minv @ jac.T @ lam, atol=10 * atol
            )
            work = lam @ (jac @ free + 0.5 * (jac @ minv @ jac.T @ lam))
            size = np.abs(lam) @ (np.abs(jac) @ np.abs(free) + np.abs(a) @ np.abs(lam))
            assert p.energy_change(lam) == pytest.approx(work, abs=100 * atol * size)


@given(seed=seeds)
def test_energy_change_is_the_difference_of_kinetic_energies(seed):
    problem = random_contact_problem(seed)
    problem = FORMS["J and M"](problem)
    lam = np.random.default_rng(seed).normal(size=problem.m)
    general = problem.generalized
    before, after = (
        0.5 * v @ general.momentum_of(v) for v in (general.v_free, problem.velocity(lam))
    )
    # Both energies are sums of a few dozen products, with a solve with M before them.
    assert problem.energy_change(lam) == pytest.approx(after - before, abs=1e-10 * (before + after))


@given(seed=seeds)
def test_energy_change_of_a_solution_without_targets_is_not_positive(seed):
    problem = random_contact_problem(seed)
    free = problem.generalized if problem.rows is None else problem.rows
    problem = lv.Problem.from_jacobian(
        problem.jacobian,
        np.linalg.inv(problem.rows.inverse_mass_matrix().toarray()),
        free.v_free.ravel(),
        cones=problem.cones,
        compliance=problem.compliance,
    )
    solution = lv.solve(problem, tol=1e-9)
    before = (
        0.5
        * problem.generalized.v_free
        @ problem.generalized.momentum_of(problem.generalized.v_free)
    )
    assert solution.success and problem.energy_change(solution.impulse) <= 1e-8 * before


def test_diagonal_of_zero_or_negative_entries_uses_the_largest_of_the_row():
    a = np.array([[0.0, 3.0, 0.0], [3.0, -1.0, 0.0], [0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(lv.Problem.lcp(a, np.zeros(3)).d, [3.0, 3.0, 3.0])
    tiny = np.array([[1e-12, 1.0], [1.0, 2.0]])
    np.testing.assert_array_equal(lv.Problem.lcp(tiny, np.zeros(2)).d, [1.0, 2.0])
    np.testing.assert_array_equal(lv.Problem.lcp(np.zeros((2, 2)), np.zeros(2)).d, [1.0, 1.0])
    pair = lv.Problem.contact(np.diag([1.0, 1.0, 10.0]), np.zeros(3), [0.5])
    np.testing.assert_array_equal(pair.d, [1.0, 5.5, 5.5])


def test_residual_of_an_impulse_that_is_not_finite_is_infinite():
    for friction in ("coulomb", "cone"):
        problem = random_contact_problem(1, friction)
        for bad in (np.nan, np.inf, -np.inf):
            for row in range(problem.m):
                lam = np.zeros(problem.m)
                lam[row] = bad
                assert lv.residual(problem, lam).relative == np.inf, (friction, bad, row)
                assert lv.residual(problem, lam, "float32").relative == np.inf, (friction, bad, row)


@given(seed=seeds)
def test_floor_bounds_the_rounded_exact_solution(seed):
    """A solution in long double, rounded to float64, scores at most twice the floor, and not far below it."""
    rng = np.random.default_rng(seed)
    m = 12
    scale = 10.0 ** rng.uniform(-3, 3, m)
    g = rng.normal(size=(m, m)) * scale[:, None]
    a = np.round(g @ g.T, 12)
    a = (a + a.T) / 2 + np.diag(scale**2)
    b = rng.normal(size=m) * scale
    x = np.linalg.solve(a, b)
    la, lb, exact = a.astype(np.longdouble), b.astype(np.longdouble), x.astype(np.longdouble)
    for _ in range(20):  # refinement: each step gains the digits of the float64 factorisation
        exact += np.linalg.solve(a, (lb - la @ exact).astype(float))
    judged = lv.residual(lv.Problem.linear(a, b), exact.astype(float))
    assert judged.relative <= 2.0 * judged.roundoff_floor
    assert judged.roundoff_floor <= 1e-6


@pytest.mark.parametrize("law", ["coulomb", "cone"])
@pytest.mark.parametrize("kind", ["bounded rows", "normals", *CONTACTS])
@given(seed=seeds)
def test_certificate_check_equals_its_twin(kind, law, seed):
    """A y = 0, or not; y a tenth off the border of its cone to either side, or along normals alone."""
    rng = np.random.default_rng(seed)
    if kind == "bounded rows":
        low = np.where(rng.random(8) < 0.5, 0.0, -np.inf)
        cones = lv.Cones.bounded(low, np.where(rng.random(8) < 0.8, np.inf, 5.0))
        y = np.where(low == 0.0, np.abs(rng.normal(size=8)), rng.normal(size=8)) * (
            rng.random(8) < 0.7
        )
    else:
        normals = lv.Cones.contacts([0.0, 0.0], 0)
        made = kind != "normals" and CONTACTS[kind](seed, law, bodies=3, joints=0, contacts=2)
        cones = made.cones if made else normals
        share = rng.choice([0.0, 0.9, 1.1])
        y = np.zeros(cones.n_rows)
        y[cones.normal_rows] = rng.uniform(0.1, 1.0, 2)
        for i, (rows, _) in ((k, part) for k in range(2) for part in parts(cones, k)):
            way = rng.normal(size=len(rows))
            y[rows] = (
                share
                * y[cones.ptr[i]]
                * cones.friction_coefficient[rows]
                * way
                / np.linalg.norm(way)
            )
    y = y * rng.choice([1.0, 1.0, 1.0, -1.0])
    m = len(y)
    g = rng.normal(size=(len(y), len(y)))
    off = rng.random() < 0.8
    for _ in range(
        2
    ):  # once leaves rounding of what was there, much of a row that y takes nearly all of
        g -= np.outer(y, y @ g) / max(y @ y, 1e-9) * off
    b = rng.normal(size=m)
    b += y * (rng.choice([0.5, 0.5, -0.5]) - b @ y) / max(y @ y, 1e-9)
    problem = lv.Problem(b, cones, g @ g.T, friction=law)
    reason = judge_twin.Problem(spec_of(problem)).refutes(y)
    assert (check_certificate(problem, y) is None) == (reason is None), reason


def test_solve_at_rest_converges_without_iterations():
    a = np.diag([1.0, 2.0])
    for b, nothing in (
        ([-1.0, -2.0], True),  # separating: zero is the solution
        ([1e-10, -1.0], True),  # below a nanometre per second
        ([2e-9, -1.0], False),
        ([1.0, 0.0], False),
    ):
        p = lv.Problem.lcp(a, b)
        assert residuals.is_solved_by_zero(p) is nothing
        assert lv.residual(p, [0.0, 0.0]).nothing_to_do is nothing
    # In the unit of speed, whatever the masses: V0 is a velocity.
    assert residuals.is_solved_by_zero(lv.Problem.lcp(1e12 * a, [1e-10, -1.0]))
    assert not residuals.is_solved_by_zero(lv.Problem.lcp(1e-12 * a, [2e-9, -1.0]))
    # Doing nothing is zero clipped to the bounds.
    assert residuals.is_solved_by_zero(lv.Problem.lcp(a, [0.0, 0.0], lower=1.0))
    assert not residuals.is_solved_by_zero(lv.Problem.lcp(a, [0.0, 5.0], lower=1.0))
    assert residuals.is_solved_by_zero(lv.Problem.lcp(np.zeros((0, 0)), []))


@pytest.mark.parametrize("friction", ["coulomb", "cone"])
@given(seed=seeds)
def test_floor_bounds_the_rounded_slider_between_tangents_of_unlike_mass(friction, seed):
    """It slides along the light one: A lambda says nothing of the impulse's own rounding, which d makes a velocity."""
    rng = np.random.default_rng(seed)
    normal, light, mu, b = rng.uniform(0.5, 2.0, 4).astype(np.longdouble)
    d = np.diag([normal, 10.0 ** rng.uniform(0.0, 12.0), light]).astype(float)
    push = 4.0 * mu * b * light / normal  # four times what the contact holds
    x = b / normal if friction == "coulomb" else (b + mu * push) / (normal + mu * mu * light)
    problem = lv.Problem.contact(d, np.array([b, 0.0, push], float), [float(mu)], friction=friction)
    exact = np.array([x, 0.0, mu * x], float)
    judged = lv.residual(problem, exact)
    # A disk: both lambda_t and mu lambda_n are rounded. The projection on a cone rounds in five more operations.
    assert judged.relative <= (2.0 if friction == "coulomb" else 7.0) * judged.roundoff_floor
    if friction == "coulomb":  # a wide cone's nearest point follows the tangents
        off = lv.residual(
            problem, exact * [1.0, 1.0, 1.0 + 2.0**-46]
        )  # by 64 units of the last place
        assert off.relative > 2.0 * off.roundoff_floor


def test_certificate_of_a_sum_within_rounding_is_rejected():
    """A^T y is (0, 0, -2^-53), which impulses of 3e7 N s meet to 1e-9; exact zeros are a proof at the same b.y."""
    y = [1.0, 1.0, -1.0]
    b = np.array([1.0, 0.0, 1.0 - 3e-9])
    for small, proves in ((2.0**-53, False), (0.0, True)):
        a = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, small], [1.0, 1.0, 1.0]])
        for upper in (np.inf, 1e12):
            problem = lv.Problem.lcp(a, b, lower=-np.inf, upper=[np.inf, np.inf, upper])
            assert (check_certificate(problem, y) is None) is proves
        met = np.array([1.0 - 3e-9 * 2.0**53, -3e-9, 3e-9 * 2.0**53])
        if not proves:
            assert lv.residual(problem, met).relative < 2e-9
    for jac, proves in (([[1.0], [-1.0]], True), ([[1.0], [2.0**-30 - 1.0]], False)):
        cones = lv.Cones.bounded([0.0, 0.0], [np.inf, np.inf])
        target = [1.0, -1.0 + 1e-10]
        opposed = lv.Problem.from_jacobian(jac, [[1.0]], [0.0], target=target, cones=cones)
        assert (check_certificate(opposed, [1.0, 1.0]) is None) is proves


def test_residual_with_huge_bounds_counts_the_step():
    # w pushes into a bound on which lambda already sits: no error, however large the bound.
    for bound in (1e6, 1e60):
        problem = lv.Problem.lcp([[0.0, 0.0], [0.0, 1.0]], [1.0, 1.0], -bound, bound)
        assert lv.residual(problem, [bound, 1.0]).relative == 0.0
        assert lv.residual(problem, [-bound, 1.0]).relative > 0.1
        assert lv.solve(problem, "pgs").impulse.tolist() == [bound, 1.0]
