"""Build the blocks of contacts from coefficients of friction, and project impulses on the bounds of blocks."""

from __future__ import annotations

from math import isfinite
from typing import Any

import numpy as np

from lavender.base.arrays import (
    FloatArray,
    as_array,
    check_int,
    check_nonnegative_magnitudes,
    get_shape,
)
from lavender.base.errors import InputError, check_name
from lavender_ext.core import blocks as kernels
from lavender_ext.judge import measure

*_, BOX_KIND, _, ELLIPSE_KIND = kernels.KINDS

# Shapes of the bound of two tangents: their norm is bounded, or each tangent separately.
SHAPES = ("disk", "box")
# In a box, mu_1 = 0 with mu_2 > 0 is stored as this multiple of mu_2, because the ratio mu_2 / mu_1 is stored.
# Impulses of that size vanish by rounding when they are added to impulses along the second tangent. An ellipse with a
# smaller ratio of its coefficients is rejected.
MIN_COEFFICIENT_RATIO = 2.0**-60


def _convert_coefficient_pairs(mu: Any) -> FloatArray:
    """Convert coefficients of two tangents to a checked array (k, 2)."""
    array = as_array("mu", mu, (None,) * np.ndim(mu))
    check_nonnegative_magnitudes("mu", array, "-")
    if array.ndim != 2 or array.shape[1] != 2:
        raise InputError(
            f"mu has shape {array.shape}; (k,) or (k, 2), one for each tangent, is needed"
        )
    return array


def convert_ellipse_coefficients(mu: Any) -> tuple[FloatArray, FloatArray | None]:
    """Return mu_1 (k,) and mu_2 / mu_1 (k,) of ellipses with mu (k, 2); the ratio is None if all are disks."""
    pairs = _convert_coefficient_pairs(mu)
    smaller, larger = pairs.min(axis=1), pairs.max(axis=1)
    bad = np.flatnonzero((smaller < 2.0 * MIN_COEFFICIENT_RATIO * larger) & (larger > 0.0))
    if len(bad):
        raise InputError(
            f"mu of contact {bad[0]} is {pairs[bad[0]].tolist()}; an ellipse needs a ratio above 0 and below 1e18"
        )
    first, second = pairs[:, 0], pairs[:, 1]
    ratio = np.divide(second, first, out=np.ones(len(first)), where=first > 0.0)
    return first.copy(), ratio if (ratio != 1.0).any() else None


def make_contact_blocks(
    mu: Any, tangents: int, patch_radius: Any, rolling: Any, count: int | None, shape: str
) -> kernels.Blocks:
    """Build the blocks of k contacts with the same rows, which may have a fault; `Cones.contacts` has the arguments."""
    if type(tangents) is not int or not 0 <= tangents <= 5:
        tangents = check_int("tangents", tangents, 0, 5)
    is_box = check_name("shape", shape, SHAPES) == "box"
    is_pair = type(mu) is not float and len(get_shape("mu", mu)) > 1
    has_spin, has_rolling = patch_radius is not None, rolling is not None
    if has_spin or has_rolling or tangents != 2:
        if is_box and (has_spin or has_rolling or tangents > 2):
            raise InputError(
                "a box has up to two tangents, without spin (patch_radius) and rolling"
            )
        if is_pair and not is_box:
            raise InputError(
                f"mu has shape {np.shape(mu)}, of ellipses; (k,) is needed with spin or rolling"
            )
        if tangents > 2 and has_spin:
            raise InputError(
                f"{tangents} tangents make a round cone, which has spin: leave patch_radius out"
            )
        if has_rolling and tangents != 2:
            raise InputError(
                f"tangents is {tangents}; rolling needs tangents=2, the axes of rolling"
            )
    ratio = None
    pair_kind = 0
    if is_box and tangents == 2:
        pair_kind = BOX_KIND
        ratio = np.ones(1)
        if is_pair:
            mu, second = _convert_coefficient_pairs(mu).T
            smallest = MIN_COEFFICIENT_RATIO * second
            mu = np.where((mu <= smallest) & (second > 0.0), smallest, mu)
            ratio = np.divide(second, mu, out=np.zeros(len(mu)), where=mu > 0.0)
    elif is_pair and not is_box:
        mu, ratio = convert_ellipse_coefficients(mu)
        pair_kind = 0 if ratio is None else ELLIPSE_KIND
    size_of_mu = 1 if type(mu) is float or np.ndim(mu) == 0 else get_shape("mu", mu)[0]
    k = size_of_mu if count is None else check_int("count", count)
    mu = mu if type(mu) is float and isfinite(mu) else as_array("mu", mu, (k,), unit="-")
    if patch_radius is not None:
        patch_radius = as_array("patch_radius", patch_radius, (k,), unit="m")
    if rolling is not None:
        rolling = as_array("rolling", rolling, (k,), unit="m")
    if ratio is not None:
        patch_radius = np.ascontiguousarray(np.broadcast_to(ratio, (k,)))
    blocks = kernels.make_contact_blocks(k, tangents, mu, patch_radius, rolling, pair_kind)
    if blocks is None:
        raise InputError(f"{k} contacts have more than 2^31 - 1 rows: split the problem")
    return blocks


def project_impulse(cones: Any, impulse: FloatArray) -> FloatArray:
    """Project an impulse (m,) [N s] on the bounds of `Cones`, normal rows first.

    Bounded rows and normals are clipped. Then each friction component is projected radially on its coefficient times
    the clipped normal impulse. This is the feasibility step of a sweep, not the projection on the friction cone.
    """
    if cones.has_ellipse:
        return cones.stretch * project_impulse(
            cones.ellipses_replaced_by_disks, impulse / cones.stretch
        )
    out: FloatArray = measure.project_impulse_on_bounds(cones._blocks, impulse)
    return out
