"""Redundant rows of a problem, and the quantities that are unique although A is singular.

If A is singular, impulses are not unique: a table on four legs. The slack w, and with it every body's velocity, is
unique for symmetric positive semidefinite A without Coulomb friction. A = J M^-1 J^T has the rank of J. If J is known,
its rows, scaled to length 1, are decomposed by QR with column pivoting. A diagonal entry of R is the part of a row's
direction that is new next to the rows before it. A holds the squares of these parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import FloatArray, check_float
from lavender.base.errors import CapabilityError
from lavender.problem import Problem, check_problem
from lavender.problem.ordering import group_blocks_by_island
from lavender.solvers.islands import find_islands, get_rows_of_blocks

MIN_NEW_PART = 1e-6  # Smallest new part of a direction that differs from rounding of A, or of float32 data.
MAX_ISLAND_ROWS = 3_000  # A dense QR factorisation of this many rows takes about 20 s.
NULL_VECTOR_TOL = 1e-9  # A row with entries of up to this in all unit null vectors is not moved by them.


@dataclass(frozen=True, eq=False)
class Redundancy:
    """Rank of A and redundant rows; `str()` gives a summary.

    Parameters
    ----------
    problem, rank : Problem, int
    tol : float
        Largest new part of a row's direction [-] that counted as redundant.
    rows : tuple of int
        Redundant rows: each depends on rows before it.
    impulse_is_unique : (m,) bool
        Whether all solutions have the same impulse on a row.
    """

    problem: Problem
    rank: int
    tol: float
    rows: tuple[int, ...]
    impulse_is_unique: npt.NDArray[np.bool_]

    @property
    def row_names(self) -> tuple[str, ...]:
        """Names of the redundant rows."""
        return tuple(map(self.problem.row_name, self.rows))

    @property
    def block_names(self) -> tuple[str, ...]:
        """Names of the blocks (joints, contacts) with only redundant rows: removing them changes no motion."""
        p, size = self.problem, np.diff(self.problem.cones.ptr)
        count = np.bincount([p.block_of(i) for i in self.rows], minlength=p.n_blocks)
        return tuple(p.block_name(int(i)) for i in np.flatnonzero((count > 0) & (count == size)))

    @property
    def unique(self) -> tuple[str, ...]:
        """Quantities that all solutions share; compare only these."""
        if not self.problem.is_semidefinite or self.problem.law == "coulomb":
            return ()
        return ("slack", "body velocities", "objective", *["impulse"] * (not self.rows))

    def __str__(self) -> str:
        rows, blocks = (x[:8] + ("...",) * (len(x) > 8) for x in (self.row_names, self.block_names))
        text = f"rank {self.rank} of {self.problem.m}; redundant: {', '.join(rows) or 'no row'}\n"
        text += f"all rows of: {', '.join(blocks)}\n" if blocks else ""
        return f"{text}unique: {', '.join(self.unique) or 'no quantity is certain'}"


def redundancy(problem: Problem, *, tol: float = 1e-12) -> Redundancy:
    """Compute the rank of A, find the redundant rows, and list the quantities that are unique.

    Islands (sets of rows that share bodies, directly or through others) are decomposed separately.

    Parameters
    ----------
    tol : float, default 1e-12
        A row is redundant if the new part of its direction does not exceed this. It is at least 1e-6 if only A is
        known, if the problem has compliance, or if its data were float32.

    Returns
    -------
    Redundancy

    Raises
    ------
    InputError, CapabilityError
        `tol` is not between 0 and 1, or an island has more than 3,000 rows.
    """
    check_problem(problem)
    tol = check_float("tol", tol, low=0.0, high=1.0)
    jacobian: Any = None
    if problem.matrix is None and not np.any(problem.compliance):
        jacobian = problem.generalized.jac if problem.generalized else problem.velocity_form().jacobian
    tol = max(tol, MIN_NEW_PART) if jacobian is None or problem.precision == "float32" else tol
    m = problem.m
    unique, dependent = np.ones(m, bool), []
    for blocks in group_blocks_by_island(*find_islands(problem)):
        island = get_rows_of_blocks(problem, blocks)
        if len(island) > MAX_ISLAND_ROWS:
            raise CapabilityError(f"{len(island)} rows are coupled; at most {MAX_ISLAND_ROWS} are possible")
        part = (problem.csr[:, island] if jacobian is None else jacobian)[island]
        scaled = _scale_rows(part[:, np.unique(part.indices)].toarray(), jacobian is None)
        null = _find_null_vectors(scaled, tol if jacobian is not None else tol**2)
        dependent += island[_find_last_rows(null)].tolist()
        if len(null):
            largest = np.abs(np.linalg.qr(null.T)[0]).max(axis=1)
            unique[island] = problem.is_symmetric and largest <= NULL_VECTOR_TOL
    rows = tuple(sorted(dependent))
    return Redundancy(problem, m - len(rows), tol, rows=rows, impulse_is_unique=unique)


def _scale_rows(rows: FloatArray, is_delassus: bool) -> FloatArray:
    """Scale rows to length 1; first scale rows and columns of A to largest entries near 1."""
    for axis in (0, 1, 0, 1, 0, 1, 0, 1) if is_delassus else (1,):
        largest = np.abs(rows).max(axis=axis, keepdims=True, initial=0.0) ** (0.5 if is_delassus else 1.0)
        rows = rows / np.where(largest > 0.0, largest, 1.0)
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows / np.where(length > 0.0, length, 1.0)


def _find_null_vectors(rows: FloatArray, tol: float) -> FloatArray:
    """Return independent y (k, m) with y rows = 0."""
    from scipy.linalg import qr, solve_triangular

    if not rows.size:
        return np.eye(len(rows))
    m = len(rows)
    r, order = qr(rows.T, mode="r", pivoting=True)
    size = np.abs(np.diagonal(r))
    rank = int(np.count_nonzero(size > max(tol, m * 2.0**-53) * size[0]))  # Rounding leaves about m 2^-53.
    null = np.zeros((m - rank, m))
    null[:, order[rank:]] = np.eye(m - rank)
    null[:, order[:rank]] = -solve_triangular(r[:rank, :rank], r[:rank, rank:]).T
    return null


def _find_last_rows(null: FloatArray) -> list[int]:
    """Return a row for each null vector (k, m), by elimination from the last row: each depends on rows before it."""
    null, last = null.copy(), []
    for i in range(null.shape[1] - 1, -1, -1):
        k = int(np.argmax(np.abs(null[:, i]))) if len(null) else -1
        if k >= 0 and abs(null[k, i]) > NULL_VECTOR_TOL * np.abs(null[k]).max():
            last.append(i)
            pivot, null = null[k] / null[k, i], np.delete(null, k, axis=0)
            null -= np.outer(null[:, i], pivot)
    return last
