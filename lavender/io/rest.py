"""Right-hand sides of bodies that have come to rest, as of a joint with friction whose velocity falls exponentially.

A problem refuses a b with all entries below 1e-60 m/s, whose squares underflow (`MIN_MAGNITUDE`). An engine reaches
such velocities by exact steps, so importers count them as 0.
"""

from __future__ import annotations

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender_ext.core.checks import MIN_MAGNITUDE

# [m/s, rad/s] Larger velocities are never set to 0.
MAX_REST_VELOCITY = 1e-30
# [m/s] A world with a larger target is not examined.
MAX_EXAMINED_TARGET = 1e-50


def count_tiny_as_zero(b: FloatArray) -> FloatArray:
    """Return b (m,) [m/s], or zeros if all of its entries are below MIN_MAGNITUDE."""
    return np.zeros_like(b) if np.abs(b).max(initial=0.0) < MIN_MAGNITUDE else b


def set_worlds_at_rest(
    jac: FloatArray, free: FloatArray, target: FloatArray, first: IntArray
) -> None:
    """Set v* and targets to 0 in place in worlds in which all entries of b = target - J v* are below MIN_MAGNITUDE.

    Only velocities of the columns that J uses change, and only if all of them are below MAX_REST_VELOCITY.

    Parameters
    ----------
    jac : (rows of all worlds, nv)
    free : (n, nv), m/s, rad/s
    target : (rows of all worlds,), m/s
    first : (n + 1,) int
        First row of each world, followed by the number of rows.
    """
    is_large = np.concatenate([[0], np.cumsum(~(np.abs(target) < MAX_EXAMINED_TARGET))])
    is_examined = (is_large[first[1:]] == is_large[first[:-1]]) & (first[1:] > first[:-1])
    for i in np.flatnonzero(is_examined).tolist():
        rows = jac[first[i] : first[i + 1]]
        own = slice(int(first[i]), int(first[i + 1]))
        used = (rows != 0.0).any(axis=0)
        is_slow = np.abs(free[i, used]).max(initial=0.0) < MAX_REST_VELOCITY
        if is_slow and np.abs(target[own] - rows @ free[i]).max() < MIN_MAGNITUDE:
            free[i, used] = 0.0
            target[own] = 0.0
