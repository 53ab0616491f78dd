"""Check coefficients of friction, and convert them for disks, ellipses and boxes."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, as_array, check_nonnegative_magnitudes
from lavender.base.errors import InputError, check_name

# Shapes of the bound of two tangents: their norm is bounded, or each tangent separately.
SHAPES = ("disk", "box")
# In a box, mu_1 = 0 with mu_2 > 0 is stored as this multiple of mu_2, because the ratio mu_2 / mu_1 is stored.
# Impulses of that size vanish by rounding when they are added to impulses along the second tangent. An ellipse with a
# smaller ratio of its coefficients is rejected.
MIN_COEFFICIENT_RATIO = 2.0**-60


def check_shape(name: str, shape: Any) -> str:
    """Return a shape of friction; raise UnknownName unless it is one of `SHAPES`."""
    check_name(name, shape, SHAPES)
    return shape


def check_coefficients(name: str, value: Any, k: int, unit: str = "") -> FloatArray:
    """Convert coefficients or radii to a checked array (k,), one for each of k contacts."""
    array = as_array(name, value, (k,), unit=unit or "-")
    check_nonnegative_magnitudes(name, array, unit or "-")
    return array


def check_friction_combination(
    mu: Any, tangents: int, spin: bool, rolling: bool, is_box: bool, is_pair: bool
) -> None:
    """Raise InputError if no kind of contact has this combination of rows."""
    if is_box and (spin or rolling or tangents > 2):
        raise InputError(
            "a box has up to two tangents, and neither spin nor rolling: leave patch_radius, rolling and tangents "
            "out, or give shape='disk'"
        )
    if is_pair and not is_box:
        raise InputError(
            f"mu has shape {np.shape(mu)}; two coefficients for each contact define an ellipse, which has "
            "neither spin nor rolling: leave patch_radius, rolling and tangents out, or give one mu for each contact"
        )
    if tangents > 2 and spin:
        raise InputError(
            f"{tangents} tangents make a round cone, which includes spin: leave patch_radius out"
        )
    if rolling and tangents != 2:
        raise InputError(
            f"rolling needs tangents=2, because the rolling rows rotate about two tangents; tangents is {tangents}"
            + (" (a round cone, which includes rolling)" if tangents > 2 else "")
        )


def _convert_coefficient_pairs(mu: Any) -> FloatArray:
    """Convert coefficients of two tangents to a checked array (k, 2)."""
    array = as_array("mu", mu, (None,) * np.ndim(mu))
    check_nonnegative_magnitudes("mu", array, "-")
    if array.ndim != 2 or array.shape[1] != 2:
        raise InputError(f"mu has shape {array.shape}; (k,) or (k, 2), one for each tangent, is needed")
    return array


def convert_box_coefficients(mu: Any) -> tuple[Any, FloatArray]:
    """Return mu_1 (float or (k,)) and mu_2 / mu_1 (1,) or (k,) of boxes with mu scalar, (k,) or (k, 2)."""
    if np.ndim(mu) < 2:
        return mu, np.ones(1)
    first, second = _convert_coefficient_pairs(mu).T
    smallest = MIN_COEFFICIENT_RATIO * second
    first = np.where((first <= smallest) & (second > 0.0), smallest, first)
    return first, np.divide(second, first, out=np.zeros(len(first)), where=first > 0.0)


def convert_ellipse_coefficients(mu: Any) -> tuple[FloatArray, FloatArray | None]:
    """Return mu_1 (k,) and mu_2 / mu_1 (k,) of ellipses with mu (k, 2); the ratio is None if all are disks."""
    pairs = _convert_coefficient_pairs(mu)
    smaller, larger = pairs.min(axis=1), pairs.max(axis=1)
    bad = np.flatnonzero((smaller < 2.0 * MIN_COEFFICIENT_RATIO * larger) & (larger > 0.0))
    if len(bad):
        raise InputError(
            f"mu of contact {bad[0]} is {pairs[bad[0]].tolist()}; an ellipse needs two numbers above 0 with a "
            "ratio below 1e18, or two zeros: give shape='box' for a tangent without friction"
        )
    first, second = pairs[:, 0], pairs[:, 1]
    ratio = np.divide(second, first, out=np.ones(len(first)), where=first > 0.0)
    return first.copy(), ratio if (ratio != 1.0).any() else None
