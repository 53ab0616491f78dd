"""The zero of one island's equations: found by Newton's method in ball arithmetic, enclosed by Krawczyk's test.

The Jacobian F' over a box (the slope) is held as float64 numbers with error bounds, and the rows of an inverse are
computed in portions. Each sum of k products of float64 numbers p_i q_i has an error of at most

    k UNIT / (1 - k UNIT) sum |p_i q_i|                                                                 (3)

in any order (Higham 2002, section 3.1), so |I - Y F'| needs only float64 arithmetic. If this norm is not below 1 and
the island is small, an inverse in ball arithmetic is tried.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import factor_sparse_lu
from lavender.lab.proof.numbers import UNIT, max_abs, round_up_magnitude
from lavender.lab.proof.operator import MAX_DENSE_FLOAT_ROWS, Part, Rounded, round_up

# Up to this many unknowns, an inverse in more than float64 precision is tried.
MAX_BALL_INVERSE_UNKNOWNS = 200

# Largest number of entries of the inverse that are in memory at once (32 MB).
MAX_INVERSE_ENTRIES = 4_000_000

# A friction component with a speed of up to this fraction of the largest b may stick in the solution.
STICKING_SPEED_FRACTION = 1e-9

MAX_BOX_ENLARGEMENTS = 10  # The box X is enlarged at most this often.

# Bound of products that underflow to zero; it is negligible next to the numbers, which are scaled to about 1.
UNDERFLOW_BOUND = 2.0**-300


class Sticks(Exception):
    """Raised if friction `components` that were assumed to slide have a very small speed, or possibly zero speed."""

    def __init__(self, components: list[Any]) -> None:
        self.components = components


class NoZero(Exception):
    """Raised if no box X with K(X) inside X is found; `slope` (n, n) is F' at the answer."""

    def __init__(self, slope: Any) -> None:
        self.slope = slope


class Island:
    """Equations (1) of `lavender.lab.proof` for the rows of one island, with sliding friction components.

    `part` is A of these rows. `lam` holds the impulses of all rows of the problem, and `base` their slacks if the
    impulses of the island's rows are zero.
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
        self.index = {r: k for k, r in enumerate(which)}
        self.base = [base[r] for r in which]

    def evaluate_equations(self, x: list[Any]) -> tuple[list[Any], Any]:
        """Compute F(x), and the slacks w and speed s of each sliding component."""
        number, index = self.number, self.index
        w = [p + q for p, q in zip(self.part.multiply(x), self.base, strict=True)]
        out, speeds = list(w), []
        for first, part in self.sliding:
            z = [number(c) * w[index[r]] for r, c in zip(part.rows, part.coefficients, strict=True)]
            s = sum((q * q for q in z), number(0.0)).sqrt() if len(z) > 1 else abs(z[0])  # pyright: ignore[reportAttributeAccessIssue]
            speeds.append((w, s))
            normal = x[index[first]] if first in index else self.lam[first]
            for r, c in zip(part.rows, part.coefficients, strict=True):
                c2 = number(c) * number(c)
                out[index[r]] = x[index[r]] * s + c2 * w[index[r]] * normal
            if self.cone and first in index:
                out[index[first]] -= s
        return out, speeds

    def compute_slope(self, x: list[Any], speeds: Any) -> tuple[dict[Any, Any], dict[Any, Any]]:
        """Compute the Jacobian F' = left A + right over a box x.

        Return the entries of `left` that differ from the identity, and the non-zero entries of `right`.
        """
        number, index = self.number, self.index
        left: dict[Any, Any] = {}
        right: dict[Any, Any] = {}
        for (first, part), (w, s) in zip(self.sliding, speeds, strict=True):
            at = [
                (index[r], number(c) * number(c)) for r, c in zip(part.rows, part.coefficients, strict=True)
            ]
            gradient = [c2 * w[k] / s for k, c2 in at]  # Derivative of the speed s by the slacks w.
            normal = x[index[first]] if first in index else self.lam[first]
            for k, c2 in at:
                for (q, _), ds in zip(at, gradient, strict=True):
                    left[k, q] = x[k] * ds + (c2 * normal if q == k else 0)
                right[k, k] = s
                if first in index:
                    right[k, index[first]] = c2 * w[k]
            if self.cone and first in index:
                for (q, _), ds in zip(at, gradient, strict=True):
                    left[index[first], q] = -ds
        return left, right

    def compute_slope_as_floats(self, x: list[Any], speeds: Any) -> Rounded:
        """Return the slope as float64 numbers with error bounds."""
        a, n = self.part.matrix_with_error_bounds, len(x)
        if not self.sliding:
            return a
        left, right = self.compute_slope(x, speeds)
        for k in range(n):
            left.setdefault((k, k), self.number(1.0))
        (p, dp), (r, dr) = (_split_midpoints_and_bounds(entries, n) for entries in (left, right))
        size = abs(p) @ abs(a.near)
        rounding = 2.0 * (_count_max_row_entries(p) + 2) * UNIT  # (3)
        off = abs(p) @ a.off + dp @ (abs(a.near) + a.off) + dr + rounding * (size + abs(r))
        return Rounded(p @ a.near + r, round_up(off))

    def compute_slope_as_balls(self, x: list[Any], speeds: Any) -> Any:
        """Return the slope as a matrix of balls."""
        a, n = self.part.exact_matrix, len(x)
        if not self.sliding:
            return a
        left, right = self.compute_slope(x, speeds)
        full, added = self.flint.arb_mat(n, n, np.eye(n).ravel().tolist()), self.flint.arb_mat(n, n)
        for (k, q), v in left.items():
            full[k, q] = v
        for (k, q), v in right.items():
            added[k, q] = v
        return full * a + added

    def enclose_zero(self, answer: list[float], velocity_scale: float) -> list[Any]:
        """Compute balls that contain exactly one zero of the equations, starting from the impulses `answer` [N s].

        Raises
        ------
        Sticks
            Components have zero speed, or speeds of up to STICKING_SPEED_FRACTION of `velocity_scale` [m/s] at the
            answer.
        NoZero
            No box proves a zero.
        """
        number = self.number
        start = [number(x) for x in answer]
        for inverse in (FloatInverse, BallInverse):
            try:
                with np.errstate(
                    over="ignore", invalid="ignore"
                ):  # Numbers that are not finite prove nothing.
                    enclosure = self._verify_by_krawczyk(*self._run_newton(start, inverse))
            except ZeroDivisionError:
                enclosure = None
            if enclosure is not None:
                return enclosure
            if len(start) > MAX_BALL_INVERSE_UNKNOWNS:
                break
        # A component with a very small sliding speed at the answer may stick in the solution.
        _, speeds = self.evaluate_equations(start)
        slow = [
            p
            for (_, p), (_, s) in zip(self.sliding, speeds, strict=True)
            if not s > STICKING_SPEED_FRACTION * velocity_scale
        ]
        if slow:
            raise Sticks(slow)
        raise NoZero(self.compute_slope_as_floats(start, speeds).near)

    def _run_newton(self, x: list[Any], kind: Any) -> tuple[list[Any], Any]:
        """Run Newton's method; return the midpoints near a zero, and the inverse of the slope there."""
        inverse, moved, last = None, math.inf, math.inf
        small = 2.0 ** (-0.75 * self.flint.ctx.prec)
        for step in range(30):
            value, speeds = self.evaluate_equations(x)
            if any(not (s > 0) for _, s in speeds):
                break  # A component does not slide, or is on the boundary between sliding and sticking.
            if (
                inverse is None
                or moved > (1e-3 if self.sliding else 0.1) * last
                or (self.sliding and step < 3)
            ):
                inverse = kind(self, x, speeds)
            move = inverse.multiply(value)
            x = [(p - q).mid() for p, q in zip(x, move, strict=True)]
            size, last, moved = max_abs(x), moved, max_abs(move)
            if not math.isfinite(moved):
                raise ZeroDivisionError
            if step > 1 and (moved <= small * size or (step > 9 and moved > 0.1 * last)):
                break
        _, speeds = self.evaluate_equations(x)
        sticking = [part for (_, part), (_, s) in zip(self.sliding, speeds, strict=True) if not s > 0]
        if sticking:
            raise Sticks(sticking)
        return x, inverse

    def _verify_by_krawczyk(self, x: list[Any], inverse: Any) -> list[Any] | None:
        """Return balls around x by (2), or None if no box is found."""
        number = self.number
        value, speeds = self.evaluate_equations(x)
        half_width = np.full(len(x), 2.0 ** (-0.6 * self.flint.ctx.prec) * max_abs(x) + 2.0**-900)
        for _ in range(MAX_BOX_ENLARGEMENTS):
            box = [p + number(0.0, q) for p, q in zip(x, half_width.tolist(), strict=True)]
            _, speeds = self.evaluate_equations(box) if self.sliding else (None, [])
            if all(s > 0 for _, s in speeds):
                box_radius = inverse.bound_radius(box, speeds, value, half_width)
                if (box_radius < half_width).all():
                    return [p + number(0.0, q) for p, q in zip(x, box_radius.tolist(), strict=True)]
                half_width = 4.0 * np.maximum(half_width, box_radius)
            else:
                half_width = 0.25 * half_width
            if not np.isfinite(half_width).all():
                break
        return None


class BallInverse:
    """Y in balls: the inverse of the slope's midpoint."""

    def __init__(self, island: Island, x: list[Any], speeds: Any) -> None:
        self.island = island
        self.matrix = island.flint.arb_mat
        self.inverse = island.compute_slope_as_balls(x, speeds).mid().inv().mid()

    def multiply(self, value: list[Any]) -> list[Any]:
        """Compute the midpoints of Y F."""
        return (self.inverse * self.matrix(len(value), 1, value)).mid().entries()

    def bound_radius(
        self, box: list[Any], speeds: Any, value: list[Any], half_width: FloatArray
    ) -> FloatArray:
        """Compute |Y F| + |I - Y F'(X)| (X - x), rounded up."""
        n = len(box)
        unit = self.matrix(n, n, np.eye(n).ravel().tolist())
        ball = self.matrix(n, 1, [self.island.number(0.0, q) for q in half_width.tolist()])
        newton = self.inverse * self.matrix(n, 1, value)
        away = (unit - self.inverse * self.island.compute_slope_as_balls(box, speeds)) * ball - newton
        return np.array([round_up_magnitude(q) for q in away.entries()])


class FloatInverse:
    """Y in float64, of the slope scaled to entries of about 1 by powers of two."""

    def __init__(self, island: Island, x: list[Any], speeds: Any) -> None:
        self.island = island
        near = island.compute_slope_as_floats(x, speeds).near
        with np.errstate(all="ignore"):
            self.column = _compute_scaling_powers(np.sqrt(_max_abs(near, 0)))
            self.row = _compute_scaling_powers(
                _max_abs(_scale_rows_and_columns(near, np.ones(len(x)), self.column), 1)
            )
            near = _scale_rows_and_columns(near, self.row, self.column)
            self.dense_inverse: Any = None
            self.factor: Any = None
            try:
                if isinstance(near, np.ndarray):
                    self.dense_inverse = np.linalg.inv(near)
                elif np.isfinite(near.data).all():
                    options = {"SymmetricMode": True}
                    self.factor = factor_sparse_lu(
                        near, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options=options
                    )
                else:
                    raise ZeroDivisionError
            except (np.linalg.LinAlgError, RuntimeError):
                raise ZeroDivisionError from None

    def multiply(self, value: list[Any]) -> list[Any]:
        """Compute the midpoints of Y F."""
        right = self.row * np.array([float(q) for q in value])
        move = self.column * (
            self.factor.solve(right) if self.dense_inverse is None else self.dense_inverse @ right
        )
        return [self.island.number(q) for q in move.tolist()]

    def _iterate_rows(self, n: int) -> Iterator[tuple[int, FloatArray]]:
        """Yield (first row, transposed rows of Y) for consecutive blocks of at most MAX_INVERSE_ENTRIES entries."""
        if self.dense_inverse is not None:
            yield 0, self.dense_inverse.T
            return
        step = max(1, MAX_INVERSE_ENTRIES // n)
        for first in range(0, n, step):
            last = min(first + step, n)
            unit = np.zeros((n, last - first), order="F")
            unit[np.arange(first, last), np.arange(last - first)] = 1.0
            yield first, self.factor.solve(unit, trans="T")

    @np.errstate(under="ignore")  # UNDERFLOW_BOUND accounts for underflow.
    def bound_radius(
        self, box: list[Any], speeds: Any, value: list[Any], half_width: FloatArray
    ) -> FloatArray:
        """Compute |Y F| + |I - Y F'(X)| (X - x), rounded up; inf if float64 cannot represent the numbers."""
        slope, n = self.island.compute_slope_as_floats(box, speeds), len(box)
        near, off = (_scale_rows_and_columns(a, self.row, self.column) for a in slope)
        before, after = (a.ravel() if isinstance(a, np.ndarray) else a.data for a in (slope.near, near))
        nonzero = abs(np.concatenate([self.row, self.column, after[before != 0.0]]))
        out = np.full(n, math.inf)
        if not ((nonzero > UNDERFLOW_BOUND) & (nonzero < 1.0 / UNDERFLOW_BOUND)).all():
            return out  # Products of these numbers overflow or underflow.
        transposed = near.T if isinstance(near, np.ndarray) else near.T.tocsr()
        k = 2.0 * (_count_max_row_entries(transposed) + 3) * UNIT  # (3)
        r = round_up(half_width / self.column)
        f = round_up(self.row * np.array([round_up_magnitude(q) for q in value]))
        t = f + (k * abs(near) + round_up(off)) @ r + UNDERFLOW_BOUND * r.sum()
        for first, y in self._iterate_rows(n):
            p = transposed @ y
            p[np.arange(first, first + y.shape[1]), np.arange(y.shape[1])] -= 1.0
            out[first : first + y.shape[1]] = abs(p).T @ r + abs(y).T @ t
        out = self.column * (out + UNDERFLOW_BOUND * r.sum()) * (1.0 + 8.0 * (n + 8) * UNIT)
        return np.where(np.isfinite(out), out, math.inf)


def _compute_scaling_powers(size: FloatArray) -> FloatArray:
    """Return powers of two that scale `size` to about 1."""
    return np.exp2(-np.round(np.log2(np.where(size > 0.0, size, 1.0))))


def _scale_rows_and_columns(a: Any, row: FloatArray, column: FloatArray) -> Any:
    """Multiply the rows and the columns of `a` by factors."""
    if isinstance(a, np.ndarray):
        return row[:, None] * a * column
    data = a.data * np.repeat(row, np.diff(a.indptr)) * column[a.indices]
    return sp.csr_array((data, a.indices, a.indptr), shape=a.shape)


def _max_abs(a: Any, axis: int) -> FloatArray:
    """Return the largest magnitude along an axis."""
    size = abs(a).max(axis=axis)
    return np.asarray(size if isinstance(a, np.ndarray) else size.toarray().ravel())


def _count_max_row_entries(a: Any) -> int:
    """Return the largest number of non-zero entries in a row."""
    count = np.count_nonzero(a, axis=1) if isinstance(a, np.ndarray) else np.diff(a.indptr)
    return int(count.max())


def _split_midpoints_and_bounds(entries: dict[Any, Any], n: int) -> tuple[Any, Any]:
    """Return the float64 midpoints of balls as an (n, n) matrix, and a matrix of bounds of their errors."""
    at = tuple(np.array(list(entries), np.int64).reshape(-1, 2).T)
    near = [float(v.mid()) for v in entries.values()]
    off = [round_up_magnitude(v - x) for v, x in zip(entries.values(), near, strict=True)]
    if n > MAX_DENSE_FLOAT_ROWS:
        return tuple(sp.csr_array((np.array(v), at), shape=(n, n)) for v in (near, off))
    out = np.zeros((2, n, n))
    out[0][at], out[1][at] = near, off
    return out[0], out[1]
