"""Sweep orders of blocks, by name, with their levels and colours.

    given       order of the problem             bottom_up   by level from the ground, breadth first
    reverse     reversed                         top_down    levels in reverse
    symmetric   given and reverse alternate      colored     colour by colour; blocks of a colour share no moving body
    random      shuffled before every sweep      local       blocks of neighbouring bodies close together
                                                 an int array: this permutation of blocks

On a problem with rows, every named order has joints before contacts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.arrays import IntArray, as_array, check_int
from lavender.base.errors import CapabilityError, InputError, UnknownName
from lavender.base.lazy_import import sparse as sp
from lavender.problem import Problem
from lavender_ext.core.order import (
    GIVEN,
    RANDOM,
    SYMMETRIC,
    compute_block_levels,
    compute_body_colors,
    compute_matrix_colors,
)

# Orders of LavenderSim, which creates contacts in the order of its bodies and so does not need "local".
ENGINE_ORDERS = ("given", "reverse", "symmetric", "random", "colored", "bottom_up", "top_down")
SWEEP_ORDERS = (*ENGINE_ORDERS, "local")


@dataclass
class Order:
    """A sweep order for the kernels; `blocks` and `rng` change with every sweep."""

    blocks: IntArray  # (k,) int: order of the next sweep, modified in place.
    split: int  # blocks[:split] and blocks[split:] (joints and contacts) are permuted separately.
    mode: int  # GIVEN, SYMMETRIC or RANDOM.
    rng: np.ndarray  # (1,) uint64: state of the random number generator.
    is_given: bool = False  # Whether every sweep uses the order of the problem.

    @property
    def is_fixed(self) -> bool:
        """Whether every sweep uses the same order."""
        return self.mode == GIVEN


def compute_block_order(
    problem: Problem,
    order: str | Sequence[int] | Any = "given",
    *,
    seed: int = 0,
    ground: Any = None,
) -> Order:
    """Compute the sweep order of a problem's blocks.

    Parameters
    ----------
    problem : Problem
    order : str or int array (k,)
        Name of an order (see the module), or a permutation.
    seed : int
        Only with "random".
    ground : int array, optional
        Blocks that touch the ground, needed for "bottom_up" and "top_down" on a matrix. With bodies, the static bodies
        are known.

    Returns
    -------
    Order
    """
    k = problem.cones._blocks.n_blocks
    split = 0 if problem.rows is None else problem.rows.n_joints
    if (
        type(order) is str
        and order == "given"
        and ground is None
        and type(seed) is int
        and seed == 0
    ):
        return Order(
            np.arange(k, dtype=np.int32), split, GIVEN, np.zeros(1, np.uint64), is_given=True
        )
    rng = np.array([check_int("seed", seed, high=None) % 2**64], np.uint64)
    if seed and not (isinstance(order, str) and order == "random"):
        raise InputError(f"seed={seed} needs order='random': leave seed out")
    if not isinstance(order, str):
        if ground is not None:
            raise InputError(
                "ground= is given with an array; it needs order='bottom_up' or 'top_down'"
            )
        blocks = as_array("order", order, (k,), dtype=np.int32).copy()
        if not np.array_equal(np.sort(blocks), np.arange(k)):
            raise InputError(
                f"order is not a permutation; it needs every block from 0 to {k - 1} exactly once"
            )
        return Order(blocks, k, GIVEN, rng)
    if order not in SWEEP_ORDERS:
        raise UnknownName("order", order, SWEEP_ORDERS)
    if ground is not None and order not in ("bottom_up", "top_down"):
        raise InputError(f"ground= needs order='bottom_up' or 'top_down', not {order!r}")
    blocks = np.arange(k, dtype=np.int32)
    if order == "given":
        return Order(blocks, split, GIVEN, rng, is_given=True)
    if order == "reverse":
        blocks = np.concatenate([blocks[:split][::-1], blocks[split:][::-1]])
    elif order in ("bottom_up", "top_down"):
        level = compute_block_levels_from_ground(problem, ground)
        if order == "top_down":
            level = level.max(initial=0) - level
        blocks = _sort_by_key(level, split)
    elif order == "local":
        blocks = compute_small_bandwidth_block_order(problem)
    elif order == "colored":
        blocks = _sort_by_key(compute_block_colors(problem), split)
    mode = SYMMETRIC if order == "symmetric" else RANDOM if order == "random" else GIVEN
    return Order(np.ascontiguousarray(blocks, np.int32), split, mode, rng)


def _sort_by_key(key: IntArray, split: int) -> IntArray:
    """Return an order of blocks (k,): joints before contacts, each sorted stably by `key`."""
    is_contact = np.arange(len(key)) >= split
    return np.lexsort((key, is_contact)).astype(np.int32)


def compute_block_levels_from_ground(problem: Problem, ground: Any = None) -> IntArray:
    """Compute the level (k,) of each block: its distance from static bodies, or in A's graph from `ground`."""
    k = problem.n_blocks
    if problem.rows is not None:
        if ground is not None:
            raise InputError(
                "ground= is given with rows, whose static bodies are the ground: leave it out"
            )
        return compute_block_levels(problem.rows.moving_block_bodies, problem.rows.n_bodies)
    if ground is None:
        raise CapabilityError("levels of a matrix need ground=, the blocks that touch the ground")
    ground = as_array("ground", ground, (None,), dtype=np.int32)
    if ground.size and (ground.min() < 0 or ground.max() >= k):
        raise InputError(
            f"ground holds block {ground.max()}; there are {k} blocks, numbered from 0"
        )
    if not ground.size:
        return np.zeros(k, np.int32)
    graph = _build_block_graph(problem)
    level = sp.csgraph.dijkstra(graph, unweighted=True, indices=np.unique(ground), min_only=True)
    # Blocks that do not touch others have a level of their own.
    return np.where(np.isfinite(level), level, level[np.isfinite(level)].max() + 1.0).astype(
        np.int32
    )


# Bodies are renumbered if the numbers of two touching bodies differ by more than this on average. The velocities of a
# body take 48 bytes; with smaller differences, the velocities that a sweep uses at a time fit into a second-level
# cache.
MAX_MEAN_BODY_DISTANCE = 4_096


def number_bodies_by_adjacency(problem: Problem) -> IntArray:
    """Return a numbering (n,) of bodies in which touching bodies have close numbers.

    It is the present numbering if that is close enough, else reverse Cuthill-McKee.
    """
    assert problem.rows is not None
    n = problem.rows.n_bodies
    numbers = np.arange(n, dtype=np.int32)
    pair = problem.rows.moving_block_bodies
    pair = pair[(pair >= 0).all(axis=1)]
    if not len(pair) or np.abs(pair[:, 0] - pair[:, 1]).mean() <= MAX_MEAN_BODY_DISTANCE:
        return numbers
    graph = sp.csr_array((np.ones(len(pair), np.int8), (pair[:, 0], pair[:, 1])), shape=(n, n))
    rank = np.empty(n, np.int32)
    rank[sp.csgraph.reverse_cuthill_mckee(sp.csr_matrix(graph + graph.T), symmetric_mode=True)] = (
        numbers
    )
    return rank


def compute_small_bandwidth_block_order(problem: Problem) -> IntArray:
    """Return an order of blocks (k,) in which blocks of neighbouring bodies are close together, joints first.

    The key is `number_bodies_by_adjacency`; blocks of a matrix are in reverse Cuthill-McKee order.
    """
    if problem.rows is None:
        if problem.n_blocks == 0:
            return np.zeros(0, np.int32)
        graph = sp.csr_matrix(_build_block_graph(problem))
        return np.ascontiguousarray(
            sp.csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True), np.int32
        )
    rank = np.append(number_bodies_by_adjacency(problem), np.int32(-1))
    pair = rank[problem.rows.moving_block_bodies]
    low, high = pair.min(axis=1), pair.max(axis=1)
    low = np.where(low < 0, high, low)  # For a static body, -1, use the number of the moving body.
    is_contact = np.arange(problem.n_blocks) >= problem.rows.n_joints
    return np.lexsort((high, low, is_contact)).astype(np.int32)


def compute_block_colors(problem: Problem) -> IntArray:
    """Compute the colour (k,) of each block by a greedy search in the order of the problem.

    Blocks of one colour share no moving body (rows), or no entry of A (matrix).
    """
    if problem.rows is not None:
        return compute_body_colors(problem.rows.moving_block_bodies, problem.rows.n_bodies)
    graph = _build_block_graph(problem)
    numbers = np.arange(problem.n_blocks + 1, dtype=np.int32)
    pattern = graph.indptr.astype(np.int32), graph.indices.astype(np.int32)
    return compute_matrix_colors(numbers, numbers[:-1], *pattern)


def group_blocks_by_island(count: int, label: IntArray) -> list[IntArray]:
    """Return the blocks of each of `count` islands, in order, from the island `label` (k,) of each block."""
    order = np.argsort(label, kind="stable").astype(np.int32)
    return np.split(order, np.searchsorted(label[order], np.arange(1, count)))[:count]


def _build_block_graph(problem: Problem) -> sp.csr_array:
    """Return the graph of blocks that A couples, as a symmetric pattern without the diagonal."""
    a = problem.csr
    block_of = np.repeat(np.arange(problem.n_blocks), np.diff(problem.cones.ptr))
    i = np.repeat(block_of, np.diff(a.indptr))
    j = block_of[a.indices]
    off_diagonal = i != j
    i, j = i[off_diagonal], j[off_diagonal]
    ones = np.ones(2 * len(i), np.int8)
    k = problem.n_blocks
    graph = sp.csr_array((ones, (np.concatenate([i, j]), np.concatenate([j, i]))), shape=(k, k))
    graph.sum_duplicates()
    return graph
