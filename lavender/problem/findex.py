"""Convert blocks from and to the arrays of ODE, Bullet and DART: bounds of each row, and its normal row `findex`.

findex_i < 0         lower_i <= lambda_i <= upper_i
findex_i = j >= 0    |lambda_i| <= mu lambda_j, mu = upper_i, j a normal: 0 <= lambda_j         (lower_i is not read)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray, as_array
from lavender.base.errors import InputError
from lavender.problem.cones import Cones, get_block_kinds


def order_findex_rows(findex: Any, count: int | None = None) -> IntArray:
    """Return, for each row of the problem (m,), its row in the arrays; friction rows follow their normal row."""
    findex = as_array("findex", findex, (count,), dtype=np.int32)
    m = len(findex)
    rows = np.flatnonzero(findex >= 0)
    for i in rows:
        j = int(findex[i])
        if j >= m:
            raise InputError(
                f"findex[{i}] is {j}; a row below {m} is needed, or -1 for constant bounds"
            )
        if j == i:
            raise InputError(
                f"findex[{i}] is {i}, its own row; the row of its normal is needed, or -1"
            )
        if findex[j] >= 0:
            raise InputError(
                f"findex[{i}] is {j}, a row with findex {findex[j]}; the row of a normal (findex -1) is needed"
            )
    normal = np.where(findex >= 0, findex, np.arange(m))
    # Sort by the normal row, then the normal before its friction rows, then by the original order.
    return np.lexsort((np.arange(m), findex >= 0, normal)).astype(np.int32)


def convert_from_findex(lower: Any, upper: Any, findex: Any, m: int) -> tuple[IntArray, Cones]:
    """Check the arrays (m,) and return `order_findex_rows` and the blocks."""
    findex = as_array("findex", findex, (m,), dtype=np.int32)
    order = order_findex_rows(findex, m)
    low = as_array("lower", lower, (m,), finite=False, unit="N s")
    high = as_array("upper", upper, (m,), finite=False, unit="N s")
    is_friction = findex >= 0
    with np.errstate(invalid="ignore"):
        for is_bad, requirement in (
            (~is_friction & ~(low <= high), "lower <= upper is needed"),
            (
                is_friction & ~(np.isfinite(high) & (high >= 0.0)),
                "on a row with findex >= 0, upper is mu: a finite number >= 0 is needed",
            ),
        ):
            if is_bad.any():
                i = int(np.flatnonzero(is_bad)[0])
                raise InputError(f"row {i}: lower = {low[i]}, upper = {high[i]}; {requirement}")
    normal = np.unique(findex[is_friction])
    bad = normal[(low[normal] != 0.0) | (high[normal] != np.inf)]
    if len(bad):
        i = int(bad[0])
        raise InputError(
            f"row {i} is the normal of friction row {int(np.flatnonzero(findex == i)[0])} and has the "
            f"bounds [{low[i]}, {high[i]}]; [0, inf] is needed, or findex -1 of its friction rows"
        )
    count = np.bincount(findex[is_friction], minlength=m) if m else np.zeros(0, int)
    bad = np.flatnonzero(count > 2)
    if len(bad):
        raise InputError(f"{count[bad[0]]} rows have findex {bad[0]}; at most two are possible")
    first = order[~is_friction[order]]  # First row of each block, as an index into the arrays.
    size = 1 + count[first]
    ptr = np.concatenate([[0], np.cumsum(size)]).astype(np.int32)
    k = len(first)
    mu = np.zeros((k, 2))
    for tangent in (0, 1):
        blocks = np.flatnonzero(size > 1 + tangent)
        mu[blocks, tangent] = high[order[ptr[blocks] + 1 + tangent]]
    box = Cones.contacts(mu, shape="box")
    is_box = size == 3
    return order, Cones(
        ptr=ptr,
        kind=get_block_kinds(size > 1, box=is_box),
        lower=np.where(is_friction, -high, low)[order],
        upper=high[order],
        mu=np.where(is_box, box.mu, mu[:, 0]),
        patch_radius=np.where(is_box, box.patch_radius, 0.0),
    )


def convert_to_findex(cones: Cones) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return lower, upper and findex (m,) of blocks; raise InputError for disks."""
    disks = np.flatnonzero(cones.n_together > 1)
    if len(disks):
        raise InputError(f"block {disks[0]} is a disk; a box is needed: cones.shaped('box')")
    lower, upper = cones.lower.copy(), cones.upper.copy()
    findex = np.full(cones.n_rows, -1, np.int32)
    rows = np.flatnonzero(cones.friction_rows)
    coefficient = cones.friction_coefficient.copy()
    first_tangent = cones.ptr[:-1][cones.is_box] + 1
    # A tangent without friction gets exactly 0.
    coefficient[first_tangent] = cones.coefficients[cones.is_box, 0]
    upper[rows] = coefficient[rows]
    lower[rows] = -coefficient[rows]
    findex[rows] = np.repeat(cones.ptr[:-1], np.diff(cones.ptr))[rows]
    return lower, upper, findex
