"""Sweep orders of blocks, by name, with their levels and colours.

    given       as they stand                    bottom_up   by level from the ground, breadth first
    reverse     backwards                        top_down    the levels backwards
    symmetric   given, then reverse, in turn     colored     colour by colour, none sharing a moving body
    random      shuffled before every sweep      local       blocks of near bodies near in the sweep
                                                 an int array: that permutation of blocks

On a problem with rows, joints stay before contacts under every name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.arrays import IntArray, as_array, whole_number
from lavender.base.errors import CapabilityError, InputError, UnknownName
from lavender.base.lazy_import import sparse as sp
from lavender.problem import Problem
from lavender_ext.core.order import (
    GIVEN,
    RANDOM,
    SYMMETRIC,
    body_colors,
    body_order_levels,
    graph_colors,
)
from lavender_ext.factor.graph import matrix_components

# The engine makes its contacts in the order of its bodies; "local" is for problems from elsewhere.
ENGINE_ORDERS = ("given", "reverse", "symmetric", "random", "colored", "bottom_up", "top_down")
ORDERS = (*ENGINE_ORDERS, "local")


@dataclass
class Order:
    """A sweep order as the kernels take it; `blocks` and `rng` advance with the sweeps."""

    blocks: IntArray  # (k,) the coming sweep's order, modified in place
    split: int  # blocks[:split] and blocks[split:] are permuted apart: joints, contacts
    mode: int  # given, symmetric or random
    rng: np.ndarray  # (1,) uint64, state of the generator
    is_given: bool = False  # every sweep runs over the blocks as they stand

    @property
    def is_fixed(self) -> bool:
        """Every sweep runs in the same order."""
        return self.mode == GIVEN


def block_order(
    problem: Problem, order: str | Sequence[int] | Any = "given", *, seed: int = 0, ground: Any = None
) -> Order:
    """Order of a problem's blocks.

    Parameters
    ----------
    order : str or int array (k,)
    seed : int, only with "random"
    ground : int array, only with "bottom_up" / "top_down" on a matrix
        Blocks that touch the ground; with rows the static bodies are known.

    Raises
    ------
    UnknownName
        No such order.
    InputError
        Not a permutation; ground given where it is not used, or out of range.
    CapabilityError
        Levels of a matrix without `ground`.
    """
    k = problem.n_blocks
    split = 0 if problem.rows is None else problem.rows.n_joints
    if type(order) is str and order == "given" and ground is None and type(seed) is int and seed == 0:
        return Order(np.arange(k, dtype=np.int32), split, GIVEN, np.zeros(1, np.uint64), is_given=True)
    rng = np.array([whole_number("seed", seed, high=None) % 2**64], np.uint64)
    if seed and not (isinstance(order, str) and order == "random"):
        raise InputError(f"seed={seed} goes with order='random'; no other order draws lots")
    if not isinstance(order, str):
        if ground is not None:
            raise InputError("ground= goes with bottom_up and top_down, not with an array of blocks")
        blocks = as_array("order", order, (k,), dtype=np.int32).copy()
        if not np.array_equal(np.sort(blocks), np.arange(k)):
            raise InputError(f"order must hold every block from 0 to {k - 1} once")
        return Order(blocks, k, GIVEN, rng)
    if order not in ORDERS:
        raise UnknownName("order", order, ORDERS)
    if ground is not None and order not in ("bottom_up", "top_down"):
        raise InputError(f"ground= goes with bottom_up and top_down, not with {order!r}")
    blocks = np.arange(k, dtype=np.int32)
    if order == "given":
        return Order(blocks, split, GIVEN, rng, is_given=True)
    if order == "reverse":
        blocks = np.concatenate([blocks[:split][::-1], blocks[split:][::-1]])
    elif order in ("bottom_up", "top_down"):
        level = levels(problem, ground)
        if order == "top_down":
            level = level.max(initial=0) - level
        blocks = _sort_by_key(level, split)
    elif order == "local":
        blocks = local_order(problem)
    elif order == "colored":
        blocks = _sort_by_key(colors(problem), split)
    mode = SYMMETRIC if order == "symmetric" else RANDOM if order == "random" else GIVEN
    return Order(np.ascontiguousarray(blocks, np.int32), split, mode, rng)


def _sort_by_key(key: IntArray, split: int) -> IntArray:
    """Sort blocks (k,) by key: joints first, equal keys in the given order."""
    is_contact = np.arange(len(key)) >= split
    return np.lexsort((key, is_contact)).astype(np.int32)


def levels(problem: Problem, ground: Any = None) -> IntArray:
    """Level (k,) of each block: distance from the static bodies, or from the blocks `ground` through A."""
    k = problem.n_blocks
    if problem.rows is not None:
        if ground is not None:
            raise InputError(
                "ground= is for problems given as a matrix; with rows the static bodies are known"
            )
        return body_order_levels(problem.rows.block_bodies, problem.rows.n_bodies)
    if ground is None:
        raise CapabilityError(
            "levels of a matrix need ground=: the blocks that touch the ground (with rows they are known)"
        )
    ground = as_array("ground", ground, (None,), dtype=np.int32)
    if ground.size and (ground.min() < 0 or ground.max() >= k):
        raise InputError(f"ground names block {ground.max()}; there are {k} blocks")
    graph = _block_graph(problem)
    level = np.full(k, -1, np.int32)
    front = np.unique(ground)
    depth = 0
    while len(front):
        level[front] = depth
        depth += 1
        reached = np.unique(graph[front].indices)
        front = reached[level[reached] < 0]
    level[level < 0] = depth
    return level


# Mean difference of two body numbers up to which numbers count as near: velocities of 48 bytes each, so that those
# in use stay in a second-level cache.
NEAR = 4_096


def body_ranks(problem: Problem) -> IntArray:
    """Place (n,) of each body in a numbering where bodies that touch are near.

    Their own numbers where these are near already, else reverse Cuthill-McKee.
    """
    assert problem.rows is not None
    n = problem.rows.n_bodies
    own = np.arange(n, dtype=np.int32)
    pair = problem.rows.block_bodies
    pair = pair[(pair >= 0).all(axis=1)]
    if not len(pair) or np.abs(pair[:, 0] - pair[:, 1]).mean() <= NEAR:
        return own
    graph = sp.csr_array((np.ones(len(pair), np.int8), (pair[:, 0], pair[:, 1])), shape=(n, n))
    rank = np.empty(n, np.int32)
    rank[sp.csgraph.reverse_cuthill_mckee(sp.csr_matrix(graph + graph.T), symmetric_mode=True)] = own
    return rank


def local_order(problem: Problem) -> IntArray:
    """Blocks (k,), joints first, by the bodies they touch, numbered by `body_ranks`; a matrix: by its graph."""
    if problem.rows is None:
        if problem.n_blocks == 0:
            return np.zeros(0, np.int32)
        graph = sp.csr_matrix(_block_graph(problem))
        return np.ascontiguousarray(sp.csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True), np.int32)
    rank = np.append(body_ranks(problem), np.int32(-1))
    pair = rank[problem.rows.block_bodies]
    low, high = pair.min(axis=1), pair.max(axis=1)
    low = np.where(low < 0, high, low)  # on a static body: with the contacts of the other
    is_contact = np.arange(problem.n_blocks) >= problem.rows.n_joints
    return np.lexsort((high, low, is_contact)).astype(np.int32)


def colors(problem: Problem) -> IntArray:
    """Colour (k,) of each block, greedy in the given order.

    Blocks of one colour share no moving body (rows), or no entry of A (matrix).
    """
    if problem.rows is not None:
        return body_colors(problem.rows.block_bodies, problem.rows.n_bodies)
    graph = _block_graph(problem)
    k = problem.n_blocks
    return graph_colors(
        np.arange(k + 1, dtype=np.int32),
        np.arange(k, dtype=np.int32),
        graph.indptr.astype(np.int32),
        graph.indices.astype(np.int32),
    )


def rows_of_each(problem: Problem, ptr: IntArray) -> list[IntArray]:
    """Rows of each island of A, in order; those from ptr[i] to ptr[i + 1] belong together whatever A says."""
    part = np.repeat(np.arange(len(ptr) - 1, dtype=np.int32), np.diff(ptr))
    indptr, indices, _ = problem._compressed
    count, label = matrix_components(ptr, part, indptr, indices)
    return blocks_of_each(count, label[part])


def blocks_of_each(count: int, label: IntArray) -> list[IntArray]:
    """Blocks of each island, in order, from the island of each block (k,)."""
    order = np.argsort(label, kind="stable").astype(np.int32)
    return np.split(order, np.searchsorted(label[order], np.arange(1, count)))[:count]


def _block_graph(problem: Problem) -> sp.csr_array:
    # Blocks that meet in A, as a symmetric pattern without the diagonal.
    a = problem.csr
    block_of = np.repeat(np.arange(problem.n_blocks), np.diff(problem.cones.ptr))
    i = np.repeat(block_of, np.diff(a.indptr))
    j = block_of[a.indices]
    keep = i != j
    i, j = i[keep], j[keep]
    ones = np.ones(2 * len(i), np.int8)
    k = problem.n_blocks
    graph = sp.csr_array((ones, (np.concatenate([i, j]), np.concatenate([j, i]))), shape=(k, k))
    graph.sum_duplicates()
    return graph
