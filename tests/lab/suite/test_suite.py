"""The suite: every case is what its name says, its reference is a solution, and names make the same bits."""

import pickle
from fractions import Fraction

import numpy as np
import pytest
from kkt_truth import Exact

import lavender as lv
from lavender import suite
from lavender.contract.enumeration import enumerate_lcp
from lavender.judge.certificates import check_certificate
from lavender.lab.suite import exact, hard

DEFAULT = suite.SETS["default"]
EVERY = sorted({*DEFAULT, *hard.SET})
LARGE = {"hang(n=10000)"}  # seconds


# -- names ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", EVERY)
def test_a_name_makes_the_same_case_again(name):
    one = suite.case(name)
    assert one.name == one.problem.name == name  # spelled in the one way
    assert one.reason
    assert "\n" not in one.reason
    if name in LARGE:
        return
    two = pickle.loads(pickle.dumps(one))  # a call of its name
    assert one.problem == two.problem
    assert one.problem.b.tobytes() == two.problem.b.tobytes()
    assert one.parameters == two.parameters


def test_a_function_and_its_name_agree():
    case = suite.pyramid(4, mass_ratio=1e6, friction="coulomb", sliding=0.5)
    assert case.name == "pyramidF(k=4, mass_ratio=1e6, sliding=0.5)"
    assert suite.case(case.name).problem == case.problem
    assert suite.case("pyramid(k=4, friction=coulomb, sliding=.5, mass_ratio=1_000_000)").name == case.name
    assert suite.case("pyramid(friction='cone', k=2)").name == "pyramid(k=2, friction=cone)"
    assert suite.case("stack(n=1e1)").name == "stack(n=10)"
    assert suite.case("two_particles").name == "two_particles"
    assert suite.stack().name == "stack"
    assert suite.case("near_parallel(angle=1e-09)").name == "near_parallel(angle=1e-9)"
    assert suite.case("stack(mass_ratio=1000)").name == "stack(mass_ratio=1e3)"
    assert suite.case("two_particles(m2=0.1)").name == "two_particles(m2=0.1)"
    assert suite.case("two_particles(drift=-1e-3)").parameters["drift"] == -1e-3


@pytest.mark.parametrize(
    ("text", "error", "sign"),
    [
        ("pyramd(k=3)", lv.UnknownName, "did you mean 'pyramid'"),
        ("pyramid(mas_ratio=1e6)", lv.UnknownName, "did you mean 'mass_ratio'"),
        ("pyramidF(friction=cone)", lv.UnknownName, "friction"),
        ("defualt", lv.UnknownName, "did you mean 'default'"),
        ("pyramid(", lv.InputError, "is not a case"),
        ("pyramid(3)", lv.InputError, "is not a case"),
        ("pyramid(k=3, k=4)", lv.InputError, "is not a case"),
        ("pyramid(**k)", lv.InputError, "is not a case"),
        ("pyramid(k=[3])", lv.InputError, "is not a case"),
        ("pyramid(k=True)", lv.InputError, "is not a case"),
        ("__import__('os')(k=3)", lv.InputError, "is not a case"),
        ("pyramid(k=open('x'))", lv.InputError, "is not a case"),
        ("", lv.InputError, "is not a case"),
        ("(" * 500, lv.InputError, "is not a case"),
        ("pyramid(k=2.5)", lv.InputError, "a whole number"),
        ("pyramid(k=-1)", lv.InputError, "a whole number"),
        ("pyramid(k=0)", lv.InputError, "at least 1"),
        ("pyramid(k=1e59)", lv.InputError, "a whole number"),
        ("pyramid(k=abc)", lv.InputError, "a number"),
        ("pyramid(mass_ratio=1e999)", lv.InputError, "a finite number"),
        ("pyramid(mass_ratio=0)", lv.InputError, "above 0"),
        ("pyramid(friction=3)", lv.InputError, "a word"),
        ("pyramid(friction=glue)", lv.InputError, "none or coulomb or cone"),
        ("boxed_friction(scene=glue)", lv.InputError, "box_stack, pyramid or granular"),
        ("toy_stack(kick=-1)", lv.InputError, "upwards"),
        ("toy_stack(friction=glue)", lv.InputError, "'none' or 'box'"),
        ("random_spd(condition=0.5)", lv.InputError, "1 or more"),
        ("near_parallel(angle=0)", lv.InputError, "needed"),
        ("slider(mu=-1)", lv.InputError, "needed"),
        ("diagonal(kind=odd)", lv.InputError, "is needed"),
        ("infeasible(kind=odd)", lv.InputError, "is needed"),
        ("slab(n=1)", lv.InputError, "needed"),
        ("units(kg=0)", lv.InputError, "needed"),
    ],
)
def test_a_wrong_name_says_what_was_meant(text, error, sign):
    with pytest.raises(error, match=sign):
        suite.case(text)
    with pytest.raises(error, match=sign):
        suite.cases(text)


def test_sets_and_families_are_listed():
    assert [c.name for c in suite.cases("default")] == [c.name for c in suite.default()] == list(DEFAULT)
    assert [c.name for c in suite.cases("stack(n=3)")] == ["stack(n=3)"]
    listed = suite.families()
    assert all(summary.strip() for summary in listed.values())
    for name in listed:
        if not suite.explain_missing_packages(suite.get_package_name_of_case(name)):
            assert suite.case(name).problem.m > 0  # the listing is itself a valid name


# -- references -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [
        *sorted(set(EVERY) - LARGE - {"granular(n=9)"}),  # half a second
        "stack(n=300, mass_ratio=1e6)",
        "stackF(n=20, mass_ratio=7)",
        "box_stack(n=5, mass_ratio=1e8)",
        "toy_stack(kick=0.1)",
        "toy_stack(kick=0)",
        "toy_stack(friction=box)",
        "boxed_friction(n=5)",
        "boxed_friction(n=4, scene=pyramid)",
        "hang(n=20, tip_mass=1e6)",
        "random_spd(n=60, condition=1e10)",
        *(
            f"slider(mu={mu}, speed={v}, friction={law})"
            for mu in (0, 0.1, 10)
            for v in (0.01, 6)
            for law in ("coulomb", "cone")
        ),
        *(f"anisotropic(ratio={ratio}, speed={v})" for ratio in (0.1, 100, 1e6) for v in (0.1, 100)),
    ],
)
def test_a_reference_is_a_solution(name):
    case = suite.case(name)
    reference = case.reference
    if reference is None:
        assert case.problem.law in ("coulomb", "cone")
        assert name not in hard.SET or "sliding=0.5" in name or name == "box_stackF(n=10, mass_ratio=1e6)"
        return
    assert reference.source
    if reference.impulse is None:
        assert check_certificate(case.problem, reference.certificate) is None
        assert reference.compare == "nothing"
        return
    judged = lv.residual(case.problem, reference.impulse)
    # 1e-14: the sums of the judge itself, of up to a hundred terms, where the floor is as low as 1e-16.
    least = 1e-14 if name in hard.SET else 1e-15
    assert judged.relative <= max(least, 2.0 * judged.roundoff_floor), str(judged)
    assert reference.compare in ("impulse", "slack", "error")


def test_the_toy_stack_is_solved_by_trying_all_active_sets():
    problem = suite.toy_stack().problem
    found = enumerate_lcp(problem.dense(), problem.b, problem.cones.lower, problem.cones.upper)
    assert len(found) >= 1
    for lam, _ in found:
        np.testing.assert_allclose(suite.toy_stack().reference.impulse, lam, rtol=0, atol=1e-14)
    clamped = np.maximum(np.linalg.solve(problem.dense(), problem.b), 0.0)
    assert lv.residual(problem, clamped).relative > 0.1  # solving, then clamping once, is another answer


def test_random_spd_has_the_condition_it_names():
    for condition in (1.0, 1e3, 1e8):
        a = suite.random_spd(30, condition).problem.dense()
        assert np.linalg.cond(a) == pytest.approx(condition, rel=1e-6)
        assert np.array_equal(a, a.T)


def test_extended_precision_beats_float64_and_refuses_what_it_cannot_solve():
    case = suite.random_spd(12, 1e10)
    a, b = case.problem.dense(), case.problem.b
    wide = exact.solve_linear(case.problem)
    plain = np.linalg.solve(a, b)
    rows = [[Fraction(x) for x in row] for row in a.tolist()]
    truth = np.array([float(x) for x in Exact.solve(rows, [Fraction(x) for x in b.tolist()])])
    assert np.array_equal(wide, truth)  # both are the exact solution, rounded once
    assert np.abs(plain - truth).max() > 1e-12
    with pytest.raises(lv.InputError, match="singular"):
        exact.solve_linear(lv.Problem.linear([[1.0, 1.0], [1.0, 1.0]], [1.0, 2.0]))


def test_a_boxed_solution_is_proved_or_refused():
    problem = suite.pyramid(4, mass_ratio=1e3).problem
    rough = lv.solve(problem, "pgs", tol=1e-6, max_iter=200_000)
    assert rough.success
    proved = exact.solve_boxed(problem, rough.impulse)
    judged = lv.residual(problem, proved)
    assert judged.relative <= 2.0 * judged.roundoff_floor, str(judged)
    with pytest.raises(lv.InputError, match="active set"):
        exact.solve_boxed(problem, np.zeros(problem.m))
