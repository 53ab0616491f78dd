"""Exact solutions of small bounded problems, found by trying every choice of active bounds."""

import itertools

import numpy as np


def random_bounds(rng, m):
    """Draw lower and upper bounds (m,) of rows: only lower, both, only upper, none, or equal bounds."""
    kind = rng.integers(0, 5, m)
    return np.choose(kind, [0.0, -1.0, -np.inf, -np.inf, 0.5]), np.choose(
        kind, [np.inf, 1.0, 0.5, np.inf, 0.5]
    )


def enumerate_lcp(a, b, lower, upper, tol=1e-9):
    """Return every (impulse, slack) that solves the bounded problem up to `tol` with a nonsingular block of free rows.

    The time grows as 3^m: m is at most about 8.
    """
    choices = [
        [-1] if lo == hi else [0] + [-1] * bool(np.isfinite(lo)) + [1] * bool(np.isfinite(hi))
        for lo, hi in zip(lower, upper, strict=True)
    ]
    solutions = []
    equal = lower == upper  # Any slack is admissible on rows with equal bounds.
    for bound in map(np.array, itertools.product(*choices)):
        free = bound == 0
        x = np.where(bound < 0, lower, np.where(bound > 0, upper, 0.0))
        if free.any():
            block = a[np.ix_(free, free)]
            if np.linalg.cond(block) > 1e12:
                continue
            x[free] = np.linalg.solve(block, b[free] - a[np.ix_(free, ~free)] @ x[~free])
        w = a @ x - b
        margin = tol * (1.0 + np.abs(x).max(initial=0.0) + np.abs(b).max(initial=0.0))
        inside = np.all(x >= lower - margin) and np.all(x <= upper + margin)
        if inside and np.all(w[(bound < 0) & ~equal] >= -margin) and np.all(w[bound > 0] <= margin):
            solutions.append((x, w))
    return solutions
