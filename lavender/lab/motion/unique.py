"""Criteria that prove that the motion of a problem is unique. If none holds, there may be one motion or several.

Islands (sets of blocks that moving bodies connect) are examined separately. The motion of an island is unique if one
of these holds:

    the law is convex    A symmetric positive semidefinite, no friction in it or the law `cone`:
                         w and the velocities are those of a convex program
    normals feel no      A_tn = 0 between its friction rows and all others, A positive definite on the
    friction             others: these are a separate boxed LCP with a unique lambda_n, which determines every
                         disk, and the remaining problem is convex. Example: one contact on a body, its normal through
                         the centre
    friction is small    kappa < 1, below: a contraction has one fixed point
    nothing slides       a solution has w = 0 on all rows, and its friction is so far from the bounds that no other
                         solution exists, (3)

De Saxce's change of variable makes a Coulomb solution the solution of a convex cone problem in which the normal
targets are raised by s_i = mu_i (|u_t| + r |u_s|), s being a fixed point of s -> lambda(s) -> s (Acary, Cadoux,
Lemarechal, Malick 2011, ZAMM 91, 155-175). For two values of s, with Z the block of A^-1 on the normals, S = diag(mu)
on the friction rows (mu r on torsional rows, mu_r on rolling rows), and any positive diagonal T (one entry a contact),

    |D lambda|_A^2 <= - D s . D lambda_n <= |D s|_Z |D lambda|_A          the cone is convex, A positive definite
    |T D s|^2 <= c |T S (A D lambda)_t|^2 <= c max eig(T S A_tt S T) |D lambda|_A^2   c friction components of a
    contact

    kappa^2 = c max eig(T S A_tt S T) max eig(T^-1 Z T^-1)                                               (1)

If a solution lambda has w = 0, the zero impulse is within the bounds of all rows, and contact i uses the fraction
sigma_i < 1 of its friction, let D be the difference of any other solution from it and s that solution's. Row by row,

    |D lambda|_A^2 = w' . D lambda <= sum s_i (sigma_i lambda_n,i - lambda'_n,i)
                  <= |s|_Z |D lambda|_A - sum (1 - sigma_i) s_i lambda_n,i <= |s|_Z (|D lambda|_A - h)    (2)
    h = min_i (1 - sigma_i) lambda_n,i / sqrt(Z_ii)           |s|_Z <= sum s_i sqrt(Z_ii), since s >= 0

so D lambda = 0 or h < |D lambda|_A <= kappa (|D lambda|_A - h). Since w'.lambda' <= 0, lambda' lies in the ball
|lambda' - lambda / 2|_A <= |lambda|_A / 2, and so |D lambda|_A <= |lambda|_A. There is no other solution if

    |lambda|_A <= h    or    (kappa - 1) |lambda|_A < kappa h                                            (3)

(2) and (3) are results of this project. Slacks w up to ZERO_SLACK_FRACTION of the largest |b| count as 0.

Haslinger 1983 (Math. Meth. Appl. Sci. 5, 422-437) shows that friction that is small against the coupling leaves one
solution; Klarbring 1990 (Ing.-Archiv 60, 529-541) shows that larger friction need not, even for one contact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.lab.motion.reference import get_motion_cache, get_reference
from lavender.problem import Problem
from lavender.problem.cones import Cones
from lavender.problem.ordering import group_rows_by_island

MAX_DENSE_PROOF_ROWS = 600  # (1) is tested on islands of up to this many rows, as dense matrices.
UNCOUPLED_TOL = 1e-14  # A_tn counts as zero up to this fraction of sqrt(d_t d_n).
CRITERION_MARGIN = 1e-6  # Margin of (1) and (3) for the rounding of eigenvalues.
ZERO_SLACK_FRACTION = 1e-10  # w counts as zero up to this fraction of the largest |b| of an island.
# A is positive definite if the smallest eigenvalue of D^-1/2 A D^-1/2 is above this.
MIN_DEFINITE_EIGENVALUE = 1e-10


@dataclass(frozen=True)
class Uniqueness:
    """Result of `prove_uniqueness`: whether the motion of a problem is proved to be unique.

    Parameters
    ----------
    proved : bool
    reason : str
        The criterion that proves it, or the first contact for which no criterion holds.
    kappa : float
        Largest contraction number (1) that was needed; 0 if none was needed, inf if none was computed.
    """

    proved: bool
    reason: str
    kappa: float

    def __bool__(self) -> bool:
        return self.proved

    def __str__(self) -> str:
        return f"unique: {self.reason}" if self.proved else f"not proved to be unique: {self.reason}"


def prove_uniqueness(problem: Problem) -> Uniqueness:
    """Prove that a problem has only one motion; the result names the criterion, or a contact for which none holds.

    If friction is not small, `auto` solves the problem once to test the last criterion. Uniqueness is not proved for
    islands with friction of more than 600 rows.
    """
    refusal = get_motion_cache(problem).refusal
    if refusal:
        return Uniqueness(False, refusal, np.inf)
    if problem.law != "coulomb":
        return Uniqueness(True, "the law is convex", 0.0)
    c = problem.cones
    friction = c.friction_coefficient > 0.0
    if not friction.any():
        return Uniqueness(True, "no contact has friction", 0.0)
    reasons, kappa = [], 0.0
    for island in group_rows_by_island(problem, c.ptr):
        if not friction[island].any():
            continue
        reason, k = _prove_island(problem, island, friction[island])
        if reason is None:
            first = problem.row_name(int(island[np.argmax(friction[island])])).rsplit(", ", 1)[0]
            kappa_note = f" (kappa {k:.2g})" if np.isfinite(k) else ""
            return Uniqueness(False, f"no criterion holds at {first}{kappa_note}", k)
        if reason not in reasons:
            reasons.append(reason)
        kappa = max(kappa, k)
    return Uniqueness(True, " and ".join(reasons) + (f" (kappa {kappa:.2g})" if kappa > 0.0 else ""), kappa)


def _prove_island(problem: Problem, rows: np.ndarray, friction: np.ndarray) -> tuple[str | None, float]:
    """Return (criterion, kappa) of one island that has friction; the criterion is None if none holds."""
    if len(rows) > MAX_DENSE_PROOF_ROWS:
        return None, np.inf
    scale = 1.0 / np.sqrt(problem.csr_data.d[rows])
    a = problem.csr[rows][:, rows].toarray() * scale[:, None] * scale
    a = 0.5 * (a + a.T)
    if not np.isfinite(a).all() or not scale.all():
        return None, np.inf
    others = a[np.ix_(~friction, ~friction)]
    if np.all(np.abs(a[np.ix_(friction, ~friction)]) <= UNCOUPLED_TOL) and _is_definite(others):
        return "normals feel no friction", 0.0
    if not _is_definite(a):
        return None, np.inf
    try:
        with np.errstate(all="ignore"):
            kappa, inverse_diagonal = _compute_contraction_number(problem, rows, friction, a, scale)
    except np.linalg.LinAlgError:  # Products of the numbers overflow.
        return None, np.inf
    if kappa < 1.0 - CRITERION_MARGIN:
        return "friction is small", kappa
    return (
        "nothing slides" if _proves_no_contact_slides(problem, rows, kappa, inverse_diagonal) else None
    ), kappa


def _proves_no_contact_slides(
    problem: Problem, rows: np.ndarray, kappa: float, inverse_diagonal: FloatArray
) -> bool:
    """Whether (3) holds for the reference; `inverse_diagonal` (k,) [kg] is Z_ii of the contacts with friction."""
    solution = get_reference(problem)
    c, x = problem.cones, solution.impulse
    w = problem.slack(x)[rows]
    at_rest = ZERO_SLACK_FRACTION * float(np.max(np.abs(problem.b[rows]), initial=0.0))
    if not solution.is_accepted or np.max(np.abs(w), initial=0.0) > at_rest:
        return False
    block = np.unique(np.searchsorted(c.ptr, rows, side="right") - 1)
    bounded = rows[~c.is_contact[np.searchsorted(c.ptr, rows, side="right") - 1]]
    if np.any(c.lower[bounded] > 0.0) or np.any(c.upper[bounded] < 0.0):
        return False
    components, unused_friction = _group_friction_rows_by_contact(c), []
    for i in block.tolist():
        if i not in components:
            continue
        friction_used = max(
            float(np.linalg.norm(x[rows_of_component])) / c.friction_coefficient[rows_of_component[0]]
            for rows_of_component in components[i]
        )
        unused_friction.append(x[c.ptr[i]] - friction_used)  # This is (1 - sigma) lambda_n.
    h = float(np.min(np.array(unused_friction) / np.sqrt(inverse_diagonal)))
    size = float(np.sqrt(max(x[rows] @ (w + problem.b[rows]), 0.0)))  # This is |lambda|_A of the island.
    return h > 0.0 and (
        size <= h * (1.0 - CRITERION_MARGIN) or (kappa - 1.0) * size < kappa * h * (1.0 - CRITERION_MARGIN)
    )


def _compute_contraction_number(
    problem: Problem, rows: np.ndarray, friction: np.ndarray, a: FloatArray, scale: FloatArray
) -> tuple[float, FloatArray]:
    """Compute kappa of (1), and Z_ii (k,) [kg] of the contacts that have friction."""
    # In scaled rows: (A_tt)_ij = a_ij / (scale_i scale_j), Z_ij = (a^-1)_ij scale_i scale_j.
    c = problem.cones
    block = np.searchsorted(c.ptr, rows, side="right") - 1
    tangents = np.flatnonzero(friction)
    contacts, contact_index = np.unique(block[tangents], return_inverse=True)
    normals = np.searchsorted(rows, c.ptr[contacts])
    size = c.friction_coefficient[rows[tangents]] / scale[tangents]
    sliding = a[np.ix_(tangents, tangents)] * size[:, None] * size
    inverse_on_normals = np.linalg.inv(a)[np.ix_(normals, normals)] * scale[normals][:, None] * scale[normals]
    components = _group_friction_rows_by_contact(c)
    n_components = float(max(len(components[i]) for i in contacts.tolist()))
    max_sliding = np.zeros(len(contacts))
    np.maximum.at(max_sliding, contact_index, np.diagonal(sliding))
    best = np.inf
    for t in (np.sqrt(np.diagonal(inverse_on_normals)), 1.0 / np.sqrt(max_sliding)):
        sliding_eigenvalue = np.linalg.eigvalsh(sliding * t[contact_index][:, None] * t[contact_index])[-1]
        inverse_eigenvalue = np.linalg.eigvalsh(inverse_on_normals / t[:, None] / t)[-1]
        best = min(
            best, float(np.sqrt(n_components * max(sliding_eigenvalue, 0.0) * max(inverse_eigenvalue, 0.0)))
        )
    return best, np.diagonal(inverse_on_normals)


def _group_friction_rows_by_contact(c: Cones) -> dict[int, list[IntArray]]:
    """Return the friction components of each contact that have a non-zero bound."""
    components: dict[int, list[IntArray]] = {}
    reach = c.friction_coefficient
    for i, rows_of_component in c.friction_components():
        if reach[rows_of_component[0]] > 0.0:
            components.setdefault(i, []).append(rows_of_component)
    return components


def _is_definite(a: FloatArray) -> bool:
    """Whether a matrix of unit diagonal is positive definite with a margin."""
    try:
        np.linalg.cholesky(a - MIN_DEFINITE_EIGENVALUE * np.eye(len(a)))
    except np.linalg.LinAlgError:
        return False
    return True
