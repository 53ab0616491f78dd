"""Where one motion alone solves a problem, by a proof: none of these says that there are several.

Islands (blocks that no body, directly or through others, connects) are looked at apart. One is unique where

    the law is convex    A symmetric positive semidefinite, no friction in it or the law `cone`:
                         w and the velocities are those of a convex program
    normals feel no      A_tn = 0 between its friction rows and all others, A positive definite on the
    friction             others: these are a boxed LCP of their own, whose lambda_n is unique; it fixes every
                         disk, and what is left is convex. One contact on a body, its normal through the centre
    friction is small    kappa < 1, below: a contraction has one fixed point
    nothing slides       a solution has w = 0 on all rows and so much of friction left over that no other can be, (3)

De Saxce's change of variable makes a Coulomb solution the solution of a convex cone problem whose normal targets
are raised by s_i = mu_i (|u_t| + r |u_s|), s being a fixed point of s -> lambda(s) -> s (Acary, Cadoux, Lemarechal,
Malick 2011, ZAMM 91, 155-175). For two values of s, with Z the block of A^-1 on the normals, S = diag(mu) on the
friction rows (mu r on spin, mu_r on what rolls), and any positive diagonal T (one entry a contact),

    |D lambda|_A^2 <= - D s . D lambda_n <= |D s|_Z |D lambda|_A          the cone is convex, A positive definite
    |T D s|^2 <= c |T S (A D lambda)_t|^2 <= c max eig(T S A_tt S T) |D lambda|_A^2   c parts of a contact

    kappa^2 = c max eig(T S A_tt S T) max eig(T^-1 Z T^-1)                                               (1)

Where a solution lambda has w = 0, doing nothing lies within the bounds of all rows, and contact i uses the share
sigma_i < 1 of its friction, let D be the difference of any other solution from it and s that solution's. Row by row,

    |D lambda|_A^2 = w' . D lambda <= sum s_i (sigma_i lambda_n,i - lambda'_n,i)
                  <= |s|_Z |D lambda|_A - sum (1 - sigma_i) s_i lambda_n,i <= |s|_Z (|D lambda|_A - h)    (2)
    h = min_i (1 - sigma_i) lambda_n,i / sqrt(Z_ii)           |s|_Z <= sum s_i sqrt(Z_ii), since s >= 0

so D lambda = 0 or h < |D lambda|_A <= kappa (|D lambda|_A - h). Since w'.lambda' <= 0, lambda' lies in the ball
|lambda' - lambda / 2|_A <= |lambda|_A / 2, and so |D lambda|_A <= |lambda|_A. There is no other solution where

    |lambda|_A <= h    or    (kappa - 1) |lambda|_A < kappa h                                            (3)

(2) and (3) are of this project; w counts as 0 up to rounding of a solution at the floor.

That friction which is small against the coupling leaves one solution is known since Haslinger 1983 (Math. Meth.
Appl. Sci. 5, 422-437); that it need not otherwise, also for one contact, since Klarbring 1990 (Ing.-Archiv 60,
529-541).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.lab.motion.reference import kept, reference
from lavender.problem import Problem
from lavender.problem.cones import Cones
from lavender.problem.ordering import rows_by_island

LARGEST = 600  # rows of an island up to which (1) is looked for, dense
UNCOUPLED = 1e-14  # of sqrt(d_t d_n): A_tn that is nothing but rounding
MARGIN = 1e-6  # of (1) and (3), for rounding of eigenvalues
AT_REST = 1e-10  # of the largest |b| of an island: w that is nothing but rounding
DEFINITE = 1e-10  # smallest eigenvalue of D^-1/2 A D^-1/2 that counts as positive definite


@dataclass(frozen=True)
class Uniqueness:
    """Whether one motion alone is proved to solve a problem."""

    proved: bool
    reason: str  # the criterion that proves it, or where none does
    kappa: float  # -, the largest contraction number (1) that was needed; 0 where none was, inf where none was found

    def __bool__(self) -> bool:
        return self.proved

    def __str__(self) -> str:
        return f"unique: {self.reason}" if self.proved else f"not proved to be unique: {self.reason}"


def uniqueness(problem: Problem) -> Uniqueness:
    """Whether the motion that solves a problem is proved to be the only one, by which criterion, or where none holds.

    A problem with friction that is not small is solved by `auto`, once, for the last criterion. Islands of more than
    600 rows with friction are not looked at.
    """
    refusal = kept(problem).refusal
    if refusal:
        return Uniqueness(False, refusal, np.inf)
    if problem.law != "coulomb":
        return Uniqueness(True, "the law is convex", 0.0)
    c = problem.cones
    friction = c.reach > 0.0
    if not friction.any():
        return Uniqueness(True, "no contact has friction", 0.0)
    reasons, kappa = [], 0.0
    for island in rows_by_island(problem, c.ptr):
        if not friction[island].any():
            continue
        reason, k = _island(problem, island, friction[island])
        if reason is None:
            first = problem.row_name(int(island[np.argmax(friction[island])])).rsplit(", ", 1)[0]
            told = f" (kappa {k:.2g})" if np.isfinite(k) else ""
            return Uniqueness(False, f"no criterion holds at {first}{told}", k)
        if reason not in reasons:
            reasons.append(reason)
        kappa = max(kappa, k)
    return Uniqueness(True, " and ".join(reasons) + (f" (kappa {kappa:.2g})" if kappa > 0.0 else ""), kappa)


def _island(problem: Problem, rows: np.ndarray, friction: np.ndarray) -> tuple[str | None, float]:
    """(criterion, kappa) of one island that has friction; None where none holds."""
    if len(rows) > LARGEST:
        return None, np.inf
    scale = 1.0 / np.sqrt(problem.csr_data.d[rows])
    a = problem.csr[rows][:, rows].toarray() * scale[:, None] * scale
    a = 0.5 * (a + a.T)
    if not np.isfinite(a).all() or not scale.all():
        return None, np.inf
    others = a[np.ix_(~friction, ~friction)]
    if np.all(np.abs(a[np.ix_(friction, ~friction)]) <= UNCOUPLED) and _definite(others):
        return "normals feel no friction", 0.0
    if not _definite(a):
        return None, np.inf
    try:
        with np.errstate(all="ignore"):
            kappa, lifting = _kappa(problem, rows, friction, a, scale)
    except np.linalg.LinAlgError:  # of numbers whose products overflow
        return None, np.inf
    if kappa < 1.0 - MARGIN:
        return "friction is small", kappa
    return ("nothing slides" if _sticks(problem, rows, kappa, lifting) else None), kappa


def _sticks(problem: Problem, rows: np.ndarray, kappa: float, lifting: FloatArray) -> bool:
    """Whether (3) holds of the reference; `lifting` (k,) [kg] is Z_ii of the contacts with friction."""
    found = reference(problem)
    c, x = problem.cones, found.impulse
    w = problem.slack(x)[rows]
    at_rest = AT_REST * float(np.max(np.abs(problem.b[rows]), initial=0.0))
    if not found.accepted or np.max(np.abs(w), initial=0.0) > at_rest:
        return False
    block = np.unique(np.searchsorted(c.ptr, rows, side="right") - 1)
    bounded = rows[~c.is_contact[np.searchsorted(c.ptr, rows, side="right") - 1]]
    if np.any(c.lower[bounded] > 0.0) or np.any(c.upper[bounded] < 0.0):
        return False
    rubbing, left = _rubbing(c), []
    for i in block.tolist():
        if i not in rubbing:
            continue
        used = max(float(np.linalg.norm(x[part])) / c.reach[part[0]] for part in rubbing[i])
        left.append(x[c.ptr[i]] - used)  # (1 - sigma) lambda_n
    h = float(np.min(np.array(left) / np.sqrt(lifting)))
    size = float(np.sqrt(max(x[rows] @ (w + problem.b[rows]), 0.0)))  # |lambda|_A of the island
    return h > 0.0 and (size <= h * (1.0 - MARGIN) or (kappa - 1.0) * size < kappa * h * (1.0 - MARGIN))


def _kappa(
    problem: Problem, rows: np.ndarray, friction: np.ndarray, a: FloatArray, scale: FloatArray
) -> tuple[float, FloatArray]:
    """Kappa of (1), and Z_ii (k,) [kg] of the contacts that have friction."""
    # In the scaled rows: (A_tt)_ij = a_ij / (scale_i scale_j), Z_ij = (a^-1)_ij scale_i scale_j.
    c = problem.cones
    block = np.searchsorted(c.ptr, rows, side="right") - 1
    tangents = np.flatnonzero(friction)
    contacts, place = np.unique(block[tangents], return_inverse=True)
    normals = np.searchsorted(rows, c.ptr[contacts])
    size = c.reach[rows[tangents]] / scale[tangents]
    sliding = a[np.ix_(tangents, tangents)] * size[:, None] * size
    lifting = np.linalg.inv(a)[np.ix_(normals, normals)] * scale[normals][:, None] * scale[normals]
    rubbing = _rubbing(c)
    parts = float(max(len(rubbing[i]) for i in contacts.tolist()))
    strongest = np.zeros(len(contacts))
    np.maximum.at(strongest, place, np.diagonal(sliding))
    best = np.inf
    for t in (np.sqrt(np.diagonal(lifting)), 1.0 / np.sqrt(strongest)):
        one = np.linalg.eigvalsh(sliding * t[place][:, None] * t[place])[-1]
        two = np.linalg.eigvalsh(lifting / t[:, None] / t)[-1]
        best = min(best, float(np.sqrt(parts * max(one, 0.0) * max(two, 0.0))))
    return best, np.diagonal(lifting)


def _rubbing(c: Cones) -> dict[int, list[IntArray]]:
    """The parts of each contact whose bound is not 0."""
    found: dict[int, list[IntArray]] = {}
    reach = c.reach
    for i, part in c.parts():
        if reach[part[0]] > 0.0:
            found.setdefault(i, []).append(part)
    return found


def _definite(a: FloatArray) -> bool:
    try:
        np.linalg.cholesky(a - DEFINITE * np.eye(len(a)))
    except np.linalg.LinAlgError:
        return False
    return True
