"""Redundant rows of a problem, and the quantities that are unique although A is singular.

If A is singular, impulses are not unique: a table on four legs. The slack w, and with it every body's velocity, is
unique for symmetric positive semidefinite A without Coulomb friction. A row i is redundant if its pivot after
elimination of the rows before it,

    p_i = A_ii - A_iB A_BB^-1 A_Bi   (B: rows before i that are not redundant)   [1/kg]

does not exceed `tol`^2 A_ii. The new fraction of the row's direction, sqrt(p_i / A_ii), is the length of its component
outside the span of the rows B, in the metric of the masses. If J is known, the fraction is computed from J, and a
direction that is new in J alone counts, too: next to a body that is 1e25 times heavier, the metric of the masses hides
it. If only A is known, its rounding hides fractions below MIN_NEW_FRACTION_OF_A.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import FloatArray, check_float
from lavender.base.errors import CapabilityError, InputError
from lavender.base.lazy_import import lapack
from lavender.base.lazy_import import sparse as sp
from lavender.problem import Problem, check_problem
from lavender.problem.derived import cached_property
from lavender.problem.operators import analyse_matrix_for_factorisation, has_shifted_cholesky
from lavender.problem.ordering import group_rows_by_island
from lavender_ext.pivot.direct import Pivoting

# Smallest new fraction of a row's direction that differs from rounding of A. A holds squares of fractions, and
# rounding of its products and of their elimination leaves about 1e-14 of the diagonal, rarely 1e-13.
MIN_NEW_FRACTION_OF_A = 1e-6
# Smallest new fraction that differs from rounding of float32 data: equal rows differ by about ten roundings of 2^-24.
MIN_NEW_FRACTION_FLOAT32 = 1e-6
MAX_DENSE_ISLAND_ROWS = 1200  # Islands of up to this many rows are decomposed as dense matrices.
# In larger islands, pivots up to this fraction of d times the number of rows count as zero.
PIVOT_TOL_PER_ROW = 1e-12
# In larger islands, rows with pivots up to this fraction of d are left out of the sparse factor and tested afterwards.
# A smaller fraction spoils later pivots by rounding; a larger fraction leaves more rows out. The next entry is used if
# more than MAX_DENSE_ISLAND_ROWS of the rows left out may be new. Of 851 matrices, 1e-2 gives the right rank for all,
# 1e-3 for 843, and a factor of all rows for 822.
LEFT_OUT_PIVOTS = (1e-2, 1e-4, 1e-6)
N_PROBE_VECTORS = 3  # Products with this many random vectors show which of the rows left out are new.
# If A_ii is at most this fraction of the largest entry of its row, d is that entry, and A_ii may still be exact.
MAX_HIDDEN_DIAGONAL = 1e-10
# If A_ii does not exceed this fraction of a d that two rows share, the units of the two rows differ.
MAX_SHARED_SCALE_FRACTION = 1e-3
SEMIDEFINITE_SLACK = 1e-8  # A counts as semidefinite in a row if |A_ij| / sqrt(A_ii A_jj) <= 1 + this.
NULL_VECTOR_TOL = 1e-9  # A row with entries of up to this in all unit null vectors is not moved by them.


IndexArray = npt.NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Redundancy:
    """Result of `redundancy`; `str()` gives a summary of a few lines.

    Parameters
    ----------
    problem : Problem
    rank : int
        Rank of A.
    tol : float
        Largest threshold that was used [-]. A row is redundant if the new fraction of its direction is at most this.
    method : str
        Description of the decompositions.
    rows : tuple of int
        Redundant rows: each depends on the rows that are not redundant.
    impulse_is_unique : (m,) bool
        Whether all solutions have the same impulse on a row.
    """

    problem: Problem
    rank: int
    tol: float
    method: str
    rows: tuple[int, ...]
    impulse_is_unique: npt.NDArray[np.bool_]

    @property
    def row_names(self) -> tuple[str, ...]:
        """Names of the redundant rows."""
        return tuple(self.problem.row_name(i) for i in self.rows)

    @cached_property
    def blocks(self) -> tuple[int, ...]:
        """Blocks (joints, contacts) with only redundant rows: removing them changes no motion."""
        ptr = self.problem.cones.ptr
        count = np.bincount([self.problem.block_of(i) for i in self.rows], minlength=self.problem.n_blocks)
        return tuple(int(i) for i in np.flatnonzero((count > 0) & (count == np.diff(ptr))))

    @property
    def block_names(self) -> tuple[str, ...]:
        """Names of the blocks with only redundant rows."""
        return tuple(map(self.problem.block_name, self.blocks))

    @property
    def slack_is_unique(self) -> bool:
        """Whether slack and body velocities are the same in every solution."""
        return self.problem.is_semidefinite and self.problem.law != "coulomb"

    @property
    def unique(self) -> tuple[str, ...]:
        """Quantities that all solutions share, for a positive semidefinite A; compare only these."""
        if not self.slack_is_unique:
            return ()
        impulse = ("impulse",) if self.rank == self.problem.m else ()
        return ("slack", "body velocities", "objective", *impulse)

    def __str__(self) -> str:
        m = self.problem.m
        if self.rank == m:
            return f"rank {m} of {m} ({self.method}): no row is redundant"
        names = ", ".join(self.row_names[:8]) + (", ..." if len(self.rows) > 8 else "")
        lines = [f"rank {self.rank} of {m} ({self.method}); redundant: {names}"]
        if self.blocks:
            more = ", ..." if len(self.blocks) > 8 else ""
            lines.append(f"all rows of: {', '.join(self.block_names[:8])}{more}")
        lines.append(f"unique: {', '.join(self.unique) or 'no quantity is certain'}")
        return "\n".join(lines)


def redundancy(problem: Problem, *, tol: float = 1e-12) -> Redundancy:
    """Compute the rank of A, find the redundant rows, and list the quantities that are unique.

    Islands (sets of rows that share bodies, directly or through others) are decomposed separately:

    - up to 1,200 rows, J known and no compliance: QR of J M^-1/2 and of J with column pivoting;
    - up to 1,200 rows, otherwise: Cholesky factorisation of A with pivoting. Its pivots are squares of fractions, so
      `tol` is at least 1e-6. QR replaces it for asymmetric or indefinite A;
    - more rows: a sparse Cholesky factor, in which pivots up to 1e-12 d times the number of rows n count as zero, so
      `tol` is at least 1e-6 sqrt(n).

    If the problem's data were float32, `tol` is at least 1e-6. `Redundancy.tol` and `Redundancy.method` hold the value
    and the decompositions that were used.

    Parameters
    ----------
    tol : float, default 1e-12
        A row is redundant if the new fraction of its direction, in the metric of the masses, does not exceed this.

    Returns
    -------
    Redundancy

    Raises
    ------
    InputError
        `tol` is not between 0 and 1.
    CapabilityError
        A is asymmetric or indefinite and an island has more than 1,200 rows, or products of the numbers exceed
        float64.
    """
    check_problem(problem)
    if not check_float("tol", tol, low=0.0) < 1.0:
        raise InputError(f"tol is {tol}; a number from 0 to below 1 is needed")
    if problem.precision == "float32":
        tol = max(tol, MIN_NEW_FRACTION_FLOAT32)
    m = problem.m
    unique = np.ones(m, bool)
    dependent: list[int] = []
    used, methods = tol, set()
    with np.errstate(all="ignore"):  # Numbers that are not finite are reported below.
        scale = 1.0 / np.sqrt(problem.csr_data.d)
        unit = _compute_unit_diagonal_factors(problem, scale)
        scaled = sp.csr_array(sp.diags_array(unit) @ problem.csr @ sp.diags_array(unit))
        # A is zero if J has no column.
        has_jacobian = m and problem.matrix is None and problem.jacobian.shape[1]
        roots = _build_unit_row_roots(problem) if has_jacobian and not np.any(problem.compliance) else ()
    if not all(np.isfinite(part.data).all() for part in (scaled, *roots)):
        raise CapabilityError(
            "the rank cannot be computed: rows of unit size exceed float64 (give the problem in other units)"
        )
    for island in group_rows_by_island(problem, np.arange(m + 1, dtype=np.int32)):
        a = scaled[island][:, island]
        sound = problem.is_semidefinite or (problem.is_symmetric and has_shifted_cholesky(a))
        if problem.is_symmetric and len(island) <= MAX_DENSE_ISLAND_ROWS:
            dependent_rows, limit, descriptions = _find_dependent_rows_densely(
                a.toarray(), [root[island] for root in roots], tol, sound
            )
            used = max(used, limit)
            if len(dependent_rows):
                basis = _compute_null_basis(a.toarray(), dependent_rows)
                if unit is not scale:  # Convert from rows scaled by A_ii to rows scaled by d.
                    basis = np.linalg.qr(basis * (unit[island] / scale[island])[:, None])[0]
                unique[island] = np.abs(basis).max(axis=1) <= NULL_VECTOR_TOL
        else:
            dependent_rows, limit, descriptions = _find_dependent_rows_of_large_island(a, sound, tol)
            used = max(used, limit)
            unique[island] = len(dependent_rows) == 0
        methods.update(descriptions)
        dependent += island[dependent_rows].tolist()
    return Redundancy(
        problem=problem,
        rank=m - len(dependent),
        tol=used,
        method="; ".join(sorted(methods)) or "no rows",
        rows=tuple(sorted(dependent)),
        impulse_is_unique=unique,
    )


def _find_dependent_rows_densely(
    a: FloatArray, roots: list[sp.csr_array], tol: float, sound: bool
) -> tuple[IndexArray, float, list[str]]:
    """Find the dependent rows of a symmetric island. If A is `sound` (semidefinite), each depends on rows before it.

    Returns
    -------
    rows, threshold of the new fraction of a direction that was used, descriptions of the methods
    """
    if not sound:
        return _find_dependent_columns_by_qr(_equilibrate(a), tol), tol, [f"QR with pivoting, {tol:.0e}"]
    if not roots:
        tol = max(tol, MIN_NEW_FRACTION_OF_A)
        tail, descriptions = _find_dependent_rows_by_cholesky(a, tol), [f"Cholesky with pivoting, {tol:.0e}"]
    else:
        # Keep the columns that the island uses, at least one.
        own = [root[:, np.unique(np.append(root.indices, 0))] for root in roots]
        tails = [_find_dependent_columns_by_qr(root.toarray().T, tol) for root in own]
        tail, descriptions = min(tails, key=len), [f"QR of J M^-1/2 with pivoting, {tol:.0e}"]
        if len({len(t) for t in tails}) > 1:
            descriptions.append(
                f"of {len(a)} rows {len(a) - len(tails[0])} by the masses and "
                f"{len(a) - len(tails[1])} without them: the larger number counts"
            )
    return _find_rows_dependent_on_earlier(a, tail, max(tol, MIN_NEW_FRACTION_OF_A)), tol, descriptions


def _find_dependent_rows_of_large_island(
    a: sp.csr_array, sound: bool, tol: float
) -> tuple[IndexArray, float, list[str]]:
    """Find the dependent rows of a large or asymmetric island; return (rows, threshold, texts)."""
    n = a.shape[0]
    if sound:
        limit = max(tol, math.sqrt(PIVOT_TOL_PER_ROW * n))
        return _find_dependent_rows_by_sparse_cholesky(a, limit**2), limit, [f"sparse Cholesky, {limit:.0e}"]
    if n > MAX_DENSE_ISLAND_ROWS:
        raise CapabilityError(
            f"A is asymmetric or indefinite and {n} of its rows are coupled; the rank of at most "
            f"{MAX_DENSE_ISLAND_ROWS} coupled rows can be computed: pass a smaller problem, or the symmetric part of A"
        )
    return (
        _find_dependent_columns_by_qr(_equilibrate(a.toarray().T), tol),
        tol,
        [f"QR with pivoting, {tol:.0e}"],
    )


def _compute_unit_diagonal_factors(problem: Problem, scale: FloatArray) -> FloatArray:
    """Compute factors (m,) that scale the diagonal of A to one.

    A factor is d^-1/2, or A_ii^-1/2 if d differs from A_ii although A_ii is not a rounding error. The two differ next
    to rows of very much heavier bodies (1e20 times and more), where d is the largest entry of the row, and in two rows
    of different units that share a d (the mean of both A_ii). A_ii is not a rounding error if no entry A_ij of the row
    exceeds sqrt(A_ii A_jj), as in every semidefinite A.
    """
    a = problem.csr
    own = a.diagonal()
    row_max = abs(a).max(axis=1).toarray().ravel() if problem.m else own
    hidden = (own > 0.0) & (
        (own <= MAX_HIDDEN_DIAGONAL * row_max) | (own * scale**2 <= MAX_SHARED_SCALE_FRACTION)
    )
    if not hidden.any():
        return scale
    with np.errstate(all="ignore"):
        diagonal_scale = np.where(own > 0.0, 1.0 / np.sqrt(np.where(own > 0.0, own, 1.0)), scale)
        share = (
            abs(sp.csr_array(sp.diags_array(diagonal_scale) @ a @ sp.diags_array(diagonal_scale)))
            .max(axis=1)
            .toarray()
            .ravel()
        )
    return np.where(hidden & (share <= 1.0 + SEMIDEFINITE_SLACK), diagonal_scale, scale)


def _build_unit_row_roots(problem: Problem) -> tuple[sp.csr_array, sp.csr_array]:
    """Build two matrices of unit rows that have the rank of A: J M^-1/2, and J with unit masses in place of M.

    A direction counts as new if it is new in either: the first matrix hides motion of heavy bodies, the second hides
    small entries of J.
    """
    root_of_a = problem.velocity_form().jacobian
    if problem.generalized is not None:
        root_without_masses = problem.generalized.jac
    else:
        rows = problem.rows
        assert rows is not None
        largest_inv_inertia = np.abs(rows.inv_inertia).max(axis=(1, 2)) if rows.n_bodies else np.zeros(0)
        inertia_unit = np.where(largest_inv_inertia > 0.0, largest_inv_inertia, 1.0)[:, None, None]
        unit_mass_rows = replace(
            rows,
            inv_mass=(rows.inv_mass > 0.0).astype(float),
            inv_inertia=rows.inv_inertia / inertia_unit,
            copy=False,
        )
        root_without_masses = (
            Problem(problem.b, problem.cones, rows=unit_mass_rows, copy=False).velocity_form().jacobian
        )
    for squared in (False, True):  # Divide by the largest entry first: squares of large entries overflow.
        size = (
            np.sqrt((root_without_masses * root_without_masses).sum(axis=1))
            if squared
            else abs(root_without_masses).max(axis=1).toarray().ravel()
        )
        root_without_masses = sp.csr_array(
            sp.diags_array(1.0 / np.where(size > 0.0, size, 1.0)) @ root_without_masses
        )
    return root_of_a, root_without_masses


def _find_dependent_columns_by_qr(a: FloatArray, tol: float) -> IndexArray:
    """Find columns of `a` that depend on the others, by QR with pivoting and the relative threshold `tol`."""
    from scipy.linalg import qr

    r, order = qr(a, mode="r", pivoting=True)
    size = np.abs(np.diagonal(r))
    rank = int(np.count_nonzero(size > tol * size[0])) if len(size) and size[0] > 0.0 else 0
    return np.sort(order[rank:])


def _equilibrate(a: FloatArray) -> FloatArray:
    """Scale `a` so that the largest entry of each row and column is near 1; the rank does not change."""
    for axis in (0, 1, 0, 1, 0, 1, 0, 1):
        largest = np.abs(a).max(axis=axis, keepdims=True)
        a = a / np.sqrt(np.where(largest > 0.0, largest, 1.0))
    return a


def _find_dependent_rows_by_cholesky(a: FloatArray, tol: float) -> IndexArray:
    """Find rows of a semidefinite `a` (unit diagonal) that depend on the others, by Cholesky with pivoting."""
    # Rounding alone leaves a pivot of about len(a) 2^-53.
    _, order, rank, _ = lapack.dpstrf(a, tol=max(tol**2, len(a) * 2.0**-52))
    return np.sort(order[rank:] - 1)


def _find_dependent_rows_by_sparse_cholesky(a: sp.csr_array, limit: float) -> IndexArray:
    """Return the dependent rows of a large semidefinite `a` (unit diagonal), by a sparse factor without pivoting.

    Rows N with small pivots are left out. Their Schur complement on the other rows, B, is

        S = A_NN - A_NB A_BB^-1 A_BN,   S z = (A z - A x)_N,   A_BB x_B = (A z)_B,   x_N = 0 = z_B

    Products with random z show in which rows S is not zero; their block of S is factored with pivoting.
    """
    n = a.shape[0]
    system, values = analyse_matrix_for_factorisation(a)

    def product(z: FloatArray) -> FloatArray:
        y = a @ z
        x = system.solve(y)
        x += system.solve(y - a @ x)
        out: FloatArray = (y - a @ x)[left]
        return out

    for pivot in (*LEFT_OUT_PIVOTS, limit):
        system.factor(values, None, 0.0, pivot)
        left = system.list_lost_rows()
        random, new = np.random.default_rng(0), np.zeros(len(left))
        for _ in range(N_PROBE_VECTORS if len(left) else 0):
            z = np.zeros(n)
            z[left] = random.standard_normal(len(left))
            new = np.maximum(new, np.abs(product(z)))
        maybe_new = np.flatnonzero(new > limit)
        if len(maybe_new) <= MAX_DENSE_ISLAND_ROWS:
            break
    else:
        return left
    block = np.zeros((len(maybe_new), len(maybe_new)))
    for k, i in enumerate(left[maybe_new]):
        z = np.zeros(n)
        z[i] = 1.0
        block[k] = product(z)[maybe_new]
    maybe_new = maybe_new[block.diagonal() > limit]
    block = block[np.ix_(block.diagonal() > limit, block.diagonal() > limit)]
    if not len(maybe_new):
        return left
    dependent = _find_dependent_rows_by_cholesky(np.asfortranarray(0.5 * (block + block.T)), math.sqrt(limit))
    return np.delete(left, np.delete(maybe_new, dependent))


def _find_rows_dependent_on_earlier(a: FloatArray, tail: IndexArray, tol: float) -> IndexArray:
    """Return dependent rows such that each depends on rows before it, as many as in `tail`.

    `tail` is a set of dependent rows. It is returned unchanged if the search finds another number of them.
    """
    if len(tail) == 0:
        return tail
    m = len(a)
    problem = Problem.linear(a, np.zeros(m))
    pivoting = Pivoting(problem.csr_data, m - 1, np.arange(m, dtype=np.int32), max(tol**2, m * 2.0**-52))
    pivoting.factor_all()
    dependent_rows = np.array(pivoting.skipped(), np.intp)
    return dependent_rows if len(dependent_rows) == len(tail) else tail


def _compute_null_basis(a: FloatArray, dependent_rows: IndexArray) -> FloatArray:
    """Compute orthonormal null vectors from (-A_BB^-1 A_Bi, e_i) for each redundant row i."""
    independent_rows = np.setdiff1d(np.arange(len(a)), dependent_rows)
    vectors = np.zeros((len(a), len(dependent_rows)))
    vectors[dependent_rows] = np.eye(len(dependent_rows))
    if len(independent_rows):
        _, share, info = lapack.dposv(
            a[np.ix_(independent_rows, independent_rows)], a[np.ix_(independent_rows, dependent_rows)]
        )
        if info != 0:
            share = np.linalg.lstsq(
                a[np.ix_(independent_rows, independent_rows)],
                a[np.ix_(independent_rows, dependent_rows)],
                rcond=None,
            )[0]
        vectors[independent_rows] = -share
    return np.linalg.qr(vectors)[0]
