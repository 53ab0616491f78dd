"""Lemke's method: complementary pivoting along one path, for any small dense A.

    w = q + M s + c z,   w, s >= 0,  w_i s_i = 0,   z from its first value down to 0

The path ends at z = 0, a solution, or on a secondary ray. For copositive-plus M (positive semidefinite ones
are) a ray proves that there is none: its direction is the certificate, checked before INFEASIBLE is said.
Everything is scaled to unit diagonal first. Rows become nonnegative ones exactly:

    lower bound alone   lambda = lower + s              upper bound alone   lambda = upper - s, w -> -w
    both bounds         lambda = lower + s, a row more: upper - lower - s >= 0 complementary to v >= 0,
                        w + v >= 0 complementary to s
    free                eliminated by principal pivots; what none reaches is split, lambda = s+ - s-
    fixed               a constant

In the end the rows found free are solved anew by LU of A itself and refined, so that what the pivots lost
does not reach the result. Ties are broken lexicographically: no cycles, in exact arithmetic.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

from lavender._arrays import FloatArray, IntArray
from lavender.certificates import check_certificate
from lavender.deadline import CHUNK_TIME, Deadline
from lavender.problem import Problem
from lavender.registry import SolverSpec
from lavender.residuals import at_floor, quick
from lavender.solution import Claim, Status
from lavender.solvers.polyhedral import count_rows
from lavender_ext.judge import measure
from lavender_ext.pivot.tableau import PIVOTS, RAY, Dictionary

LIMIT = 2000  # rows: a dictionary of 32 MB
# -, entries of a column this much below its largest are not pivoted on; the finer one for a second path, on
# matrices whose own entries span as much.
TINY, FINER = 1e-11, 1e-13
REGULAR = 1e-13  # -, reciprocal condition above which a block can be eliminated: the result is refined anyway
STABLE = 1e-2  # -, a diagonal entry of this share of its row and column makes a fair pivot of its own
BATCH = 200  # pivots after which the dictionary is formed anew, which drops what rounding left
ENTRY, FORMED = 1e-9, 5e-10  # s for each entry of the dictionary in a pivot, and n^3 times to form it anew
STEP = 1e-3  # s that pivots have at least, whatever it took to form their dictionary
LAID_OUT = 5e-8  # s for each entry of the first dictionary; FORMED for each that a free row's pivot touches
PATHS = 8  # covering vectors tried
PIVOTS_A_ROW = 20  # on one path, before it counts as lost
GOOD = 1e-12  # relative residual at which no other path is tried


Places = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Standard:
    """M s + q >= 0, s >= 0 for the rows of a problem, and the way back.

    Of an `exchanged` row s stands for w and w for lambda's distance from its bound.
    """

    problem: Problem
    m: FloatArray  # (n, n) -
    q: FloatArray  # (n,) sqrt J
    base: FloatArray  # (m,) N s, lambda where its variable is 0
    turn: FloatArray  # (m,) sqrt kg, lambda_i = base_i + turn_i x_i; negative for an upper bound alone
    kept: Places  # rows with a variable of their own: the first places; then caps, then second halves
    capped: Places  # places of kept rows with both bounds
    split: Places  # places of kept rows that are free
    exchanged: Mask  # (kept + caps,)
    out: Places  # free rows eliminated
    back: FloatArray  # (out, kept + caps + 1): x_out = back @ (s, 1)

    def impulse(self, s: FloatArray, w: FloatArray, direction: bool = False) -> FloatArray:
        """lambda (m,) [N s] of s, w (n,), or the direction of lambda for directions of both."""
        k, whole = len(self.kept), len(self.exchanged)
        s = s.copy()
        s[self.split] -= s[whole:]
        x = np.where(self.exchanged, w[:whole], s[:whole])[:k]
        lam = np.zeros(len(self.base)) if direction else self.base.copy()
        lam[self.kept] += self.turn[self.kept] * x
        x_out = self.back[:, :whole] @ s[:whole] + (0.0 if direction else self.back[:, whole])
        lam[self.out] += self.turn[self.out] * x_out
        return lam


def standard_form(problem: Problem) -> Standard:
    """Scale, shift, eliminate and split; see the module."""
    c = problem.cones
    a = problem.dense()
    low, high = np.isfinite(c.lower), np.isfinite(c.upper)
    rows = np.flatnonzero(~(low & high & (c.lower == c.upper)))
    base = np.where(low, c.lower, np.where(high, c.upper, 0.0))
    turn = np.where(~low & high, -1.0, 1.0) / np.sqrt(problem.csr_data.d)
    scaled = (turn[:, None] * a * turn)[np.ix_(rows, rows)]
    q = (turn * (a @ base - problem.b))[rows]
    free = (~low & ~high)[rows]
    capped = np.flatnonzero((low & high)[rows])
    k, n = len(rows), len(rows) + len(capped)
    m = np.zeros((n, n))
    m[:k, :k] = scaled
    m[capped, np.arange(k, n)] = 1.0
    m[np.arange(k, n), capped] = -1.0
    room = (c.upper - c.lower)[rows][capped] / np.abs(turn[rows][capped])
    m, q, gone, exchanged = _eliminate(m, np.concatenate([q, room]), np.flatnonzero(free))
    stay = np.flatnonzero(~gone)
    place = np.cumsum(~gone) - 1  # of a row that stays
    split = place[np.flatnonzero(free & ~gone[:k])]
    back = np.column_stack([m[np.ix_(np.flatnonzero(gone), stay)], q[gone]])
    m, q = m[np.ix_(stay, stay)], q[stay]
    m = np.block([[m, -m[:, split]], [-m[split], m[np.ix_(split, split)]]])
    q = np.concatenate([q, -q[split]])
    kept, out = rows[~gone[:k]], rows[gone[:k]]
    return Standard(
        problem=problem,
        m=m,
        q=q,
        base=base,
        turn=turn,
        kept=kept,
        capped=place[capped],
        split=split,
        exchanged=exchanged[stay],
        out=out,
        back=back,
    )


def _eliminate(m: FloatArray, q: FloatArray, free: Places) -> tuple[FloatArray, FloatArray, Mask, Mask]:
    """Principal pivots that make the variables of free rows basic: (M, q, rows that are, rows exchanged).

    All at once where their block is regular; else one by one, or two by two with whichever row helps, which
    then has exchanged its two variables. Free rows that no pivot reaches stay as they are.
    """
    gone, exchanged = np.zeros(len(q), bool), np.zeros(len(q), bool)
    if len(free) == 0:
        return m, q, gone, exchanged
    block = m[np.ix_(free, free)]
    lu, _, info = lapack.dgetrf(block)
    if info == 0 and lapack.dgecon(lu, np.abs(block).sum(axis=0).max())[0] > REGULAR:
        gone[free] = True
        return (*_principal_pivot(m, q, free), gone, exchanged)
    left = list(free)
    while left:
        size = np.maximum(np.abs(m).max(axis=0), np.abs(m).max(axis=1))
        size = np.where(size > 0.0, size, 1.0)
        diagonal = np.diagonal(m)
        single = np.abs(diagonal[left]) / size[left]
        best = int(np.argmax(single))
        pair = [left[best]]
        if single[best] < STABLE:
            # det of rows (f, j) against the size of both; eliminated rows are out of the question
            det = np.abs(diagonal[left, None] * diagonal - m[left] * m[:, left].T) / (size[left, None] * size)
            det[:, gone] = 0.0
            f, j = np.unravel_index(int(np.argmax(det)), det.shape)
            if det[f, j] > max(single[best] ** 2, REGULAR):
                pair = [left[f], int(j)]
            elif single[best] <= REGULAR:
                break
        m, q = _principal_pivot(m, q, np.array(pair))
        for i in pair:
            if i in left:
                left.remove(i)
                gone[i] = True
            else:
                exchanged[i] = not exchanged[i]
    return m, q, gone, exchanged


def _principal_pivot(m: FloatArray, q: FloatArray, rows: Places) -> tuple[FloatArray, FloatArray]:
    """w and s of these rows change places in w = M s + q."""
    inverse = np.linalg.inv(m[np.ix_(rows, rows)])
    new = m - m[:, rows] @ inverse @ m[rows]
    new[:, rows] = m[:, rows] @ inverse
    new[rows] = -inverse @ m[rows]
    new[np.ix_(rows, rows)] = inverse
    head = inverse @ q[rows]
    q = q - m[:, rows] @ head
    q[rows] = -head
    return new, q


@dataclass
class LemkeState:
    """A problem, in standard form from the first run on, and the paths followed on it so far."""

    problem: Problem
    form: Standard | None = None
    walk: Walk | None = None

    def formed(self, time_limit: float | None) -> Standard | None:
        """The standard form; None where it would take longer than that [s]."""
        if self.form is None:
            if time_limit is not None and _counted(self.problem) > time_limit:
                return None
            self.form = standard_form(self.problem)
        return self.form


def _counted(problem: Problem) -> float:
    """What the standard form takes [s]."""
    c = problem.cones
    low, high = np.isfinite(c.lower), np.isfinite(c.upper)
    n = problem.m + np.count_nonzero(low & high)
    return float(LAID_OUT * n**2 + FORMED * n**2 * np.count_nonzero(~low & ~high))


@dataclass(frozen=True)
class Lemke:
    """Lemke's complementary pivoting; one path, no options."""

    def prepare(self, problem: Problem) -> LemkeState:
        return LemkeState(problem)

    def update(self, state: LemkeState, problem: Problem) -> LemkeState:
        return self.prepare(problem)

    @np.errstate(all="ignore")  # what overflows is judged
    def run(
        self,
        state: LemkeState,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None = None,
    ) -> Claim:
        deadline = Deadline(time_limit)
        form = state.formed(time_limit)
        if form is None:
            return _too_late()
        return Walk(form, impulse).go(impulse, max_iter, tol, Deadline(deadline.left(STEP)))

    @np.errstate(all="ignore")  # what overflows is judged
    def resume(
        self, state: LemkeState, impulse: FloatArray, n: int, tol: float, time_limit: float | None = None
    ) -> Claim:
        """At most n more pivots from where the last call stopped: n, then n, end where 2 n do."""
        deadline = Deadline(time_limit)
        form = state.formed(time_limit)
        if form is None:
            return _too_late()
        if state.walk is None:
            state.walk = Walk(form, impulse)
        return state.walk.go(impulse, n, tol, Deadline(deadline.left(STEP)))


def _too_late() -> Claim:
    return Claim(Status.TIME_LIMIT, 0, {"pivots": 0}, "the dictionary alone would take longer", form="dense")


class Walk:
    """Paths of one problem from where they stand; the best judged iterate so far, and what was spent."""

    def __init__(self, form: Standard, impulse: FloatArray) -> None:
        self.form, self.problem, self.impulse = form, form.problem, impulse.copy()
        m = form.problem.m
        self.w, self.e = np.empty(m), np.empty(m)
        self.best, self.floor = np.inf, 0.0
        self.pivots, self.work = 0, {"pivots": 0}
        self.message = ""
        self.certificate: FloatArray | None = None
        self.budget, self.deadline, self.tol = 0, Deadline(), 0.0
        self.ended = Status.INTERRUPTED  # where Ctrl-C ended the steps; else their last word
        self.steps = self.solve()

    def go(self, impulse: FloatArray, n: int, tol: float, deadline: Deadline) -> Claim:
        """At most n more pivots; the best impulse (m,) so far in place."""
        self.budget, self.tol = self.pivots + n, tol
        self.deadline = deadline
        work = dict(self.work)
        self.ahead: FloatArray | None = None
        status = Status.MAX_ITERATIONS if n <= 0 else next(self.steps, self.ended)
        impulse[:] = self.impulse if self.ahead is None else self.ahead
        self.work["pivots"] = self.pivots
        spent = {what: count - work.get(what, 0) for what, count in self.work.items()}
        spent = {what: count for what, count in spent.items() if count or what == "pivots"}
        return Claim(status, spent["pivots"], spent, self.message, form="dense", certificate=self.certificate)

    def judge(self, x: FloatArray, result: bool = True) -> float:
        """Relative residual of x within its bounds; the best becomes the result.

        With `result` False only that of this call: what comes later must not know where a call ended.
        """
        c = self.problem.cones
        x = np.clip(x, c.lower, c.upper)
        if not np.isfinite(x).all():
            return np.inf
        relative, floor = quick(self.problem, x, self.w, self.e, floor=True)
        if relative < self.best:
            if result:
                self.best, self.floor, self.impulse = relative, floor, x
            else:
                self.ahead = x
        return relative

    def end(self, status: Status) -> Status:
        """The last word: further calls say the same."""
        self.ended = status
        return status

    def verdict(self) -> Status:
        if self.best <= self.tol:
            self.message = ""
            return self.end(Status.CONVERGED)
        return self.end(Status.FLOOR if at_floor(self.best, self.floor) else Status.STALLED)

    def count(self, what: str) -> None:
        self.work[what] = self.work.get(what, 0) + 1

    # -- the path ----------------------------------------------------------------------------------

    def solve(self) -> Iterator[Status]:
        """All paths; how each call ends where it is cut, and in the end."""
        q = self.form.q
        n = len(q)
        self.judge(self.impulse)
        if n == 0 or q.min() >= 0.0:
            self.finish(np.arange(n, dtype=np.int32))
            yield self.verdict()
            return
        covers = np.random.default_rng(0)
        for path in range(PATHS):
            # Another covering vector is another path: past rays that prove nothing, and past lost ones.
            cover = np.ones(n) if path < 2 else covers.uniform(0.2, 1.8, n)
            yield from self.follow(cover, FINER if path == 1 else TINY)
            if self.certificate is not None:
                yield self.end(Status.INFEASIBLE)
                return
            if self.best <= max(GOOD, 2.0 * self.floor):
                break
            if self.pivots >= self.budget:
                yield Status.MAX_ITERATIONS
        yield self.verdict()

    def follow(self, cover: FloatArray, tiny: float) -> Iterator[Status]:
        """One path from q + M s + cover z; a certificate where its end proves that there is no solution."""
        q = self.form.q
        n = len(q)
        basic = np.arange(n, dtype=np.int32)
        nonbasic = np.append(np.arange(n, 2 * n), 2 * n).astype(np.int32)
        t = np.ascontiguousarray(np.column_stack([self.form.m, cover, q]))
        book = Dictionary(t, basic, nonbasic, np.empty(2 * n + 1, np.int32), tiny)
        # z enters where q / cover is least; the last of equals is lexicographically least.
        r = n - 1 - int(np.argmin((q / cover)[::-1]))
        book.pivot(r, n)
        book.enter(n + r)
        self.pivots += 1
        last = self.pivots + PIVOTS_A_ROW * n + BATCH
        self.count("paths")
        chunk = max(1, int(CHUNK_TIME / (ENTRY * n * n)))
        while True:
            code, left = PIVOTS, BATCH
            while code == PIVOTS and left:
                while self.pivots >= self.budget or self.late():
                    yield self.cut(t, basic)
                code, done = book.pivots(min(left, chunk, self.budget - self.pivots))
                self.pivots += done
                left -= done
            if code != PIVOTS:
                break
            while self.late(FORMED * float(n) ** 3):
                yield self.cut(t, basic)
            entering = int(nonbasic[book.entering])
            if self.pivots >= last or not self.form_anew(t, basic, nonbasic, cover):
                self.message = "lost its path to rounding"
                return
            book = Dictionary(t, basic, nonbasic, np.empty(2 * n + 1, np.int32), tiny)
            book.enter(entering)
        self.judge(self.form.impulse(*self.values(t, basic)))
        if code == RAY:
            self.ray(t, basic, nonbasic, book.entering)
            return
        self.message = ""
        while self.late(FORMED * float(self.about_free(basic)) ** 3):
            yield self.cut(t, basic)
        self.finish(basic)

    def cut(self, t: FloatArray, basic: IntArray) -> Status:
        """A call ends in the middle of a path."""
        self.judge(self.form.impulse(*self.values(t, basic)), result=False)
        return Status.MAX_ITERATIONS if self.pivots >= self.budget else Status.TIME_LIMIT

    def late(self, more: float = 0.0) -> bool:
        """The time is up, or would be `more` [s] from now."""
        return self.deadline.passed(more)

    def values(self, t: FloatArray, basic: IntArray) -> tuple[FloatArray, FloatArray]:
        """s, w (n,) of a dictionary."""
        return self.column(np.maximum(t[:, -1], 0.0), basic)

    def column(self, x: FloatArray, basic: IntArray) -> tuple[FloatArray, FloatArray]:
        n = len(basic)
        both = np.zeros(2 * n + 1)
        both[basic] = x
        return both[n : 2 * n], both[:n]

    def form_anew(self, t: FloatArray, basic: IntArray, nonbasic: IntArray, cover: FloatArray) -> bool:
        """The same dictionary from M and q; False where its basis is singular to rounding."""
        n = len(basic)
        # w - M s - c z = q; columns of w, s, z
        columns = np.column_stack([np.eye(n), -self.form.m, -cover])
        lu, pivot, info = lapack.dgetrf(columns[:, basic])
        if info != 0:
            return False
        new = lapack.dgetrs(lu, pivot, np.column_stack([-columns[:, nonbasic], self.form.q]))[0]
        if not np.isfinite(new).all():
            return False
        t[:] = new
        self.count("factorisations")
        return True

    def ray(self, t: FloatArray, basic: IntArray, nonbasic: IntArray, entering: int) -> None:
        """On a secondary ray: its direction may prove that there is no solution."""
        n = len(basic)
        s, w = self.column(t[:, entering], basic)
        into = int(nonbasic[entering])
        if into < n:
            w[into] = 1.0
        elif into < 2 * n:
            s[into - n] = 1.0
        big = max(s.max(), w.max())
        s, w = (np.where(x > TINY * big, x, 0.0) for x in (s, w))
        y = self.form.impulse(s, w, direction=True)
        c = self.problem.cones
        y[np.isfinite(c.lower) & np.isfinite(c.upper)] = 0.0
        self.message = "ended on a secondary ray"
        size = np.abs(y).max(initial=0.0)
        if size > 0.0 and check_certificate(self.problem, y / size) is None:
            self.message += ": no impulse meets every row"
            self.certificate = y / size

    # -- the result --------------------------------------------------------------------------------

    def about_free(self, basic: IntArray) -> int:
        """How many rows `finish` solves anew, or a few more."""
        form, n = self.form, len(basic)
        k, whole = n + len(form.kept), n + len(form.exchanged)
        inside = int(np.count_nonzero((basic >= n) & (basic < k)))
        pulls = int(np.count_nonzero((basic >= k) & (basic < whole)))  # caps: at the upper bound
        return max(inside - pulls, 0) + int(form.exchanged.sum()) + len(form.split) + len(form.out)

    def finish(self, basic: IntArray) -> None:
        """Solve the rows found free anew, on A itself, and refine while that halves the residual."""
        form, problem = self.form, self.problem
        n, k, whole = len(form.q), len(form.kept), len(form.exchanged)
        is_basic = np.zeros(2 * n + 1, bool)
        is_basic[basic] = True
        x_basic = np.where(form.exchanged, is_basic[:whole], is_basic[n : n + whole])
        on = x_basic[:k].copy()
        on[form.split] = True
        x = form.base.copy()
        pulls = form.capped[x_basic[k:]]  # the cap pulls: at the upper bound
        x[form.kept[pulls]] = problem.cones.upper[form.kept[pulls]]
        on[pulls] = False
        free = np.sort(np.concatenate([form.kept[on], form.out]))
        if len(free) == 0:
            self.judge(x)
            return
        scale = np.abs(form.turn[free])
        a = scale[:, None] * problem.csr[free][:, free].toarray() * scale
        self.count("factorisations")
        lu, pivot, info = lapack.dgetrf(a)
        singular = info != 0 or lapack.dgecon(lu, np.abs(a).sum(axis=0).max())[0] < 1e-14
        if singular:
            # Start from what the pivots found: of all solutions on these rows the nearest to it.
            x[free] = self.impulse[free]
        w, previous = np.empty(problem.m), np.inf
        for _ in range(6):
            measure.slack(problem.csr_data, x, w)
            rhs = scale * w[free]
            if not (np.isfinite(rhs).all() and np.isfinite(a).all()):
                break  # LAPACK would complain on the terminal, and has no answer
            step = np.linalg.lstsq(a, rhs, rcond=1e-13)[0] if singular else lapack.dgetrs(lu, pivot, rhs)[0]
            x[free] -= scale * step
            relative = self.judge(x)
            if relative <= self.floor or not relative < 0.5 * previous:
                break
            previous = relative
            self.count("refinements")


def _refusal(problem: Problem) -> str | None:
    rows = count_rows(problem)
    if rows > LIMIT:
        means = "" if rows == problem.m else f", its friction as bounded rows {rows}"
        return (
            f"holds a dense dictionary, for at most {LIMIT} rows; this problem has {problem.m}{means}: "
            "use direct, newton or pgs"
        )
    return None


SPEC = SolverSpec(
    name="lemke",
    factory=Lemke,
    laws=frozenset({"linear", "lcp"}),
    boxes=frozenset({"coulomb", "cone"}),
    operators=frozenset({"matrix"}),
    exact=True,
    resumable=False,
    impulse=False,
    max_iter=20_000,
    refusal=_refusal,
    summary="Lemke's complementary pivoting, dense, any A",
    reference="Lemke 1965; Cottle, Pang, Stone 1992, section 4.4, and 4.9 for degeneracy",
)
