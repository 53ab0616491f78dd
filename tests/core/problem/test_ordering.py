"""Orders of blocks: permutations that keep joints first, levels, colours, and what is refused."""

import numpy as np
import pytest
from hypothesis import given
from random_problems import (
    as_matrix,
    random_contact_problem,
    random_lcp,
    seeds,
    side_by_side,
    sweeps,
    touching,
)

import lavender as lv
from lavender.problem.ordering import (
    SWEEP_ORDERS,
    compute_block_colors,
    compute_block_levels_from_ground,
    compute_block_order,
    number_bodies_by_adjacency,
)


@given(seed=seeds)
@pytest.mark.parametrize("order", SWEEP_ORDERS)
def test_named_orders_are_permutations_with_joints_first(order, seed):
    problem = random_contact_problem(seed)
    o = compute_block_order(problem, order, seed=seed if order == "random" else 0)
    assert sorted(o.blocks.tolist()) == list(range(problem.n_blocks))
    assert o.split == problem.rows.n_joints
    assert sorted(o.blocks[: o.split].tolist()) == list(range(o.split))


@given(seed=seeds)
def test_block_colors_share_no_moving_body(seed):
    problem = random_contact_problem(seed, bodies=6, contacts=20)
    o = compute_block_order(problem, "colored")
    color = compute_block_colors(problem)
    body = np.concatenate([problem.rows.joint_body, problem.rows.contact_body])
    for c in range(color.max() + 1):
        moving = body[color == c].ravel()
        moving = moving[moving >= 0]
        assert len(moving) == len(set(moving.tolist()))
    for part in (o.blocks[: o.split], o.blocks[o.split :]):
        assert (np.diff(color[part]) >= 0).all()


@given(seed=seeds)
def test_block_colors_of_a_matrix_share_no_entry(seed):
    problem = as_matrix(random_contact_problem(seed, bodies=6, contacts=20))
    color = compute_block_colors(problem)
    a = problem.dense()
    ptr = problem.cones.ptr
    for i in range(problem.n_blocks):
        for j in range(i):
            if color[i] == color[j]:
                assert not a[ptr[i] : ptr[i + 1], ptr[j] : ptr[j + 1]].any()


def test_block_colors_of_a_dense_graph_exceed_63():
    """100 contacts of one body with 100 others: every one needs its own colour."""
    n = 100
    rows = touching(np.stack([np.zeros(n), np.arange(1, n + 1)], axis=1))
    assert sorted(compute_block_colors(lv.Problem.from_rows(rows)).tolist()) == list(range(n))


def test_block_levels_count_from_the_ground():
    n = 6
    body = np.stack([np.arange(-1, n - 1), np.arange(n)], axis=1)
    shuffled = np.random.default_rng(3).permutation(n)
    rows = touching(body[shuffled])
    problem = lv.Problem.from_rows(rows)
    np.testing.assert_array_equal(compute_block_levels_from_ground(problem), shuffled)
    np.testing.assert_array_equal(
        shuffled[compute_block_order(problem, "bottom_up").blocks], np.arange(n)
    )
    np.testing.assert_array_equal(
        shuffled[compute_block_order(problem, "top_down").blocks], np.arange(n)[::-1]
    )
    matrix = as_matrix(problem)
    ground = np.flatnonzero(shuffled == 0)
    np.testing.assert_array_equal(compute_block_levels_from_ground(matrix, ground), shuffled)
    with pytest.raises(lv.CapabilityError, match="ground"):
        compute_block_order(matrix, "bottom_up")


def test_blocks_of_floating_bodies_are_above_the_blocks_of_bodies_on_the_ground():
    rows = touching(np.array([(3, 4), (-1, 0), (0, 1), (4, 5)]))
    problem = lv.Problem.from_rows(rows)
    level = compute_block_levels_from_ground(problem)
    assert level.tolist()[1:3] == [0, 1] and min(level[0], level[3]) > 1
    assert compute_block_order(problem, "bottom_up").blocks.tolist() == [1, 2, 0, 3]
    assert compute_block_order(problem, "top_down").blocks.tolist() in ([0, 3, 2, 1], [3, 0, 2, 1])


@given(seed=seeds)
def test_blocks_of_a_matrix_that_no_path_connects_to_the_ground_are_above_all_others(seed):
    a = as_matrix(random_contact_problem(seed, bodies=8, joints=2, contacts=5))
    two = side_by_side([a, a])
    ground = np.arange(a.n_blocks)[::2]
    level = compute_block_levels_from_ground(two, ground)
    assert (level[ground] == 0).all()
    assert level[a.n_blocks :].min() >= max(level[: a.n_blocks].max(), 1)


def test_order_symmetric_is_forwards_then_backwards():
    problem = random_lcp(4)
    forwards = lv.solve(problem, "pgs", tol=0.0, max_iter=1)
    both = sweeps(problem, "pgs", 1, order="reverse", impulse=forwards.impulse)
    np.testing.assert_array_equal(sweeps(problem, "pgs", 2, order="symmetric"), both)


def test_ranks_of_blocks_are_a_permutation_that_brings_neighbours_near():
    # A chain of 20,000 bodies whose numbers are shuffled: neighbours are 6,700 apart in the mean.
    n = 20_000
    rng = np.random.default_rng(0)
    chain = rng.permutation(n)
    body = np.stack([chain[:-1], chain[1:]], axis=1)
    rows = touching(body, inv_inertia=np.zeros((n, 3, 3)))
    rank = number_bodies_by_adjacency(lv.Problem.from_rows(rows))
    assert np.array_equal(np.sort(rank), np.arange(n))
    assert np.abs(np.diff(rank[body], axis=1)).max() == 1
