"""Answers made in float32: errors that rounding explains, stops before convergence, data that are widened exactly."""

import numpy as np
import pytest
import scipy.sparse as sp
from calls import robot
from hypothesis import given
from hypothesis import strategies as st
from random_problems import (
    random_contact_problem,
    random_lcp,
    random_tree_parents,
    seeds,
    side_by_side,
    tree_mass,
)

import lavender as lv
from lavender.judge.residuals import UNIT_ROUNDOFF_FLOAT32, estimate_float32_slack_errors


def dense_parts(p):
    """A, J, M^-1, M, v*: dense, whatever the problem holds."""
    if p.rows is not None:
        inverse = p.rows.inverse_mass_matrix().toarray()
        return p.dense(), p.jacobian.toarray(), inverse, None, p.rows.v_free.ravel()
    g = p.generalized
    mass = g.mass.toarray()
    return p.dense(), g.jac.toarray(), np.linalg.inv(mass), mass, g.v_free


@pytest.mark.parametrize("form", ["rows", "matrix", "generalized"])
@given(seed=seeds)
def test_the_parts_of_the_floor_are_the_formulas_written_densely(form, seed):
    p = (
        random_contact_problem(seed)
        if form == "rows"
        else robot(seed)
        if form == "generalized"
        else random_lcp(seed)
    )
    lam = lv.solve(p, max_iter=50).impulse
    if form == "matrix":
        a = p.dense()
        own = a**2 @ lam**2
        data = a**2 @ lam**2 + p.b**2
        velocities = 0.0 * p.b
    else:
        a, jac, inverse, mass, free = dense_parts(p)
        x = inverse @ jac.T @ lam
        pushed = jac.T**2 @ lam**2
        through = (jac @ inverse) ** 2
        rounded_mass = (
            jac**2 @ inverse**2 @ (jac.T @ lam) ** 2 if mass is None else through @ mass**2 @ x**2
        )
        own = a**2 @ lam**2
        b2 = (p.b + jac @ free) ** 2 + 2 * jac**2 @ free**2
        data = jac**2 @ x**2 + through @ pushed + rounded_mass + p.compliance**2 * lam**2 + b2
        velocities = 0.0 * p.b
        if form == "generalized":
            acts = (lam != p.cones.lower) & (lam != p.cones.upper) & (lam != 0.0)
            seen = jac**2 @ x**2 + p.b**2 + p.compliance**2 * lam**2
            velocities = a**2 @ np.where(acts, seen / p.compliance**2, 0.0)
    for got, want in zip(
        estimate_float32_slack_errors(p, lam), (own, data, velocities), strict=True
    ):
        np.testing.assert_allclose(got, UNIT_ROUNDOFF_FLOAT32**2 * want, rtol=1e-9, atol=1e-30)


@given(seed=seeds, off=st.sampled_from([0.5, 0.99, 0.9999]))
def test_the_residual_above_the_floor_does_not_depend_on_the_order_of_islands(seed, off):
    parts = [random_lcp(seed), random_lcp(seed + 1)]
    impulses = [off * lv.solve(parts[0]).impulse, 0.9 * lv.solve(parts[1]).impulse]
    one, other = (
        lv.residual(side_by_side(parts[::k]), np.concatenate(impulses[::k]), precision="float32")
        for k in (1, -1)
    )
    assert (one.verdict, one.relative, one.above_floor) == (
        other.verdict,
        other.relative,
        other.above_floor,
    )
    assert one.above_floor > 0.0


@given(seed=seeds)
def test_a_solution_rounded_to_float32_is_at_its_floor_and_one_further_off_is_not(seed):
    p = random_lcp(seed)
    exact = lv.solve(p, "direct" if p.is_symmetric else "auto", tol=1e-12, max_iter=100_000)
    if not exact.residual.relative < 1e-10:
        return
    there = lv.residual(p, exact.impulse.astype(np.float32), precision="float32")
    assert there.verdict == "at its floor", there
    assert there.relative <= 4.0 * there.roundoff_floor
    off = lv.residual(p, 0.99 * exact.impulse, precision="float32")
    if off.relative > 1e-4:  # of what 1 % less does; rounding is below that here
        assert off.verdict == "stopped before convergence"
        assert off.excess == off.relative / off.roundoff_floor > 4.0
        assert f"stopped before convergence, {off.excess:.2g} times its floor" in str(off)


def test_jacobian_in_float32_is_widened_exactly():
    p = robot(7, number=np.float32)
    assert p.precision == "float32"
    rng = np.random.default_rng(7)
    mass = tree_mass(rng, random_tree_parents(rng, 10)).astype(np.float32)
    assert np.array_equal(np.tril(p.generalized.mass.toarray()), np.tril(mass.astype(np.float64)))
    assert np.array_equal(p.generalized.v_free, p.generalized.v_free.astype(np.float32))
    assert lv.residual(p, p.start()).precision == "float32"  # the judge takes the problem's
    assert lv.residual(p, p.start(), precision="float64").precision == "float64"
    assert lv.solve(p).residual.precision == "float64"  # our solvers work in float64
    jac = sp.csr_array(p.generalized.jac)
    mass = p.generalized.mass.toarray()
    v = p.generalized.v_free
    for j, m, free, precision in (
        (
            jac.astype(np.float32),
            sp.csr_array(mass.astype(np.float32)),
            v.astype(np.float32),
            "float32",
        ),
        (jac.astype(np.float32), [mass.astype(np.float32)], v.astype(np.float32), "float32"),
        (jac, mass.astype(np.float32), v.astype(np.float32), "float64"),
        (jac.astype(np.float32), mass.astype(np.float32), v.tolist(), "float64"),
    ):
        made = lv.Problem.from_jacobian(j, m, free, cones=p.cones)
        assert made.precision == precision
    forced = lv.Problem.from_jacobian(jac, mass, v, cones=p.cones, precision="float32")
    assert forced.precision == "float32"


def test_generalized_mass_summed_in_float32_may_be_asymmetric_in_the_last_bit():
    mass = np.array([[2.0, 0.3], [0.3, 1.0]], np.float32)
    mass[0, 1] = np.nextafter(mass[0, 1], np.float32(1))
    jac = np.eye(2, dtype=np.float32)
    v = np.zeros(2, np.float32)
    made = lv.Problem.from_jacobian(jac, mass, v, cones=lv.Cones.free(2))
    assert made.generalized.mass.toarray()[1, 0] == mass[1, 0]
    with pytest.raises(lv.InputError, match="M is not symmetric"):
        lv.Problem.from_jacobian(jac, mass.astype(float), v, cones=lv.Cones.free(2))
    mass[0, 1] = 0.4
    with pytest.raises(lv.InputError, match="M is not symmetric"):
        lv.Problem.from_jacobian(jac, mass, v, cones=lv.Cones.free(2))
