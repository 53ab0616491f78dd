"""The search for cases of blocks whose equations have a solution, and its enclosure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, read_only
from lavender.base.lazy_import import sparse as sp
from lavender.lab.motion import uniqueness
from lavender.lab.proof.dependence import Tangled, dependencies, pivots
from lavender.lab.proof.island import Island, NoZero, Sticks
from lavender.lab.proof.numbers import UNIT, Balls, Rationals, sign_of, upper_end
from lavender.lab.proof.operator import Operator, Part
from lavender.problem import Problem

RATIONAL = 100  # unknowns up to which boundaries are decided in rational numbers, where nothing slides

NAMED = 2000  # unknowns up to which a singular direction is looked for

SMALL = 32  # unknowns that are not parted into islands

ROUNDS = 30  # changes of cases, as in an active-set method


@dataclass(frozen=True, eq=False)
class Enclosure:
    """An exact solution of the problem's own numbers and how far from an answer it is, or that there is none.

    `str()` is a line.
    """

    proven: bool  # an exact solution is enclosed
    # N s: largest |lambda_i - lambda_i*| of a row, rounded up; inf where nothing is proven
    impulse_radius: float = math.inf
    velocity_radius: float = math.inf  # m/s: largest |w_i - w_i*| of a row
    unique: bool = (
        False  # no other solution has other velocities: convex laws; Coulomb's only by `motion.uniqueness`
    )
    # why nothing is proven, and what would be needed; where it is: rows whose impulses are one of a family
    reason: str = ""
    impulse: FloatArray | None = field(default=None, repr=False)  # (m,) N s, the exact one rounded
    # degenerate blocks by name: between two cases, dependent to rounding, or singular
    boundary: tuple[str, ...] = ()
    infeasible: bool = (
        False  # a certificate proves that the problem has no solution; `reason` names the blocks
    )

    def __str__(self) -> str:
        if self.infeasible:
            return self.reason
        if not self.proven:
            return f"not proven: {self.reason}"
        words = "velocities unique" if self.unique else "perhaps one of several motions"
        more = f"; {self.reason}" if self.reason else ""
        return (
            f"proven: an exact solution within {self.impulse_radius:.1e} N s, {self.velocity_radius:.1e} m/s of "
            f"each row, {words}{more}"
        )


@dataclass
class _Part:
    rows: list[int]
    reach: list[float]  # c of each row
    slides: bool = False


@dataclass
class _Block:
    """A bounded row (no normal), or a contact: its case."""

    index: int
    first: int
    parts: list[_Part] | None = None  # None: a row
    loaded: bool = True  # of a contact; of a row: inside its bounds
    at: float = 0.0  # N s, where a row is not inside
    touches: bool = False  # at its bound, or open, and perhaps w = 0 too


class _Undecided(Exception):
    """A condition that balls or the number of rounds leave open."""

    def __init__(self, reason: str, boundary: tuple[str, ...] = ()) -> None:
        super().__init__(reason)
        self.boundary = boundary


class Search:
    """Cases of all blocks, their equations, and the changes of cases that inequalities ask for."""

    def __init__(self, flint: Any, problem: Problem, given: FloatArray, answer: FloatArray) -> None:
        self.flint, self.problem = flint, problem
        self.given, self.answer = given, answer  # where it begins, and what distances are from
        self.operator, self.cone = Operator(problem), problem.law == "cone"
        self.blocks = self._cases()
        self.family: Any = np.zeros(0, np.int64)
        self.singular = False  # in float64: more bits do not help
        self.still: Any = np.zeros(0, np.int32)  # rows of blocks that touch: w = 0, by rows it depends on

    # -- cases ----------------------------------------------------------------------------------

    def _cases(self) -> list[_Block]:
        """From the point that one update would project: inside a bound or beyond it."""
        cones = self.problem.cones
        lam, w, d = self.given, self.problem.slack(self.given), self.problem.d
        parts: dict[int, list[_Part]] = {}
        contact, reaches = cones.is_contact, cones.reach
        for i, rows in cones.parts():
            reach = reaches[rows]
            if (reach > 0.0).any():
                live = rows[reach > 0.0]
                parts.setdefault(i, []).append(_Part(live.tolist(), reach[reach > 0.0].tolist()))
        out = []
        for i, (first, end) in enumerate(zip(cones.ptr[:-1].tolist(), cones.ptr[1:].tolist(), strict=True)):
            if not contact[i]:
                for r in range(first, end):
                    low, high, x = cones.lower[r], cones.upper[r], lam[r] - w[r] / d[r]
                    inside = (low < x or low == -math.inf) and (x < high or high == math.inf)
                    out.append(_Block(i, r, None, inside, float(low if x <= low else high)))
                continue
            own = parts.get(i, [])
            speed = [math.hypot(*(c * w[r] for r, c in zip(p.rows, p.reach, strict=True))) for p in own]
            shifted = w[first] - (sum(speed) if self.cone else 0.0)
            block = _Block(i, first, own, lam[first] - shifted / d[first] > 0.0)
            for part in own:
                step = max(d[r] for r in part.rows)
                y = [(lam[r] - w[r] / step) / c for r, c in zip(part.rows, part.reach, strict=True)]
                part.slides = math.hypot(*y) > lam[first]
            out.append(block)
        return out

    def run(self) -> Enclosure:
        """Change cases until a solution is enclosed, or say why none is."""
        try:
            tried: set[tuple[Any, ...]] = set()
            before: tuple[Any, ...] = ()
            exactly = False  # in rational numbers, once balls cannot tell
            for _ in range(ROUNDS):
                key = tuple(
                    (b.loaded, b.at, b.touches, tuple(p.slides for p in b.parts or ())) for b in self.blocks
                )
                if key in tried:
                    turned = [
                        b for b, one, other in zip(self.blocks, key, before, strict=True) if one != other
                    ]
                    raise self._undecided(turned, "between two cases, which change in turns")
                tried.add(key)
                before = key
                try:
                    lam, w = self.solve()
                except _Recase:
                    continue
                if not (exactly and self.exact):
                    boundary = self._changed(lam, w)
                    exactly = bool(boundary) and self.exact
                if exactly:
                    boundary = self._changed(*self.solve(Rationals(self.flint)))
                if boundary == []:
                    return self.told(lam, w)
                if boundary:
                    raise self._undecided(
                        boundary, f"on the boundary of two cases, closer than {self.flint.ctx.prec} bits tell"
                    )
            raise _Undecided(f"cases still change after {ROUNDS} rounds; a more accurate answer is needed")
        except _Undecided as undecided:
            return Enclosure(False, reason=str(undecided), boundary=undecided.boundary)

    def _undecided(self, blocks: list[_Block], words: str) -> _Undecided:
        names = tuple(dict.fromkeys(self.problem.row_name(block.first) for block in blocks))
        return _Undecided(f"{_listed(names)}: {words}", names)

    # -- equations ------------------------------------------------------------------------------

    def _unknown(self) -> tuple[Any, list[Any]]:
        """Rows that the case does not fix, and the impulses of all (floats where fixed)."""
        fixed = [0.0] * self.problem.m
        unknown = []
        for block in self.blocks:
            if block.parts is None:
                if block.loaded:
                    unknown.append(block.first)
                else:
                    fixed[block.first] = block.at
            elif block.loaded:
                unknown += [block.first, *(r for part in block.parts for r in part.rows)]
        return np.array(sorted(unknown), np.int64), fixed

    def solve(self, kind: Any = None) -> tuple[list[Any], list[Any]]:
        """Balls that hold a zero of the equations, or the zero in rationals: impulses and slack of all rows."""
        kind = Balls(self.flint) if kind is None else kind
        self.number = kind.number
        unknown, fixed = self._unknown()
        free = self._independent(unknown, fixed)
        self.family = np.setdiff1d(unknown, free)
        for r in self.family.tolist():
            fixed[r] = float(self.given[r])
        lam = [kind.number(x) for x in fixed]
        base = self.operator.slack(kind, lam)
        islands = self._islands(free)
        slides = any(part.slides for block in self.blocks if block.loaded for part in block.parts or ())
        self.exact = not slides and max(map(len, islands), default=0) <= RATIONAL
        for which in islands:
            if isinstance(kind, Rationals):
                right = kind.matrix(len(which), 1, [-base[r] for r in which.tolist()])
                for r, x in zip(
                    which.tolist(), self.operator.block(kind, which).solve(right).entries(), strict=True
                ):
                    lam[r] = x
            else:
                self._island(which, lam, base)
        return lam, self.operator.slack(kind, lam)

    def _islands(self, free: Any) -> list[Any]:
        if len(free) <= SMALL:
            return [free] if len(free) else []
        graph = self.operator.pattern(free)
        block = np.searchsorted(self.problem.cones.ptr, free, side="right")
        together = sp.coo_array((np.ones(len(free)), (np.arange(len(free)), block))).tocsr()
        graph = graph + together @ together.T
        n, label = sp.csgraph.connected_components(graph, directed=False)
        return [free[label == k] for k in range(n)]

    def _independent(self, unknown: Any, fixed: list[float]) -> Any:
        """A largest set of rows with w = 0 whose J is independent; the others must depend on it exactly, b too."""
        still = set(unknown.tolist())
        for block in self.blocks:
            for part in block.parts or ():
                if part.slides:
                    still -= set(part.rows)
            if self.cone and block.parts and any(part.slides for part in block.parts):
                still.discard(block.first)
        j = self.operator.rows
        if self.operator.transposed is None:
            j = j[:, np.union1d(unknown, np.flatnonzero(fixed))]
        else:
            still &= set(np.flatnonzero(self.problem.compliance == 0.0).tolist())
        touches = (b for b in self.blocks if b.touches and not b.loaded)
        touching = np.array(
            [b.first for b in touches if not (b.at and self.operator.soft(b.first))], np.int64
        )
        rows, self.still = np.array(sorted(still), np.int64), touching[:0]
        if not len(rows):
            return unknown
        first, numerical = pivots(j[rows])
        if numerical == len(rows) and not len(touching):
            return unknown
        own = rows[first]
        while True:  # w = 0 of rows with load; not of one that touches, which must depend on them alone
            rows = np.concatenate([own, touching])
            try:
                found = dependencies(self.flint, j[rows], self.operator.target[rows], numerical)
            except Tangled as tangled:
                if len(touching):
                    touching = touching[:0]
                    continue
                raise self._named(
                    rows[tangled.args[0]],
                    "depend on each other to rounding, too many to tell whether exactly",
                ) from None
            kept, contradict = (rows[k] for k in found)
            left = np.setdiff1d(touching, kept)
            if len(left) == len(touching):
                break
            touching = left
        wrong = np.setdiff1d(contradict, touching)
        if len(wrong):
            self._open(wrong)
        self.still = np.setdiff1d(touching, contradict)
        return np.setdiff1d(unknown, np.setdiff1d(rows, kept))

    def _open(self, rows: Any) -> None:
        """Rows that cannot all have w = 0, by exact numbers: one that is bounded by itself carries nothing instead."""
        opened = False
        for block in self.blocks:
            if block.loaded and block.first in rows and not block.parts:
                low, high = (
                    float(self.problem.cones.lower[block.first]),
                    float(self.problem.cones.upper[block.first]),
                )
                if low == -math.inf and high == math.inf:
                    continue
                block.loaded, block.at, opened = False, low if math.isfinite(low) else high, True
        if opened:
            raise _Recase
        raise self._named(rows, "depend on other rows to rounding and contradict them in the last bits")

    def _named(self, rows: Any, words: str) -> _Undecided:
        names = tuple(self.problem.row_name(int(r)) for r in rows)
        words += "; which carry load hangs on these (a compliance on them decides it)"
        return _Undecided(f"{_listed(names)}: {words}", names)

    def _island(self, which: Any, lam: list[Any], base: list[Any]) -> None:
        """Enclose the impulses of `which`, by (2), into `lam`."""
        own = set(which.tolist())
        sliding = [
            (block.first, part)
            for block in self.blocks
            if block.parts
            and block.loaded
            and (block.first in own or any(r in own for p in block.parts for r in p.rows))
            for part in block.parts
            if part.slides
        ]
        part = Part(self.operator, Balls(self.flint), which)
        island = Island(self.flint, part, sliding, self.cone, lam, base)
        try:
            found = island.enclose(self.given[which].tolist(), float(abs(self.problem.b).max()))
        except Sticks as slow:
            for one in slow.parts:
                one.slides = False
            raise _Recase from None
        except NoZero as error:
            raise self._singular(which, error.slope) from None
        for r, x in zip(which.tolist(), found, strict=True):
            lam[r] = x

    def _singular(self, which: Any, slope: Any) -> _Undecided:
        """Names the blocks whose impulses the equations do not fix, if they are singular."""
        rows = which[:0]
        slope = slope if isinstance(slope, np.ndarray) else slope.toarray()
        if len(which) <= NAMED and np.isfinite(slope).all():
            _, size, direction = np.linalg.svd(
                slope / np.maximum(abs(slope).max(axis=1, keepdims=True), UNIT)
            )
            if size[-1] <= 1e-12 * size[0]:
                self.singular = True
                rows = which[abs(direction[-1]) > 0.1 * abs(direction[-1]).max()]
        words = "no box proves a zero: the answer is too far from a solution, or two solutions are near"
        if len(rows):
            words = (
                "their equations are singular to rounding; a family of solutions, or one between two cases"
            )
        first = self.problem.cones.ptr[np.searchsorted(self.problem.cones.ptr, rows, side="right") - 1]
        names = tuple(dict.fromkeys(self.problem.row_name(int(r)) for r in first))
        return _Undecided(f"{_listed(names) or f'{len(which)} impulses that are coupled'}: {words}", names)

    # -- inequalities ---------------------------------------------------------------------------

    def _changed(self, lam: list[Any], w: list[Any]) -> list[_Block] | None:
        """Change the cases that are certainly wrong: None; else the blocks whose inequalities cannot be told."""
        changed, boundary = False, []
        cones, number = self.problem.cones, self.number
        for block in self.blocks:
            r = block.first
            if block.parts is None:
                low, high = float(cones.lower[r]), float(cones.upper[r])
                if block.loaded:
                    below = sign_of(lam[r] - number(low)) if math.isfinite(low) else 1
                    above = sign_of(number(high) - lam[r]) if math.isfinite(high) else 1
                    if below < 0 or above < 0:
                        block.loaded, block.at, changed = False, low if below < 0 else high, True
                    elif not below or not above:
                        block.loaded, block.at, block.touches, changed = (
                            False,
                            high if below else low,
                            True,
                            True,
                        )
                elif low < high:
                    sign = sign_of(w[r]) * (1 if block.at == low else -1)
                    if sign < 0:
                        block.loaded = changed = True
                    elif not sign and not block.touches:
                        block.touches = changed = True
                    elif not sign and r not in self.still:
                        boundary.append(block)
                continue
            speeds = [
                sum(((number(c) * w[k]) ** 2 for k, c in zip(p.rows, p.reach, strict=True)), 0 * w[r])
                for p in block.parts
            ]
            if not block.loaded:
                sign = sign_of(w[r])
                # w_n >= sum s; one root of the sum of squares where there is one part
                if self.cone and sign > 0:
                    sign = (
                        sign_of(w[r] * w[r] - speeds[0])
                        if len(speeds) == 1
                        else sign_of(w[r] - sum((self._root(s) for s in speeds), self.flint.arb(0)))
                    )
                if sign < 0:
                    block.loaded = changed = True
                elif not sign and not block.touches:
                    block.touches = changed = True
                elif not sign and ((self.cone and block.parts) or r not in self.still):
                    boundary.append(block)
                continue
            sign = sign_of(lam[r])
            if sign <= 0:
                block.loaded, block.touches, changed = False, not sign, True
                continue
            for part in block.parts:
                if part.slides:
                    continue  # |lambda / c| = lambda_n by (1), against w by its sign
                y = sum(
                    ((lam[k] / number(c)) ** 2 for k, c in zip(part.rows, part.reach, strict=True)),
                    0 * lam[r],
                )
                sign = sign_of(lam[r] * lam[r] - y)
                if sign < 0:
                    part.slides = changed = True
                elif not sign:
                    boundary.append(block)
        return None if changed else boundary

    def _root(self, square: Any) -> Any:
        """A ball that holds the root; a ball of a square may reach below 0."""
        square = self.flint.arb(square)
        return square.sqrt() if square > 0 else square.abs_upper().sqrt() * self.flint.arb(0.5, 0.5)

    def told(self, lam: list[Any], w: list[Any]) -> Enclosure:
        """The enclosure of balls of impulses and slacks."""
        kind = Balls(self.flint)
        own = self.operator.slack(kind, [kind.number(x) for x in self.answer.tolist()])
        off = max((upper_end(x - g) for x, g in zip(lam, self.answer.tolist(), strict=True)), default=0.0)
        speed = max((upper_end(x - y) for x, y in zip(w, own, strict=True)), default=0.0)
        if not (math.isfinite(off) and math.isfinite(speed)):
            raise _Undecided("no bound of the impulses is finite")
        reason = ""
        if len(self.family):
            names = tuple(self.problem.row_name(int(r)) for r in self.family)
            reason = f"the impulses of {_listed(names)} are one of a family"
        convex = self.problem.law != "coulomb"
        unique = self.operator.semidefinite() if convex else uniqueness(self.problem.disk).proved
        return Enclosure(
            proven=True,
            impulse_radius=off,
            velocity_radius=speed,
            unique=unique,
            reason=reason,
            impulse=read_only(np.array([float(x.mid()) for x in lam])),
        )


class _Recase(Exception):
    """Cases of blocks were changed before there was a zero."""


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(names[:4]) + (" and others" if len(names) > 4 else "")
