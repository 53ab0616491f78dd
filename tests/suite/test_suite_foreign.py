"""Problems of other structures: the same bits every time, solvable, half of them for judging, as a lot has it."""

import numpy as np
import pytest

import lavender as lv
from lavender import suite
from lavender.errors import UnknownName
from lavender.suite.foreign import JUDGED, MATRICES, STRUCTURES, TUNED, WORLDS
from lavender.suite.wild import STRUCTURES as OF_WILD

SEEDS = range(250)


@pytest.fixture(scope="module")
def cases():
    return [suite.foreign(seed=seed, rows=300) for seed in SEEDS]


def structure(case):
    return case.reason.partition(",")[0]


def test_a_seed_gives_the_same_bits(cases):
    for seed in (0, 7, 31):
        again = suite.case(cases[seed].name)
        assert again.problem == cases[seed].problem
        assert again.problem.b.tobytes() == cases[seed].problem.b.tobytes()
    assert cases[0].problem != cases[1].problem


def test_every_structure_is_drawn_and_none_is_one_of_wild(cases):
    assert {structure(case) for case in cases} == set(STRUCTURES)
    assert not set(STRUCTURES) & set(OF_WILD)
    assert {case.problem.law for case in cases} >= {"lcp", "coulomb", "cone"}
    assert {case.problem.operator for case in cases} == {"rows", "matrix", "generalized"}


@pytest.mark.parametrize(("part", "names"), [("tuned", TUNED), ("judged", JUDGED)])
def test_a_part_draws_its_own_structures_alone(part, names):
    drawn = {structure(suite.foreign(seed=seed, rows=60, part=part)) for seed in range(80)}
    assert drawn == names
    assert suite.case(f"foreign_{part}(seed=3, rows=60)").problem == suite.foreign(3, 60, part).problem


def test_the_lot_takes_half_of_the_worlds_and_half_of_the_matrices():
    assert len(JUDGED & set(WORLDS)) == len(WORLDS) // 2
    assert len(JUDGED & set(MATRICES)) == len(MATRICES) // 2
    assert set(STRUCTURES) == TUNED | JUDGED
    with pytest.raises(UnknownName, match="judged"):
        suite.foreign(part="jugded")


@pytest.mark.parametrize("seed", range(0, 250, 10))
def test_a_drawn_problem_can_be_solved(cases, seed):
    problem = cases[seed].problem
    assert np.isfinite(problem.b).all()
    solution = lv.solve(problem, "auto", tol=1e-6, time_limit=20.0)
    # What rounding alone costs bounds what can be asked for at mass ratios of 1e8.
    assert solution.residual.relative <= max(1e-6, 2.0 * solution.residual.floor)
