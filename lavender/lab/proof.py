"""Proofs that an exact solution stands beside an answer: how far away at most, in balls of interval arithmetic.

On the case of each block (a row inside its bounds or at one of them; a contact open or loaded, each part of its
friction sticking or sliding) the conditions are equations in the impulses that are not fixed by the case,

    free, loaded, sticks     w_i = A_i lambda - b_i = 0
    loaded, cone law         w_n = sum_g s_g,    s_g = |c w_g| over the sliding parts g, c the reach of its rows
    slides                   lambda_i s_g + c_i^2 w_i lambda_n = 0                                        (1)

and inequalities in the rest: lambda within its bounds, w >= 0 at a lower one, |lambda_g / c| <= lambda_n, and where a
contact is open w_n >= 0 (Coulomb) or w_n >= sum |c w_g| (cone law). With x~ an approximate zero, Y ~ F'(x~)^-1 and a
box X around x~,

    K(X) = x~ - Y F(x~) + (I - Y F'(X)) (X - x~)  inside X   =>   F has one zero in X                      (2)

(Krawczyk 1969; Neumaier 1990, theorem 5.1.8), in ball arithmetic on the problem's float64 numbers as exact ones; where
each inequality holds over the box of the zero, it is a solution. Rows that depend on others exactly, target included,
keep the impulse that they were given: the impulses are one of a family, the velocities are those of all.
Balls cannot tell a zero from a small number: a row that carries nothing and has w = 0 is proven where it depends, as
exactly, on rows that have, or where a solution in rational numbers says so (nothing slides, up to RATIONAL unknowns);
else it is named as on the border of two cases.

Needs python-flint (extra `proof`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, read_only
from lavender.base.errors import CapabilityError, SolverUnavailable
from lavender.base.later import lapack
from lavender.base.later import sparse as sp
from lavender.judge.solution import Solution
from lavender.lab.motion import uniqueness
from lavender.problem import Problem, check_problem
from lavender.problem.cones import ROW

__all__ = ["Enclosure", "prove"]

BITS = (128, 256)  # of the balls: what the first leave undecided the second try
UNIT = 2.0**-53
RATIONAL = 100  # unknowns up to which borders are decided in rational numbers, where nothing slides
LARGEST = 2000  # unknowns that are coupled, in dense balls of 128 bits: a minute, 0.3 GB
PRECISE = 200  # unknowns up to which an inverse in more than float64 is tried
SLOW = 1e-9  # of the largest b: a speed that an answer may have where the solution sticks
SMALL = 32  # unknowns that are not parted into islands
ROUNDS = 30  # changes of cases, as in an active-set method
EXTENT = 10  # enlargements of X


@dataclass(frozen=True, eq=False)
class Enclosure:
    """An exact solution of the problem's own numbers, and how far from an answer it is. `str()` is a line."""

    proven: bool
    impulse_radius: (
        float  # N s: largest |lambda_i - lambda_i*| of a row, rounded up; inf where nothing is proven
    )
    velocity_radius: float  # m/s: largest |w_i - w_i*| of a row
    unique: bool  # no other solution has other velocities: convex laws; Coulomb's only by `motion.uniqueness`
    reason: str  # why nothing is proven, and what would be needed; where it is: rows whose impulses are one of a family
    impulse: FloatArray | None = field(default=None, repr=False)  # (m,) N s, the exact one rounded
    borders: tuple[
        str, ...
    ] = ()  # degenerate blocks by name: between two cases, dependent to rounding, or singular

    def __str__(self) -> str:
        if not self.proven:
            return f"not proven: {self.reason}"
        words = "velocities unique" if self.unique else "perhaps one of several motions"
        more = f"; {self.reason}" if self.reason else ""
        return (
            f"proven: an exact solution within {self.impulse_radius:.1e} N s, {self.velocity_radius:.1e} m/s of "
            f"each row, {words}{more}"
        )


def prove(problem: Problem, solution: Any) -> Enclosure:
    """Enclose an exact solution of the problem near an answer, with a proof.

    Parameters
    ----------
    problem : Problem
        Its float64 numbers count as exact: A and b, or J, M^-1 or M, compliance, b, bounds and coefficients; of bodies
        J as float64 has it.
    solution : Solution or (m,) array_like, N s
        The answer, of any solver; near enough to tell which contacts stick, slide and are open.

    Returns
    -------
    Enclosure
        Not proven is a result: `reason` says which block is undecided, or what else was in the way.

    Raises
    ------
    SolverUnavailable
        python-flint is not installed.
    CapabilityError
        More than LARGEST unknowns that are coupled with each other.

    Notes
    -----
    R. Krawczyk 1969, Computing 4, 187-201; A. Neumaier 1990, Interval Methods for Systems of Equations; F. Johansson
    2017, Arb, IEEE Trans. Computers 66, 1281-1292.

    Examples
    --------
    >>> import lavender as lv
    >>> problem = lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0])
    >>> found = lv.prove(problem, lv.solve(problem, "pgs", tol=1e-9))
    >>> found.proven, found.unique, found.velocity_radius < 1e-8
    (True, True, True)
    """
    check_problem(problem)
    given = problem.impulse_array(solution.impulse if isinstance(solution, Solution) else solution)
    for bits in BITS:
        with _balls(bits) as flint:
            search = Search(flint, problem, given)
            found = search.run()
        if found.proven or search.singular:
            break
    return found


def require() -> None:
    """Raise SolverUnavailable where python-flint is not installed."""
    with _balls(BITS[0]):
        pass


@contextmanager
def _balls(bits: int) -> Iterator[Any]:
    try:
        import flint
    except ImportError:
        raise SolverUnavailable(
            "prove needs python-flint (interval arithmetic): pip install 'lavender-contact[proof]'"
        ) from None
    before, flint.ctx.prec = flint.ctx.prec, bits
    try:
        yield flint
    finally:
        flint.ctx.prec = before


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

    def __init__(self, reason: str, borders: tuple[str, ...] = ()) -> None:
        super().__init__(reason)
        self.borders = borders


class Operator:
    """A of float64 numbers that are taken as exact: its rows times impulses, and blocks of it, in numbers of a kind."""

    def __init__(self, problem: Problem) -> None:
        self.problem: Any = problem
        self.rows = problem.csr if problem.matrix is not None else problem.jacobian
        if problem.matrix is None and problem.rows is not None:
            self.inverse = problem.rows.inverse_mass_matrix().tocsr()
        self.transposed = self.rows.T.tocsr() if problem.matrix is None else None
        self.target, self.v = self._targets()
        self._mass: dict[Any, Any] = {}  # M^-1, by kind of number
        self._bias: dict[Any, list[Any]] = {}  # b

    def _targets(self) -> tuple[FloatArray, FloatArray | None]:
        """What b was made of, target - J v*: a target that is nothing but rounding is 0. (b, None) of a matrix."""
        problem = self.problem
        if problem.matrix is not None:
            return problem.b, None
        v = problem.rows.v_free.ravel() if problem.generalized is None else problem.generalized.v_free
        target = problem.b + self.rows @ v
        dust = 4.0 * UNIT * (abs(self.rows) @ abs(v) * (1 + np.diff(self.rows.indptr)) + abs(problem.b))
        return np.where(abs(target) <= dust, 0.0, target), v

    def soft(self, row: int) -> bool:
        return self.transposed is not None and bool(self.problem.compliance[row] > 0.0)

    def bias(self, kind: Any) -> list[Any]:
        """b of exact numbers."""
        if type(kind) in self._bias:
            return self._bias[type(kind)]
        out = [kind.number(x) for x in self.target.tolist()]
        if self.v is not None:
            moved = _times(kind, self.rows, [kind.number(x) for x in self.v.tolist()], None)
            out = [x - y for x, y in zip(out, moved, strict=True)]
        self._bias[type(kind)] = out
        return out

    def weighed(self, kind: Any, right: Any) -> Any:
        """M^-1 times a matrix of balls or rationals (nv, k)."""
        generalized = self.problem.generalized
        if generalized is None:
            return _matrix(kind, self.inverse) * right
        if type(kind) not in self._mass:
            self._mass[type(kind)] = _matrix(kind, generalized.mass).inv()
        return self._mass[type(kind)] * right

    def block(self, kind: Any, which: Any) -> Any:
        """A of these rows and columns."""
        if self.transposed is None:
            return _matrix(kind, self.rows[which][:, which])
        part = self.rows[which]
        used = np.unique(part.indices)
        if self.problem.generalized is None:
            inner = self.inverse[used][:, used]
            j = _matrix(kind, part[:, used])
            a = j * _matrix(kind, inner) * j.transpose()
        else:
            j = _matrix(kind, part)
            a = j * self.weighed(kind, j.transpose())
        for k, i in enumerate(which.tolist()):
            a[k, k] += kind.number(float(self.problem.compliance[i]))
        return a

    def pattern(self, which: Any) -> Any:
        """Where A of these rows and columns may be other than 0: float64 may round a sum of products to 0."""
        if self.transposed is None:
            return (self.rows[which][:, which] != 0).astype(float)
        generalized = self.problem.generalized
        inner = (self.inverse if generalized is None else sp.csr_array(generalized.mass)) != 0
        if generalized is not None:
            label = sp.csgraph.connected_components(inner, directed=False)[1]
            inner = sp.coo_array((np.ones(len(label)), (np.arange(len(label)), label))).tocsr()
            inner = inner @ inner.T
        j = (self.rows[which] != 0).astype(float)
        return j @ inner.astype(float) @ j.T

    def slack(self, kind: Any, impulse: list[Any]) -> list[Any]:
        """w = A lambda - b of all rows."""
        problem, number = self.problem, kind.number
        # A ball about 0 is not 0; `!=` would have to be certain.
        at = np.flatnonzero(~np.array([x == 0 for x in impulse], bool))
        if self.transposed is None:
            a = _times(kind, self.rows, impulse, at)
        else:
            pulled = _times(kind, self.transposed, impulse, at)
            if problem.generalized is None:
                moved = _times(kind, self.inverse, pulled, None)
            else:
                moved = self.weighed(kind, kind.matrix(len(pulled), 1, pulled)).entries()
            a = _times(kind, self.rows, moved, None)
        theta = [0.0] * problem.m if problem.compliance is None else problem.compliance.tolist()
        return [
            x + number(t) * y - b if t else x - b
            for x, t, y, b in zip(a, theta, impulse, self.bias(kind), strict=True)
        ]

    def semidefinite(self) -> bool:
        """Proof that x.A x >= 0 for every x, of exact numbers."""
        problem = self.problem
        if problem.matrix is not None:
            return _semidefinite(problem.dense())
        if problem.generalized is not None:
            return _semidefinite(problem.generalized.mass.toarray())
        return bool((problem.rows.inv_mass >= 0.0).all()) and _semidefinite(problem.rows.inv_inertia)


def _semidefinite(a: FloatArray) -> bool:
    """Whether Cholesky of symmetric matrices (..., n, n) less c I runs through, c what it may round.

    S. M. Rump 2006, Verification of positive definiteness, BIT 46, 433-452: c = g tr(A) / (1 - g), g = (n + 2) UNIT.
    """
    if not (a == np.swapaxes(a, -1, -2)).all():
        return False
    n = a.shape[-1]
    eye, empty = np.eye(n), ~(a != 0.0).any(axis=-1)
    scale = abs(a).max(axis=(-1, -2), keepdims=True, initial=0.0)
    a = a / np.exp2(np.ceil(np.log2(np.where(scale > 0.0, scale, 1.0)))) + empty[..., None] * eye
    trace = np.trace(a, axis1=-2, axis2=-1)[..., None, None]
    try:
        # Twice as much: of the trace, of the subtraction and of what underflows, too.
        np.linalg.cholesky(a - 2.0 * (n + 3) * UNIT * np.maximum(trace, 1.0) * eye)
    except np.linalg.LinAlgError:
        return False
    return True


class Balls:
    def __init__(self, flint: Any) -> None:
        self.number, self.matrix = flint.arb, flint.arb_mat


class _Rationals:
    def __init__(self, flint: Any) -> None:
        self.matrix, self._flint = flint.fmpq_mat, flint

    def number(self, x: float) -> Any:
        return self._flint.fmpq(*x.as_integer_ratio())


def _matrix(kind: Any, a: Any) -> Any:
    dense = a.toarray()
    return kind.matrix(*dense.shape, [kind.number(x) for x in dense.ravel().tolist()])


def _times(kind: Any, a: Any, x: list[Any], at: Any) -> list[Any]:
    # Sparse times vector; `at`: the entries of x that are not zero.
    out, zero = [], kind.number(0.0)
    live = None if at is None else np.isin(a.indices, at)
    data, indices, ptr = a.data.tolist(), a.indices.tolist(), a.indptr.tolist()
    for i in range(a.shape[0]):
        total = zero
        for k in range(ptr[i], ptr[i + 1]):
            if (live is None or live[k]) and data[k] != 0.0:
                total = total + kind.number(data[k]) * x[indices[k]]
        out.append(total)
    return out


class Search:
    """Cases of all blocks, their equations, and the changes of cases that inequalities ask for."""

    def __init__(self, flint: Any, problem: Problem, given: FloatArray) -> None:
        self.flint, self.problem, self.given = flint, problem, given
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
        for i, rows in cones.parts():
            reach = cones.reach[rows]
            if (reach > 0.0).any():
                live = rows[reach > 0.0]
                parts.setdefault(i, []).append(_Part(live.tolist(), reach[reach > 0.0].tolist()))
        out = []
        for i, (first, end) in enumerate(zip(cones.ptr[:-1].tolist(), cones.ptr[1:].tolist(), strict=True)):
            if cones.kind[i] == ROW:
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
                    lam, w = self._solve()
                except _Recase:
                    continue
                if not (exactly and self.exact):
                    borders = self._changed(lam, w)
                    exactly = bool(borders) and self.exact
                if exactly:
                    borders = self._changed(*self._solve(_Rationals(self.flint)))
                if borders == []:
                    return self.told(lam, w)
                if borders:
                    raise self._undecided(
                        borders, f"on the border of two cases, closer than {self.flint.ctx.prec} bits tell"
                    )
            raise _Undecided(f"cases still change after {ROUNDS} rounds; a more accurate answer is needed")
        except _Undecided as undecided:
            return Enclosure(
                proven=False,
                impulse_radius=math.inf,
                velocity_radius=math.inf,
                unique=False,
                reason=str(undecided),
                borders=undecided.borders,
            )

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

    def _solve(self, kind: Any = None) -> tuple[list[Any], list[Any]]:
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
            if isinstance(kind, _Rationals):
                right = kind.matrix(len(which), 1, [-base[r] for r in which.tolist()])
                for r, x in zip(
                    which.tolist(), self.operator.block(kind, which).solve(right).entries(), strict=True
                ):
                    lam[r] = x
            else:
                self._island(kind, which, lam, base)
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
        first, numerical = _pivots(j[rows].toarray())
        if numerical == len(rows) and not len(touching):
            return unknown
        own = rows[first]
        while True:  # w = 0 of rows with load; not of one that touches, which must depend on them alone
            rows = np.concatenate([own, touching])
            try:
                found = _dependencies(self.flint, j[rows], self.operator.target[rows])
            except _Tangled as tangled:
                if len(touching):
                    touching = touching[:0]
                    continue
                raise self._named(
                    rows[tangled.args[0]], "depend on each other to rounding, not exactly"
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

    def _island(self, kind: Any, which: Any, lam: list[Any], base: list[Any]) -> None:
        """Enclose the impulses of `which`, by (2), into `lam`."""
        n = len(which)
        if n > LARGEST:
            raise CapabilityError(f"{n} unknowns are coupled with each other; up to {LARGEST} are proven")
        a = self.operator.block(kind, which)
        place = {r: k for k, r in enumerate(which.tolist())}
        parts = [
            (block.first, part)
            for block in self.blocks
            if block.parts
            and block.loaded
            and (block.first in place or any(r in place for p in block.parts for r in p.rows))
            for part in block.parts
            if part.slides
        ]
        matrix, number = kind.matrix, kind.number
        b0 = matrix(n, 1, [base[r] for r in which.tolist()])  # w of what is fixed

        def f(x: Any) -> tuple[Any, Any]:
            """F and, of the sliding parts, their w and s."""
            w = a * x + b0
            out, speeds = [w[k, 0] for k in range(n)], []
            for first, part in parts:
                z = [number(c) * w[place[r], 0] for r, c in zip(part.rows, part.reach, strict=True)]
                s = sum((q * q for q in z), number(0.0)).sqrt() if len(z) > 1 else abs(z[0])
                speeds.append((w, s))
                normal = x[place[first], 0] if first in place else lam[first]
                for r, c in zip(part.rows, part.reach, strict=True):
                    c2 = number(c) * number(c)
                    out[place[r]] = x[place[r], 0] * s + c2 * w[place[r], 0] * normal
                if self.cone and first in place:
                    out[place[first]] -= s
            return matrix(n, 1, out), speeds

        def slope(x: Any, speeds: Any, left: Any, right: Any, other: Any) -> Any:
            """F' = left A + right over a box, into two matrices of 1 and 0."""
            for (first, part), (w, s) in zip(parts, speeds, strict=True):
                at = [(place[r], number(c) * number(c)) for r, c in zip(part.rows, part.reach, strict=True)]
                share = [c2 * w[k, 0] / s for k, c2 in at]  # ds = share . dw
                normal = x[place[first], 0] if first in place else lam[first]
                for k, c2 in at:
                    for (q, _), ds in zip(at, share, strict=True):
                        left[k, q] = other(x[k, 0] * ds + (c2 * normal if q == k else 0))
                    right[k, k] = other(s)
                    if first in place:
                        right[k, place[first]] = other(c2 * w[k, 0])
                if self.cone and first in place:
                    for (q, _), ds in zip(at, share, strict=True):
                        left[place[first], q] = other(-ds)

        def near(x: Any, speeds: Any) -> FloatArray:
            left, right = np.eye(n), np.zeros((n, n))
            slope(x, speeds, left, right, float)
            return left @ floats + right

        def over(x: Any, speeds: Any) -> Any:
            if not parts:
                return a
            left, right = matrix(unit), matrix(n, n)
            slope(x, speeds, left, right, number)
            return left * a + right

        floats = np.asarray(self.problem.csr[which][:, which].toarray())
        unit = matrix(n, n, np.eye(n).ravel().tolist())
        x = matrix(n, 1, [number(float(self.given[r])) for r in which.tolist()])
        start, inverse, precise = x, None, False
        moved = last = math.inf
        for step in range(30):
            value, speeds = f(x)
            if any(not (s > 0) for _, s in speeds):
                break  # its case is wrong, or on the border
            precise = precise or (step > 6 and moved > 0.1 * last)
            if inverse is None or moved > (1e-3 if parts else 0.1) * last or (parts and step < 3):
                inverse = None if precise else self._inverse(near(x, speeds))
            if inverse is None:
                try:
                    if n > PRECISE:
                        raise ZeroDivisionError
                    inverse, precise = over(x, speeds).mid().inv().mid(), True
                except ZeroDivisionError:
                    raise self._singular(which, near(x, speeds)) from None
            move = (inverse * value).mid()
            x = (x - move).mid()
            size, last, moved = _largest(x), moved, _largest(move)
            enough = moved <= 2.0 ** (-0.75 * self.flint.ctx.prec) * size
            if step > 1 and (enough or (precise and step > 9 and moved > 0.1 * last)):
                break
        value, speeds = f(x)
        still = [part for (_, part), (_, s) in zip(parts, speeds, strict=True) if not s > 0]
        for part in still:
            part.slides = False
        if still:
            raise _Recase
        newton = inverse * value
        radius = [2.0 * upper_end(q) for q in newton.entries()]
        least = max(radius, default=0.0) + 2.0 ** (-self.flint.ctx.prec + 16) * _largest(x) + 2.0**-900
        wide = [max(q, 1e-6 * least) for q in radius]
        for _ in range(EXTENT):
            ball = matrix(n, 1, [number(0.0, q) for q in wide])
            box = x + ball
            value, speeds = f(box)
            if all(s > 0 for _, s in speeds):
                away = (unit - inverse * over(box, speeds)) * ball - newton
                reach = [upper_end(q) for q in away.entries()]
                if all(q < p for q, p in zip(reach, wide, strict=True)):
                    for r in which.tolist():
                        lam[r] = x[place[r], 0] + number(0.0, reach[place[r]])
                    return
                wide = [4.0 * max(p, q) for p, q in zip(wide, reach, strict=True)]
            else:
                wide = [0.25 * p for p in wide]
            if not all(math.isfinite(q) for q in wide):
                break
        # What hardly slides at the answer may stick.
        _, speeds_given = f(start)
        hardly = SLOW * float(abs(self.problem.b).max())
        slow = [part for (_, part), (_, s) in zip(parts, speeds_given, strict=True) if not s > hardly]
        for part in slow:
            part.slides = False
        if slow:
            raise _Recase
        raise self._singular(which, near(start, speeds_given))

    def _inverse(self, middle: FloatArray) -> Any:
        n = len(middle)
        with np.errstate(all="ignore"):
            scale = np.sqrt(np.maximum(abs(middle).max(axis=0), np.finfo(float).tiny))
            row = np.maximum(abs(middle / scale).max(axis=1), np.finfo(float).tiny)
            try:
                inverse = np.linalg.inv(middle / scale / row[:, None]) / scale[:, None] / row
            except np.linalg.LinAlgError:
                return None
            good = np.isfinite(inverse).all() and abs(np.eye(n) - inverse @ middle).max() < 1e-3
        return self.flint.arb_mat(n, n, inverse.ravel().tolist()) if good else None

    def _singular(self, which: Any, slope: FloatArray) -> _Undecided:
        """Names the blocks whose impulses the equations do not fix, if they are singular."""
        rows = which[:0]
        if np.isfinite(slope).all():
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
        changed, border = False, []
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
                        border.append(block)
                continue
            speeds = [
                sum((_squared(number(c) * w[k]) for k, c in zip(p.rows, p.reach, strict=True)), 0 * w[r])
                for p in block.parts
            ]
            if not block.loaded:
                sign = sign_of(w[r])
                if (
                    self.cone and sign > 0
                ):  # w_n >= sum s; one root of the sum of squares where there is one part
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
                    border.append(block)
                continue
            sign = sign_of(lam[r])
            if sign <= 0:
                block.loaded, block.touches, changed = False, not sign, True
                continue
            for part in block.parts:
                if part.slides:
                    continue  # |lambda / c| = lambda_n by (1), against w by its sign
                y = sum(
                    (_squared(lam[k] / number(c)) for k, c in zip(part.rows, part.reach, strict=True)),
                    0 * lam[r],
                )
                sign = sign_of(lam[r] * lam[r] - y)
                if sign < 0:
                    part.slides = changed = True
                elif not sign:
                    border.append(block)
        return None if changed else border

    def _root(self, square: Any) -> Any:
        """A ball that holds the root; a ball of a square may reach below 0."""
        square = self.flint.arb(square)
        return square.sqrt() if square > 0 else square.abs_upper().sqrt() * self.flint.arb(0.5, 0.5)

    def told(self, lam: list[Any], w: list[Any]) -> Enclosure:
        kind = Balls(self.flint)
        own = self.operator.slack(kind, [kind.number(x) for x in self.given.tolist()])
        off = max((upper_end(x - g) for x, g in zip(lam, self.given.tolist(), strict=True)), default=0.0)
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


class _Tangled(Exception):
    """Rows that depend on each other to rounding, by no simple quotients."""


class _Recase(Exception):
    """Cases of blocks were changed before there was a zero."""


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(names[:4]) + (" and others" if len(names) > 4 else "")


def upper_end(x: Any) -> float:
    """No less than |x| for any number of a ball; the float of an upper end may be rounded down."""
    up = abs(x).upper()
    return 0.0 if up == 0 else float(up) * (1.0 + 2.0**-50) + 2.0**-1070


def _largest(x: Any) -> float:
    return max((abs(float(q)) for q in x.entries()), default=0.0)


def _squared(x: Any) -> Any:
    return x * x


def sign_of(x: Any) -> int:
    """+1 where certainly x >= 0, -1 where certainly x < 0, else 0."""
    return 1 if x >= 0 else -1 if x < 0 else 0


def _pivots(j: FloatArray) -> tuple[Any, int]:
    """An order of the rows of J in which those that depend on others to rounding come last, and how many do not."""
    size = np.maximum(np.sqrt((j * j).sum(axis=1)), np.finfo(float).tiny)
    unit = j / size[:, None]
    _, order, rank, _ = lapack.dpstrf(unit @ unit.T, tol=1e-10)
    return np.concatenate([np.sort(order[:rank]), np.sort(order[rank:])]) - 1, int(rank)


PRIMES = (2**61 - 1, 2**521 - 1)  # the second where numbers of the first are too small for the quotients


def _dependencies(flint: Any, j: Any, target: FloatArray) -> tuple[Any, Any]:
    """Rows of J that are independent of those before them, and others whose target contradicts theirs: exactly.

    Rows that are independent modulo a prime are so. Where they span all columns that they reach, the others depend on
    them; else what these are made of is read modulo the prime as quotients of whole numbers, and held to J in rational
    numbers. Rows of no target contradict nothing.
    """
    _, label = sp.csgraph.connected_components(
        sp.block_array([[None, j != 0], [(j != 0).T, None]]).astype(float), directed=False
    )
    kept, contradict = [], []
    for k in np.unique(label[: j.shape[0]]):
        rows = np.flatnonzero(label[: j.shape[0]] == k)
        columns = np.flatnonzero(label[j.shape[0] :] == k)
        for prime in PRIMES:
            found = _dependent(flint, j[rows][:, columns], target[rows], prime)
            if found is not None:
                break
        else:
            raise _Tangled(rows)
        kept.append(rows[found[0]])
        contradict.append(rows[found[1]])
    return np.sort(np.concatenate(kept)), np.sort(np.concatenate(contradict))


def _dependent(flint: Any, j: Any, target: FloatArray, prime: int) -> tuple[list[int], list[int]] | None:
    m, n = j.shape
    dense = [[_residue(x, prime) if x else 0 for x in row] for row in j.T.toarray().tolist()]
    entries = [x for row in dense for x in row]
    if prime < 2**64:
        reduced, rank = flint.nmod_mat(n, m, entries, prime).rref()
    else:
        reduced, rank = flint.fmpz_mod_mat(n, m, entries, flint.fmpz_mod_ctx(prime)).rref()
    kept: list[int] = []
    for k in range(m):
        if len(kept) < rank and int(reduced[len(kept), k]) != 0:
            kept.append(k)
    others = sorted(set(range(m)) - set(kept))
    if not others or (rank == n and not target.any()):
        return kept, []
    number = _exact(flint)
    exact = [
        dict(zip(j.indices[s:e].tolist(), map(number, j.data[s:e].tolist()), strict=True))
        for s, e in zip(j.indptr[:-1].tolist(), j.indptr[1:].tolist(), strict=True)
    ]
    goal, contradict = [number(x) for x in target.tolist()], []
    for k in others:
        rest, left = dict(exact[k]), goal[k]
        for i, base in enumerate(kept):
            c = int(reduced[i, k])
            if c:
                share = flint.fmpq(*_quotient(c, prime))
                left = left - share * goal[base]
                for column, x in exact[base].items():
                    rest[column] = rest.get(column, 0) - share * x
        if any(x != 0 for x in rest.values()):
            return None
        if left != 0:
            contradict.append(k)
    return kept, contradict


def _exact(flint: Any) -> Any:
    return lambda x: flint.fmpq(*x.as_integer_ratio())


def _residue(x: float, prime: int) -> int:
    top, bottom = x.as_integer_ratio()
    return top * pow(bottom, -1, prime) % prime


def _quotient(c: int, prime: int) -> tuple[int, int]:
    """The quotient of least size that is c modulo the prime (half an extended Euclid; Wang 1981)."""
    a, b, u, v = prime, c, 0, 1
    while b * b > prime:
        q = a // b
        a, b, u, v = b, a - q * b, v, u - q * v
    return (b, v) if v > 0 else (-b, -v)
