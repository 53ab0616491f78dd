"""Coefficients of friction as a caller gives them: checked, and read as disks, ellipses or boxes."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, as_array, check_sizes
from lavender.base.errors import InputError, check_name

# What bounds two tangents: their norm, or each by itself.
SHAPES = ("disk", "box")
# mu_1 = 0 beside mu_2 > 0 stands as this share of mu_2 in a box: its impulses vanish in any sum with those of mu_2.
# An ellipse is wider than that.
LEAST_SHARE = 2.0**-60


def check_shape(name: str, shape: Any) -> str:
    """A shape of friction, one of SHAPES.

    Raises
    ------
    UnknownName
        None of them.
    """
    check_name(name, shape, SHAPES)
    return shape


def sizes_of(name: str, value: Any, k: int, unit: str = "") -> FloatArray:
    """Coefficients or radii, one for each of k contacts, checked."""
    array = as_array(name, value, (k,), unit=unit or "-")
    check_sizes(name, array, unit or "-")
    return array


def check_parts(mu: Any, tangents: int, spin: bool, rolls: bool, box: bool, pair: bool) -> None:
    """Raise where no kind of contact has these rows together."""
    if box and (spin or rolls or tangents > 2):
        raise InputError(
            "a box bounds up to two tangents, no spin and no rolling: leave patch_radius, rolling and tangents "
            "out, or give them as a disk's (shape='disk')"
        )
    if pair and not box:
        raise InputError(
            f"mu has shape {np.shape(mu)}; one for each of two tangents makes an ellipse, which bounds no spin "
            "and no rolling: leave patch_radius, rolling and tangents out, or give one mu for each contact"
        )
    if tangents > 2 and spin:
        raise InputError(f"{tangents} tangents make a round cone, which bounds spin itself: no patch_radius")
    if rolls and tangents != 2:
        raise InputError(
            f"rolling needs tangents=2, about which it rolls; tangents is {tangents}"
            + (", a round cone, which bounds rolling itself" if tangents > 2 else "")
        )


def _pairs(mu: Any) -> FloatArray:
    """mu (k, 2), one for each of two tangents, checked."""
    given = as_array("mu", mu, (None,) * np.ndim(mu))
    check_sizes("mu", given, "-")
    if given.ndim != 2 or given.shape[1] != 2:
        raise InputError(f"mu has shape {given.shape}; (k,) or (k, 2), one for each tangent, is needed")
    return given


def sides_of(mu: Any) -> tuple[Any, FloatArray]:
    """mu_1 (float or (k,)) of boxes and mu_2 / mu_1, (1,) or (k,), from mu: scalar, (k,) or (k, 2)."""
    if np.ndim(mu) < 2:
        return mu, np.ones(1)
    first, second = _pairs(mu).T
    first = np.where((first <= LEAST_SHARE * second) & (second > 0.0), LEAST_SHARE * second, first)
    some = first > 0.0
    return first, np.divide(second, first, out=np.zeros(len(first)), where=some)


def axes_of(mu: Any) -> tuple[FloatArray, FloatArray | None]:
    """mu_1 (k,) of ellipses and mu_2 / mu_1 (k,), None where all are disks, from mu (k, 2)."""
    given = _pairs(mu)
    flat = np.flatnonzero(
        (given.min(axis=1) < 2.0 * LEAST_SHARE * given.max(axis=1)) & (given.max(axis=1) > 0.0)
    )
    if len(flat):
        raise InputError(
            f"mu of contact {flat[0]} is {given[flat[0]].tolist()}; an ellipse needs two numbers above 0 (or no "
            "friction at all), none 1e18 times the other: shape='box' takes a tangent without friction"
        )
    first, second = given[:, 0], given[:, 1]
    ratio = np.divide(second, first, out=np.ones(len(first)), where=first > 0.0)
    return first.copy(), ratio if (ratio != 1.0).any() else None
