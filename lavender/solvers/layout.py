"""A problem with rows copied in sweep order, so that a sweep reads memory from front to back.

Blocks are in the order of the sweep, and bodies are numbered by `ordering.body_ranks`. A block reads the same
values, so the impulses have the same bits; only sums over all rows have another order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.problem import FRICTION_LAWS, Problem
from lavender.problem.ordering import Order, body_ranks
from lavender_ext.core.blocks import Blocks
from lavender_ext.core.problem import Data

# Contacts from which the copy pays: their arrays exceed the second-level cache (measured: 1.0 to 1.1 times as
# fast at 10,000, twice at 100,000).
LARGE = 8_000


@dataclass(frozen=True)
class Layout:
    """The problem in sweep order, and where its rows came from."""

    data: Any  # lavender_ext.core.problem.Data
    rows: np.ndarray  # (m,) intp, row of the problem at each place
    place: np.ndarray  # (m,) intp, place of each row
    rank: IntArray  # (n,) place of each body

    def take(self, impulse: FloatArray) -> FloatArray:
        """Impulse (m,) in sweep order; a new array."""
        return np.take(impulse, self.rows, mode="clip")

    def put(self, laid: FloatArray, impulse: FloatArray) -> None:
        """Impulse (m,) of sweep order into the problem's order."""
        np.take(laid, self.place, out=impulse, mode="clip")


def pays(problem: Problem, order: Order) -> bool:
    """Whether the copy pays: a large problem, swept in a fixed order that is not its own, joints first."""
    rows = problem.rows
    if rows is None or order.is_given or not order.is_fixed or rows.n_contacts < LARGE:
        return False
    return bool(np.all(order.blocks[: rows.n_joints] < rows.n_joints))


def lay_out(problem: Problem, blocks: IntArray, before: Layout | None = None) -> Layout:
    """`problem` with its blocks in the order `blocks` (k,), joints first.

    `before`: of a problem of the same structure, in the same order.
    """
    r, c = problem.rows, problem.cones
    assert r is not None
    assert problem.compliance is not None
    kj, mj = r.n_joints, len(r.jac)
    size = np.diff(c.ptr)[blocks]
    ptr = np.zeros(len(blocks) + 1, np.int32)
    np.cumsum(size, out=ptr[1:])
    if before is None:
        rows = np.arange(problem.m) + np.repeat(c.ptr[blocks] - ptr[:-1], size)
        place = np.empty(problem.m, np.intp)
        place[rows] = np.arange(problem.m)
        ranks = body_ranks(problem)
    else:
        rows, place, ranks = before.rows, before.place, before.rank
    joint, contact = blocks[:kj], blocks[kj:] - kj
    rank = np.append(ranks, np.int32(-1))  # a static body, -1, stays -1
    body = np.argsort(rank[:-1])
    given = _apart(
        *c._take_blocks(blocks)._blocks.arrays, problem.b[rows],
        r.jac[rows[:mj]], rank[r.joint_body[joint]], r.normal[contact], r.tangent[contact], r.arm_a[contact],
        r.arm_b[contact], rank[r.contact_body[contact]], r.inv_mass[body], r.inv_inertia[body],
        problem.compliance[rows],
    )  # fmt: skip
    data = Data(Blocks(*given[:7]), given[7], FRICTION_LAWS.index(problem.friction), rows=tuple(given[8:]))
    return Layout(data, rows, place, ranks)


def _apart(*arrays: np.ndarray) -> list[np.ndarray]:
    # Large arrays begin on a page each. A sweep reads them side by side: at the same place of a page they would
    # share a few sets of the first-level cache (measured: apart 3 to 12 % faster at 100,000 contacts).
    out = []
    for i, array in enumerate(arrays):
        skip = 320 * i
        buffer = np.empty(array.nbytes + skip + 4096, np.uint8)
        first = -buffer.ctypes.data % 4096 + skip
        view = buffer[first : first + array.nbytes].view(array.dtype).reshape(array.shape)
        view[...] = array
        out.append(view)
    return out
