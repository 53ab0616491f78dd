"""Islands of a problem (`lavender_ext/core/islands.pxd`), and the restriction of a problem to its islands."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.problem import Problem
from lavender.problem.data import Names
from lavender_ext.core.checks import is_rhs_valid


def find_islands(problem: Problem) -> tuple[int, IntArray]:
    """Return the number of islands and the island of each block (k,), numbered in block order.

    A block that is only between static bodies, or with an empty row of A, is an island by itself.
    """
    get_zero_impulse_reference(problem)  # The judge labels the islands with their references.
    count, label = problem.metric.islands()
    return int(count), label


def get_rows_of_blocks(problem: Problem, blocks: IntArray) -> IntArray:
    """Return the row numbers of these blocks, in order."""
    ptr = problem.cones.ptr
    size = np.diff(ptr)[blocks]
    start = np.repeat(ptr[:-1][blocks], size)
    inner = np.arange(int(size.sum())) - np.repeat(np.cumsum(size) - size, size)
    return start + inner


def restrict_to_blocks(problem: Problem, blocks: IntArray, rows: IntArray) -> Problem:
    """Return the problem that contains only these blocks. They must form complete islands.

    The restriction is exact, except that a b that is negligible in all rows becomes 0.
    """
    cones = problem.cones._select_blocks(blocks)
    names = Names(len(blocks), lambda: [problem.block_name(i) for i in blocks])
    attributes: dict[str, Any] = {
        "friction": problem.friction,
        "names": names,
        "name": problem.name,
    }
    b: FloatArray = problem.b[rows]
    b = b if is_rhs_valid(b) else np.zeros(len(rows))
    if problem.generalized is not None:
        assert problem.compliance is not None
        trees = problem.generalized.trees
        touched = np.isin(trees, np.unique(trees[problem.generalized.jac[rows].indices]))
        general = problem.generalized.restrict_to_rows_and_velocities(rows, np.flatnonzero(touched))
        return Problem(
            b, cones, generalized=general, compliance=problem.compliance[rows], **attributes
        )
    if problem.rows is None:
        return Problem(b, cones, problem.csr[rows][:, rows], **attributes)
    bodies = problem.rows
    joints = blocks[blocks < bodies.n_joints]
    contacts = blocks[blocks >= bodies.n_joints] - bodies.n_joints
    pairs = bodies.joint_body[joints], bodies.contact_body[contacts]
    used = np.unique(np.concatenate([each.ravel() for each in pairs]))
    used = used[used >= 0]
    # The last entry belongs to the static body, -1.
    number_in_part = np.full(bodies.n_bodies + 1, -1, np.int32)
    number_in_part[used] = np.arange(len(used))
    joint_sizes = np.diff(bodies.joint_ptr)[joints]
    part = replace(
        bodies,
        **{name: getattr(bodies, name)[used] for name in ("inv_mass", "inv_inertia", "v_free")},
        **{
            name: getattr(bodies, name)[contacts]
            for name in ("normal", "tangent", "arm_a", "arm_b")
        },
        jac=bodies.jac[rows[: int(joint_sizes.sum())]],
        joint_ptr=np.concatenate([[0], np.cumsum(joint_sizes)]).astype(np.int32),
        joint_body=number_in_part[pairs[0]],
        contact_body=number_in_part[pairs[1]],
        copy=False,
    )
    assert problem.compliance is not None
    return Problem(b, cones, rows=part, compliance=problem.compliance[rows], **attributes)
