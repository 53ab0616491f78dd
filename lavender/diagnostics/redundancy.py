"""Redundant rows of a problem, and the quantities that are unique although A is singular.

If A is singular, impulses are not unique: a table on four legs. The slack w, and with it every body's velocity, is
unique for symmetric positive semidefinite A without Coulomb friction. A = J M^-1 J^T has the rank of J. If J is known,
its rows, scaled to length 1, are made orthogonal to the rows before them. The length of the rest is the new part of a
row's direction. A holds the squares of these parts. An island with a well-conditioned A has no redundant row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import FloatArray, check_float
from lavender.base.errors import CapabilityError
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import factor_sparse_lu
from lavender.problem import Problem, check_problem
from lavender.problem.ordering import group_blocks_by_island
from lavender.solvers.islands import find_islands, get_rows_of_blocks

MIN_NEW_PART = (
    1e-6  # Smallest new part of a direction that differs from rounding of A, or of float32 data.
)
MAX_BASIS_NUMBERS = (
    2**27
)  # Largest number of entries of the orthonormal rows of an island and their coefficients.
CHUNK_ROWS = 64  # Number of rows that one matrix product makes orthogonal to the rows before them.
# An island has full rank if 1 / |A^-1| exceeds this and 1e3 tol^2, with A scaled to 1.
MIN_INVERSE_NORM = 1e-9
INVERSE_STEPS = 2  # Pairs of steps of inverse iteration, with A and its transpose.
# Rows with smaller new parts wait until all rows with larger ones are in the basis, so that rounding is not amplified.
MIN_PARTS = (1e-2, 1e-5, 0.0)
# A row with relative entries of up to this in random null vectors is not moved by them.
NULL_VECTOR_TOL = 1e-9
# A new part below this is made orthogonal to all rows once more, because its rounding is relative to the whole row.
MIN_ACCURATE_PART = 1e-3


@dataclass(frozen=True, eq=False)
class Redundancy:
    """Rank of A and redundant rows; `str()` gives a summary.

    Parameters
    ----------
    problem, rank : Problem, int
    tol : float
        Largest new part of a row's direction [-] that counted as redundant.
    rows : tuple of int
        Redundant rows: each depends on the other rows. Of rows that depend on each other, later ones are preferred.
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
        p = self.problem
        size = np.diff(self.problem.cones.ptr)
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
        `tol` is not between 0 and 1, or an island of dependent rows is too large for memory (about 10,000 velocities).
    """
    check_problem(problem)
    tol = check_float("tol", tol, low=0.0, high=1.0)
    jacobian: Any = None
    if problem.matrix is None and not np.any(problem.compliance):
        jacobian = (
            problem.generalized.jac if problem.generalized else problem.velocity_form().jacobian
        )
    tol = max(tol, MIN_NEW_PART) if jacobian is None or problem.precision == "float32" else tol
    m = problem.m
    unique = np.ones(m, bool)
    dependent = []
    for blocks in group_blocks_by_island(*find_islands(problem)):
        island = get_rows_of_blocks(problem, blocks)
        part = sp.csr_array((problem.csr[:, island] if jacobian is None else jacobian)[island])
        if not part.nnz:
            dependent += island.tolist()
            unique[island] = False
            continue
        scaled = _scale_rows(part[:, np.unique(part.indices)], jacobian is None)
        if _has_full_rank(scaled, jacobian is None, tol):
            continue
        is_new, is_moved = _decompose_rows(scaled, tol if jacobian is not None else tol**2)
        dependent += island[~is_new].tolist()
        if not is_new.all():
            unique[island] = problem.is_symmetric & ~is_moved
    rows = tuple(sorted(dependent))
    return Redundancy(problem, m - len(rows), tol, rows=rows, impulse_is_unique=unique)


def _scale_rows(rows: sp.csr_array, is_delassus: bool) -> sp.csr_array:
    """Scale rows to length 1; first scale rows and columns of A to largest entries near 1."""

    def divide(x: FloatArray) -> sp.dia_array:
        return sp.diags_array(1.0 / np.where(x > 0.0, x, 1.0))

    for axis in (0, 1, 0, 1, 0, 1, 0, 1) if is_delassus else (1,):
        largest = abs(rows).max(axis=axis).toarray().ravel() ** (0.5 if is_delassus else 1.0)
        rows = divide(largest) @ rows if axis else rows @ divide(largest)
    return sp.csr_array(divide(np.sqrt((rows * rows).sum(axis=1))) @ rows)


def _has_full_rank(rows: sp.csr_array, is_delassus: bool, tol: float) -> bool:
    """Return whether a sparse factorisation proves that no row depends on others; False if it does not.

    Inverse iteration from random vectors estimates |A^-1|. SciPy's `onenormest` is not used: its start is of +1 and -1
    from NumPy's global generator, and it misses a null vector that is orthogonal to it.
    """
    m = rows.shape[0]
    if not 0 < m <= rows.shape[1]:
        return False
    matrix = rows if is_delassus else rows @ rows.T
    try:
        factor = factor_sparse_lu(sp.csc_array(matrix))
    except RuntimeError:  # A pivot is 0.
        return False
    x = np.random.default_rng(0).normal(size=(m, 2))
    size = np.zeros(2)
    with np.errstate(all="ignore"):
        for trans in ("N", "T") * INVERSE_STEPS:
            x = factor.solve(x / np.linalg.norm(x, axis=0), trans)
            size = np.linalg.norm(x, axis=0)
    return bool(max(MIN_INVERSE_NORM, 1e3 * tol**2) * size.max() < 1.0)


def _decompose_rows(
    rows: sp.csr_array, tol: float
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Return whether each of m rows of length 1 is in a largest independent set, and whether a null vector moves it.

    Gram-Schmidt is applied twice to chunks of rows. Earlier rows are preferred among those with similar new parts. The
    null vectors, y rows = 0, are two random combinations of all.
    """
    from scipy.linalg import solve_triangular

    m, n = rows.shape
    size = min(m, n)
    r = 0
    if size * (n + size) > MAX_BASIS_NUMBERS:
        raise CapabilityError(
            f"{m} rows over {n} velocities are coupled; their rank takes too much memory"
        )
    tol = max(tol, m * 2.0**-53)  # Rounding leaves about m 2^-53.
    basis, lower = np.zeros((size, n)), np.zeros((size, size))  # independent rows = lower basis
    y = np.random.default_rng(0).normal(size=(2, m))
    dependent_sum = np.zeros((2, size))
    is_new = np.zeros(m, bool)
    pending = np.arange(m)
    for min_part in MIN_PARTS:
        deferred: list[int] = []
        for at in np.split(pending, range(CHUNK_ROWS, len(pending), CHUNK_ROWS)):
            chunk = rows[at].toarray()
            start = r
            coefficients = np.zeros((len(at), size))
            for _ in range(2):
                step = chunk @ basis[:start].T
                chunk -= step @ basis[:start]
                coefficients[:, :start] += step
            for i, x, c in zip(at.tolist(), chunk, coefficients, strict=True):
                for begin in (start, start, 0):
                    if begin == start or tol < np.linalg.norm(x) < MIN_ACCURATE_PART:
                        step = basis[begin:r] @ x
                        x -= step @ basis[begin:r]
                        c[begin:r] += step
                length = float(np.linalg.norm(x))
                is_new[i] = length > max(tol, min_part) and r < size
                if is_new[i]:
                    basis[r], c[r], lower[r] = x / length, length, c
                    r += 1
                elif length <= tol or r == size:
                    dependent_sum += np.outer(y[:, i], c)
                else:
                    deferred.append(i)
        pending = np.array(deferred, int)
    if r:
        y[:, is_new] = -solve_triangular(
            lower[:r, :r], dependent_sum[:, :r].T, lower=True, trans=1
        ).T
    largest = np.abs(y).max(axis=0)
    return is_new, largest > NULL_VECTOR_TOL * largest.max(initial=0.0)
