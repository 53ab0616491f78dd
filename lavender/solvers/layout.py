"""Copy a problem with its rows in sweep order, so that a sweep reads memory from front to back.

Blocks are in the order of the sweep, and bodies are numbered by `ordering.number_bodies_by_adjacency`. The update of a
block reads the same values, so impulses do not change by a bit; only sums over all rows are added in another order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.problem import FRICTION_LAWS, Problem
from lavender.problem.ordering import Order, number_bodies_by_adjacency
from lavender_ext.core.blocks import make_blocks_over_arrays
from lavender_ext.core.problem import Data

# From this many contacts on, sweeps over the copy are faster, because the arrays exceed the second-level cache
# (measured: 1.0 to 1.1 times as fast at 10,000 contacts, twice as fast at 100,000).
MIN_CONTACTS_FOR_COPY = 8_000


@dataclass(frozen=True)
class Layout:
    """A problem in sweep order, with the permutation of its rows and bodies."""

    data: Any  # lavender_ext.core.problem.Data
    rows: np.ndarray  # (m,) intp: row of the problem at each position of the sweep order.
    position: np.ndarray  # (m,) intp: position of each row of the problem in the sweep order.
    rank: IntArray  # (n,) int32: number of each body in the copy.

    def to_sweep_order(self, impulse: FloatArray) -> FloatArray:
        """Return an impulse (m,) in sweep order as a new array."""
        return np.take(impulse, self.rows, mode="clip")

    def from_sweep_order(self, sweep_impulse: FloatArray, impulse: FloatArray) -> None:
        """Copy an impulse (m,) in sweep order to `impulse` (m,) in the problem's order."""
        np.take(sweep_impulse, self.position, out=impulse, mode="clip")


def is_reordered_copy_faster(problem: Problem, order: Order) -> bool:
    """Return whether sweeps over a copy are faster: for a large problem in a fixed order that is not its own order."""
    rows = problem.rows
    if (
        rows is None
        or order.is_given
        or not order.is_fixed
        or rows.n_contacts < MIN_CONTACTS_FOR_COPY
    ):
        return False
    return bool(np.all(order.blocks[: rows.n_joints] < rows.n_joints))


def copy_problem_in_block_order(
    problem: Problem, blocks: IntArray, before: Layout | None = None
) -> Layout:
    """Copy `problem` with its blocks in the order `blocks` (k,), joints first.

    `before` is the layout of a problem of the same structure in the same order; its permutations are reused.
    """
    r, c = problem.rows, problem.cones
    assert r is not None
    assert problem.compliance is not None
    kj = r.n_joints
    mj = len(r.jac)
    size = np.diff(c.ptr)[blocks]
    ptr = np.zeros(len(blocks) + 1, np.int32)
    np.cumsum(size, out=ptr[1:])
    if before is None:
        rows = np.arange(problem.m) + np.repeat(c.ptr[blocks] - ptr[:-1], size)
        position = np.empty(problem.m, np.intp)
        position[rows] = np.arange(problem.m)
        ranks = number_bodies_by_adjacency(problem)
    else:
        rows, position, ranks = before.rows, before.position, before.rank
    joint = blocks[:kj]
    contact = blocks[kj:] - kj
    rank = np.append(ranks, np.int32(-1))  # A static body, -1, stays -1.
    body = np.argsort(rank[:-1])
    arrays = _copy_to_separate_pages(
        *c._select_blocks(blocks)._blocks.arrays,
        problem.b[rows],
        r.jac[rows[:mj]],
        rank[r.joint_body[joint]],
        r.normal[contact],
        r.tangent[contact],
        r.arm_a[contact],
        r.arm_b[contact],
        rank[r.contact_body[contact]],
        r.inv_mass[body],
        r.inv_inertia[body],
        problem.compliance[rows],
    )
    data = Data(
        make_blocks_over_arrays(*arrays[:7]),
        arrays[7],
        FRICTION_LAWS.index(problem.friction),
        rows=tuple(arrays[8:]),
    )
    return Layout(data, rows, position, ranks)


def _copy_to_separate_pages(*arrays: np.ndarray) -> list[np.ndarray]:
    """Copy arrays to different offsets from a page boundary.

    A sweep reads all arrays at the same time. Large arrays begin on a page boundary, so entries with equal indices
    would compete for a few sets of the first-level cache (measured: different offsets are 3 to 12 % faster at 100,000
    contacts).
    """
    out = []
    for i, array in enumerate(arrays):
        skip = 320 * i
        buffer = np.empty(array.nbytes + skip + 4096, np.uint8)
        first = -buffer.ctypes.data % 4096 + skip
        view = buffer[first : first + array.nbytes].view(array.dtype).reshape(array.shape)
        view[...] = array
        out.append(view)
    return out
