"""The rows of a problem that move, in the scaled unknown of Newton's method.

    z = D^1/2 lambda,   H = D^-1/2 A D^-1/2,   g = D^-1/2 b,   H z - g = s,   z, s complementary on every element

An element is a bounded row, or a contact with the tangents, the spin and the rolling that move.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lavender._arrays import FloatArray, IntArray
from lavender.cones import CONTACT, CONTACT_ROLLING, CONTACT_SPIN, ROW
from lavender.problem import Problem
from lavender.solvers._islands import block_bodies


@dataclass
class Scaled:
    """Rows that move, as elements. Fixed rows (equal bounds, mu = 0 tangents, empty rows) are taken out."""

    problem: Problem
    keep: IntArray  # (mk,) rows that move
    fixed: FloatArray  # (m,) impulse of the fixed rows, 0 elsewhere
    scale: FloatArray  # (mk,) D^-1/2
    g: FloatArray  # (mk,)
    theta: FloatArray  # (mk,)
    ptr: IntArray  # (n + 1,) first row of each element
    kind: IntArray  # (n,)
    wptr: IntArray  # (n + 1,) first entry of each element's small matrix
    lower: FloatArray  # (mk,)
    upper: FloatArray  # (mk,)
    a_t: FloatArray  # (n,) mu in the metric of d; 0 on rows
    a_s: FloatArray  # (n,) mu r likewise
    a_r: FloatArray | None = None  # (n,) mu_r likewise; None without rolling
    bodies: IntArray | None = None  # (n, 2) bodies of each element
    whole: bool = True  # every row moves

    @property
    def m(self) -> int:
        return len(self.keep)

    @property
    def has_friction(self) -> bool:
        """Some element has more rows than one: a contact with tangents or spin that move."""
        return len(self.kind) < self.m

    @cached_property
    def speed(self) -> FloatArray:
        """Velocity error (m,) per unit of the natural map."""
        weight = self.problem.metric.weight
        return np.asarray((weight if self.whole else weight[self.keep]) * self.scale)

    def impulse(self, z: FloatArray) -> FloatArray:
        """lambda (m,) of z."""
        if self.whole:
            return z * self.scale
        lam = self.fixed.copy()
        lam[self.keep] = z * self.scale
        return lam

    def unknown(self, impulse: FloatArray) -> FloatArray:
        """z of lambda (m,)."""
        return (impulse if self.whole else impulse[self.keep]) / self.scale


@dataclass(frozen=True)
class _Elements:
    """Which rows move, and how they stand together."""

    ptr: IntArray  # (n + 1,) first of its moving rows
    kind: IntArray  # (n,)
    block: Any  # (n,) block of each element, or a slice of all where that is itself
    held: tuple[IntArray, FloatArray] | None = (
        None  # rows that move, impulse of those that do not; None: all move
    )


def scaled(problem: Problem) -> Scaled:
    """Scale, and take out what cannot move."""
    cones, m = problem.cones, problem.m
    e = _elements(problem)
    if e.held is None:
        keep, fixed = np.arange(m, dtype=np.int32), np.zeros(m)
        pick: Any = slice(None)
        b = problem.b
    else:
        keep, fixed = e.held
        pick = keep
        # -A fixed: slack(fixed) = A fixed - b
        b = problem.b - (problem.slack(fixed) + problem.b) if fixed.any() else problem.b
    scale = 1.0 / np.sqrt(problem.d[pick])
    mk, compliance = len(keep), problem.compliance
    if len(e.kind) == mk:
        wptr = e.ptr
        a_t = a_s = np.zeros(mk)
        a_r = None
    else:
        size = np.diff(e.ptr)
        wptr = np.concatenate([[0], np.cumsum(size**2)]).astype(np.int32)
        root, reach = 1.0 / scale, cones.reach[pick]
        turning = np.where(e.kind == CONTACT_SPIN, e.ptr[1:] - 1, e.ptr[:-1] + 3)

        def opened(at: IntArray, has: Any) -> FloatArray:
            at = np.minimum(at, mk - 1)
            return np.where(has, reach[at] * root[at] / root[e.ptr[:-1]], 0.0)

        rolls = e.kind == CONTACT_ROLLING
        a_t = opened(e.ptr[:-1] + 1, e.kind != ROW)
        a_s = opened(turning, (e.kind == CONTACT_SPIN) | (rolls & (size == 6)))
        a_r = opened(e.ptr[1:] - 2, rolls) if rolls.any() else None
    return Scaled(
        problem=problem,
        keep=keep,
        fixed=fixed,
        scale=scale,
        g=b[pick] * scale,
        theta=np.zeros(mk) if compliance is None else compliance[pick] * scale * scale,
        ptr=e.ptr,
        kind=e.kind,
        wptr=wptr,
        lower=cones.lower[pick] / scale,
        upper=cones.upper[pick] / scale,
        a_t=a_t,
        a_s=a_s,
        a_r=a_r,
        bodies=None
        if problem.rows is None
        else np.ascontiguousarray(block_bodies(problem)[e.block], np.int32),
        whole=e.held is None,
    )


def _elements(problem: Problem) -> _Elements:
    """Elements of a problem; the usual ones, of which every row moves, are seen at a glance."""
    cones, m = problem.cones, problem.m
    n = len(cones.kind)
    if len(problem.metric.empty) == 0:
        if (
            0 < 3 * n == m
            and bool(np.all(cones.kind == CONTACT))
            and bool(np.all(cones.ptr[1:] - cones.ptr[:-1] == 3))
            and bool(np.all(cones.mu > 0.0))
        ):
            return _Elements(np.array(cones.ptr, np.int32), np.full(n, CONTACT, np.int32), slice(None))
        if (n == m or cones.is_bounded_rows) and bool((cones.lower < cones.upper).all()):
            block = slice(None) if n == m else np.repeat(np.arange(n), np.diff(cones.ptr))
            return _Elements(np.arange(m + 1, dtype=np.int32), np.zeros(m, np.int32), block)
    return _mixed_elements(problem)


def _mixed_elements(problem: Problem) -> _Elements:
    cones, m = problem.cones, problem.m
    size: IntArray = np.diff(cones.ptr).astype(np.int32)
    row = np.repeat((cones.kind == ROW) | (size == 1), size)
    position = np.arange(m) - np.repeat(cones.ptr[:-1], size)
    contact = np.repeat(cones.kind != ROW, size)
    spin, rolling = np.zeros(m, bool), np.zeros(m, bool)
    spin[cones.apart_rows[cones.apart_rows >= 0]] = True
    rolling[cones.rolling_rows[cones.rolling_rows >= 0] + 1] = True  # the last of the two
    still = np.asarray(cones.lower == cones.upper)
    still |= contact & (position > 0) & (cones.reach == 0.0)
    fixed = np.zeros(m)
    fixed[still] = np.where(np.isfinite(cones.lower[still]), cones.lower[still], 0.0)
    for i in problem.metric.empty:
        j = problem.block_of(int(i))
        if cones.kind[j] == ROW or size[j] == 1:
            still[i] = True
            bound = cones.upper[i] if problem.b[i] > 0.0 else cones.lower[i] if problem.b[i] < 0.0 else 0.0
            fixed[i] = np.clip(bound if np.isfinite(bound) else 0.0, cones.lower[i], cones.upper[i])
    keep: IntArray = np.flatnonzero(~still).astype(np.int32)
    mk = len(keep)
    block, is_row = np.repeat(np.arange(len(size)), size)[keep], row[keep]
    first = np.ones(mk, bool)
    first[1:] = is_row[1:] | (block[1:] != block[:-1])
    start = np.flatnonzero(first)
    ptr = np.append(start, mk).astype(np.int32)
    kind = np.where(is_row[start] | (np.diff(ptr) == 1), ROW, CONTACT).astype(np.int32)
    kind[spin[keep][ptr[1:] - 1] & (kind != ROW)] = CONTACT_SPIN
    # Without tangents that move what rolls takes their place.
    kind[rolling[keep][ptr[1:] - 1] & (np.diff(ptr) >= 5)] = CONTACT_ROLLING
    return _Elements(ptr, kind, block[start], (keep, fixed) if still.any() else None)
