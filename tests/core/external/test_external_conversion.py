"""Problems as convex programs: a solution made by hand satisfies the optimality conditions of both forms."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from random_problems import as_matrix, random_rows

import lavender as lv
from lavender.external.as_qp import impulse_form, pick_form, target, velocity_form

# Residuals of the conditions below are sums of a few dozen products of numbers near 1.
ROUNDING = 1e-11


def solved_problem(seed, mass=1.0):
    """A bounded-row problem with rows and its solution: bounds, impulse and slack are drawn, b follows."""
    rng = np.random.default_rng(seed)
    rows = random_rows(rng, bodies=4, joints=3, contacts=7)
    mj, c = len(rows.jac), rows.n_contacts
    m = mj + c
    kind = rng.integers(0, 5, mj)  # free, lower, upper, both, fixed
    low = np.where((kind == 1) | (kind == 3), -rng.uniform(0.0, 1.0, mj), -np.inf)
    high = np.where((kind == 2) | (kind == 3), rng.uniform(0.0, 1.0, mj), np.inf)
    low[kind == 4] = high[kind == 4] = rng.normal(size=mj)[kind == 4]
    compliance = rng.uniform(0.0, 0.3, m) * (rng.random(m) < 0.5)
    blank = lv.Problem.from_rows(rows, 0.0, lower=low, upper=high, compliance=compliance)
    lower, upper = blank.cones.lower, blank.cones.upper
    lam, w = rng.normal(size=m), np.zeros(m)
    at = rng.random(m)
    on_low = (np.isfinite(lower) & (at < 0.5)) | (lower == upper)
    on_high = np.isfinite(upper) & (at >= 0.5) & (lower < upper) & ((at < 0.75) | ~np.isfinite(lower))
    lam = np.where(on_low, lower, np.where(on_high, upper, lam))
    inside = ~on_low & ~on_high
    span = np.where(np.isfinite(upper - lower), upper - lower, 1.0)
    lam[inside] = np.where(
        np.isfinite(lower), lower + 0.5 * span, np.where(np.isfinite(upper), upper - 0.5, lam)
    )[inside]
    w[on_low] = rng.uniform(0.1, 1.0, m)[on_low]
    w[on_high] = -rng.uniform(0.1, 1.0, m)[on_high]
    w[lower == upper] = rng.normal(size=m)[lower == upper]
    b = blank.csr @ lam - w
    # b = target - J v*, and `blank` has target 0.
    problem = lv.Problem.from_rows(rows, b - blank.b, lower=low, upper=high, compliance=compliance)
    assert lv.residual(problem, lam).relative < 1e-13
    return problem, lam, w


def check_optimality(qp, x, zeta, xi):
    stationarity = qp.P @ x + qp.q + qp.A.T @ zeta + xi
    scale = 1.0 + np.abs(x).max(initial=0.0) + np.abs(zeta).max(initial=0.0)
    assert np.abs(stationarity).max(initial=0.0) <= ROUNDING * scale
    s = qp.b - qp.A @ x
    assert np.abs(s[: qp.n_zero]).max(initial=0.0) <= ROUNDING * scale
    rest = slice(qp.n_zero, None)
    assert s[rest].min(initial=0.0) >= -ROUNDING * scale
    assert zeta[rest].min(initial=0.0) >= -ROUNDING * scale
    assert np.abs(s[rest] * zeta[rest]).max(initial=0.0) <= ROUNDING * scale**2
    if qp.lb is not None:
        assert (x - qp.lb).min(initial=0.0) >= -ROUNDING * scale
        assert (qp.ub - x).min(initial=0.0) >= -ROUNDING * scale


@given(st.integers(0, 10**6))
@settings(max_examples=60)
def test_solutions_satisfy_the_impulse_form(seed):
    problem, lam, w = solved_problem(seed)
    qp = impulse_form(as_matrix(problem))
    x, zeta, xi = qp.start(lam)
    check_optimality(qp, x, zeta, xi)
    assert np.allclose(np.diag(qp.P.toarray()), 1.0, rtol=1e-14)
    assert np.allclose(qp.impulse(x, zeta), lam, rtol=0, atol=ROUNDING)
    # The multiplier of the bounds is the slack, in m/s.
    assert np.allclose(qp.multiplier(x, xi), -w, rtol=0, atol=1e3 * ROUNDING)


@given(st.integers(0, 10**6))
@settings(max_examples=60)
def test_solutions_satisfy_the_velocity_form(seed):
    problem, lam, w = solved_problem(seed)
    qp = velocity_form(problem)
    x, zeta, xi = qp.start(lam)
    # t >= 0 of rows with two bounds: its multiplier takes up the rest of the range.
    if qp.lb is not None:
        bounded = np.isfinite(qp.lb)
        xi[bounded] = -(qp.P @ x + qp.q + qp.A.T @ zeta)[bounded]
        assert xi[bounded].max() <= ROUNDING
    check_optimality(qp, x, zeta, xi)
    assert np.allclose(qp.impulse(x, zeta), lam, rtol=0, atol=1e3 * ROUNDING)
    own = qp.multiplier(x, xi)[qp.kept]
    assert np.allclose(own, -w[qp.kept], rtol=0, atol=1e3 * ROUNDING)


def test_known_rows_are_taken_out():
    a = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 0.0]])
    problem = lv.Problem.lcp(a, [1.0, 1.0, 1.0], lower=[0.0, 0.25, 0.0], upper=[np.inf, 0.25, 3.0])
    qp = impulse_form(problem)
    assert qp.kept.tolist() == [0]  # row 1 has one value, row 2 is decided by b > 0
    assert qp.fixed.tolist() == [0.0, 0.25, 3.0]
    solution = lv.solve(problem, "osqp")
    assert solution.success
    assert np.allclose(solution.impulse, [0.4375, 0.25, 3.0], rtol=1e-6)


def test_friction_without_mu_has_no_cone():
    rng = np.random.default_rng(3)
    rows = random_rows(rng, bodies=3, joints=0, contacts=2)
    problem = lv.Problem.from_rows(rows, mu=[0.0, 0.5], tangents=2, patch_radius=[0.1, 0.0], friction="cone")
    for qp in (impulse_form(problem), velocity_form(problem)):
        assert qp.kept.tolist() == [0, 4, 5, 6]
        assert qp.soc == (3,)


@pytest.mark.parametrize("form", [impulse_form, velocity_form])
def test_units_do_not_reach_the_backend(form):
    # Powers of two change no mantissa: kg x 4, m x 2, s x 8 give the same program to the bit.
    problem, *_ = solved_problem(5)
    r, kg, m, s = problem.rows, 4.0, 2.0, 8.0
    jac = r.jac.copy()
    angular_rows = ~np.any(jac[:, [0, 1, 2, 6, 7, 8]], axis=1)
    jac[:, [3, 4, 5, 9, 10, 11]] *= m
    jac[angular_rows] /= m  # an angular row measures rad/s in either system
    rows = lv.Rows(
        r.inv_mass / kg, r.inv_inertia / (kg * m * m), r.v_free * np.repeat([m / s, 1.0 / s], 3), jac,
        r.joint_ptr, r.joint_body, r.normal, r.tangent, r.arm_a * m, r.arm_b * m, r.contact_body,
    )  # fmt: skip
    mj = len(jac)
    speed = np.full(problem.m, m / s)
    speed[:mj][angular_rows] = 1.0 / s
    push = kg * m * m / (s * s) / speed  # energy / velocity, so that lambda w is an energy
    moved = lv.Problem.from_rows(
        rows,
        speed * (problem.b - lv.Problem.from_rows(r, 0.0).b),
        lower=problem.cones.lower[:mj] * push[:mj],
        upper=problem.cones.upper[:mj] * push[:mj],
        compliance=problem.compliance * speed / push,
    )
    one, two = form(problem), form(moved)
    # The square roots and the mass matrix's eigenvectors round on their own.
    assert np.allclose(one.q, two.q, rtol=1e-10, atol=1e-12)
    assert np.allclose(one.b, two.b, rtol=1e-10, atol=1e-12)
    assert target(problem, 1e-6) == pytest.approx(target(moved, 1e-6), rel=1e-10)


def test_auto_takes_the_form_by_size_mass_ratio_and_backend():
    rng = np.random.default_rng(4)
    rows = random_rows(rng, bodies=5, joints=0, contacts=8)
    small = lv.Problem.from_rows(rows)
    assert pick_form(small, "auto") == "impulse"  # 8 rows, 30 velocities
    assert pick_form(small, "auto", definite=True) == "velocity"
    assert pick_form(as_matrix(small), "auto", definite=True) == "impulse"
    many = lv.Problem.from_rows(random_rows(rng, bodies=2, joints=0, contacts=13))
    assert pick_form(many, "auto") == "velocity"  # 13 rows, 12 velocities
    inv_mass = rows.inv_mass.copy()
    inv_mass[0] /= 1e4
    heavy = lv.Rows(
        inv_mass, rows.inv_inertia, rows.v_free, normal=rows.normal, tangent=rows.tangent,
        arm_a=rows.arm_a, arm_b=rows.arm_b, contact_body=rows.contact_body,
    )  # fmt: skip
    assert pick_form(lv.Problem.from_rows(heavy), "auto") == "velocity"
    with pytest.raises(lv.CapabilityError, match="needs a problem with rows"):
        pick_form(as_matrix(small), "velocity")
    with pytest.raises(lv.InputError, match="'impulse', 'velocity', 'auto'"):
        pick_form(small, "dual")


def test_linear_system_as_equality_form():
    rng = np.random.default_rng(6)
    a = rng.normal(size=(5, 5))
    a = a @ a.T + np.eye(5)
    b = rng.normal(size=5)
    qp = impulse_form(lv.Problem.linear(a, b), equality=True)
    x, zeta, xi = qp.start(np.linalg.solve(a, b))
    check_optimality(qp, x, zeta, xi)
    assert qp.n_zero == 5
    assert not qp.q.any()
