"""Two coefficients of a contact: boxes, which bound each tangent by itself, findex, pivoting; ellipses, which share."""

from dataclasses import replace
from functools import partial

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from random_problems import (
    as_matrix,
    dragged,
    random_box_friction_contacts,
    random_ellipse_friction_contacts,
    seeds,
)

import lavender as lv
from lavender.problem.cones import project_impulse

LAWS = ("coulomb", "cone")


def free(seed, contacts=4, friction="coulomb", mu=None):
    return dragged(seed, contacts, mu, "box", friction)


def test_cones_shaped_to_box_and_back_are_equal():
    disk = lv.Cones.free(2) + lv.Cones.contacts([0.5, 0.3]) + lv.Cones.contacts(0.4, 1)
    assert disk.shaped("box").shaped("disk") == disk
    assert disk.shaped("box").coefficients.tolist() == [
        [0, 0],
        [0, 0],
        [0.5] * 2,
        [0.3] * 2,
        [0.4] * 2,
    ]
    two = lv.Cones.contacts([(0.1, 0.2), (0.3, 0.3)], shape="box")
    assert two.shaped("disk").kind.tolist() == [lv.CONTACT_ELLIPSE, lv.CONTACT]
    assert two.shaped("disk").shaped("box") == two


@given(seed=seeds)
def test_findex_round_trip_in_any_order_is_equal(seed):
    rng = np.random.default_rng(seed)
    bounded, contacts = int(rng.integers(0, 4)), int(rng.integers(0, 4))
    tangents = rng.integers(0, 3, contacts)
    low = list(-rng.uniform(0, 1, bounded))
    high = list(rng.uniform(0, 1, bounded))
    index = [-1] * bounded
    for t in tangents:
        normal = len(index)
        mu = rng.choice([0.0, 0.25, 0.5, 1.0], t)
        low += [0.0, *-mu]
        high += [np.inf, *mu]
        index += [-1] + [normal] * t
    m = len(index)
    order = rng.permutation(m) if rng.random() < 0.7 else np.arange(m)
    back = np.argsort(order)
    given_ = np.array([-1 if index[i] < 0 else back[index[i]] for i in order], int)
    low, high = np.array(low)[order], np.array(high)[order]
    a = np.eye(m) * rng.uniform(1, 2, m) + 0.1
    b = rng.normal(size=m)
    guess = rng.uniform(0.0, 1.0, m)
    problem = lv.Problem.from_findex(a, b, low, high, given_, guess=guess)
    rows = lv.Problem.findex_order(given_)
    a2, b2, low2, high2, findex = problem.to_findex()
    np.testing.assert_array_equal(a2, a[np.ix_(rows, rows)])
    np.testing.assert_array_equal(b2, b[rows])
    np.testing.assert_array_equal(problem.guess, guess[rows])
    np.testing.assert_allclose(high2, high[rows], rtol=1e-15)
    np.testing.assert_allclose(low2, low[rows], rtol=1e-15)
    named = np.where(findex < 0, -1, rows[findex]) if m else findex
    np.testing.assert_array_equal(named, given_[rows])
    for kind, unread in ((np.int64, np.nan), (np.float32, 2.0)):
        low3 = np.where(findex < 0, low2, unread)
        again = lv.Problem.from_findex(
            a2, b2, low3, high2, findex.astype(kind), guess=problem.guess
        )
        assert again == problem


def test_boxed_problem_has_constant_friction_bounds():
    boxed = free(1, contacts=1, mu=[(0.25, 0.5)]).boxed(2.0)
    assert boxed.cones.upper.tolist() == [np.inf, 0.5, 1.0]


@pytest.mark.parametrize("name", ["lemke", "direct"])
@pytest.mark.parametrize("law", LAWS)
@given(seed=seeds, iterations=st.sampled_from([1, 2, 1000]))
def test_pivoting_on_boxes_is_not_worse_than_its_start(law, name, seed, iterations):
    """Rows that depend on each other, which many impulses or none can meet; from near the best that `auto` finds."""
    problem = random_box_friction_contacts(seed, law, bodies=3, joints=4, contacts=8)
    problem = replace(problem, compliance=np.zeros(problem.m))
    found = lv.solve(problem, "auto", tol=1e-8).impulse
    near = found + 1e-6 * np.random.default_rng(seed).normal(size=problem.m)
    start = project_impulse(problem.cones, near)
    end = lv.solve(problem, name, impulse=start, tol=1e-8, max_iter=iterations)
    # a solution at the floor of rounding may be as far above zero as the start
    bound = max(lv.residual(problem, start).relative, 1e-8, 2.0 * end.residual.roundoff_floor)
    assert end.residual.relative <= bound, end


def test_cones_of_two_coefficients_return_them_and_equal_ones_are_a_disk():
    mu = np.array([[0.5, 0.2], [0.02, 0.8], [0.3, 0.3], [0.0, 0.0]])
    cones = lv.Cones.contacts(mu)
    assert cones.has_ellipse
    assert not cones.is_polyhedral
    np.testing.assert_allclose(cones.coefficients, mu, rtol=1e-15)
    np.testing.assert_allclose(cones.friction_coefficient.reshape(-1, 3)[:, 1:], mu, rtol=1e-15)
    np.testing.assert_allclose(
        cones.stretch.reshape(-1, 3)[:2], [[1, 1, 0.4], [1, 0.025, 1]], rtol=1e-15
    )
    assert lv.Cones.contacts([(0.5, 0.5), (0.0, 0.0)]) == lv.Cones.contacts([0.5, 0.0])
    assert (lv.Cones.free(2) + cones).has_ellipse
    assert lv.Problem.contact(np.eye(3), np.ones(3), [(0.5, 0.5)]).disk.cones.kind.tolist() == [
        lv.CONTACT
    ]
    x = np.array([1.0, 3.0, 4.0, 1.0, 0.0, 0.1, 1.0, 0.3, 0.0, -1.0, 1.0, 1.0])
    t = lv.cones.project_impulse(cones, x).reshape(-1, 3)
    np.testing.assert_allclose(np.hypot(*(t[0, 1:] / mu[0])), 1.0)
    np.testing.assert_allclose(t[1:, 1:], [[0, 0.1], [0.3, 0.0], [0, 0]], atol=1e-15)


@pytest.mark.parametrize("mass", ["in order", "in another order"])
def test_converted_ellipses_share_the_factor_of_the_mass_matrix(mass):
    """Bit for bit what J with longer rows and the same M come to, although M is neither checked nor factored again."""
    rng = np.random.default_rng(0)
    n = 12
    half = np.eye(n) + np.diag(rng.normal(size=n - 1), 1)
    M = half @ half.T
    if mass == "in another order":  # an arrow, which fills in as it stands
        M = np.diag(np.full(n, 20.0))
        M[-1], M[:, -1] = 1.0, 1.0
        M[-1, -1] = 20.0
    J = rng.normal(size=(9, n)) * (rng.random((9, n)) < 0.5)
    J[2] *= 1e-306  # some products with 1e-18 vanish
    cones = lv.Cones.contacts([(0.5, 2e-18), (0.8, 0.3), (0.2, 0.9)])
    problem = lv.Problem.from_jacobian(J, M, rng.normal(size=n), cones=cones, compliance=0.1)
    s, disk = cones.stretch, problem.disk
    anew = lv.problem.generalized.Generalized(s[:, None] * J, M, problem.generalized.v_free)
    assert disk.generalized == anew
    for own, other in zip(disk.generalized.operator.jac, anew.operator.jac, strict=True):
        assert own.tobytes() == other.tobytes()
    x = rng.normal(size=9)
    assert disk.generalized.change(x).tobytes() == anew.change(x).tobytes()
    assert (
        disk.metric.whitened()[2].tobytes()
        == lv.Problem(disk.b, disk.cones, generalized=anew, compliance=disk.compliance)
        .metric.whitened()[2]
        .tobytes()
    )


def ellipses_of_rows(seed, friction="coulomb"):
    base = random_ellipse_friction_contacts(seed, friction)
    return replace(base, compliance=base.compliance + 0.3)


ELLIPSES = {
    "generalized": partial(dragged, contacts=3),
    "matrix": lambda *a, **k: as_matrix(dragged(*a, contacts=3, **k)),
    "rows": ellipses_of_rows,
}


@pytest.mark.parametrize("form", ELLIPSES)
def test_solution_of_ellipses_is_in_the_given_rows(form):
    problem = ELLIPSES[form](3, friction="cone")
    s = problem.cones.stretch
    calls = []
    found = lv.solve(
        problem,
        "anderson",
        tol=1e-6,
        max_iter=5,
        callback=lambda n, x, r: calls.append((x, r)) and None,
    )
    r = lv.residual(problem, found.impulse)
    np.testing.assert_allclose(
        found.slack, problem.dense() @ found.impulse - problem.b, rtol=1e-9, atol=1e-12
    )
    np.testing.assert_allclose(found.residual.error, r.error, rtol=1e-9, atol=1e-12)
    assert found.residual.relative == pytest.approx(r.relative, rel=1e-9)
    for x, at in calls:
        np.testing.assert_allclose(at.slack, problem.dense() @ x - problem.b, rtol=1e-9, atol=1e-12)
    single = np.float32(lv.solve(problem, tol=1e-9).impulse)
    assert lv.residual(problem, single, "float32").verdict == "at its floor"
    assert lv.residual(problem, 1.001 * single, "float32").verdict == "stopped before convergence"
    pairs = [int(i) for i in problem.cones.ptr[:-1][problem.cones.kind == lv.CONTACT_ELLIPSE]]
    rows = r.velocity_by_row.copy()
    for n in pairs:
        rows[n + 1] = np.hypot(rows[n + 1], rows[n + 2])
    assert rows.max() == pytest.approx(r.velocity, rel=1e-12)
    p = problem.disk
    assert not p.cones.has_ellipse
    assert p.disk is p
    assert lv.residual(p, problem.on_disk(found.impulse)).relative == pytest.approx(
        r.relative, rel=1e-12
    )
    np.testing.assert_allclose(p.dense(), s[:, None] * problem.dense() * s, rtol=1e-12)
    assert problem.row_name(r.worst_row) == r.worst_name == p.row_name(r.worst_row)
