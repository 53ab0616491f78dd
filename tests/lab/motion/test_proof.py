"""`lavender.prove`: what is proven is so, for every law, kind of contact and form; what is not says why."""

import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse as sp
from random_families import wild

import lavender as lv
from lavender import suite
from lavender.lab import proof
from lavender.lab.proof import dependence, island, operator, search
from lavender.lab.proof.numbers import Balls, Rationals, set_ball_precision
from lavender.lab.proof.operator import Operator
from tests import proof_twin
from tests.kkt_truth import Exact
from tests.random_problems import general, random_contact_problem

flint = pytest.importorskip("flint", reason="python-flint (extra proof) is not installed")


def test_a_linear_problem_beside_rational_numbers():
    """lambda = A^-1 b by fractions is within what was proven, for well and badly conditioned A."""
    for condition in ("10", "1e6", "1e12"):
        problem = suite.case(f"random_spd(n=12, condition={condition})").problem
        exact = Exact.solve(Exact.array(problem.dense()), Exact.array(problem.b))
        solution = lv.solve(problem, "direct", tol=1e-12)
        found = lv.prove(problem, solution)
        off = max(abs(Fraction(x) - y) for x, y in zip(solution.impulse.tolist(), exact, strict=True))
        assert found.proven and off <= Fraction(found.impulse_radius) <= off * 2 + Fraction(1, 10**25)


@pytest.mark.parametrize("name", ["auto", "pgs", "direct"])
def test_a_problem_without_a_solution_is_proven_to_have_none(name):
    """With a certificate of the answer, or of `auto` if the solver gives none; it was "not proven"."""
    for seed in range(5):
        rows = np.random.default_rng(seed).integers(-3, 4, (2, 4)).astype(float)
        jac = np.vstack([rows, -rows[:1]])  # the last row contradicts the first
        problem = lv.Problem.from_jacobian(
            jac,
            np.eye(4),
            np.zeros(4),
            target=[1.0, 0.5, 1.0],
            cones=lv.Cones.bounded(np.zeros(3), np.full(3, np.inf)),
        )
        found = lv.prove(problem, lv.solve(problem, name, max_iter=100))
        assert found.infeasible and not found.proven and found.impulse is None
        assert str(found) == "no solution, proved: rows 0 and 2"
    nearly = lv.Problem.lcp([[1.0, -1.0], [-1.0, 1.0 + 2.0**-52]], [1.0, 1.0])
    lost = lv.solve(nearly)
    assert lost.status is lv.Status.INFEASIBLE  # for data within rounding
    assert not lv.prove(nearly, lost).infeasible


CASES = (
    "stack(n=8)", "box_stack(n=4)", "pyramid(k=4)", "pyramid(k=16)", "box_stackF(n=4)", "slabF(n=4, sliding=0.5)",
    "four_bar", "big_boxF(mass_ratio=1, sliding=0.5)", "granular(n=2, friction=cone)", "granularF(n=2, sliding=0.5)",
    "pyramidF(k=6, mass_ratio=1e3, sliding=0.5)",  # rows that depend on others by quotients of thousands of bits
)  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_cases_of_the_suite_are_proven_where_rows_depend_on_each_other_too(name):
    problem = suite.case(name).problem
    answers = (lv.solve(problem, name, tol=1e-12) for name in ("auto", "newton"))
    proofs = [lv.prove(problem, answer) for answer in answers]  # one of them may end between two cases
    found = max(proofs, key=lambda proof: proof.proven)
    assert found.proven, found
    # What is enclosed is a solution for the judge as well; bodies at 10 m/s and 1 kg, to 1e-9 of them.
    assert lv.residual(problem, found.impulse).relative < 1e-12
    assert found.velocity_radius < 1e-8


@pytest.mark.parametrize("friction", ["coulomb", "cone"])
@pytest.mark.parametrize("rolling", [False, True])
def test_every_kind_of_contact_and_form(friction, rolling):
    """Bodies, their A as a dense and as a sparse matrix, and J and M: one solution, by each of them."""
    proven = 0
    for seed in range(6):
        problem = random_contact_problem(seed, friction, bodies=6, joints=2, contacts=3, rolling=rolling)
        solution = lv.solve(problem, "newton", tol=1e-13)
        found = lv.prove(problem, solution)
        proven += found.proven
        if not found.proven:
            continue
        assert found.velocity_radius <= 1e-9
        dense = lv.Problem(problem.b, problem.cones, problem.dense(), friction=friction)
        csr = lv.Problem(problem.b, problem.cones, sp.csr_array(problem.dense()), friction=friction)
        for other in (dense, csr, general(problem)):
            again = lv.prove(other, solution)
            # A was rounded: another problem, whose solution is off by some 1e-16 times the condition.
            assert again.proven and np.allclose(again.impulse, found.impulse, atol=1e-9)
    assert proven >= 5


def test_an_answer_at_the_edge_of_a_family_of_impulses_is_proven_from_inside_of_it(monkeypatch):
    problem = wild(seed=0, rows=600).problem
    edge = lv.solve(problem, "admm", tol=1e-12)
    found = lv.prove(problem, edge)
    assert found.proven and found.velocity_radius < 1e-9
    assert abs(found.impulse - edge.impulse).max() <= found.impulse_radius  # of this answer, not of the other
    monkeypatch.setattr(proof, "INTERIOR_SOLVERS", ())
    assert lv.prove(problem, edge).boundary == ("row 12", "row 21")


def test_a_block_on_the_boundary_of_two_cases_is_named():
    """A block pushed exactly as hard as friction holds: between sticking and sliding, for any arithmetic."""
    found = lv.prove((problem := suite.case("threshold").problem), lv.solve(problem, tol=1e-12))
    assert not found.proven and found.boundary == ("contact 0, normal",) and "contact 0" in str(found)


def test_what_has_no_solution_is_not_proven():
    for name in ("infeasible(kind=squeeze)", "infeasible(kind=joints)"):
        problem = suite.case(name).problem
        found = lv.prove(problem, np.ones(problem.m))
        assert not found.proven and found.reason and found.impulse is None


def test_doing_nothing_and_empty_problems():
    problem = lv.Problem.lcp(np.eye(2), [-1.0, -2.0])
    found = lv.prove(problem, np.zeros(2))
    assert found.proven and found.impulse_radius == 0.0 == found.velocity_radius
    assert lv.prove(lv.Problem.lcp(np.zeros((0, 0)), []), np.zeros(0)).proven


def test_proofs_in_threads_keep_their_precision_and_that_of_the_caller():
    """python-flint has one precision for the process: a second proof waits until the first has restored it."""
    before, seen = flint.ctx.prec, []

    def other():
        with set_ball_precision(256):
            seen.append(flint.ctx.prec)

    thread = threading.Thread(target=other)
    with set_ball_precision(128):
        thread.start()
        thread.join(0.2)  # s, for the other one to begin, if it could
        assert (seen, flint.ctx.prec) == ([], 128)
    thread.join()
    assert (seen, flint.ctx.prec) == ([256], before)
    problem = suite.case("pyramidF(k=3, sliding=0.5)").problem
    solution = lv.solve(problem, "newton", tol=1e-12)
    alone = lv.prove(problem, solution)
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(lambda _: lv.prove(problem, solution), range(8)):
            assert (found.proven, found.velocity_radius) == (alone.proven, alone.velocity_radius)
    assert flint.ctx.prec == before


def test_without_python_flint_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "flint", None)
    with pytest.raises(lv.SolverUnavailable, match=r"\[proof\]"):
        lv.prove(lv.Problem.lcp(np.eye(1), [1.0]), [1.0])


@pytest.mark.parametrize("first", (0, 50))
def test_a_twin_in_rational_numbers_finds_nothing_false(first):
    tried = [proof_twin.attack(seed) for seed in range(first, first + 50)]
    assert not [wrong for _, _, wrong in tried if wrong]
    near = [held for label, held, _ in tried if label in ("strict exact", "strict near", "strict noise")]
    assert sum(near) >= 0.95 * len(near) > 0


@pytest.mark.slow
def test_sparse_numbers_prove_nothing_false_either(monkeypatch):
    """Small problems by the way of large ones: sparse float64 numbers with bounds, rows of the inverse in portions."""
    for where, name in (
        (operator, "MAX_DENSE_BALL_ROWS"),
        (operator, "MAX_DENSE_FLOAT_ROWS"),
        (island, "MAX_DENSE_FLOAT_ROWS"),
        (island, "MAX_INVERSE_ENTRIES"),
    ):
        monkeypatch.setattr(where, name, 1)
    tried = [proof_twin.attack(seed) for seed in range(200, 230)]
    assert not [wrong for _, _, wrong in tried if wrong]
    near = [held for label, held, _ in tried if label in ("strict exact", "strict near", "strict noise")]
    assert sum(near) >= 0.9 * len(near) > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["granular(n=8)", "chain(n=700)"])
def test_thousands_of_coupled_rows_are_proven(name):
    problem = suite.case(name).problem
    found = lv.prove(problem, lv.solve(problem, tol=1e-12))
    assert found.proven and found.unique and found.velocity_radius < 1e-9, found


def test_both_inverses_enclose_the_same_zero(monkeypatch):
    """Float64 with bounds, and balls throughout: each other's centre lies inside."""
    problem = suite.case("granularF(n=2, sliding=0.5)").problem
    solution = lv.solve(problem, "newton", tol=1e-12)
    one = lv.prove(problem, solution)
    monkeypatch.setattr(island, "FloatInverse", island.BallInverse)
    two = lv.prove(problem, solution)
    assert one.proven and two.proven
    assert abs(one.impulse - two.impulse).max() <= 2.0**-50 * abs(two.impulse).max()
    assert one.impulse_radius == pytest.approx(two.impulse_radius, rel=1e-9)


def test_a_prime_that_divides_the_numbers_makes_no_rows_dependent(monkeypatch):
    """Modulo 3 rows 0 and 1 are one row and their targets agree; in whole numbers neither holds."""
    independent = sp.csr_array([[1.0, 0.5, 0.0], [1.0, 2.0, 0.0], [0.5, 0.25, 0.0], [0.0, 0.0, 2.0**-60]])
    contradicting = sp.csr_array([[0.5, 1.0], [1.0, 2.0], [3.0, 6.0]])
    for prime in (3, dependence.PRIME):
        monkeypatch.setattr(dependence, "PRIME", prime)
        kept, wrong = dependence.find_dependent_rows(flint, independent, np.array([1.0, 0.5, 0.5, 1.0]))
        assert kept.tolist() == [0, 1, 3] and wrong.tolist() == []
        kept, wrong = dependence.find_dependent_rows(flint, contradicting, np.array([0.25, 2.0, 1.5]))
        assert kept.tolist() == [0] and wrong.tolist() == [1]


def hair(h, side):
    """Row 0 is pushed by h: a hair that balls of 256 bits cannot tell from nothing beside 1, which they round to 0."""
    a = [[2.0, -h, side], [-h, 1.0, 0.0], [side, 0.0, 1.0]]
    b = [side, 1.0, 1.0]
    return lv.Problem(b, lv.Cones.bounded([0.0, 1.0, 1.0], [np.inf, 1.0, 1.0]), np.array(a))


def told_of_hairs():
    """What is proven of row 0, which carries h / 2 where that is positive, else nothing."""
    pushed, pulled = (
        [lv.prove(hair(h, side), [0.0, 1.0, 1.0]) for side in (1.0, -1.0)] for h in (2.0**-300, -(2.0**-300))
    )
    return all(p.proven and p.impulse_radius >= 2.0**-301 for p in pushed) and all(
        p.proven and p.impulse_radius == 0.0 for p in pulled
    )


def test_hairs_are_told_in_rational_numbers():
    with np.errstate(all="raise"):  # as some have NumPy set for themselves
        assert told_of_hairs()


def lower_end(x):
    return float(abs(x).lower())


def sign_of_upper_end(x):
    return 1 if (x.upper() if isinstance(x, flint.arb) else x) >= 0 else -1


def sign_of_middle(x):
    return 1 if (x.mid() if isinstance(x, flint.arb) else x) >= 0 else -1


@pytest.mark.parametrize(
    ("name", "turned"),
    [
        ("round_up_magnitude", lower_end),
        ("get_certain_sign", sign_of_upper_end),
        ("get_certain_sign", sign_of_middle),
    ],
)
def test_an_arithmetic_with_one_rounding_turned_is_caught(monkeypatch, name, turned):
    monkeypatch.setattr(search, name, turned)
    assert not told_of_hairs() or any(proof_twin.attack(seed)[2] for seed in range(50))


@pytest.mark.parametrize("inverse", ["FloatInverse", "BallInverse"])
def test_balls_of_a_linear_problem_hold_its_rational_solution(monkeypatch, inverse):
    """And their middles are not that solution."""
    monkeypatch.setattr(island, "FloatInverse", getattr(island, inverse))
    reach = island.FloatInverse.bound_radius
    for share, held in ((1.0, True), (0.0, False)):
        monkeypatch.setattr(island.FloatInverse, "bound_radius", lambda *a, share=share: share * reach(*a))
        inside = []
        for seed in range(8):
            problem = suite.case(f"random_spd(n=6, condition=1e4, seed={seed})").problem
            given = lv.solve(problem, "direct").impulse
            find = search.Search(flint, problem, given, given)
            balls, exact = find.solve_equations()[0], find.solve_equations(Rationals(flint))[0]
            inside += [ball.contains(x) for ball, x in zip(balls, exact, strict=True)]
        assert all(inside) == held


def test_a_matrix_that_is_indefinite_in_its_last_bit_has_no_unique_velocities():
    a = np.array([[1.0, 1.0 + 2.0**-52], [1.0 + 2.0**-52, 1.0]])
    problem = lv.Problem.lcp(a, [1.0, 1.0])
    for given in ([1.0, 0.0], [0.0, 1.0]):  # two solutions
        found = lv.prove(problem, given)
        assert found.proven and found.impulse.tolist() == given and not found.unique


def test_a_ball_about_zero_counts():
    """w of a row that another moves by at most 1: [-1, 1] holds it."""
    a = Operator(lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [0.0, 0.0]))
    w = a.compute_slack(Balls(flint), [flint.arb(0, 1), flint.arb(0)])
    assert w[1].contains(0.75) and w[0].contains(-1.5)


@pytest.mark.parametrize(
    "problem",
    [
        lv.Problem.lcp([[0.0]], [1.0]),
        lv.Problem.linear([[0.0]], [1.0]),
        lv.Problem.lcp(np.diag([1.0, 0.0]), [1.0, 1.0]),
        lv.Problem.lcp([[0.0, 1.0], [-1.75, 0.0]], [1.25, 0.5]),
    ],
)
def test_an_infinite_impulse_is_no_solution(problem):
    """0 lambda >= 1: an infinite impulse had met it."""
    for x in (np.zeros(problem.m), np.ones(problem.m)):
        found = lv.prove(problem, x)
        assert not found.proven and found.impulse is None
