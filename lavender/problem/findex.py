"""Blocks in the arrays of ODE, Bullet and DART: bounds of each row, and the row whose impulse they follow.

findex_i < 0         lower_i <= lambda_i <= upper_i
findex_i = j >= 0    |lambda_i| <= mu lambda_j, mu = upper_i, j a normal: 0 <= lambda_j         (lower_i is not read)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray, as_array
from lavender.base.errors import InputError
from lavender.problem.cones import Cones, kinds_of


def order_of(findex: Any, count: int | None = None) -> IntArray:
    """(m,) row of the arrays for each row of the problem: every normal, then those that follow it."""
    findex = as_array("findex", findex, (count,), dtype=np.int32)
    m = len(findex)
    rows = np.flatnonzero(findex >= 0)
    for i in rows:
        j = int(findex[i])
        if j >= m:
            raise InputError(
                f"findex[{i}] is {j}; a row below {m} is needed, or -1 where bounds are constant"
            )
        if j == i:
            raise InputError(
                f"findex[{i}] is its own row; give the row of its normal, or -1 where bounds are constant"
            )
        if findex[j] >= 0:
            raise InputError(
                f"findex[{i}] is {j}, which is no normal: it follows row {findex[j]} itself; a row with findex -1 is "
                "needed"
            )
    leader = np.where(findex >= 0, findex, np.arange(m))
    # by the leader, itself first, then in the order given
    return np.lexsort((np.arange(m), findex >= 0, leader)).astype(np.int32)


def blocks_of(lower: Any, upper: Any, findex: Any, m: int) -> tuple[IntArray, Cones]:
    """(`order_of` the rows, their blocks), checked."""
    findex = as_array("findex", findex, (m,), dtype=np.int32)
    order = order_of(findex, m)
    low = as_array("lower", lower, (m,), finite=False, unit="N s")
    high = as_array("upper", upper, (m,), finite=False, unit="N s")
    follows = findex >= 0
    with np.errstate(invalid="ignore"):
        for wrong, needed in (
            (~follows & ~(low <= high), "lower <= upper is needed"),
            (
                follows & ~(np.isfinite(high) & (high >= 0.0)),
                "upper is mu where findex >= 0, a finite number >= 0",
            ),
        ):
            if wrong.any():
                i = int(np.flatnonzero(wrong)[0])
                raise InputError(f"row {i}: lower = {low[i]}, upper = {high[i]}; {needed}")
    normal = np.unique(findex[follows])
    bad = normal[(low[normal] != 0.0) | (high[normal] != np.inf)]
    if len(bad):
        i = int(bad[0])
        raise InputError(
            f"row {i} is the normal of row {int(np.flatnonzero(findex == i)[0])} with bounds [{low[i]}, {high[i]}]; "
            "a normal has [0, inf]: give friction with other bounds as constant ones (findex -1)"
        )
    count = np.bincount(findex[follows], minlength=m) if m else np.zeros(0, int)
    many = np.flatnonzero(count > 2)
    if len(many):
        raise InputError(
            f"{count[many[0]]} rows follow row {many[0]}; up to two, its tangents, are known: give the others constant "
            "bounds, or spin as patch_radius of Cones.contacts"
        )
    first = order[~follows[order]]  # of every block, its row in the arrays
    size = 1 + count[first]
    ptr = np.concatenate([[0], np.cumsum(size)]).astype(np.int32)
    k = len(first)
    mu = np.zeros((k, 2))
    for column in (0, 1):
        has = np.flatnonzero(size > 1 + column)
        mu[has, column] = high[order[ptr[has] + 1 + column]]
    box, sides = Cones.contacts(mu, shape="box"), size == 3
    return order, Cones(
        ptr=ptr,
        kind=kinds_of(size > 1, sides=sides),
        lower=np.where(follows, -high, low)[order],
        upper=high[order],
        mu=np.where(sides, box.mu, mu[:, 0]),
        patch_radius=np.where(sides, box.patch_radius, 0.0),
    )


def arrays_of(cones: Cones) -> tuple[FloatArray, FloatArray, IntArray]:
    """lower, upper, findex (m,) of blocks."""
    round_ = np.flatnonzero(cones.n_together > 1)
    if len(round_):
        raise InputError(
            f"block {round_[0]} bounds its tangents together, a disk; findex bounds each by itself: "
            "give the problem cones.shaped('box'), which is another law"
        )
    lower, upper = cones.lower.copy(), cones.upper.copy()
    findex = np.full(cones.n_rows, -1, np.int32)
    rows, reach = np.flatnonzero(cones.friction_rows), cones.reach.copy()
    first = cones.ptr[:-1][cones.is_box] + 1
    reach[first] = cones.coefficients[cones.is_box, 0]  # of a side without friction 0
    upper[rows] = reach[rows]
    lower[rows] = -reach[rows]
    findex[rows] = np.repeat(cones.ptr[:-1], np.diff(cones.ptr))[rows]
    return lower, upper, findex
