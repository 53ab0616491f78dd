"""Large piles: written-out orders and neighbours in space change speed, never the answer."""

from dataclasses import replace

import numpy as np
import pytest
from random_problems import as_matrix, random_contact_problem, sweeps

import lavender as lv
from benchmarks.core_problems import lattice_pile
from lavender.problem.ordering import compute_block_colors, compute_block_order
from lavender.solvers import layout, sweeping

NAME = "sequential_impulses"
ORDERS = ("reverse", "colored", "bottom_up", "top_down", "local")


@pytest.fixture(scope="module")
def pile():
    return lattice_pile(600, shuffle=True)


@pytest.mark.parametrize("order", ORDERS)
def test_records_of_bodies_written_out_change_no_bit(order, pile, monkeypatch):
    """Cold start: v = 0 in any numbering, and every block then reads the same values in the same order."""
    monkeypatch.setattr("lavender.problem.ordering.MAX_MEAN_BODY_DISTANCE", 0)
    plain = sweeps(pile, NAME, 7, order=order)
    monkeypatch.setattr(layout, "MIN_CONTACTS_FOR_COPY", 1)
    state = lv.prepare(pile, "sequential_impulses", order=order).state
    assert state.layout is not None
    np.testing.assert_array_equal(sweeps(pile, NAME, 7, order=order), plain)


@pytest.mark.parametrize("seed", range(5))
def test_written_out_sweeps_keep_joints_spin_and_warm_starts(seed, monkeypatch):
    problem = random_contact_problem(seed, bodies=12, joints=5, contacts=30)
    monkeypatch.setattr("lavender.problem.ordering.MAX_MEAN_BODY_DISTANCE", 0)
    start = sweeps(problem, NAME, 3)
    plain = {o: sweeps(problem, NAME, 20, order=o, impulse=start) for o in ORDERS}
    monkeypatch.setattr(layout, "MIN_CONTACTS_FOR_COPY", 1)
    for order, impulse in plain.items():
        # v = M^-1 J^T lam of the warm start is summed in another order: rounding, carried through 20 sweeps.
        np.testing.assert_allclose(
            sweeps(problem, NAME, 20, order=order, impulse=start),
            impulse,
            rtol=0,
            atol=1e-11 * np.abs(impulse).max(),
        )


def test_written_out_sweeps_that_stall_return_the_best_iterate_in_the_given_order(
    pile, monkeypatch
):
    monkeypatch.setattr(layout, "MIN_CONTACTS_FOR_COPY", 1)
    solver = lv.prepare(pile, "sequential_impulses", order="local")
    solver.solve(tol=1e-30, max_iter=40)
    relative, impulse = solver.state.best
    assert lv.residual(pile, impulse).relative == pytest.approx(relative, rel=1e-9)


@pytest.mark.parametrize("order", ORDERS)
def test_written_out_sweeps_that_are_unfinished_return_impulses_in_the_given_order(
    order, pile, monkeypatch
):
    plain = lv.solve(pile, NAME, order=order, tol=1e-9, max_iter=60)
    monkeypatch.setattr(layout, "MIN_CONTACTS_FOR_COPY", 1)
    copied = lv.solve(pile, NAME, order=order, tol=1e-9, max_iter=60)
    assert copied.status is plain.status is lv.Status.MAX_ITERATIONS
    np.testing.assert_array_equal(copied.impulse, plain.impulse)


@pytest.mark.parametrize("name", lv.available(order=True))
@pytest.mark.parametrize("large", [1, 10**9])
def test_sweeps_with_any_order_within_a_color_have_the_same_bits(name, large, pile, monkeypatch):
    """Blocks of one colour do not read what others of it write: contacts, joints and rows, packed and copied or not."""
    monkeypatch.setattr(layout, "MIN_CONTACTS_FOR_COPY", large)
    rng = np.random.default_rng(5)
    jointed = random_contact_problem(3, bodies=40, joints=20, contacts=200)
    matrix = as_matrix(jointed)
    free = replace(matrix, cones=lv.Cones.free(matrix.m))
    for problem in (pile, jointed, matrix, free):
        if lv.get(name).refuses(problem) is None:
            color = compute_block_colors(problem)
            is_contact = np.arange(problem.n_blocks) >= compute_block_order(problem).split
            orders = [np.lexsort((rng.random(len(color)), color, is_contact)) for _ in range(3)]
            for budget in ({"tol": 0.0, "max_iter": 3}, {"tol": 1e-6, "max_iter": 60}):
                results = [
                    lv.solve(problem, name, order=order, **budget) for order in ("colored", *orders)
                ]
                assert len({s.impulse.tobytes() for s in results}) == 1
                assert len({(s.iterations, s.status) for s in results}) == 1


def test_local_takes_a_matrix_too(pile):
    matrix = lv.Problem.contact(pile.delassus(), pile.b, pile.cones.mu)
    blocks = compute_block_order(matrix, "local").blocks
    assert sorted(blocks.tolist()) == list(range(matrix.n_blocks))
    assert lv.solve(matrix, "pgs", order="local", tol=1e-6, max_iter=5000).success


@pytest.mark.parametrize("order", ("given", *ORDERS, "symmetric", "random"))
def test_written_out_sweeps_with_new_numbers_keep_the_structure(order, pile, monkeypatch):
    monkeypatch.setattr("lavender.problem.ordering.MAX_MEAN_BODY_DISTANCE", 0)
    monkeypatch.setattr(layout, "MIN_CONTACTS_FOR_COPY", 1)
    other = replace(pile, b=pile.b * 1.25)
    prepared = lv.prepare(pile, "sequential_impulses", order=order)
    prepared.solve(tol=0.0, max_iter=3)
    fresh = sweeps(other, NAME, 3, order=order)
    found = []
    for module, name in ((sweeping, "compute_block_order"), (layout, "number_bodies_by_adjacency")):
        true = getattr(module, name)
        monkeypatch.setattr(
            module, name, lambda *a, _true=true, **kw: found.append(_true) or _true(*a, **kw)
        )
    changed = prepared.solve(other, tol=0.0, max_iter=3)
    assert changed.impulse.tobytes() == fresh.tobytes()
    # An order that changes with every sweep begins anew; of the others nothing is looked for again.
    assert len(found) == (order in ("random", "symmetric"))
