"""Contacts that bound each tangent by itself: blocks, findex, pivoting, ellipses."""

from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from random_problems import dragged, random_boxes, seeds

import lavender as lv
from lavender import registry
from lavender.problem.cones import project
from lavender.solvers.polyhedral import as_rows

LAWS = ("coulomb", "cone")


def free(seed, contacts=4, friction="coulomb", mu=None):
    return dragged(seed, contacts, mu, "box", friction)


# -- blocks ------------------------------------------------------------------------------------------------------------


def test_one_shape_becomes_the_other_and_back():
    disk = lv.Cones.free(2) + lv.Cones.contacts([0.5, 0.3]) + lv.Cones.contacts(0.4, 1)
    assert disk.shaped("box").shaped("disk") == disk
    assert disk.shaped("box").coefficients.tolist() == [[0, 0], [0, 0], [0.5] * 2, [0.3] * 2, [0.4] * 2]
    two = lv.Cones.contacts([(0.1, 0.2), (0.3, 0.3)], shape="box")
    assert two.shaped("disk").kind.tolist() == [lv.CONTACT_ELLIPSE, lv.CONTACT]
    assert two.shaped("disk").shaped("box") == two
    with pytest.raises(lv.InputError, match="two numbers above 0"):
        lv.Cones.contacts([(0.0, 0.2)], shape="box").shaped("disk")
    with pytest.raises(lv.InputError, match="no box bounds its spin"):
        lv.Cones.contacts(0.5, patch_radius=0.1).shaped("box")


# -- findex ------------------------------------------------------------------------------------------------------------


@given(seed=seeds)
@settings(max_examples=40)
def test_findex_comes_back_in_any_order(seed):
    rng = np.random.default_rng(seed)
    bounded, contacts = int(rng.integers(0, 4)), int(rng.integers(0, 4))
    tangents = rng.integers(0, 3, contacts)
    low, high, index = list(-rng.uniform(0, 1, bounded)), list(rng.uniform(0, 1, bounded)), [-1] * bounded
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
    a, b = np.eye(m) * rng.uniform(1, 2, m) + 0.1, rng.normal(size=m)
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
    for kind in (np.int64, np.float32):
        again = lv.Problem.from_findex(a2, b2, low2, high2, findex.astype(kind), guess=problem.guess)
        assert again == problem


@pytest.mark.parametrize(
    ("lower", "upper", "findex", "words"),
    [
        ([0, -1, -1], [np.inf, 1, 1], [-1, 1, 0], "its own row"),
        ([0, -1, -1], [np.inf, 1, 1], [-1, 0, 1], "no normal: it follows row 0"),
        ([0, -1, -1], [np.inf, 1, 1], [-1, 0, 3], "a row below 3"),
        ([0, -1, -1], [np.inf, np.inf, 1], [-1, 0, 0], "it is mu"),
        ([0, -1, -1], [np.inf, np.nan, 1], [-1, 0, 0], "lower <= upper"),
        ([0, 2, -1], [np.inf, 1, 1], [-1, 0, 0], "lower <= upper"),
        ([0, -1, -1], [5, 1, 1], [-1, 0, 0], r"a normal has \[0, inf\]"),
        ([-1, -1, -1], [np.inf, 1, 1], [-1, 0, 0], r"a normal has \[0, inf\]"),
        ([0, -1], [np.inf, 1], [-1, 0, 0], "shape"),
    ],
)
def test_a_findex_that_is_none_is_told(lower, upper, findex, words):
    with pytest.raises(lv.InputError, match=words):
        lv.Problem.from_findex(np.eye(3), np.ones(3), lower, upper, findex)


def test_fixed_normals_make_constant_bounds():
    boxed = free(1, contacts=1, mu=[(0.25, 0.5)]).boxed(2.0)
    assert boxed.cones.upper.tolist() == [np.inf, 0.5, 1.0]


def test_what_findex_cannot_hold_is_told():
    with pytest.raises(lv.InputError, match="3 rows follow row 0"):
        lv.Problem.from_findex(np.eye(4), np.ones(4), [0, -1, -1, -1], [np.inf, 1, 1, 1], [-1, 0, 0, 0])
    disk = lv.Problem.contact(np.eye(3), np.ones(3), 0.5)
    with pytest.raises(lv.InputError, match=r"shaped\('box'\)"):
        disk.to_findex()
    with pytest.raises(lv.InputError, match=r"relaxed\('coulomb'\)"):
        free(1, friction="cone").to_findex()


# -- solutions ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["lemke", "direct"])
@pytest.mark.parametrize("law", LAWS)
@given(seed=seeds, iterations=st.sampled_from([1, 2, 1000]))
@settings(max_examples=15)
def test_pivoting_ends_nowhere_worse_than_it_starts(law, name, seed, iterations):
    """Rows that depend on each other, which many impulses or none can meet; from near the best that `auto` finds."""
    problem = random_boxes(seed, law, bodies=3, joints=4, contacts=8)
    problem = replace(problem, compliance=np.zeros(problem.m))
    found = lv.solve(problem, "auto", tol=1e-8).impulse
    near = found + 1e-6 * np.random.default_rng(seed).normal(size=problem.m)
    start = project(problem.cones, near)
    end = lv.solve(problem, name, impulse=start, tol=1e-8, max_iter=iterations)
    # a solution at the floor of rounding may be as far above zero as the start
    bound = max(lv.residual(problem, start).relative, 1e-8, 2.0 * end.residual.floor)
    assert end.residual.relative <= bound, end


def test_a_solver_of_others_is_not_handed_a_box_it_knows_nothing_of():
    spec = registry.SolverSpec("theirs", lambda: None, frozenset({"coulomb"}), "no boxes")
    assert "takes no boxes" in spec.refuses(free(1))
    assert spec.refuses(replace(free(1), cones=lv.Cones.contacts(0.5, count=4))) is None
    with pytest.raises(lv.InputError, match="boxes"):
        registry.SolverSpec("theirs", lambda: None, frozenset({"coulomb"}), "", boxes=frozenset({"lcp"}))


@pytest.mark.parametrize("law", LAWS)
def test_the_bounded_rows_hold_what_they_stand_for(law):
    problem = free(4, friction=law)
    form = as_rows(problem)
    rng = np.random.default_rng(0)
    lam = np.abs(rng.normal(size=problem.m))
    lam[1::3] = lam[::3] * problem.cones.coefficients[:, 0] * rng.uniform(-1, 1, 4)
    lam[2::3] = lam[::3] * problem.cones.coefficients[:, 1] * rng.uniform(-1, 1, 4)
    z = form.start(lam)
    assert z.min() >= 0.0
    np.testing.assert_allclose(form.back @ z, lam, atol=1e-13)
    if law == "cone":  # its edges: symmetric, and no more than what the cone's dual asks
        assert form.rows.asymmetry <= 1e-15
    else:  # copositive, which ends Lemke's path at a solution
        a = form.rows.csr
        for _ in range(200):
            x = rng.exponential(size=form.rows.m) * (rng.random(form.rows.m) < 0.7)
            assert x @ (a @ x) >= -1e-12 * (abs(x) @ (abs(a) @ abs(x)))
