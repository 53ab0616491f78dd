"""Short walks of Newton's method between sweeps under Coulomb's law."""

from itertools import pairwise

import numpy as np
import pytest

import lavender as lv
from lavender.residuals import judged
from lavender.solvers._sweepers import Sweeps
from lavender.solvers._trail import Trail
from lavender.solvers._walks import WALK, Walks, in_turns, sweeps_of, walk_step
from lavender.suite.wild import wild

STALLS = 6140  # of 114 rows, that sweeps take 1,500 for


def trail_of(seed, tol=1e-9):
    problem = wild(seed=seed).problem
    trail = Trail(problem, tol, np.inf)
    trail.offer(problem.start())
    return problem, trail


def test_a_walk_ends_what_sweeps_have_begun():
    problem, trail = trail_of(STALLS)
    sweeps = sweeps_of(trail, 1000)
    assert isinstance(sweeps, Walks)
    sweeps.look(64)
    assert trail.best > 1e-3
    assert sweeps._walk() <= 1e-9
    assert judged(problem, trail.impulse.copy()).relative == trail.best
    assert trail.work["factorisations"] <= WALK
    assert trail.iterations == 64 + trail.work["factorisations"]


def test_the_next_walk_is_due_when_sweeps_have_cost_as_much():
    _, trail = trail_of(6042)
    sweeps = sweeps_of(trail, 100_000)
    cost = WALK * walk_step(trail.costs.system)
    walks = 0
    for _ in range(80):
        before = sweeps.walked
        sweeps.look(32)
        if sweeps.walked != before:
            assert (sweeps.walked - before) * sweeps.per >= cost
            walks += 1
    assert walks > 0


def test_sweeps_stay_where_they_are():
    _, trail = trail_of(6042)
    walking, plain = sweeps_of(trail, 100_000), Sweeps(trail)
    for _ in range(50):
        walking.look(32)
        plain.look(32)
    if not walking.walked:
        walking._walk()
    assert np.array_equal(walking.impulse, plain.impulse)


def test_no_walk_under_another_law():
    problem = wild(seed=6017).problem
    assert problem.law == "cone"
    assert type(sweeps_of(Trail(problem, 1e-6, np.inf), 1000)) is Sweeps


@pytest.mark.parametrize("most", [60, 170, 180, 181, 500, 900])
def test_walks_and_other_sweeps_keep_to_the_budget(most):
    for seed in (STALLS, 6042):
        solution = lv.solve(wild(seed=seed).problem, "auto", tol=1e-13, max_iter=most)
        assert solution.iterations <= most


def test_few_rows_have_turns_of_sweeps_instead():
    problem, trail = trail_of(5136, 1e-6)  # of 12 rows, which anderson does not end
    sweeps = sweeps_of(trail, 100_000)
    assert not isinstance(sweeps, Walks)
    assert not sweeps.run(100_000)
    assert in_turns(trail, sweeps, 100_000)
    assert judged(problem, trail.impulse.copy()).relative <= 1e-6
    assert [step.split()[0] for step in trail.steps] == ["anderson", "nncg"]
    solution = lv.solve(problem, tol=1e-6)
    assert solution.success
    assert [step.split()[0] for step in solution.message.split(" -> ")] == ["anderson", "nncg"]


def test_turns_of_few_rows_go_on_and_end_by_count():
    _, trail = trail_of(1582, 1e-9)  # of 24 rows, which neither ends
    sweeps = sweeps_of(trail, 100_000)
    sweeps.run(100_000)
    first = sweeps.done
    assert not in_turns(trail, sweeps, 100_000)
    turns = [step.split()[0] for step in trail.steps]
    assert turns[:3] == ["anderson", "nncg", "anderson"]
    assert all(a != b for a, b in pairwise(turns))
    assert 2 * first <= sweeps.done
    assert sweeps.ended or sweeps.done * sweeps.per > trail.costs.cheapest
    assert sweeps.done * sweeps.per <= 2.0 * trail.costs.cheapest
