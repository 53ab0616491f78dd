"""Patches of blocks solved apart where sweeps under Coulomb's law stall."""

import numpy as np
import pytest

import lavender as lv
from lavender.residuals import judged, residual
from lavender.solvers import _race
from lavender.solvers._islands import block_bodies, rows_of
from lavender.solvers._patches import CLOSER, IDLE, PLANS, Patches
from lavender.solvers._trail import Trail
from lavender.suite.families import granular
from lavender.suite.wild import wild


def stalled(sweeps=60, seed=7):
    """A loose pile, and a trail that so many sweeps reached."""
    problem = granular(n=5, friction="coulomb", seed=seed).problem
    trail = Trail(problem, 1e-9, np.inf)
    trail.offer(lv.solve(problem, "nncg", tol=0.0, max_iter=sweeps).impulse)
    return problem, trail


def test_patches_share_no_body_and_hold_the_core():
    problem, trail = stalled()
    patches = Patches(trail)
    core = np.zeros(problem.n_blocks, bool)
    core[[0, problem.n_blocks - 1]] = True
    bodies = block_bodies(problem)
    for width in (1, 2):
        label = patches._labels(core, width)
        assert np.all(label[core] >= 0)
        owner = {}
        for i in np.flatnonzero(label >= 0):
            for body in bodies[i][bodies[i] >= 0]:
                assert owner.setdefault(int(body), label[i]) == label[i]
    # One more body around it: all blocks of the core's bodies belong to it.
    near = np.isin(bodies, bodies[core][bodies[core] >= 0]).any(axis=1)
    assert np.array_equal(patches._labels(core, 1) >= 0, near)


@pytest.mark.parametrize("name", ["newton", "nncg"])
def test_a_patch_is_solved_as_part_of_the_whole(name):
    problem, trail = stalled()
    patches = Patches(trail)
    before = residual(problem, patches.impulse).error.reshape(-1, 3)
    worst = np.argmax((problem.d.reshape(-1, 3) * before**2).sum(axis=1))
    core = np.arange(problem.n_blocks) == worst
    blocks = np.flatnonzero(patches._labels(core, 1) >= 0).astype(np.int32)
    rows = rows_of(problem, blocks)
    start, rest = patches.impulse.copy(), patches.impulse.copy()
    rest[rows] = 0.0
    patches._solve(blocks, -problem.slack(rest), name)
    # What the judge of the whole finds wrong in it is what its own found; nothing else moved.
    after = residual(problem, patches.impulse).error.reshape(-1, 3)
    assert np.abs(after[blocks]).max() < 10.0 * CLOSER * np.abs(before[blocks]).max()
    assert np.array_equal(np.delete(patches.impulse, rows), np.delete(start, rows))
    assert patches.aside > 0.0


@pytest.mark.parametrize("seed", [2, 5, 6])
def test_a_pile_that_stalls_is_mended(seed):
    problem, trail = stalled(seed=seed)
    given = trail.best
    patches = Patches(trail)
    patches.mend(np.inf, 2000)
    assert trail.best < 1e-3 * given
    assert judged(problem, trail.impulse.copy()).relative == trail.best


@pytest.mark.parametrize("most", [280, 300, 350])
def test_patches_and_those_that_race_share_one_budget(monkeypatch, most):
    monkeypatch.setattr(Patches, "is_concentrated", True)
    monkeypatch.setattr(_race.Racer, "stalls", True)
    monkeypatch.setattr(_race, "EARLY", 100)
    problem = granular(n=7, friction="coulomb", seed=8).problem
    solution = lv.solve(problem, "auto", tol=1e-13, max_iter=most)
    assert "patches" in solution.message
    assert solution.iterations <= most


@pytest.mark.parametrize("early", [50, 150])
def test_patches_begin_where_sweeps_stall_and_no_sooner_than_that(monkeypatch, early):
    begun, most = [], 2000
    monkeypatch.setattr(Patches, "is_concentrated", True)
    monkeypatch.setattr(Patches, "mend", lambda self, worth, budget: begun.append(most - budget))
    monkeypatch.setattr(_race.Racer, "stalls", True)
    monkeypatch.setattr(_race, "EARLY", early)
    problem = granular(n=7, friction="coulomb", seed=8).problem
    lv.solve(problem, "auto", tol=1e-13, max_iter=most)
    assert early <= begun[0] <= 2 * early  # at the next look, after half as many more


def test_patches_come_before_solvers_that_factor():
    solution = lv.solve(wild(6074).problem, "auto", tol=1e-3)
    assert solution.status is lv.Status.CONVERGED
    assert "patches" in solution.message
    assert "newton 1" not in solution.message
    assert "admm" not in solution.message


def test_patches_that_gain_nothing_grow_and_end():
    _, trail = stalled()
    patches = Patches(trail)
    asked = []
    patches._mend = lambda name, width: asked.append((name, width))
    patches.least = patches.reached = 0.0
    patches.trail.tol = 0.0
    patches.mend(np.inf, 10_000)
    assert patches.idle == IDLE
    assert asked[: len(PLANS)] == [*PLANS[1:], (PLANS[0][0], PLANS[0][1] + 1)]
    assert max(width for _, width in asked) == max(width for _, width in PLANS) + IDLE - 1
    assert not patches.gains
