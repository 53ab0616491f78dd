"""Hard cases: each is as hard as it says, and each reference is a solution, by the judge and by a second way."""

import numpy as np
import pytest

import lavender as lv
from lavender import suite
from lavender.lab.suite import build, hard
from lavender.lab.suite.friction import (
    painleve,
    painleve_solutions,
    ramp,
    threshold,
)


def contact_states(problem, impulse, tol=1e-9):
    """Each contact's state at an impulse (m,) [N s]: "open", "stick" or "slip"."""
    c = problem.cones
    lam = np.asarray(impulse, float)
    size = max(float(np.abs(lam).max(initial=0.0)), 1e-300)
    out = []
    for i in np.flatnonzero(c.kind != lv.ROW):
        part = lam[c.ptr[i] : c.ptr[i + 1]][: 1 + int(c.n_tangents[i])]
        if part[0] <= tol * size:
            out.append("open")
        else:
            edge = np.linalg.norm(part[1:]) >= (1.0 - tol) * c.mu[i] * part[0]
            out.append("slip" if len(part) > 1 and edge else "stick")
    return out


def test_the_set_is_listed_and_every_family_is_used():
    assert suite.SETS["hard"] == hard.SET
    assert len(set(hard.SET)) == len(hard.SET)
    names = {suite.parse(name)[0] for name in hard.SET}
    for family in hard.__all__:
        if callable(getattr(hard, family)) and family in suite.FAMILIES:
            assert family in names, family


# -- as hard as they say --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "rank"),
    [("duplicated(k=64)", 1), ("slab(n=10)", 3), ("slabF(n=2)", 6), ("four_bar", 17), ("ring(n=8)", 27)],
)
def test_ranks(name, rank):
    problem = suite.case(name).problem
    assert np.linalg.matrix_rank(problem.dense(), tol=1e-11 * problem.d.max()) == rank


def test_the_four_bar_still_moves_in_one_degree_of_freedom():
    problem = hard.four_bar().problem
    assert (problem.m, problem.rows.n_bodies) == (20, 3)
    jac = problem.jacobian.toarray()
    free = np.linalg.svd(jac)[2][17:]
    assert np.abs(jac @ free.T).max() < 1e-12
    assert np.linalg.svd(jac)[1][16] > 1e-3


def test_the_ring_closes():
    case = hard.ring(8)
    after = case.problem.velocity(case.reference.impulse).ravel()
    assert np.abs(case.problem.jacobian @ after).max() < 1e-13
    a = case.problem.csr.tocoo()
    assert np.abs(a.coords[0] - a.coords[1]).max() > 20  # the band closes on itself


def test_near_parallel_and_wedge_are_nearly_singular():
    for angle in (1e-2, 1e-4):
        a = hard.near_parallel(angle).problem.dense()
        assert np.linalg.cond(a) == pytest.approx(1.0 / np.tan(angle) ** 2, rel=1e-6)
    case = hard.wedge(1e-8)
    assert case.reference.impulse[0] == pytest.approx(0.5e8 * build.FALL, rel=1e-15)


def test_units_change_no_relative_residual():
    base = hard.units(kg=1.0).problem
    impulse = np.linspace(0.0, 0.2, base.m)
    want = lv.residual(base, impulse)
    for kg, m, s in ((1e12, 1, 1), (1e-12, 1, 1), (1, 1e6, 1), (1, 1, 1e-6), (8.0, 0.5, 4.0)):
        problem = hard.units(kg=kg, m=m, s=s).problem
        got = lv.residual(problem, impulse * kg * m / s)
        assert got.relative == pytest.approx(want.relative, rel=1e-12)
        assert got.floor == pytest.approx(want.floor, rel=1e-12, abs=0.0)
        assert got.energy == pytest.approx(want.energy * kg**0.5 * m / s, rel=1e-12)


# -- closed forms, by a second way ----------------------------------------------------------------


@pytest.mark.parametrize("angle", [5.0, 20.0, 26.5, 26.6, 30.0, 40.0])
def test_a_cube_on_a_ramp_slides_with_the_speed_of_the_textbook(angle):
    case = ramp(angle=angle)
    a = np.deg2rad(angle)
    v = case.problem.velocity(case.reference.impulse)[0]
    expected = build.FALL * max(0.0, np.sin(a) - 0.5 * np.cos(a))
    assert v[0] == pytest.approx(expected, abs=1e-16)
    assert np.abs(v[1:]).max() <= 1e-16  # it neither lifts nor tips
    judged = lv.residual(case.problem, case.reference.impulse)
    assert judged.relative <= 2.0 * judged.floor


def test_the_threshold_is_between_stick_and_slip():
    for above, state in ((-1e-9, "stick"), (1e-9, "slip")):
        case = threshold(above=above)
        w = case.problem.slack(case.reference.impulse)
        assert contact_states(case.problem, case.reference.impulse, tol=1e-12) == [state]
        assert np.hypot(w[1], w[2]) == pytest.approx(max(0.0, above) * 0.5 * build.FALL, abs=1e-17)


def test_painleve_has_three_solutions_and_each_is_named():
    problem = painleve().problem
    a = problem.dense()
    assert a[0, 0] - 2.0 * a[0, 1] < 0.0  # the condition of the paradox
    found = painleve_solutions(problem)
    assert set(found) == {"open", "stick", "slip +"}
    for state, lam in found.items():
        judged = lv.residual(problem, lam)
        assert judged.relative <= max(1e-15, 2.0 * judged.floor), state
        assert contact_states(problem, lam) == [state.split()[0]]
    # And there is no other: on a grid of impulses within the cone, the error vanishes only near those.
    n, t = np.meshgrid(np.linspace(0.0, 1.5, 151), np.linspace(-1.0, 1.0, 81))
    for x, y in zip(n.ravel(), (2.0 * n * t).ravel(), strict=True):
        near = min(np.hypot(x - lam[0], y - lam[1]) for lam in found.values())
        if near > 0.05:
            assert lv.residual(problem, [x, y]).energy > 1e-3
    assert set(painleve_solutions(painleve(slide=0.5).problem)) == {"open"}


@pytest.mark.parametrize(
    "name", ["arch", "arch(n=25)", "card_house", "card_house(levels=5)", "big_box", "slab(n=5)"]
)
def test_structures_stand(name):
    case = suite.case(name)
    v = case.problem.velocity(case.reference.impulse)
    # Loads of tens of kilograms on bodies of one: rounding of impulses is 1e-15 of a metre per second each.
    assert np.abs(v).max() <= 1e-12
    assert np.linalg.norm(case.problem.rows.v_free) >= build.FALL
    if case.problem.law == "coulomb":
        weaker = suite.case(name.rstrip(")") + (", " if "(" in name else "(") + "mu=0.01)")
        with pytest.raises(lv.InputError, match="at rest"):  # friction is what holds them
            assert weaker.reference is None


@pytest.mark.parametrize("kind", ["squeeze", "joints"])
def test_infeasible_cases_have_a_proof(kind):
    case = hard.infeasible(kind)
    y = case.reference.certificate
    assert np.abs(case.problem.csr @ y).max() == 0.0
    assert case.problem.b @ y > 0.0
    wrong = lv.residual(case.problem, np.linspace(1.0, 2.0, case.problem.m))
    assert wrong.relative > 1e-3


@pytest.mark.parametrize("kind", ["zero", "negative", "negligible"])
def test_diagonals_are_as_named(kind):
    case = hard.diagonal(kind)
    entries = case.problem.dense().diagonal()[::3]
    assert np.all(
        {"zero": entries == 0.0, "negative": entries < 0.0, "negligible": (entries > 0) & (entries < 1e-17)}[
            kind
        ]
    )
    assert np.all(case.problem.d > 0.5)  # the judge's metric falls back to the row's largest entry
    lam, w = case.reference.impulse, case.problem.slack(case.reference.impulse)
    assert lam.min() == w.min() == 0.0
    assert np.array_equal(lam * w, np.zeros(len(lam)))


def test_degenerate_problems_touch_without_pressing():
    for asymmetric in (0, 1):
        case = hard.degenerate_lcp(n=40, asymmetric=asymmetric)
        lam, w = case.reference.impulse, case.problem.slack(case.reference.impulse)
        assert np.count_nonzero((lam == 0.0) & (w == 0.0)) >= 5
        assert np.array_equal(lam * w, np.zeros(40))
        assert case.problem.is_symmetric is not bool(asymmetric)
        a = case.problem.dense()
        assert (
            np.linalg.eigvalsh(a + a.T)[0] > 0.0
        )  # positive definite: a P-matrix, so the solution is the only one


@pytest.mark.parametrize(
    "text",
    [
        "near_parallel(angle=0)",
        "slider(mu=-1)",
        "diagonal(kind=odd)",
        "infeasible(kind=odd)",
        "slab(n=1)",
        "units(kg=0)",
    ],
)
def test_parameters_out_of_range_are_refused(text):
    with pytest.raises(lv.InputError, match=r"needed|known"):
        suite.case(text)
