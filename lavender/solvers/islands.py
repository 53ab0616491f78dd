"""Islands of a problem (`lavender_ext/core/islands.pxd`) and the problems that they are on their own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.problem import Problem
from lavender_ext.core.checks import LEAST, largest
from lavender_ext.factor import graph


def islands(problem: Problem) -> tuple[int, IntArray]:
    """Return the number of islands and the island of each block (k,), numbered in block order.

    A block between static bodies alone, or with an empty row of A, is an island of its own.
    """
    view = problem.derived.view
    count, label = (problem.data if view is None else view).islands()
    return int(count), label


def pairs(problem: Problem) -> int:
    """How many pairs of bodies, or of trees of M, have a block between them.

    Of a matrix, how many blocks have columns of their own: those between the same two bodies share them.
    """
    if problem.matrix is None:
        rows = problem.rows
        ends = graph.tree_ends(problem.derived.view) if rows is None else rows.block_bodies
        low, high = np.sort(ends, axis=1).T
        return len(np.unique(low.astype(np.int64) << 32 | high))
    indptr, indices, _ = problem._compressed
    summed = np.concatenate([[0], np.cumsum(indices, dtype=np.int64)])
    first = problem.cones.ptr[:-1]
    columns = [indptr[first + 1] - indptr[first], summed[indptr[first + 1]] - summed[indptr[first]]]
    return int(np.unique(np.stack(columns), axis=1).shape[1])


def rows_of(problem: Problem, blocks: IntArray) -> IntArray:
    """Row numbers of these blocks, in order."""
    ptr = problem.cones.ptr
    size = np.diff(ptr)[blocks]
    start = np.repeat(ptr[:-1][blocks], size)
    inner = np.arange(int(size.sum())) - np.repeat(np.cumsum(size) - size, size)
    return start + inner


def restrict(problem: Problem, blocks: IntArray, rows: IntArray) -> Problem:
    """The problem of these blocks alone; exact where they are whole islands, but for a b that is dust in all rows."""
    cones = problem.cones._take_blocks(blocks)
    names = None if problem.names is None else [problem.names[i] for i in blocks]
    more: dict[str, Any] = {"friction": problem.friction, "names": names, "name": problem.name}
    b: FloatArray = problem.b[rows] if largest(problem.b[rows]) >= LEAST else np.zeros(len(rows))
    if problem.generalized is not None:
        assert problem.compliance is not None
        trees = problem.generalized.trees
        touched = np.isin(trees, np.unique(trees[problem.generalized.jac[rows].indices]))
        general = problem.generalized.restrict(rows, np.flatnonzero(touched))
        return Problem(b, cones, generalized=general, compliance=problem.compliance[rows], **more)
    if problem.rows is None:
        return Problem(b, cones, problem.csr[rows][:, rows], **more)
    given = problem.rows
    joints = blocks[blocks < given.n_joints]
    contacts = blocks[blocks >= given.n_joints] - given.n_joints
    used = np.unique(np.concatenate([given.joint_body[joints].ravel(), given.contact_body[contacts].ravel()]))
    used = used[used >= 0]
    number = np.full(given.n_bodies + 1, -1, np.int32)  # the last entry is body -1
    number[used] = np.arange(len(used))
    joint_rows = int(np.diff(given.joint_ptr)[joints].sum())
    part = replace(
        given,
        inv_mass=given.inv_mass[used],
        inv_inertia=given.inv_inertia[used],
        v_free=given.v_free[used],
        jac=given.jac[rows[:joint_rows]],
        joint_ptr=np.concatenate([[0], np.cumsum(np.diff(given.joint_ptr)[joints])]).astype(np.int32),
        joint_body=number[given.joint_body[joints]],
        normal=given.normal[contacts],
        tangent=given.tangent[contacts],
        arm_a=given.arm_a[contacts],
        arm_b=given.arm_b[contacts],
        contact_body=number[given.contact_body[contacts]],
        copy=False,
    )
    assert problem.compliance is not None
    return Problem(b, cones, rows=part, compliance=problem.compliance[rows], **more)
