"""Build the blocks of a problem from the numbers of its rows and the coefficients of its contacts."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import (
    FloatArray,
    IntArray,
    as_array,
    check_int,
    check_unmasked,
    get_shape,
)
from lavender.base.errors import InputError
from lavender.problem.cones import Cones, get_block_kinds


def make_contacts_of_rows(
    name: str, m: int, mu: Any, tangents: Any, patch_radius: Any = None, rolling: Any = None
) -> Cones:
    """Build contacts with equal numbers of rows from m rows and a mu for each contact; `name` has the rows."""
    if (
        type(mu) is float
        and tangents is None
        and patch_radius is None
        and rolling is None
        and m % 3 == 0
    ):
        return Cones.contacts(mu, count=m // 3)
    check_unmasked("mu", mu)
    angular_rows = (patch_radius is not None) + 2 * (rolling is not None)
    is_ellipse = len(get_shape("mu", mu)) > 1
    own = None if tangents is None else check_int("tangents", tangents, high=2)
    if is_ellipse and own in (None, 2):
        return Cones.contacts(mu, 2, patch_radius, rolling=rolling)
    if np.ndim(mu) == 0:
        rows = 1 + angular_rows + (2 if own is None else own)
        mu = np.full(m // rows if m % rows == 0 else 1, mu)
    mu = as_array("mu", mu, (None,))
    if (len(mu) == 0) != (m == 0) or (len(mu) and m % len(mu)):
        raise InputError(f"{name} has {m} rows; a multiple of the {len(mu)} values of mu is needed")
    count = m // len(mu) - 1 - angular_rows if len(mu) else 2 * (rolling is not None)
    if not 0 <= count <= 2 or (own is not None and len(mu) and count != own):
        asked = "up to two tangent rows" if own is None else f"{own} tangent rows"
        raise InputError(
            f"{name} has {m} rows for {len(mu)} contacts; each contact needs a normal row, {asked}, a spin row if "
            "patch_radius is given, and two rolling rows if rolling is given"
        )
    if own is None and count == 1 and m % 3 == 0 and angular_rows == 0:
        raise InputError(
            f"{name} has {m} rows and mu {len(mu)} values, so that these are {len(mu)} contacts with one tangent each, "
            f"or {m // 3} contacts with two: give tangents=1, or {m // 3} values of mu"
        )
    if patch_radius is not None:
        patch_radius = as_array("patch_radius", patch_radius, (len(mu),), unit="m")
    elif count == 0 and np.any(mu > 0.0):
        raise InputError(
            f"mu has {len(mu)} values for {m} rows; mu > 0 needs rows for friction: give one mu for each contact"
        )
    return Cones.contacts(mu, count, patch_radius, rolling=rolling)


def make_contacts(
    mu: FloatArray, tangents: IntArray, patch_radius: Any, rolling: Any, shape: str
) -> Cones:
    """Build contacts of 0 to 2 tangents (c,), with spin rows if a patch radius is given, rolling rows if mu_r is."""
    has_spin, has_rolling = patch_radius is not None, rolling is not None
    for is_bad, requirement in (
        ((tangents < 0) | (tangents > 2), "0, 1 or 2 is needed for each contact"),
        ((tangents < 2) & has_rolling, "rolling rows rotate about two tangents: give tangents=2"),
        (
            (tangents == 0) & (mu > 0.0) & (not has_spin),
            "mu > 0 needs a friction row: give tangents=2, or mu 0",
        ),
    ):
        if is_bad.any():
            i = int(is_bad.argmax())
            raise InputError(
                f"tangents of contact {i} is {tangents[i]}, and mu {mu[i]:g}; {requirement}"
            )
    if not tangents.size or (tangents == tangents[0]).all():
        count = int(tangents[0]) if tangents.size else 2
        return Cones.contacts(mu, count, patch_radius, rolling=rolling, shape=shape)
    ptr = np.append(0, np.cumsum(1 + tangents + has_spin + 2 * has_rolling))
    kind = get_block_kinds(np.ones(len(mu), bool), spin=has_spin, rolling=has_rolling)
    infinite = np.full(int(ptr[-1]), np.inf)
    zeros = np.zeros(len(mu))
    radius = zeros if patch_radius is None else patch_radius
    cones = Cones(ptr, kind, -infinite, infinite, mu=mu, patch_radius=radius, rolling=rolling)
    return cones.shaped(shape) if shape == "box" else cones
