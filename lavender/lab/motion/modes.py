"""Every motion of a few contacts with one tangent: each open, stuck or sliding either way, one linear system a mode.

    open    lambda = 0                                      w_n >= 0
    stuck   w = 0                                           |lambda_t| <= mu lambda_n
    slides  w_n = 0,  lambda_t = -s mu lambda_n, s = +-1    s w_t >= 0,  lambda_n >= 0
    row     lambda at a bound, or w = 0                     w away from the bound, or lambda within

A solution lies in one of these, so all modes together hold every solution: four to the power of the contacts. Where
a mode's system is singular its solutions are x + N y; they are one motion where A N = 0, and where some y keeps to the
inequalities. Two tangents have a circle of directions to slide in, which no list holds.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.problem import Problem

CONTACTS = 8
MOST = 4**CONTACTS  # modes
AT_ONCE = 4096  # systems in memory
SINGULAR = 300  # singular modes with solutions along more than one direction: a linear program each
SLOP = 1e-9  # of the largest number of a system: what rounding may do to an inequality
NULL = 1e-11  # singular values of a scaled system, of the largest, that count as zero


class _Ways(NamedTuple):
    """What a block can do, for each way: equations E x = e and inequalities F x >= f, x scaled impulses."""

    equal: FloatArray  # (ways, r, m)
    rhs: FloatArray  # (ways, r)
    above: FloatArray  # (ways, 3, m)
    bound: FloatArray  # (ways, 3)


def enumerated(problem: Problem) -> tuple[list[FloatArray], bool] | None:
    """Impulses (m,) [N s] of every mode that has a solution, and whether their motions are all there are.

    None where the problem has more than eight contacts or 65,536 modes, a contact with friction in two tangents or
    spin, or numbers beyond float64 on the way. Not all: a mode with motions next to each other without end, or too
    many singular modes.
    """
    c = problem.cones
    contact = c.is_contact
    flat = (np.diff(c.ptr) == 1 + c.n_together) & ((c.n_tangents <= 1) | (c.mu == 0.0))
    if np.count_nonzero(contact) > CONTACTS or not np.all(flat[contact]):
        return None
    counts = np.where(contact, 2 + 2 * (c.n_tangents > 0) * (c.mu > 0.0), 1).astype(float)
    sides = 1 + (c.lower < c.upper) * (0.0 + np.isfinite(c.lower) + np.isfinite(c.upper))
    counts[~contact] = [float(np.prod(sides[c.ptr[i] : c.ptr[i + 1]])) for i in np.flatnonzero(~contact)]
    if np.log(counts).sum() > np.log(MOST) + 1e-9:
        return None
    with np.errstate(all="ignore"):
        scale = 1.0 / np.sqrt(problem.d)
        a = scale[:, None] * problem.dense() * scale
        b = scale * problem.b
        unit = float(np.abs(b).max(initial=0.0)) or 1.0  # sqrt J: the largest number of a system is 1
        b, scale = b / unit, unit * scale
        ways = [w for i in range(c.n_blocks) for w in _ways(problem, i, a, b, scale)]
    if not all(np.isfinite(part).all() for way in ways for part in way):
        return None
    found, whole = [], True
    left = SINGULAR
    for equal, rhs, above, bound in _systems(ways):
        value = np.linalg.svd(equal, compute_uv=False)
        regular = value[:, -1] > NULL * value[:, 0]
        x = np.linalg.solve(equal[regular], rhs[regular][:, :, None])[:, :, 0]
        slop = SLOP * np.maximum(1.0, np.abs(x).max(axis=1, initial=0.0))
        inside = np.all(np.einsum("kij,kj->ki", above[regular], x) >= bound[regular] - slop[:, None], axis=1)
        found += list(scale * x[inside])
        equal, rhs, above, bound = equal[~regular], rhs[~regular], above[~regular], bound[~regular]
        u, value, vt = np.linalg.svd(equal)
        inverse = np.divide(1.0, value, out=np.zeros_like(value), where=value > NULL * value[:, :1])
        along = inverse * np.einsum("klj,kl->kj", u, rhs)
        x = np.einsum("kji,kj->ki", vt, along)
        off = np.abs(np.einsum("kij,kj->ki", equal, x) - rhs).max(axis=1, initial=0.0)
        for i in np.flatnonzero(off <= SLOP):
            null = vt[i][inverse[i] == 0.0].T
            left -= null.shape[1] > 1
            if left < 0:
                return found, False
            y = _within(above[i] @ null, bound[i] - above[i] @ x[i] - SLOP)
            if y is not None:
                whole &= bool(np.abs(a @ null).max() <= SLOP)
                found.append(scale * (x[i] + null @ y))
    return found, whole


def _ways(problem: Problem, block: int, a: FloatArray, b: FloatArray, scale: FloatArray) -> Iterator[_Ways]:
    c = problem.cones
    one = np.eye(problem.m)
    none, nothing = np.zeros(problem.m), 0.0
    start, end = c.ptr[block], c.ptr[block + 1]
    if not c.is_contact[block]:
        for i in range(start, end):
            low, high = c.lower[i] / scale[i], c.upper[i] / scale[i]
            some = []
            if low < high:
                inside = [
                    (one[i], low if np.isfinite(low) else None),
                    (-one[i], -high if np.isfinite(high) else None),
                ]
                some.append(([(a[i], b[i])], [(x, y) for x, y in inside if y is not None]))
                some += [([(one[i], low)], [(a[i], b[i])])] * bool(np.isfinite(low))
                some += [([(one[i], high)], [(-a[i], -b[i])])] * bool(np.isfinite(high))
            else:
                some.append(([(one[i], low)], []))
            yield _packed(some, problem.m)
        return
    n, mu = start, c.mu[block]
    off = [(one[t], nothing) for t in range(start + 1, end)]
    opened = ([(one[n], nothing), *off], [(a[n], b[n])])
    if mu == 0.0 or end - start == 1:
        yield _packed([opened, ([(a[n], b[n]), *off], [(one[n], nothing)])], problem.m)
        return
    t = start + 1
    rub = mu * scale[n] / scale[t] * one[n]  # the bound of the scaled tangent
    stuck = (
        [(a[n], b[n]), (a[t], b[t])],
        [(one[n], nothing), (rub - one[t], nothing), (rub + one[t], nothing)],
    )
    slide = [
        (
            [(a[n], b[n]), (one[t] + s * rub, nothing)],
            [(one[n], nothing), (s * a[t], s * b[t]), (none, nothing)],
        )
        for s in (1.0, -1.0)
    ]
    yield _packed([opened, stuck, *slide], problem.m)


def _packed(some: list[Any], m: int) -> _Ways:
    r = len(some[0][0])
    out = _Ways(
        np.zeros((len(some), r, m)),
        np.zeros((len(some), r)),
        np.zeros((len(some), 3, m)),
        np.zeros((len(some), 3)),
    )
    for k, (equal, above) in enumerate(some):
        for i, (x, y) in enumerate(equal):
            out.equal[k, i], out.rhs[k, i] = x, y
        for i, (x, y) in enumerate(above):
            out.above[k, i], out.bound[k, i] = x, y
    return out


def _systems(ways: list[_Ways]) -> Iterator[tuple[FloatArray, ...]]:
    """E (k, m, m), e, F, f of all modes, some at a time."""
    counts = [len(w.rhs) for w in ways]
    for first in range(0, int(np.prod(counts)), AT_ONCE):
        mode = np.unravel_index(np.arange(first, min(first + AT_ONCE, int(np.prod(counts)))), counts)
        yield tuple(
            np.concatenate([w[part][i] for w, i in zip(ways, mode, strict=True)], axis=1) for part in range(4)
        )


def _within(g: FloatArray, h: FloatArray) -> FloatArray | None:
    """Some y with G y >= h, or None."""
    if g.shape[1] == 1:
        slope = g[:, 0]
        low = np.max(h[slope > NULL] / slope[slope > NULL], initial=-np.inf)
        high = np.min(h[slope < -NULL] / slope[slope < -NULL], initial=np.inf)
        if low > high or np.any(h[np.abs(slope) <= NULL] > 0.0):
            return None
        return np.array([min(max(low, 0.0), high)])
    from scipy.optimize import linprog

    end = linprog(np.zeros(g.shape[1]), A_ub=-g, b_ub=-h, bounds=(None, None), method="highs")
    return end.x if end.status == 0 else None
