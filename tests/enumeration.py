"""Truth for small boxed LCPs: every choice of which rows are free, at their lower or at their upper bound."""

import itertools

import numpy as np


def random_bounds(rng, m):
    """A mix of plain, boxed, upper-only, free and fixed rows."""
    kind = rng.integers(0, 5, m)
    return np.choose(kind, [0.0, -1.0, -np.inf, -np.inf, 0.5]), np.choose(
        kind, [np.inf, 1.0, 0.5, np.inf, 0.5]
    )


def enumerate_lcp(a, b, lower, upper, tol=1e-9):
    """All (lambda, w) that solve the boxed LCP with a nonsingular free block, up to `tol`; n up to 8 or so."""
    sides = [
        [-1] if lo == hi else [0] + [-1] * bool(np.isfinite(lo)) + [1] * bool(np.isfinite(hi))
        for lo, hi in zip(lower, upper, strict=True)
    ]
    found = []
    fixed = lower == upper  # any w
    for side in map(np.array, itertools.product(*sides)):
        free = side == 0
        x = np.where(side < 0, lower, np.where(side > 0, upper, 0.0))
        if free.any():
            block = a[np.ix_(free, free)]
            if np.linalg.cond(block) > 1e12:
                continue
            x[free] = np.linalg.solve(block, b[free] - a[np.ix_(free, ~free)] @ x[~free])
        w = a @ x - b
        slop = tol * (1.0 + np.abs(x).max(initial=0.0) + np.abs(b).max(initial=0.0))
        inside = np.all(x >= lower - slop) and np.all(x <= upper + slop)
        if inside and np.all(w[(side < 0) & ~fixed] >= -slop) and np.all(w[side > 0] <= slop):
            found.append((x, w))
    return found
