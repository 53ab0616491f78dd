"""Search the case of each block such that the equations of all cases have a solution, and enclose that solution."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, mark_read_only
from lavender.base.lazy_import import sparse as sp
from lavender.lab.motion import prove_uniqueness
from lavender.lab.proof.dependence import Tangled, find_dependent_rows, order_by_dependence
from lavender.lab.proof.island import Island, NoZero, Sticks
from lavender.lab.proof.numbers import UNIT, Balls, Rationals, get_certain_sign, round_up_magnitude
from lavender.lab.proof.operator import Operator, Part
from lavender.problem import Problem

# Up to this many unknowns, if nothing slides, boundaries of two cases are decided in rational numbers.
MAX_RATIONAL_UNKNOWNS = 100

# Up to this many unknowns, a null vector of singular equations is computed, so that the message names its blocks.
MAX_SINGULAR_DIRECTION_UNKNOWNS = 2000

MAX_SINGLE_ISLAND_UNKNOWNS = 32  # Up to this many unknowns, the equations are not split into islands.

# The cases of the blocks (separated, sticking, sliding, at a bound) are guessed and corrected at most this often.
MAX_CASE_CHANGES = 30


@dataclass(frozen=True, eq=False)
class Enclosure:
    """An exact solution of the problem's float64 numbers and its distance from an answer, or a proof that none exists.

    `str()` gives one line.

    Parameters
    ----------
    proven : bool
        An exact solution is enclosed.
    impulse_radius : float, N s
        Largest |lambda_i - lambda_i*| of a row, rounded up; inf if nothing is proven.
    velocity_radius : float, m/s
        Largest |w_i - w_i*| of a row, rounded up; inf if nothing is proven.
    unique : bool
        Whether it is proved that all solutions have the same velocities. This holds for convex laws; under Coulomb's
        law it needs `motion.prove_uniqueness`.
    reason : str
        If nothing is proven: the cause and a remedy. If a solution is proven: the rows with impulses that are not
        unique.
    impulse : (m,) N s, or None
        The exact solution, rounded.
    boundary : tuple of str
        Names of degenerate blocks: between two cases, dependent to rounding, or singular.
    infeasible : bool
        A certificate proves that the problem has no solution; `reason` names the blocks.
    """

    proven: bool
    impulse_radius: float = math.inf
    velocity_radius: float = math.inf
    unique: bool = False
    reason: str = ""
    impulse: FloatArray | None = field(default=None, repr=False)
    boundary: tuple[str, ...] = ()
    infeasible: bool = False

    def __str__(self) -> str:
        if self.infeasible:
            return self.reason
        if not self.proven:
            return f"not proven: {self.reason}"
        explanation = "velocities unique" if self.unique else "perhaps one of several motions"
        more = f"; {self.reason}" if self.reason else ""
        return (
            f"proven: an exact solution within {self.impulse_radius:.1e} N s, {self.velocity_radius:.1e} m/s of "
            f"each row, {explanation}{more}"
        )


@dataclass
class _FrictionComponent:
    """A friction component: its rows and case."""

    rows: list[int]
    coefficients: list[float]  # The coefficient c of each row.
    slides: bool = False


@dataclass
class _Block:
    """A bounded row or a contact, and its case.

    Parameters
    ----------
    index : int
        Index of the block in the problem.
    first : int
        First row of the block: the normal of a contact.
    parts : list of _FrictionComponent, or None
        Friction components of a contact; None for a row.
    loaded : bool
        Whether the contact has a normal impulse, or the row is inside its bounds.
    at : float, N s
        Bound at which a row is, if it is not `loaded`.
    touches : bool
        Whether w = 0 is possible although the block is not `loaded`.
    """

    index: int
    first: int
    components: list[_FrictionComponent] | None = None
    loaded: bool = True
    at: float = 0.0
    touches: bool = False


class _Undecided(Exception):
    """Raised if a condition stays undecided, by the precision of balls or by the maximum number of case changes."""

    def __init__(self, reason: str, boundary: tuple[str, ...] = ()) -> None:
        super().__init__(reason)
        self.boundary = boundary


class Search:
    """The cases of all blocks, their equations, and the changes of cases that inequalities require.

    The search starts from the impulse `start` (m,) [N s]; distances are measured from `answer` (m,) [N s].
    """

    def __init__(self, flint: Any, problem: Problem, start: FloatArray, answer: FloatArray) -> None:
        self.flint, self.problem = flint, problem
        self.start, self.answer = start, answer
        self.operator, self.cone = Operator(problem), problem.law == "cone"
        self.blocks = self._choose_initial_cases()
        self.family: Any = np.zeros(0, np.int64)
        self.singular = False  # The equations are singular in float64: a higher precision does not help.
        # Rows of touching blocks (`_Block.touches`) that have w = 0 because they depend on rows with w = 0.
        self.still: Any = np.zeros(0, np.int32)

    # -- cases ----------------------------------------------------------------------------------

    def _choose_initial_cases(self) -> list[_Block]:
        """Choose each block's case by whether the point lambda - w/d, which the judge projects, is in its bounds."""
        cones = self.problem.cones
        lam, w, d = self.start, self.problem.slack(self.start), self.problem.d
        components: dict[int, list[_FrictionComponent]] = {}
        contact, reaches = cones.is_contact, cones.friction_coefficient
        for i, rows in cones.friction_components():
            coefficients = reaches[rows]
            if (coefficients > 0.0).any():
                positive = rows[coefficients > 0.0]
                components.setdefault(i, []).append(
                    _FrictionComponent(positive.tolist(), coefficients[coefficients > 0.0].tolist())
                )
        out = []
        for i, (first, end) in enumerate(zip(cones.ptr[:-1].tolist(), cones.ptr[1:].tolist(), strict=True)):
            if not contact[i]:
                for r in range(first, end):
                    low, high, x = cones.lower[r], cones.upper[r], lam[r] - w[r] / d[r]
                    inside = (low < x or low == -math.inf) and (x < high or high == math.inf)
                    out.append(_Block(i, r, None, bool(inside), float(low if x <= low else high)))
                continue
            own = components.get(i, [])
            speed = [
                math.hypot(*(c * w[r] for r, c in zip(p.rows, p.coefficients, strict=True))) for p in own
            ]
            shifted = w[first] - (sum(speed) if self.cone else 0.0)
            block = _Block(i, first, own, bool(lam[first] - shifted / d[first] > 0.0))
            for component in own:
                step = max(d[r] for r in component.rows)
                y = [
                    (lam[r] - w[r] / step) / c
                    for r, c in zip(component.rows, component.coefficients, strict=True)
                ]
                component.slides = bool(math.hypot(*y) > lam[first])
            out.append(block)
        return out

    def search_solution(self) -> Enclosure:
        """Change cases until a solution is enclosed; if the search ends without one, the result has the reason."""
        try:
            tried: set[tuple[Any, ...]] = set()
            before: tuple[Any, ...] = ()
            exactly = False  # Becomes true, for rational arithmetic, when balls do not decide.
            for _ in range(MAX_CASE_CHANGES):
                key = tuple(
                    (b.loaded, b.at, b.touches, tuple(p.slides for p in b.components or ()))
                    for b in self.blocks
                )
                if key in tried:
                    alternating = [
                        b for b, one, other in zip(self.blocks, key, before, strict=True) if one != other
                    ]
                    raise self._make_undecided_error(alternating, "between two cases, which alternate")
                tried.add(key)
                before = key
                try:
                    lam, w = self.solve_equations()
                except _Recase:
                    continue
                if not (exactly and self.exact):
                    boundary = self._change_wrong_or_list_undecided_cases(lam, w)
                    exactly = bool(boundary) and self.exact
                if exactly:
                    boundary = self._change_wrong_or_list_undecided_cases(
                        *self.solve_equations(Rationals(self.flint))
                    )
                if boundary == []:
                    return self.make_enclosure(lam, w)
                if boundary:
                    raise self._make_undecided_error(
                        boundary,
                        f"on the boundary of two cases, closer than {self.flint.ctx.prec} bits can distinguish",
                    )
            raise _Undecided(
                f"cases still change after {MAX_CASE_CHANGES} rounds; a more accurate answer is needed"
            )
        except _Undecided as undecided:
            return Enclosure(False, reason=str(undecided), boundary=undecided.boundary)

    def _make_undecided_error(self, blocks: list[_Block], explanation: str) -> _Undecided:
        """Create the exception that names blocks and says why they are undecided."""
        names = tuple(dict.fromkeys(self.problem.row_name(block.first) for block in blocks))
        return _Undecided(f"{_join_names(names)}: {explanation}", names)

    # -- equations ------------------------------------------------------------------------------

    def _split_unknown_and_fixed(self) -> tuple[Any, list[Any]]:
        """Return the rows with unknown impulses, and the impulses of all rows, as floats if a case fixes them."""
        fixed = [0.0] * self.problem.m
        unknown = []
        for block in self.blocks:
            if block.components is None:
                if block.loaded:
                    unknown.append(block.first)
                else:
                    fixed[block.first] = block.at
            elif block.loaded:
                unknown += [block.first, *(r for component in block.components for r in component.rows)]
        return np.array(sorted(unknown), np.int64), fixed

    def solve_equations(self, kind: Any = None) -> tuple[list[Any], list[Any]]:
        """Solve the equations; return impulses and slacks (lam, w) of all rows as enclosing balls, or as rationals."""
        kind = Balls(self.flint) if kind is None else kind
        self.number = kind.number
        unknown, fixed = self._split_unknown_and_fixed()
        free = self._select_independent_rows(unknown, fixed)
        self.family = np.setdiff1d(unknown, free)
        for r in self.family.tolist():
            fixed[r] = float(self.start[r])
        lam = [kind.number(x) for x in fixed]
        base = self.operator.compute_slack(kind, lam)
        islands = self._split_islands(free)
        slides = any(
            component.slides for block in self.blocks if block.loaded for component in block.components or ()
        )
        self.exact = not slides and max(map(len, islands), default=0) <= MAX_RATIONAL_UNKNOWNS
        for which in islands:
            if isinstance(kind, Rationals):
                right = kind.matrix(len(which), 1, [-base[r] for r in which.tolist()])
                for r, x in zip(
                    which.tolist(),
                    self.operator.compute_block(kind, which).solve(right).entries(),
                    strict=True,
                ):
                    lam[r] = x
            else:
                self._enclose_island(which, lam, base)
        return lam, self.operator.compute_slack(kind, lam)

    def _split_islands(self, free: Any) -> list[Any]:
        """Split the free rows into sets that A and contacts do not couple."""
        if len(free) <= MAX_SINGLE_ISLAND_UNKNOWNS:
            return [free] if len(free) else []
        graph = self.operator.compute_sparsity_pattern(free)
        block = np.searchsorted(self.problem.cones.ptr, free, side="right")
        same_block = sp.coo_array((np.ones(len(free)), (np.arange(len(free)), block))).tocsr()
        graph = graph + same_block @ same_block.T
        n, label = sp.csgraph.connected_components(graph, directed=False)
        return [free[label == k] for k in range(n)]

    def _select_independent_rows(self, unknown: Any, fixed: list[float]) -> Any:
        """Return a maximal set of rows with w = 0 and independent rows of J.

        Raise _Undecided unless the other rows with w = 0 depend on them exactly, with consistent b.
        """
        still = set(unknown.tolist())
        for block in self.blocks:
            for component in block.components or ():
                if component.slides:
                    still -= set(component.rows)
            if self.cone and block.components and any(component.slides for component in block.components):
                still.discard(block.first)
        j = self.operator.rows
        if self.operator.transposed is None:
            j = j[:, np.union1d(unknown, np.flatnonzero(fixed))]
        else:
            still &= set(np.flatnonzero(self.problem.compliance == 0.0).tolist())
        touches = (b for b in self.blocks if b.touches and not b.loaded)
        touching = np.array(
            [b.first for b in touches if not (b.at and self.operator.has_compliance(b.first))], np.int64
        )
        rows, self.still = np.array(sorted(still), np.int64), touching[:0]
        if not len(rows):
            return unknown
        first, numerical = order_by_dependence(j[rows])
        if numerical == len(rows) and not len(touching):
            return unknown
        own = rows[first]
        while True:  # Loaded rows have w = 0; a touching row has w = 0 only if it depends on loaded rows.
            rows = np.concatenate([own, touching])
            try:
                split = find_dependent_rows(self.flint, j[rows], self.operator.target[rows], numerical)
            except Tangled as tangled:
                if len(touching):
                    touching = touching[:0]
                    continue
                raise self._make_dependent_rows_error(
                    rows[tangled.args[0]],
                    "depend on each other to rounding, too many to tell whether exactly",
                ) from None
            independent, contradict = (rows[k] for k in split)
            left = np.setdiff1d(touching, independent)
            if len(left) == len(touching):
                break
            touching = left
        wrong = np.setdiff1d(contradict, touching)
        if len(wrong):
            self._fix_bounded_rows(wrong)
        self.still = np.setdiff1d(touching, contradict)
        return np.setdiff1d(unknown, np.setdiff1d(rows, independent))

    def _fix_bounded_rows(self, rows: Any) -> None:
        """Fix a bounded row at its bound if rows cannot all have w = 0 exactly; raise an error if none is bounded."""
        opened = False
        for block in self.blocks:
            if block.loaded and block.first in rows and not block.components:
                low, high = (
                    float(self.problem.cones.lower[block.first]),
                    float(self.problem.cones.upper[block.first]),
                )
                if low == -math.inf and high == math.inf:
                    continue
                block.loaded, block.at, opened = False, low if math.isfinite(low) else high, True
        if opened:
            raise _Recase
        raise self._make_dependent_rows_error(
            rows, "depend on other rows to rounding and contradict them in the last bits"
        )

    def _make_dependent_rows_error(self, rows: Any, explanation: str) -> _Undecided:
        """Create the exception for rows that depend on each other to rounding."""
        names = tuple(self.problem.row_name(int(r)) for r in rows)
        explanation += "; the distribution of the load depends on these (a compliance on them determines it)"
        return _Undecided(f"{_join_names(names)}: {explanation}", names)

    def _enclose_island(self, which: Any, lam: list[Any], base: list[Any]) -> None:
        """Compute balls that contain the impulses of the blocks `which` by equation (2); write them to `lam`."""
        own = set(which.tolist())
        sliding = [
            (block.first, component)
            for block in self.blocks
            if block.components
            and block.loaded
            and (block.first in own or any(r in own for p in block.components for r in p.rows))
            for component in block.components
            if component.slides
        ]
        part = Part(self.operator, Balls(self.flint), which)
        island = Island(self.flint, part, sliding, self.cone, lam, base)
        try:
            enclosure = island.enclose_zero(self.start[which].tolist(), float(abs(self.problem.b).max()))
        except Sticks as slow:
            for one in slow.components:
                one.slides = False
            raise _Recase from None
        except NoZero as error:
            raise self._make_singular_error(which, error.slope) from None
        for r, x in zip(which.tolist(), enclosure, strict=True):
            lam[r] = x

    def _make_singular_error(self, which: Any, slope: Any) -> _Undecided:
        """Create the exception that names the blocks that have impulses not fixed by singular equations."""
        rows = which[:0]
        slope = slope if isinstance(slope, np.ndarray) else slope.toarray()
        if len(which) <= MAX_SINGULAR_DIRECTION_UNKNOWNS and np.isfinite(slope).all():
            _, size, direction = np.linalg.svd(
                slope / np.maximum(abs(slope).max(axis=1, keepdims=True), UNIT)
            )
            if size[-1] <= 1e-12 * size[0]:
                self.singular = True
                rows = which[abs(direction[-1]) > 0.1 * abs(direction[-1]).max()]
        explanation = "no box proves a zero: the answer is too far from a solution, or two solutions are near"
        if len(rows):
            explanation = (
                "their equations are singular to rounding: there is a family of solutions, or a solution between two "
                "cases"
            )
        first = self.problem.cones.ptr[np.searchsorted(self.problem.cones.ptr, rows, side="right") - 1]
        names = tuple(dict.fromkeys(self.problem.row_name(int(r)) for r in first))
        return _Undecided(
            f"{_join_names(names) or f'{len(which)} impulses that are coupled'}: {explanation}", names
        )

    # -- inequalities ---------------------------------------------------------------------------

    def _change_wrong_or_list_undecided_cases(self, lam: list[Any], w: list[Any]) -> list[_Block] | None:
        """Change cases that are certainly wrong and return None; otherwise return the blocks that are undecided."""
        changed, boundary = False, []
        cones, number = self.problem.cones, self.number
        for block in self.blocks:
            r = block.first
            if block.components is None:
                low, high = float(cones.lower[r]), float(cones.upper[r])
                if block.loaded:
                    below = get_certain_sign(lam[r] - number(low)) if math.isfinite(low) else 1
                    above = get_certain_sign(number(high) - lam[r]) if math.isfinite(high) else 1
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
                    sign = get_certain_sign(w[r]) * (1 if block.at == low else -1)
                    if sign < 0:
                        block.loaded = changed = True
                    elif not sign and not block.touches:
                        block.touches = changed = True
                    elif not sign and r not in self.still:
                        boundary.append(block)
                continue
            speeds = [
                sum(((number(c) * w[k]) ** 2 for k, c in zip(p.rows, p.coefficients, strict=True)), 0 * w[r])
                for p in block.components
            ]
            if not block.loaded:
                sign = get_certain_sign(w[r])
                # The condition is w_n >= sum s; with a single component, squares are compared and no root is needed.
                if self.cone and sign > 0:
                    sign = (
                        get_certain_sign(w[r] * w[r] - speeds[0])
                        if len(speeds) == 1
                        else get_certain_sign(
                            w[r] - sum((self._compute_square_root(s) for s in speeds), self.flint.arb(0))
                        )
                    )
                if sign < 0:
                    block.loaded = changed = True
                elif not sign and not block.touches:
                    block.touches = changed = True
                elif not sign and ((self.cone and block.components) or r not in self.still):
                    boundary.append(block)
                continue
            sign = get_certain_sign(lam[r])
            if sign <= 0:
                block.loaded, block.touches, changed = False, not sign, True
                continue
            for component in block.components:
                if component.slides:
                    continue  # By (1), |lambda / c| = lambda_n, opposite to w: no inequality is left.
                y = sum(
                    (
                        (lam[k] / number(c)) ** 2
                        for k, c in zip(component.rows, component.coefficients, strict=True)
                    ),
                    0 * lam[r],
                )
                sign = get_certain_sign(lam[r] * lam[r] - y)
                if sign < 0:
                    component.slides = changed = True
                elif not sign:
                    boundary.append(block)
        return None if changed else boundary

    def _compute_square_root(self, square: Any) -> Any:
        """Compute a ball that contains the root of a number that is not negative; its ball may extend below 0."""
        square = self.flint.arb(square)
        return square.sqrt() if square > 0 else square.abs_upper().sqrt() * self.flint.arb(0.5, 0.5)

    def make_enclosure(self, lam: list[Any], w: list[Any]) -> Enclosure:
        """Build the `Enclosure` of balls of impulses and slacks."""
        kind = Balls(self.flint)
        own = self.operator.compute_slack(kind, [kind.number(x) for x in self.answer.tolist()])
        off = max(
            (round_up_magnitude(x - g) for x, g in zip(lam, self.answer.tolist(), strict=True)), default=0.0
        )
        speed = max((round_up_magnitude(x - y) for x, y in zip(w, own, strict=True)), default=0.0)
        if not (math.isfinite(off) and math.isfinite(speed)):
            raise _Undecided("no bound of the impulses is finite")
        reason = ""
        if len(self.family):
            names = tuple(self.problem.row_name(int(r)) for r in self.family)
            reason = f"the impulses of {_join_names(names)} are one of a family"
        convex = self.problem.law != "coulomb"
        unique = self.operator.prove_semidefinite() if convex else prove_uniqueness(self.problem.disk).proved
        return Enclosure(
            proven=True,
            impulse_radius=off,
            velocity_radius=speed,
            unique=unique,
            reason=reason,
            impulse=mark_read_only(np.array([float(x.mid()) for x in lam])),
        )


class _Recase(Exception):
    """Raised when cases were changed before a zero was found, so that the search starts again."""


def _join_names(names: tuple[str, ...]) -> str:
    """Join up to four names."""
    return ", ".join(names[:4]) + (" and others" if len(names) > 4 else "")
