"""Packed blocks and pairs give the bits of one block after the other, whatever the kinds, the order and the scene."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from calls import prepare_sweeps, sweep_in_parts, sweep_packed
from random_problems import CONTACTS, random_contact_problem

import lavender as lv
from benchmarks.core_problems import lattice_pile
from lavender.solvers import layout

KINDS = {
    "normal": partial(random_contact_problem, tangents=0, spin=False),
    "spin": partial(random_contact_problem, tangents=2),
    "mixed": partial(random_contact_problem, spin=False),
    "one tangent": partial(random_contact_problem, tangents=1),
    **{kind: CONTACTS[kind] for kind in ("disks", "rolling", "boxes")},
}


def tangled(seed, contacts, joints, bodies=None, kind="disks"):
    bodies = bodies or max(3, (contacts + joints) // 2)
    return KINDS[kind](seed, bodies=bodies, joints=joints, contacts=contacts)


@pytest.mark.parametrize(
    "order", ["given", "reverse", "bottom_up", "top_down", "local", "colored", "array"]
)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("contacts", "joints"), [(19, 4), (25, 3), (301, 40), (30, 200)])
def test_packed_sweeps_of_any_length_have_the_bits_of_plain_ones(order, kind, contacts, joints):
    problem = tangled(contacts, contacts, joints, kind=kind)
    rng = np.random.default_rng(contacts)
    order = rng.permutation(problem.n_blocks) if order == "array" else order
    for counts in ([7], [1, 2, 16, 1, 3, 9, 2], [*rng.integers(1, 20, 6).tolist(), 30]):
        pairs, _ = sweep_packed(problem, counts, order=order)
        if (
            problem.n_blocks < 24
            or max(counts) < 8
            or (kind == "one tangent" and contacts > joints)
        ):
            assert pairs == 0
        elif problem.n_blocks > 100:  # else too few may be free of each other
            assert pairs > 0


@pytest.mark.parametrize(
    "order", ["given", "reverse", "symmetric", "bottom_up", "colored", "array"]
)
@pytest.mark.parametrize(
    ("name", "options"), [("nncg", {}), ("nncg", {"convex": 20}), ("anderson", {})]
)
@pytest.mark.parametrize(
    ("contacts", "joints", "kind"), [(24, 0, "disks"), (301, 40, "spin"), (300, 40, "mixed")]
)
def test_packed_pairs_in_single_sweeps_have_the_bits_of_plain_ones(
    order, name, options, contacts, joints, kind
):
    problem = tangled(contacts, contacts, joints, kind=kind)
    is_named = order != "array"
    rng = np.random.default_rng(contacts)
    if not is_named:
        order = np.concatenate([rng.permutation(joints), joints + rng.permutation(contacts)])
    for counts in ([1, 3, 20, 5, 70], [7]):
        pairs, _ = sweep_packed(problem, counts, name, order=order, **options)
        assert pairs == 0 or sum(counts) >= 16
        assert pairs > 0 or problem.n_blocks < 300 or not is_named or sum(counts) < 16


def test_large_piles_pack_at_longer_runs_and_written_out(monkeypatch):
    pile = lattice_pile(5_000, shuffle=True)
    for least in (layout.MIN_CONTACTS_FOR_COPY, 1):
        monkeypatch.setattr(layout, "MIN_CONTACTS_FOR_COPY", least)
        for counts, packs in (([8], False), ([16, 3], True)):
            pairs, _ = sweep_packed(pile, counts, order="reverse", start=pile.start())
            assert (pairs > 0) == packs


@pytest.mark.parametrize(
    ("name", "order", "tol"),
    [
        ("sequential_impulses", "given", 1e-2),
        ("sequential_impulses", "given", 1e-6),
        ("nncg", "symmetric", 1e-6),
        ("anderson", "given", 1e-6),
    ],
)
def test_checks_between_packed_sweeps_judge_the_same_iterates(name, order, tol):
    pile = lattice_pile(300)
    both = [prepare_sweeps(pile, name, packs, order=order) for packs in (True, False)]
    a, b = (prepared.solve(tol=tol, max_iter=300) for prepared in both)
    assert both[0].state.sweeps.records[0] > 0
    assert (a.status, a.iterations, a.impulse.tobytes()) == (
        b.status,
        b.iterations,
        b.impulse.tobytes(),
    )


def test_packed_workspace_is_reused_for_a_new_problem():
    problem = tangled(3, 120, 10)
    prepared = lv.prepare(problem, "sequential_impulses")
    prepared.solve(tol=0.0, max_iter=20)
    state = prepared.state
    start = np.zeros(problem.m)
    prepared.solve(replace(problem, b=problem.b + 0.01), tol=0.0, max_iter=20)
    # what was there before goes on one by one
    assert state.sweeps.records == (0, 0)
    lam = start.copy()
    state.sweeps.start(lam)
    prepared.solver.run(state, lam, 20, 0.0)
    assert lam.tobytes() == sweep_in_parts(problem, [20], start=start, packs=False)[0].tobytes()
