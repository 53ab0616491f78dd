"""Hard cases: each is as hard as it says, and each reference is a solution, by the judge and by a second way."""

import numpy as np
import pytest

import lavender as lv
from lavender import suite
from lavender.suite import build, hard
from lavender.suite.friction import painleve, ramp, threshold


def test_hard_set_uses_every_family():
    assert suite.SETS["hard"] == hard.SET
    assert len(set(hard.SET)) == len(hard.SET)
    names = {suite.parse_case_name(name)[0] for name in hard.SET}
    families = {
        name for name, family in suite.FAMILIES.items() if family.make.__module__ == hard.__name__
    }
    assert len(families) >= 12 and families <= names


@pytest.mark.parametrize(
    ("name", "rank"),
    [
        ("duplicated(k=64)", 1),
        ("slab(n=10)", 3),
        ("slabF(n=2)", 6),
        ("four_bar", 17),
        ("ring(n=8)", 27),
    ],
)
def test_hard_problems_have_their_documented_rank(name, rank):
    problem = suite.case(name).problem
    assert np.linalg.matrix_rank(problem.dense(), tol=1e-11 * problem.d.max()) == rank


@pytest.mark.parametrize("angle", [5.0, 20.0, 26.5, 26.6, 30.0, 40.0])
def test_hard_set_cube_on_a_ramp_slides_with_the_textbook_speed(angle):
    case = ramp(angle=angle)
    a = np.deg2rad(angle)
    v = case.problem.velocity(case.reference.impulse)[0]
    expected = build.FALL_SPEED * max(0.0, np.sin(a) - 0.5 * np.cos(a))
    assert v[0] == pytest.approx(expected, abs=1e-16)
    assert np.abs(v[1:]).max() <= 1e-16  # it neither lifts nor tips
    judged = lv.residual(case.problem, case.reference.impulse)
    assert judged.relative <= 2.0 * judged.roundoff_floor


def test_hard_set_threshold_is_between_stick_and_slip():
    for above in (-1e-9, 1e-9):
        case = threshold(above=above)
        w = case.problem.slack(case.reference.impulse)
        assert np.hypot(w[1], w[2]) == pytest.approx(
            max(0.0, above) * 0.5 * build.FALL_SPEED, abs=1e-17
        )


def test_hard_set_painleve_meets_the_condition_of_the_paradox():
    a = painleve().problem.dense()
    assert a[0, 0] - 2.0 * a[0, 1] < 0.0  # tests/project/test_examples.py has its three solutions


@pytest.mark.parametrize(
    "name",
    [
        "arch",
        "arch(n=25)",
        "card_house",
        "card_house(levels=5)",
        "big_box(mass_ratio=400)",
        "slab(n=5)",
    ],
)
def test_hard_set_structures_at_rest_do_not_move_only_with_friction(name):
    case = suite.case(name)
    v = case.problem.velocity(case.reference.impulse)
    # Loads of tens of kilograms on bodies of one: rounding of impulses is 1e-15 of a metre per second each.
    assert np.abs(v).max() <= 1e-12
    assert np.linalg.norm(case.problem.rows.v_free) >= build.FALL_SPEED
    if case.problem.law == "coulomb":
        weaker = suite.case(name.rstrip(")") + (", " if "(" in name else "(") + "mu=0.01)")
        solution = lv.solve(weaker.problem)  # friction is what holds them
        assert solution.success and np.abs(weaker.problem.velocity(solution.impulse)).max() > 1e-3
