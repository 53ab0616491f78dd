"""Packed blocks and pairs give the bits of one block after the other, whatever the kinds, the order and the scene."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from calls import impulses, in_chunks, packed, swept
from random_problems import CONTACTS, random_contact_problem

import lavender as lv
from benchmarks.core_problems import lattice_pile
from lavender.solvers import layout

FIXED = ["given", "reverse", "bottom_up", "top_down", "local", "colored", "array"]


KINDS = {
    "normal": partial(random_contact_problem, tangents=0, spin=False),
    "spin": partial(random_contact_problem, tangents=2),
    "mixed": partial(random_contact_problem, spin=False),
    "one tangent": partial(random_contact_problem, tangents=1),
    **{kind: CONTACTS[kind] for kind in ("disks", "rolling", "boxes")},
}
NO_LANES = ("one tangent",)


def tangled(seed, contacts, joints, bodies=None, kind="disks"):
    bodies = bodies or max(3, (contacts + joints) // 2)
    return KINDS[kind](seed, bodies=bodies, joints=joints, contacts=contacts)


@pytest.mark.parametrize("order", FIXED)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("contacts", "joints"), [(19, 4), (24, 0), (25, 3), (301, 40), (30, 200)])
def test_packed_runs_of_any_length_are_the_plain_ones(order, kind, contacts, joints):
    problem = tangled(contacts, contacts, joints, kind=kind)
    rng = np.random.default_rng(contacts)
    warm = np.abs(rng.normal(size=problem.m)) * 0.05
    for counts in ([7], [1, 2, 16, 1, 3, 9, 2], [*rng.integers(1, 20, 6).tolist(), 30]):
        pairs, _ = packed(problem, order, counts, warm)
        if problem.n_blocks < 24 or max(counts) < 8 or (kind in NO_LANES and contacts > joints):
            assert pairs == 0
        elif problem.n_blocks > 100:  # else too few may be free of each other
            assert pairs > 0
        assert pairs <= problem.n_blocks


@pytest.mark.parametrize("order", ["given", "reverse", "symmetric", "bottom_up", "colored", "array"])
@pytest.mark.parametrize(("name", "options"), [("nncg", {}), ("nncg", {"convex": 20}), ("anderson", {})])
@pytest.mark.parametrize(
    ("contacts", "joints", "kind"), [(24, 0, "disks"), (301, 40, "spin"), (300, 40, "mixed")]
)
def test_pairs_within_single_sweeps_are_the_plain_ones(order, name, options, contacts, joints, kind):
    problem = tangled(contacts, contacts, joints, kind=kind)
    if order == "array":
        rng = np.random.default_rng(contacts)
        order = np.concatenate([rng.permutation(joints), joints + rng.permutation(contacts)])
    for counts in ([1, 3, 20, 5, 70], [7]):
        lam, v, pairs = swept(problem, name, counts, order=order, **options)
        one, v_one, none = swept(problem, name, counts, packs=False, order=order, **options)
        np.testing.assert_array_equal(lam.view(np.uint8), one.view(np.uint8))
        np.testing.assert_array_equal(v.view(np.uint8), v_one.view(np.uint8))
        assert none == 0
        assert pairs == 0 or sum(counts) >= 16
        assert pairs > 0 or problem.n_blocks < 300 or not isinstance(order, str) or sum(counts) < 16
        assert pairs <= problem.n_blocks


def test_large_piles_pack_at_longer_runs_and_written_out(monkeypatch):
    pile = lattice_pile(5_000, shuffle=True)
    for least in (layout.LARGE, 1):
        monkeypatch.setattr(layout, "LARGE", least)
        for counts, packs in (([8], False), ([16, 3], True)):
            assert (packed(pile, "reverse", counts, pile.start())[0] > 0) == packs


@pytest.mark.parametrize(
    ("name", "order", "tol"),
    [
        ("sequential_impulses", "given", 1e-2),
        ("sequential_impulses", "given", 1e-6),
        ("nncg", "symmetric", 1e-6),
        ("anderson", "given", 1e-6),
    ],
)
def test_checks_between_packed_sweeps_see_what_they_would(name, order, tol):
    pile = lattice_pile(300)
    solutions = []
    for packs in (True, False):
        prepared = impulses(pile, packs, name, order=order)
        solutions.append(prepared.solve(tol=tol, max_iter=300))
        assert not packs or prepared.state.sweeps.pairs[0] > 0
    a, b = solutions
    assert (a.status, a.iterations) == (b.status, b.iterations)
    np.testing.assert_array_equal(a.impulse.view(np.uint8), b.impulse.view(np.uint8))


def test_a_new_problem_takes_over_the_room():
    problem = tangled(3, 120, 10)
    other = replace(problem, b=problem.b + 0.01)
    prepared = lv.prepare(problem, "sequential_impulses")
    prepared.solve(tol=0.0, max_iter=20)
    state, lam = prepared.state, np.zeros(problem.m)
    again = prepared.solve(other, tol=0.0, max_iter=20)
    fresh = lv.solve(other, "sequential_impulses", tol=0.0, max_iter=20)
    np.testing.assert_array_equal(again.impulse.view(np.uint8), fresh.impulse.view(np.uint8))
    # what was there before goes on one by one
    assert state.sweeps.pairs == (0, 0)
    state.sweeps.start(lam)
    prepared.solver.run(state, lam, 20, 0.0)
    one = in_chunks(problem, "given", [20], np.zeros(problem.m), packs=False)[0]
    np.testing.assert_array_equal(lam.view(np.uint8), one.view(np.uint8))


def test_contacts_of_one_body_are_not_packed():
    problem = tangled(1, 40, 0, bodies=3)
    ground = np.stack([np.full(40, -1), np.zeros(40)], axis=1).astype(np.int32)
    alone = lv.Problem.from_rows(replace(problem.rows, contact_body=ground), mu=0.5)
    assert packed(alone, "given", [20], alone.start()) == (0, 0)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("sequential_impulses", {"order": "symmetric"}),
        ("sequential_impulses", {"order": "random"}),
        ("nncg", {"order": "random"}),
        ("nncg", {"sweep": "blocks"}),
    ],
)
def test_orders_that_change_and_exact_blocks_are_not_packed(name, options):
    prepared = impulses(lattice_pile(300), name=name, **options)
    prepared.solve(tol=0.0, max_iter=40)
    assert prepared.state.sweeps.pairs[0] == 0


@pytest.mark.parametrize("name", ["sequential_impulses", "nncg"])
def test_hostile_numbers_do_no_harm(name):
    prepared = impulses(lattice_pile(300), name=name)
    for bad in (np.nan, np.inf, 1e300, -1e300):
        prepared.solver.run(prepared.state, np.full(prepared.problem.m, bad), 40, 0.0)
