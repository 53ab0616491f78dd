"""Proofs that a problem has no solution, checked on its own data.

A certificate y (m,) is a direction in which the bounds never end: along free rows, up where there is no upper bound,
in the cone of a contact (Coulomb: along its normal alone). There w.y >= 0 at every solution, so with z = A^T y

    0 <= w.y = z.lambda - b.y,    and none exists where   b.y > max z.lambda                      (1)

over all lambda within the bounds, for any A and every law. Where z pulls by s at most along what has no end,

    every solution has   sum |lambda| >= (b.y - pull of the rows that end) / s                    (2)

which is infinite where s is 0 in exact arithmetic. A slack s is a proof as well where no more than rounding of the data
made it, in the metric of D = diag(d), k the rows of y:

    A given           |z_i| <= (k + 2) 2^-53 sqrt(d_i) sum_j sqrt(d_j) |y_j|                      (3)
    J, M and R given  |J^T y|_M^-1 <= (k + 2) 2^-53 sum_j sqrt(d_j) |y_j|,   R y = 0 exactly      (4)
    bodies            the same, with J as float64 has it

and no solution with an impulse as large as (2) could be told from a failure: its floor would be above 1e-6. The error
of any impulse (`lavender.judge.residuals`) is

    E >= net / (|y|_D + |z|_D^-1),    V >= net / sum sqrt(d / nu) |y|,    net = b.y - pull        (5)

Where this is within tol, or within what rounding of target and J v* made of b, an answer may meet tol, and there is
nothing to prove. So b of an empty row may be dust, and equations that are repeated may differ by dust.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import NEVER, Deadline, TooLate
from lavender.judge.residuals import reference, relative_of
from lavender.problem import Problem

__all__ = ["Proof", "check_certificate", "fighting", "prove", "rounded_down"]

UNIT = 2.0**-53
SPLIT = 2.0**27 + 1.0
FAR = 1e-10  # of b.y: what z may reach, so that the floor of a solution is above 1e-6
SURE = 1e3  # times its rounding: a sum beyond is known well enough as it comes
NEAR = 1e-6  # what z may reach, beside its terms, for a solver's rounding
SIMPLE = 16  # rows of a certificate up to which numbers are looked for that make A^T y zero exactly
TAKES_PART = 1e-6  # of the largest y in the metric of D: below, a row is not named
NAMED = 6  # blocks of a kind that are named
POLISHED = 1000  # rows of a certificate up to which it is polished, by dense least squares,
LEAST_SQUARES = 6e-10  # s for each row, column, and once more the fewer of both


@dataclass(frozen=True)
class Proof:
    """What a direction y proves."""

    y: FloatArray  # (m,), as given, or polished
    impulse_bound: float  # N s, (2): of every solution; inf where none exists, 0 where y says nothing
    reason: str = ""  # why y is no proof that nothing meets the tolerance; empty where it is one
    fighting: str = ""  # blocks of y, by name, where it is a proof
    skipped: float = 0.0  # s that polishing it would have taken, where they were not left

    @property
    def words(self) -> str:
        """What is proved, and who fights."""
        who = f": {self.fighting}" if self.fighting else ""
        if self.impulse_bound == math.inf:
            return f"no solution, proved{who}"
        return (
            "no solution for data within rounding of yours; for yours every solution has an impulse of at least "
            f"{rounded_down(self.impulse_bound)} N s{who}"
        )


def rounded_down(bound: float) -> str:
    """A lower bound to one digit, no larger than it is."""
    digits, power = f"{bound:.17e}".split("e")
    return f"{float(f'{digits[0]}e{power}'):.1g}"


def check_certificate(
    problem: Problem, y: Any, tol: float = 0.0, deadline: Deadline | None = None
) -> str | None:
    """Why y (m,) does not prove that nothing meets `tol`; None where it does."""
    return prove(problem, y, tol, deadline).reason or None


def prove(problem: Problem, y: Any, tol: float = 0.0, deadline: Deadline | None = None) -> Proof:
    """What y (m,) proves: no solution, or a least impulse of every solution.

    Where y is off by rounding of a solver, the nearest direction on the same rows with A^T y = 0 takes its place, if
    it is found before the deadline. The last answer is kept with the problem: a solver, and whoever checks its claim,
    ask the same; one with a deadline asks anew what another had no time for.
    """
    y = np.array(y, float)
    y.setflags(write=False)
    asked = tol, y.shape, y.tobytes()
    last: tuple[Any, Proof] | None = problem.derived.cache.get(__name__)
    if last is not None and last[0] == asked:
        skipped = last[1].skipped
        if not skipped or deadline is None or deadline.passed(skipped):
            return last[1]
    found = _prove(problem, y, tol, deadline or NEVER)
    problem.derived.cache[__name__] = asked, found
    return found


def _prove(problem: Problem, y: FloatArray, tol: float, deadline: Deadline) -> Proof:
    with np.errstate(all="ignore"):  # what overflows proves nothing
        inner = problem.disk
        if y.shape != (problem.m,) or not np.isfinite(y).all() or not np.any(y):
            reason = f"certificate of shape {y.shape} must be {problem.m} finite numbers, not all zero"
            return Proof(y, 0.0, reason)
        found = _proof(inner, problem.on_disk(y), tol)
        if 0.0 < found.impulse_bound < math.inf and (found.reason or np.count_nonzero(y) <= SIMPLE):
            try:
                for nearer in _polished(inner, found.y, deadline):
                    again = _proof(inner, nearer, tol)
                    if not again.reason and (found.reason or again.impulse_bound == math.inf):
                        found = again
                        break
            except TooLate as late:
                found = replace(found, skipped=late.args[0])
        if inner is not problem:
            found = replace(found, y=problem.cones.stretch * found.y)
        return found if found.reason else replace(found, fighting=_told(problem, found.y))


def fighting(problem: Problem, y: Any) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Blocks that a direction y (m,) takes part in: joints and bounded rows, and contacts."""
    size = np.sqrt(problem.d) * np.abs(np.asarray(y, float))
    rows = np.flatnonzero(size > TAKES_PART * size.max(initial=0.0))
    contact = problem.cones.contact_rows
    of = [
        np.unique([problem.block_of(int(i)) for i in rows[contact[rows] == kind]]) for kind in (False, True)
    ]
    return tuple(map(int, of[0])), tuple(map(int, of[1]))


def _told(problem: Problem, y: FloatArray) -> str:
    """Who fights, by the blocks' names: "joints 7 and 9 against contact 11"."""
    return " against ".join(
        told for told in (_listed(problem, blocks) for blocks in fighting(problem, y)) if told
    )


def _listed(problem: Problem, blocks: tuple[int, ...]) -> str:
    names = [problem.row_name(int(problem.cones.ptr[i])).rsplit(", ", 1)[0] for i in blocks]
    names = list(dict.fromkeys(names))  # a joint's free rows are blocks of their own
    parts = [re.fullmatch(r"(.*\S) (\d+)", name) for name in names[:NAMED]]
    kinds = {part[1] for part in parts if part}
    if len(names) > 1 and all(parts) and len(kinds) == 1:  # "joints 7 and 9"
        return f"{kinds.pop()}s " + _joined([part[2] for part in parts if part], len(names))
    return _joined(names[:NAMED], len(names))


def _joined(names: list[str], count: int) -> str:
    if count > len(names):
        return f"{', '.join(names)} and {count - len(names)} more"
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1]))) if names else ""


def _proof(problem: Problem, y: FloatArray, tol: float) -> Proof:
    # Only the rows that y takes part in: others may have overflown.
    rows = np.flatnonzero(y)
    vanished = np.intersect1d(rows, problem.vanished_rows)
    if len(vanished):
        name = problem.row_name(int(vanished[0]))
        return Proof(y, 0.0, f"products of {name} vanish in float64: its row of A is not zero")
    given, y = y, y / _power(y)
    gain, most = float(problem.b @ y), float(np.abs(problem.b) @ np.abs(y))
    if not gain > 0.0:
        return Proof(y, 0.0, f"b.y = {gain:.2e} is not positive")
    outside = _recession_violation(problem, y)
    if outside:
        return Proof(y, 0.0, outside)
    low, high, size = _slack(problem, y, rows)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return Proof(y, 0.0, "A^T y overflows")
    share = min((len(rows) + 2.0) * UNIT, FAR * gain / most)
    pull, slack, zero = _pull(problem, low, high, share * size)
    net, rounding = gain - float(pull.sum()), (len(rows) + 4.0) * UNIT
    if not net > rounding * (most + float(np.abs(pull).sum())):
        return Proof(y, 0.0, f"A^T y reaches {high.max():.2e}; impulses within the bounds can meet b.y")
    over = float(slack.max())
    bound = net / over if over > 0.0 else math.inf
    if np.any(slack > zero):
        words = f"A^T y reaches {over:.2e}, above rounding: impulses within the bounds can meet b.y"
        return Proof(given, bound, f"{words}, of at least {rounded_down(bound)} N s")
    least, rounded = _least(problem, net, y, np.where(slack > 0.0, 0.0, np.maximum(-low, high)))
    if least > max(tol, rounded):
        return Proof(given, bound)
    return Proof(given, bound, f"no exact solution, but one to a relative residual of {least:.1g} may exist")


def _slack(problem: Problem, y: FloatArray, rows: Any) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Least and largest z (m,), its sums exact, and what rounding of the data is told by (m,): (3), (4)."""
    length = np.sqrt(problem.d)
    size = length * float(length @ np.abs(y))
    if problem.matrix is not None:
        z = _product(problem.csr[rows], y[rows])
        return z, z, size
    r = _product(problem.jacobian[rows], y[rows])
    if problem.rows is None:
        x = problem.generalized.solve(r)  # type: ignore[union-attr]
    else:
        x = problem.rows.inverse_mass_matrix() @ r
    # J x as well: an M^-1 of bodies that is not definite, by rounding, makes r.x no norm.
    off = np.maximum(length * math.sqrt(max(0.0, float(r @ x))), np.abs(problem.jacobian @ x))
    soft = problem.compliance * y  # type: ignore[operator]
    return soft - off, soft + off, 0.0 * size if np.any(soft) else size


def _product(a: Any, y: FloatArray) -> FloatArray:
    """A^T y of a CSR matrix (k, m): each sum that cancels rounded once, as products of halves of 26 bits are exact."""
    out, size = a.T @ y, abs(a).T @ np.abs(y)
    cancels = np.flatnonzero((size > 0.0) & ~(np.abs(out) > SURE * (len(y) + 2.0) * UNIT * size))
    if not len(cancels):
        return out
    columns = a[:, cancels].tocsc()
    halves = []
    for x in (columns.data, y[columns.indices]):
        high = SPLIT * x - (SPLIT * x - x)  # of 26 bits, as the rest (Veltkamp)
        halves.append((high, x - high))
    terms = np.array([p * q for p, q in product(*halves)]).T.ravel().tolist()
    out[cancels] = [math.fsum(terms[4 * at : 4 * end]) for at, end in pairwise(columns.indptr.tolist())]
    return out


def _power(x: FloatArray) -> float:
    """The power of two below the largest of |x|, not all 0: what divides exactly."""
    return float(2.0 ** np.floor(np.log2(np.abs(x).max())))


def _rims(problem: Problem, x: FloatArray) -> tuple[Any, FloatArray, FloatArray]:
    """Of what one bound holds together: its contact's normal row, the bound over the normal, and |x| of its rows."""
    c = problem.cones
    parts, reach = list(c.parts()), c.reach
    normal = c.ptr[np.array([i for i, _ in parts], int)]
    bound = np.array([reach[part[0]] for _, part in parts])
    return normal, bound, np.array([np.hypot.reduce(x[part]) for _, part in parts])


def _pull(
    problem: Problem, low: FloatArray, high: FloatArray, zero: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Largest z.lambda of each row where that ends; else the slack along lambda; and what of a slack may be rounding.

    All (m,), low <= z <= high; of a contact's rows together, on its normal.
    """
    c, size = problem.cones, np.maximum(-low, high)
    corners = [
        np.multiply(z, bound, out=np.zeros(problem.m), where=z != 0.0)
        for z in (low, high)
        for bound in (c.lower, c.upper)
    ]
    pull = np.maximum.reduce(corners)
    first = c.normal_rows
    normal, limit, rim = _rims(problem, size)
    pull[c.contact_rows] = 0.0
    most, zero = high.copy(), zero.copy()
    np.add.at(most, normal, limit * rim)
    np.add.at(zero, normal, limit * _rims(problem, zero)[2])
    pull[first] = np.where(most[first] > 0.0, np.inf, 0.0)
    size[first] = most[first]
    endless = (pull > 0.0) & ((size <= zero) | np.isinf(pull))
    return np.where(endless, 0.0, pull), np.where(endless, size, 0.0), zero


def _least(problem: Problem, net: float, y: FloatArray, z: FloatArray) -> tuple[float, float]:
    """The least relative residual (5) of any impulse, and what rounding of b, or of target and J v*, may leave."""
    data, size = problem.metric, np.abs(problem.b)
    reference(problem)
    energy = net / (_energy(data, y * data.d) + _energy(data, z))
    velocity = 0.0 if np.any(z) else net / np.sum(data.d * np.abs(y) / data.weight)
    if not energy + velocity < math.inf:
        return 0.0, 0.0
    if problem.matrix is None:
        free = problem.generalized.v_free if problem.rows is None else problem.rows.v_free  # type: ignore[union-attr]
        size = size + 2.0 * (abs(problem.jacobian) @ np.abs(free.ravel()))
    off = 4.0 * UNIT * size
    most = np.max(data.weight * off / data.d)
    return relative_of(data, energy, velocity), relative_of(data, _energy(data, off), most)


def _energy(data: Any, w: FloatArray) -> Any:
    """Norm of velocities w (m,) in the metric of D^-1 [sqrt J]."""
    return np.sqrt(np.sum(w * w / data.d))


def _polished(problem: Problem, y: FloatArray, deadline: Deadline) -> Iterator[FloatArray]:
    """The nearest direction in the metric of D, on the rows of y, with A^T y = 0 where that is nearly so.

    First to 26 bits: sums of halves and thirds of simple numbers may be 0 then.
    """
    length = np.sqrt(problem.d)
    kept = np.abs(y) * length > FAR * float(length @ np.abs(y))
    if problem.matrix is not None:
        a, weight = problem.csr, 1.0 / length
    elif problem.rows is None:
        a, weight = problem.jacobian, 1.0 / np.sqrt(problem.generalized.mass.diagonal())  # type: ignore[union-attr]
    else:
        a, weight = problem.jacobian, np.sqrt(problem.rows.inverse_mass_matrix().diagonal())
    if problem.compliance is not None:
        kept &= problem.compliance == 0.0
    rows, y = np.flatnonzero(kept), np.where(kept, y, 0.0)
    if not 0 < len(rows) <= POLISHED:
        return
    a, own = a[rows], rows if problem.matrix is not None else slice(None)
    for _ in range(2):
        z, size = weight * _product(a, y[rows]), float(length @ np.abs(y))
        near = np.flatnonzero((z != 0.0) & (np.abs(z) <= NEAR * size))
        if np.any(np.abs(z[own]) > NEAR * size) or len(near) * len(rows) > POLISHED**2:
            return
        seconds = LEAST_SQUARES * len(near) * len(rows) * min(len(near), len(rows))
        if deadline.passed(seconds):
            raise TooLate(seconds)
        system = (a[:, near].toarray() / length[rows][:, None] * weight[near]).T
        y[rows] -= np.linalg.lstsq(system, z[near], rcond=1e-9)[0] / length[rows]
    unit = 2.0**-25 * _power(y)
    yield np.rint(y / unit) * unit
    yield y


def _recession_violation(problem: Problem, y: FloatArray) -> str | None:
    c = problem.cones
    bad = ((y > 0.0) & np.isfinite(c.upper)) | ((y < 0.0) & np.isfinite(c.lower))
    bad[c.contact_rows] = False
    if bad.any():
        i = int(np.flatnonzero(bad)[0])
        return f"y[{i}] = {y[i]:.2e} leaves the bounds of {problem.row_name(i)}"
    normal, limit, size = _rims(problem, y)
    if problem.law == "coulomb":
        across = normal[size > 0.0]
        if len(across):
            return (
                f"y is not along the normal of {problem.row_name(int(across[0]))}, as Coulomb friction needs"
            )
    first = c.normal_rows
    out = np.concatenate([first[y[first] < 0.0], normal[size > limit * y[normal] * (1 + 1e-12)]])
    if len(out):
        return f"y leaves the cone of {problem.row_name(int(out.min()))}"
    return None
