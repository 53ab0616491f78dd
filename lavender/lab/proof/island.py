"""The zero of one island's equations: found by Newton's method in balls, enclosed by Krawczyk's test.

The slope over a box is held as float64 numbers with how far they may be off, and the rows of an inverse are
solved for in portions: each sum of k products of float64 numbers p_i q_i is off by at most

    k UNIT / (1 - k UNIT) sum |p_i q_i|                                                                 (3)

in any order (Higham 2002, section 3.1), so that |I - Y F'| needs no arithmetic but float64's. Where that does not
contract, few unknowns are tried by an inverse in balls.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import sparse_lu
from lavender.lab.proof.numbers import UNIT, largest, upper_end
from lavender.lab.proof.operator import DENSE, Part, Rounded, wider

PRECISE = 200  # unknowns up to which an inverse in more than float64 is tried

PORTION = 4_000_000  # numbers of the inverse that are held at once

SLOW = 1e-9  # of the largest b: a speed that an answer may have where the solution sticks

EXTENT = 10  # enlargements of X

TINY = 2.0**-300  # beside numbers scaled to 1: more than all that underflows


class Sticks(Exception):
    """Parts of friction that hardly slide, or whose speed has no sign."""

    def __init__(self, parts: list[Any]) -> None:
        self.parts = parts


class NoZero(Exception):
    """No box proves a zero; `slope` (n, n) at the answer."""

    def __init__(self, slope: Any) -> None:
        self.slope = slope


class Island:
    """Equations (1) of some rows: `part` of A, sliding parts of friction with their normals.

    `lam` are the impulses of all rows, `base` their slacks without the impulses of these.
    """

    def __init__(
        self,
        flint: Any,
        part: Part,
        sliding: list[tuple[int, Any]],
        cone: bool,
        lam: list[Any],
        base: list[Any],
    ) -> None:
        self.flint, self.part, self.sliding, self.cone, self.lam = flint, part, sliding, cone, lam
        self.number = flint.arb
        which = part.which.tolist()
        self.place = {r: k for k, r in enumerate(which)}
        self.base = [base[r] for r in which]

    def value(self, x: list[Any]) -> tuple[list[Any], Any]:
        """F and, of the sliding parts, their w and s."""
        number, place = self.number, self.place
        w = [p + q for p, q in zip(self.part.times(x), self.base, strict=True)]
        out, speeds = list(w), []
        for first, part in self.sliding:
            z = [number(c) * w[place[r]] for r, c in zip(part.rows, part.reach, strict=True)]
            s = sum((q * q for q in z), number(0.0)).sqrt() if len(z) > 1 else abs(z[0])
            speeds.append((w, s))
            normal = x[place[first]] if first in place else self.lam[first]
            for r, c in zip(part.rows, part.reach, strict=True):
                c2 = number(c) * number(c)
                out[place[r]] = x[place[r]] * s + c2 * w[place[r]] * normal
            if self.cone and first in place:
                out[place[first]] -= s
        return out, speeds

    def slope(self, x: list[Any], speeds: Any) -> tuple[dict[Any, Any], dict[Any, Any]]:
        """Entries of `left` that are not those of I, and of `right`, in F' = left A + right over a box."""
        number, place = self.number, self.place
        left: dict[Any, Any] = {}
        right: dict[Any, Any] = {}
        for (first, part), (w, s) in zip(self.sliding, speeds, strict=True):
            at = [(place[r], number(c) * number(c)) for r, c in zip(part.rows, part.reach, strict=True)]
            share = [c2 * w[k] / s for k, c2 in at]  # ds = share . dw
            normal = x[place[first]] if first in place else self.lam[first]
            for k, c2 in at:
                for (q, _), ds in zip(at, share, strict=True):
                    left[k, q] = x[k] * ds + (c2 * normal if q == k else 0)
                right[k, k] = s
                if first in place:
                    right[k, place[first]] = c2 * w[k]
            if self.cone and first in place:
                for (q, _), ds in zip(at, share, strict=True):
                    left[place[first], q] = -ds
        return left, right

    def floats(self, x: list[Any], speeds: Any) -> Rounded:
        """The slope as float64 numbers, and how far they may be off."""
        a, n = self.part.bounded, len(x)
        if not self.sliding:
            return a
        left, right = self.slope(x, speeds)
        for k in range(n):
            left.setdefault((k, k), self.number(1.0))
        (p, dp), (r, dr) = (_bounded(entries, n) for entries in (left, right))
        size = abs(p) @ abs(a.near)
        rounding = 2.0 * (_most(p) + 2) * UNIT  # (3)
        off = abs(p) @ a.off + dp @ (abs(a.near) + a.off) + dr + rounding * (size + abs(r))
        return Rounded(p @ a.near + r, wider(off))

    def balls(self, x: list[Any], speeds: Any) -> Any:
        """The slope as a matrix of balls."""
        a, n = self.part.exact, len(x)
        if not self.sliding:
            return a
        left, right = self.slope(x, speeds)
        full, added = self.flint.arb_mat(n, n, np.eye(n).ravel().tolist()), self.flint.arb_mat(n, n)
        for (k, q), v in left.items():
            full[k, q] = v
        for (k, q), v in right.items():
            added[k, q] = v
        return full * a + added

    def enclose(self, given: list[float], most: float) -> list[Any]:
        """Balls that hold one zero, the only one in them.

        Raises
        ------
        Sticks
            Parts that have no speed, or at the answer no more than SLOW of `most` [m/s].
        NoZero
        """
        number = self.number
        start = [number(x) for x in given]
        for inverse in (FloatInverse, BallInverse):
            try:
                with np.errstate(over="ignore", invalid="ignore"):  # what is not finite proves nothing
                    found = self._krawczyk(*self._newton(start, inverse))
            except ZeroDivisionError:
                found = None
            if found is not None:
                return found
            if len(start) > PRECISE:
                break
        # What hardly slides at the answer may stick.
        _, speeds = self.value(start)
        slow = [p for (_, p), (_, s) in zip(self.sliding, speeds, strict=True) if not s > SLOW * most]
        if slow:
            raise Sticks(slow)
        raise NoZero(self.floats(start, speeds).near)

    def _newton(self, x: list[Any], kind: Any) -> tuple[list[Any], Any]:
        """Middles near a zero, and the inverse of the slope there."""
        inverse, moved, last = None, math.inf, math.inf
        small = 2.0 ** (-0.75 * self.flint.ctx.prec)
        for step in range(30):
            value, speeds = self.value(x)
            if any(not (s > 0) for _, s in speeds):
                break  # its case is wrong, or on the boundary
            if (
                inverse is None
                or moved > (1e-3 if self.sliding else 0.1) * last
                or (self.sliding and step < 3)
            ):
                inverse = kind(self, x, speeds)
            move = inverse.times(value)
            x = [(p - q).mid() for p, q in zip(x, move, strict=True)]
            size, last, moved = largest(x), moved, largest(move)
            if not math.isfinite(moved):
                raise ZeroDivisionError
            if step > 1 and (moved <= small * size or (step > 9 and moved > 0.1 * last)):
                break
        _, speeds = self.value(x)
        still = [part for (_, part), (_, s) in zip(self.sliding, speeds, strict=True) if not s > 0]
        if still:
            raise Sticks(still)
        return x, inverse

    def _krawczyk(self, x: list[Any], inverse: Any) -> list[Any] | None:
        """Balls around x by (2), None where no box is found."""
        number = self.number
        value, speeds = self.value(x)
        wide = np.full(len(x), 2.0 ** (-0.6 * self.flint.ctx.prec) * largest(x) + 2.0**-900)
        for _ in range(EXTENT):
            box = [p + number(0.0, q) for p, q in zip(x, wide.tolist(), strict=True)]
            _, speeds = self.value(box) if self.sliding else (None, [])
            if all(s > 0 for _, s in speeds):
                reach = inverse.reach(box, speeds, value, wide)
                if (reach < wide).all():
                    return [p + number(0.0, q) for p, q in zip(x, reach.tolist(), strict=True)]
                wide = 4.0 * np.maximum(wide, reach)
            else:
                wide = 0.25 * wide
            if not np.isfinite(wide).all():
                break
        return None


class BallInverse:
    """Y in balls: the inverse of the slope's middle."""

    def __init__(self, island: Island, x: list[Any], speeds: Any) -> None:
        self.island = island
        self.matrix = island.flint.arb_mat
        self.inverse = island.balls(x, speeds).mid().inv().mid()

    def times(self, value: list[Any]) -> list[Any]:
        """Y F, middles."""
        return (self.inverse * self.matrix(len(value), 1, value)).mid().entries()

    def reach(self, box: list[Any], speeds: Any, value: list[Any], wide: FloatArray) -> FloatArray:
        """|Y F| + |I - Y F'(X)| (X - x), rounded up."""
        n = len(box)
        unit = self.matrix(n, n, np.eye(n).ravel().tolist())
        ball = self.matrix(n, 1, [self.island.number(0.0, q) for q in wide.tolist()])
        newton = self.inverse * self.matrix(n, 1, value)
        away = (unit - self.inverse * self.island.balls(box, speeds)) * ball - newton
        return np.array([upper_end(q) for q in away.entries()])


class FloatInverse:
    """Y in float64, of the slope scaled to entries of about 1 by powers of two."""

    def __init__(self, island: Island, x: list[Any], speeds: Any) -> None:
        self.island = island
        near = island.floats(x, speeds).near
        with np.errstate(all="ignore"):
            self.column = _power(np.sqrt(_largest(near, 0)))
            self.row = _power(_largest(_scaled(near, np.ones(len(x)), self.column), 1))
            near = _scaled(near, self.row, self.column)
            self.whole: Any = None
            self.factor: Any = None
            try:
                if isinstance(near, np.ndarray):
                    self.whole = np.linalg.inv(near)
                elif np.isfinite(near.data).all():
                    options = {"SymmetricMode": True}
                    self.factor = sparse_lu(
                        near, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options=options
                    )
                else:
                    raise ZeroDivisionError
            except (np.linalg.LinAlgError, RuntimeError):
                raise ZeroDivisionError from None

    def times(self, value: list[Any]) -> list[Any]:
        """Y F, middles."""
        right = self.row * np.array([float(q) for q in value])
        move = self.column * (self.factor.solve(right) if self.whole is None else self.whole @ right)
        return [self.island.number(q) for q in move.tolist()]

    def _rows(self, n: int) -> Iterator[tuple[int, FloatArray]]:
        """Rows of Y as columns, in portions."""
        if self.whole is not None:
            yield 0, self.whole.T
            return
        step = max(1, PORTION // n)
        for first in range(0, n, step):
            last = min(first + step, n)
            unit = np.zeros((n, last - first), order="F")
            unit[np.arange(first, last), np.arange(last - first)] = 1.0
            yield first, self.factor.solve(unit, trans="T")

    @np.errstate(under="ignore")  # TINY is more
    def reach(self, box: list[Any], speeds: Any, value: list[Any], wide: FloatArray) -> FloatArray:
        """|Y F| + |I - Y F'(X)| (X - x), rounded up; inf where numbers are beyond float64."""
        slope, n = self.island.floats(box, speeds), len(box)
        near, off = (_scaled(a, self.row, self.column) for a in slope)
        before, after = (a.ravel() if isinstance(a, np.ndarray) else a.data for a in (slope.near, near))
        live = abs(np.concatenate([self.row, self.column, after[before != 0.0]]))
        out = np.full(n, math.inf)
        if not ((live > TINY) & (live < 1.0 / TINY)).all():
            return out  # numbers whose products float64 does not hold
        turned = near.T if isinstance(near, np.ndarray) else near.T.tocsr()
        k = 2.0 * (_most(turned) + 3) * UNIT  # (3)
        r = wider(wide / self.column)
        f = wider(self.row * np.array([upper_end(q) for q in value]))
        t = f + (k * abs(near) + wider(off)) @ r + TINY * r.sum()
        for first, y in self._rows(n):
            p = turned @ y
            p[np.arange(first, first + y.shape[1]), np.arange(y.shape[1])] -= 1.0
            out[first : first + y.shape[1]] = abs(p).T @ r + abs(y).T @ t
        out = self.column * (out + TINY * r.sum()) * (1.0 + 8.0 * (n + 8) * UNIT)
        return np.where(np.isfinite(out), out, math.inf)


def _power(size: FloatArray) -> FloatArray:
    """Powers of two that scale these to about 1."""
    return np.exp2(-np.round(np.log2(np.where(size > 0.0, size, 1.0))))


def _scaled(a: Any, row: FloatArray, column: FloatArray) -> Any:
    if isinstance(a, np.ndarray):
        return row[:, None] * a * column
    data = a.data * np.repeat(row, np.diff(a.indptr)) * column[a.indices]
    return sp.csr_array((data, a.indices, a.indptr), shape=a.shape)


def _largest(a: Any, axis: int) -> FloatArray:
    size = abs(a).max(axis=axis)
    return np.asarray(size if isinstance(a, np.ndarray) else size.toarray().ravel())


def _most(a: Any) -> int:
    """Numbers in the fullest row."""
    count = np.count_nonzero(a, axis=1) if isinstance(a, np.ndarray) else np.diff(a.indptr)
    return int(count.max())


def _bounded(entries: dict[Any, Any], n: int) -> tuple[Any, Any]:
    """Matrices of float64 numbers of balls, and of how far they are off."""
    at = tuple(np.array(list(entries), np.int64).reshape(-1, 2).T)
    near = [float(v.mid()) for v in entries.values()]
    off = [upper_end(v - x) for v, x in zip(entries.values(), near, strict=True)]
    if n > DENSE:
        return tuple(sp.csr_array((np.array(v), at), shape=(n, n)) for v in (near, off))
    out = np.zeros((2, n, n))
    out[0][at], out[1][at] = near, off
    return out[0], out[1]
