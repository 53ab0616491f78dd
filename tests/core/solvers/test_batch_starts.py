"""Starts of a batch from the result of another step: worlds are mapped one by one, by the keys of their blocks."""

import numpy as np
import pytest

import lavender as lv


def make_batch(contacts, keys=None, rows_first=0, seed=0):
    """Return ragged worlds with these numbers of contacts over six velocities, after `rows_first` bounded rows each."""
    rng = np.random.default_rng(seed)
    counts = np.asarray(contacts)
    sizes = 3 * counts + rows_first
    cones = []
    for k in counts.tolist():
        blocks = lv.Cones.bounded(np.zeros(rows_first), np.full(rows_first, np.inf))
        cones.append(blocks + lv.Cones.contacts(np.full(k, 0.5)) if k else blocks)
    n = len(counts)
    return lv.Batch(
        rng.standard_normal((sizes.sum(), 6)),
        np.broadcast_to(np.eye(6), (n, 6, 6)),
        rng.standard_normal((n, 6)),
        row_ptr=np.concatenate([[0], np.cumsum(sizes)]),
        cones=cones,
        compliance=np.full(sizes.sum(), 0.1),
        key=None if keys is None else np.concatenate(keys).astype(np.uint64),
    )


def start_of(batch, previous):
    """Return the start that a solve of the batch keeps: no iteration is allowed, and tol=0 keeps starts."""
    return lv.solve_many(batch, "pgs", impulse=previous, tol=0.0, max_iter=0).impulse


def test_a_start_of_other_rows_without_keys_is_refused():
    first = lv.solve_many(make_batch([1, 2]))
    for other in ([2, 1], [1, 3], [1, 1]):
        with pytest.raises(lv.InputError, match=r"world \d: .*key="):
            lv.solve_many(make_batch(other), impulse=first)
    with pytest.raises(lv.InputError, match="2 worlds; a start of 3"):
        lv.solve_many(make_batch([1, 2, 1]), impulse=first)
    listed = lv.solve_many([first.problems[0], first.problems[1]])
    with pytest.raises(lv.InputError, match="Solutions of a batch"):
        lv.solve_many(make_batch([1, 2]), impulse=listed)


def test_kinds_of_blocks_count_even_if_the_rows_agree():
    first = lv.solve_many(make_batch([1, 1]))
    with pytest.raises(lv.InputError, match="other blocks"):
        lv.solve_many(make_batch([0, 0], rows_first=3), impulse=first)


def test_a_start_of_the_same_blocks_needs_no_keys():
    batch = make_batch([1, 2, 0])
    first = lv.solve_many(batch)
    np.testing.assert_array_equal(start_of(make_batch([1, 2, 0], seed=1), first), first.impulse)
    np.testing.assert_array_equal(start_of(batch, (batch, first.impulse)), first.impulse)


def test_keys_map_starts_as_single_problems_do():
    """For random contacts that come and go in each world, the start is that of `Problem.carry`."""
    rng = np.random.default_rng(5)
    for rows_first in (0, 1):
        keys = [
            [np.sort(rng.choice(9, k, replace=False)) for k in rng.integers(0, 6, 40)]
            for _ in range(2)
        ]
        for one in keys:
            rng.shuffle(one[0])
        contacts = [np.array([len(k) for k in one]) for one in keys]
        all_keys = [[np.append(np.full(rows_first, 100), k) for k in one] for one in keys]
        before, after = (
            make_batch(c, k, rows_first, seed=i)
            for i, (c, k) in enumerate(zip(contacts, all_keys, strict=True))
        )
        solved = lv.solve_many(before)
        start = start_of(after, solved)
        for i in range(40):
            own = after.rows_of(i)
            assert np.array_equal(after[i].key, all_keys[1][i])
            np.testing.assert_array_equal(start[own], after[i].carry(solved[i]))
        assert lv.solve_many(after, impulse=solved).success.all()


def test_starts_of_blocks_of_other_kinds_and_bounds_are_those_of_single_problems():
    """A key may come back with another kind of block; bounds of new blocks may exclude 0 on both sides."""
    rng = np.random.default_rng(3)

    def draw_batch(n=40):
        keys = [rng.choice(8, k, replace=False) for k in rng.integers(0, 5, n)]
        cones = []
        for own in keys:
            parts = lv.Cones.bounded(np.zeros(0), np.zeros(0))
            for _ in own:
                low = float(rng.choice([-2.0, 0.0, 0.5]))
                bounds = np.full(3, low), np.full(3, low + 1.0)
                bounded = lv.Cones([0, 3], [0], *bounds, [0.0], [0.0])
                parts += lv.Cones.contacts([0.5]) if rng.random() < 0.5 else bounded
            cones.append(parts)
        sizes = 3 * np.array([len(own) for own in keys])
        return lv.Batch(
            rng.standard_normal((sizes.sum(), 6)), np.broadcast_to(np.eye(6), (n, 6, 6)),
            rng.standard_normal((n, 6)), row_ptr=np.concatenate([[0], np.cumsum(sizes)]), cones=cones,
            compliance=np.full(sizes.sum(), 0.1), key=np.concatenate(keys).astype(np.uint64),
        )  # fmt: skip

    before, after = draw_batch(), draw_batch()
    solved = lv.solve_many(before)
    start = start_of(after, solved)
    for i in range(len(after)):
        np.testing.assert_array_equal(start[after.rows_of(i)], after[i].carry(solved[i]))


def test_stacked_and_padded_batches_map_by_keys():
    rng = np.random.default_rng(0)
    jac = rng.standard_normal((3, 6, 6))

    def make(key, count=None):
        cones = lv.Cones.contacts([0.5, 0.5])
        if count is not None:
            cones = [lv.Cones.contacts(np.full(k // 3, 0.5)) for k in count]
        free = rng.standard_normal((3, 6))
        return lv.Batch(jac, np.eye(6), free, cones=cones, compliance=0.1, key=key, count=count)

    stacked = make(np.array([1, 2], np.uint64))
    padded = make(np.array([2, 1, 2, 1], np.uint64), count=[3, 3, 6])
    first = lv.solve_many(stacked)
    start = padded.make_start(first)
    assert start.shape == (3, 6)
    np.testing.assert_array_equal(start[0], np.append(first.impulse[0, 3:], np.zeros(3)))
    np.testing.assert_array_equal(start[1], np.append(first.impulse[1, :3], np.zeros(3)))
    np.testing.assert_array_equal(start[2], first.impulse[2, [3, 4, 5, 0, 1, 2]])


def test_repeated_keys_are_refused():
    batch = make_batch([2, 1], [[4, 4], [1]])
    with pytest.raises(lv.InputError, match="world 0 of this batch repeats a key"):
        lv.solve_many(batch, impulse=lv.solve_many(make_batch([2, 1], [[4, 5], [1]])))
    with pytest.raises(lv.InputError, match=r"key has shape \(2,\)"):
        make_batch([2, 1], [[4], [1]])
