"""The suite: every case is what its name says, its reference is a solution, and names make the same bits."""

import pickle
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
from enumeration import enumerate_lcp

import lavender as lv
from lavender import suite
from lavender.judge.certificates import check_certificate
from lavender.report.cases import hash_problem
from lavender.suite import hard
from lavender.suite.case import load_references

DEFAULT = suite.SETS["default"]
EVERY = sorted({*DEFAULT, *hard.SET})
LARGE = {"hang(n=10000)"}  # seconds


@pytest.mark.parametrize("name", EVERY)
def test_suite_case_by_its_name_has_the_same_bits(name):
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


def test_suite_function_and_case_name_make_the_same_problem():
    case = suite.pyramid(4, mass_ratio=1e6, friction="coulomb", sliding=0.5)
    assert case.name == "pyramidF(k=4, mass_ratio=1e6, sliding=0.5)"
    assert suite.case(case.name).problem == case.problem
    assert (
        suite.case("pyramid(k=4, friction=coulomb, sliding=.5, mass_ratio=1_000_000)").name
        == case.name
    )
    assert suite.case("pyramid(friction='cone', k=2)").name == "pyramid(k=2, friction=cone)"
    assert suite.case("stack(n=1e1)").name == "stack(n=10)"
    assert suite.case("two_particles").name == "two_particles"
    assert suite.stack().name == "stack"
    assert suite.case("near_parallel(angle=1e-09)").name == "near_parallel(angle=1e-9)"
    assert suite.case("stack(mass_ratio=1000)").name == "stack(mass_ratio=1e3)"
    assert suite.case("two_particles(m2=0.1)").name == "two_particles(m2=0.1)"
    assert suite.case("two_particles(drift=-1e-3)").parameters["drift"] == -1e-3


def test_sets_and_families_are_listed():
    assert (
        [c.name for c in suite.cases("default")]
        == [c.name for c in suite.default()]
        == list(DEFAULT)
    )
    assert [c.name for c in suite.cases("stack(n=3)")] == ["stack(n=3)"]
    listed = suite.families()
    assert all(summary.strip() for summary in listed.values())
    for name in listed:
        package = suite.parse_case_name(name)[1].get("package", "")
        if not suite.explain_missing_packages(package):
            assert suite.case(name).problem.m > 0  # the listing is itself a valid name


@pytest.mark.parametrize(
    "name",
    [
        *sorted(set(EVERY) - LARGE - {"granular(n=9)"}),  # half a second
        "stack(n=300, mass_ratio=1e6)",
        "stackF(n=20, mass_ratio=7)",
        "box_stack(n=5, mass_ratio=1e8)",
        *(
            f"slider(mu={mu}, speed={v}, friction={law})"
            for mu in (0, 0.1, 10)
            for v in (0.01, 6)
            for law in ("coulomb", "cone")
        ),
        *(
            f"anisotropic(ratio={ratio}, speed={v})"
            for ratio in (0.1, 100, 1e6)
            for v in (0.1, 100)
        ),
    ],
)
def test_suite_reference_is_a_solution(name):
    case = suite.case(name)
    reference = case.reference
    if reference is None:
        # Problems above 500 rows and those that slide have no stored solution.
        assert case.problem.m > 500 or case.problem.law in ("coulomb", "cone")
        assert name not in hard.SET or case.problem.m > 500 or "F(" in name
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


def test_toy_stack_has_the_solution_of_enumeration():
    problem = suite.toy_stack().problem
    found = enumerate_lcp(problem.dense(), problem.b, problem.cones.lower, problem.cones.upper)
    assert len(found) >= 1
    for lam, _ in found:
        np.testing.assert_allclose(suite.toy_stack().reference.impulse, lam, rtol=0, atol=1e-14)
    clamped = np.maximum(np.linalg.solve(problem.dense(), problem.b), 0.0)
    assert (
        lv.residual(problem, clamped).relative > 0.1
    )  # solving, then clamping once, is another answer


def test_random_spd_has_the_condition_it_names():
    for condition in (1.0, 1e3, 1e8):
        a = suite.random_spd(30, condition).problem.dense()
        assert np.linalg.cond(a) == pytest.approx(condition, rel=1e-6)
        assert np.array_equal(a, a.T)


def multiply_exactly(matrix, x):
    """Sparse matrix times Fractions."""
    out = [Fraction(0)] * matrix.shape[0]
    coo = matrix.tocoo()
    for i, j, a in zip(coo.row.tolist(), coo.col.tolist(), coo.data.tolist(), strict=True):
        out[i] += Fraction(a) * x[j]
    return out


@pytest.mark.parametrize("name", load_references())
def test_stored_solution_meets_every_condition_to_its_digits(name):
    stored = load_references()[name]
    problem = suite.case(name).problem
    assert hash_problem(problem) == stored["sha"]
    lam = [Fraction(Decimal(digits)) for digits in stored["impulse"].split()]
    if problem.rows is None:
        factors = [problem.csr]
    else:
        factors = [problem.jacobian.T, problem.rows.inverse_mass_matrix(), problem.jacobian]
        assert not problem.compliance.any()
    speed = lam
    size = np.abs(np.array(lam, float))
    for factor in factors:
        speed = multiply_exactly(factor, speed)
        size = abs(factor) @ size
    b = [Fraction(x) for x in problem.b.tolist()]
    # Unique impulses have 31 digits. Equations of dependent rows, with rounded data, hold only to rounding.
    unit = Fraction(1, 10**30) if stored["compare"] == "impulse" else Fraction(1, 2**49)
    tolerance = unit * Fraction(float(size.max() + np.abs(problem.b).max()))
    excess = (
        float(tolerance) if stored["compare"] == "slack" else 0.0
    )  # of bounds, by dependent rows
    c = problem.cones
    lower, upper = c.lower.tolist(), c.upper.tolist()
    for i in np.flatnonzero(c.kind != lv.cones.ROW):
        first = c.ptr[i]
        end = c.ptr[i + 1]
        friction = sum((x * x for x in lam[first + 1 : end]), Fraction(0))
        assert friction <= (Fraction(float(c.mu[i])) * lam[first]) ** 2
        lower[first] = 0.0
        upper[first] = np.inf
        lower[first + 1 : end] = [-np.inf] * (end - first - 1)  # nothing slides: w is 0 on all rows
    for low, high, impulse, slack in zip(
        lower, upper, lam, np.array(speed, object) - np.array(b, object), strict=True
    ):
        assert low - excess <= float(impulse) <= high + excess
        assert slack >= -tolerance or float(impulse) >= high
        assert slack <= tolerance or float(impulse) <= low


def test_parameters_without_a_stored_solution_have_no_reference():
    assert suite.pyramid(k=4).reference is None
    assert suite.chain(n=20).reference is None
