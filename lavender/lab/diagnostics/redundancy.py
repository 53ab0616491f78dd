"""Which rows repeat others, and what is unique all the same.

Where A is singular, impulses are not unique: a table on four legs. The slack w, and with it every body's
velocity, is unique for symmetric positive semidefinite A without Coulomb friction. A row is redundant when
what is left of it after all rows before it are taken out,

    p_i = A_ii - A_iB A_BB^-1 A_Bi   (B: rows before i that are not redundant)   [1/kg]

is at most `tol`^2 A_ii: sqrt(p_i / A_ii) is the share of its direction that is new, in the metric of the masses. If J
is known, this share is computed from J, and what is new in J alone counts, too: beside a body that is 1e25 times
heavier the masses hide it. If only A is known, its rounding hides shares below SHARE_OF_A.
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
from lavender.problem.operators import analyze_panels, has_shifted_cholesky
from lavender.problem.ordering import rows_by_island
from lavender_ext.pivot.direct import Pivoting

# Smallest share of a row's direction that differs from rounding of A: A has the squares of shares, and rounding of its
# products and of their elimination leaves some 1e-14 of the diagonal, seldom 1e-13.
SHARE_OF_A = 1e-6
# The same for data that were float32: rows that are equal differ by roundings of 2^-24, of which some ten add up.
SHARE_OF_FLOAT32 = 1e-6
DENSE = 1200  # rows of an island up to which it is decomposed as a dense matrix
PIVOT_TOL_PER_ROW = (
    1e-12  # Larger islands: pivots up to this share of d times the number of rows count as zero.
)
# Larger islands: rows with pivots up to this share of d are left out of the sparse factor and looked at afterwards. A
# smaller share spoils later pivots by rounding, a larger one leaves more rows out; the next one is used if more than
# DENSE rows may be new. Of 851 matrices, 1e-2 gives each its rank, 1e-3 gives 843, and a factor alone 822.
LEFT_OUT_PIVOTS = (1e-2, 1e-4, 1e-6)
PROBES = 3  # random vectors whose products show which of the rows left out are new
FALLS_BACK = 1e-10  # A_ii over the largest entry of its row, up to which d is that entry
SHARED = 1e-3  # A_ii over a d that two rows share, up to which their units are unlike
SOUND = 1e-8  # -, above 1, up to which |A_ij| / sqrt(A_ii A_jj) is that of a semidefinite A
UNMOVED = 1e-9  # -, entries of all unit null vectors up to which a row counts as not moved


Places = npt.NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Redundancy:
    """What `redundancy` found; `str()` says it in a few lines."""

    problem: Problem
    rank: int  # of A
    tol: float  # -, share of a row's direction up to which the row counts as redundant; the largest that was used
    method: str  # how the rank was found, in words
    rows: tuple[int, ...]  # redundant rows: each adds nothing to the others that are kept
    impulse_is_unique: npt.NDArray[np.bool_]  # (m,) rows whose impulse no redundancy can change

    @property
    def row_names(self) -> tuple[str, ...]:
        """Names of the redundant rows."""
        return tuple(self.problem.row_name(i) for i in self.rows)

    @cached_property
    def blocks(self) -> tuple[int, ...]:
        """Blocks (joints, contacts) whose rows are all redundant: without them nothing would change."""
        ptr = self.problem.cones.ptr
        count = np.bincount([self.problem.block_of(i) for i in self.rows], minlength=self.problem.n_blocks)
        return tuple(int(i) for i in np.flatnonzero((count > 0) & (count == np.diff(ptr))))

    @property
    def block_names(self) -> tuple[str, ...]:
        """Names of those blocks."""
        return tuple(map(self.problem.block_name, self.blocks))

    @property
    def slack_is_unique(self) -> bool:
        """Slack and body velocities are the same in every solution."""
        return self.problem.is_semidefinite and self.problem.law != "coulomb"

    @property
    def unique(self) -> tuple[str, ...]:
        """What every solution shares, for a positive semidefinite A; compare nothing else."""
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
        lines.append(f"unique: {', '.join(self.unique) or 'nothing is certain to be'}")
        return "\n".join(lines)


def redundancy(problem: Problem, *, tol: float = 1e-12) -> Redundancy:
    """Rank of A, the rows that repeat others, and what is unique.

    Islands (rows that share no body, directly or through others) are decomposed separately. Up to 1,200 rows: by QR of
    J M^-1/2 and of J with column pivoting if J is given without compliance (nothing is squared); otherwise by Cholesky
    with pivoting, which works on squares, so that `tol` is at least 1e-6; by QR for asymmetric or indefinite A. More
    rows: by a sparse Cholesky factor, where pivots up to 1e-12 d times the number of rows count as zero: `tol` is at
    least 1e-6 times the square root of that number. If the problem's data were float32, `tol` is at least 1e-6. The
    result's `tol` and `method` have the value that was used.

    Parameters
    ----------
    tol : float, default 1e-12
        Share of a row's direction, in the metric of the masses, up to which what is new in it counts as nothing.

    Raises
    ------
    InputError
        `tol` is not between 0 and 1.
    CapabilityError
        Asymmetric or indefinite A with an island of more than 1,200 rows; numbers whose products are beyond float64.
    """
    check_problem(problem)
    if not check_float("tol", tol, low=0.0) < 1.0:
        raise InputError(f"tol is {tol}; a share from 0 to 1 is needed")
    if problem.precision == "float32":
        tol = max(tol, SHARE_OF_FLOAT32)
    m = problem.m
    unique = np.ones(m, bool)
    dependent: list[int] = []
    used, methods = tol, set()
    with np.errstate(all="ignore"):  # what is not finite is told below
        scale = 1.0 / np.sqrt(problem.csr_data.d)
        unit = _unit(problem, scale)
        scaled = sp.csr_array(sp.diags_array(unit) @ problem.csr @ sp.diags_array(unit))
        moves = m and problem.matrix is None and problem.jacobian.shape[1]  # where J has no column A is zero
        roots = _roots(problem) if moves and not np.any(problem.compliance) else ()
    if not all(np.isfinite(part.data).all() for part in (scaled, *roots)):
        raise CapabilityError(
            "the rank cannot be told: rows of unit size are beyond float64 (give the problem in other units)"
        )
    for island in rows_by_island(problem, np.arange(m + 1, dtype=np.int32)):
        a = scaled[island][:, island]
        sound = problem.is_semidefinite or (problem.is_symmetric and has_shifted_cholesky(a))
        if problem.is_symmetric and len(island) <= DENSE:
            found, limit, words = _dense_island(a.toarray(), [root[island] for root in roots], tol, sound)
            used = max(used, limit)
            if len(found):
                basis = _null_basis(a.toarray(), found)
                if unit is not scale:  # to the metric of d
                    basis = np.linalg.qr(basis * (unit[island] / scale[island])[:, None])[0]
                unique[island] = np.abs(basis).max(axis=1) <= UNMOVED
        else:
            found, limit, words = _other_island(a, sound, tol)
            used = max(used, limit)
            unique[island] = len(found) == 0
        methods.update(words)
        dependent += island[found].tolist()
    return Redundancy(
        problem=problem,
        rank=m - len(dependent),
        tol=used,
        method="; ".join(sorted(methods)) or "no rows",
        rows=tuple(sorted(dependent)),
        impulse_is_unique=unique,
    )


def _dense_island(
    a: FloatArray, roots: list[sp.csr_array], tol: float, sound: bool
) -> tuple[Places, float, list[str]]:
    """Find the dependent rows of a symmetric island, each of those before it if A is `sound`.

    Returns
    -------
    rows; share of a row's direction that counts as nothing; how they were found, in words
    """
    if not sound:
        return _by_qr(_even(a), tol), tol, [f"QR with pivoting, {tol:.0e}"]
    if not roots:
        tol = max(tol, SHARE_OF_A)
        tail, words = _by_cholesky(a, tol), [f"Cholesky with pivoting, {tol:.0e}"]
    else:
        # On the columns that the island has; one at least.
        own = [root[:, np.unique(np.append(root.indices, 0))] for root in roots]
        tails = [_by_qr(root.toarray().T, tol) for root in own]
        tail, words = min(tails, key=len), [f"QR of J M^-1/2 with pivoting, {tol:.0e}"]
        if len({len(t) for t in tails}) > 1:
            words.append(
                f"of {len(a)} rows {len(a) - len(tails[0])} by the masses and "
                f"{len(a) - len(tails[1])} without them: the larger number counts"
            )
    return _in_order(a, tail, max(tol, SHARE_OF_A)), tol, words


def _other_island(a: sp.csr_array, sound: bool, tol: float) -> tuple[Places, float, list[str]]:
    """Dependent rows of a large or asymmetric island, the share that counts as nothing, how they were found."""
    n = a.shape[0]
    if sound:
        limit = max(tol, math.sqrt(PIVOT_TOL_PER_ROW * n))
        return _by_sparse_cholesky(a, limit**2), limit, [f"sparse Cholesky, {limit:.0e}"]
    if n > DENSE:
        raise CapabilityError(
            f"A is asymmetric or indefinite and {n} of its rows hang together; the rank of at most "
            f"{DENSE} can be told: ask for parts, or for the symmetric part of A"
        )
    return _by_qr(_even(a.toarray().T), tol), tol, [f"QR with pivoting, {tol:.0e}"]


def _unit(problem: Problem, scale: FloatArray) -> FloatArray:
    """Factors (m,) that make the diagonal of A one: those of d, but where d is another number than a sound A_ii.

    Beside rows of very much heavier bodies (1e20 and more) d falls back to what stands beside A_ii. Where no entry of
    the row is above sqrt(A_ii A_jj), as in every semidefinite A, A_ii is no rounding, and the row is scaled by it. So
    is one of two rows that share a d, their mean, and have unlike units.
    """
    a = problem.csr
    own = a.diagonal()
    beside = abs(a).max(axis=1).toarray().ravel() if problem.m else own
    fallen = (own > 0.0) & ((own <= FALLS_BACK * beside) | (own * scale**2 <= SHARED))
    if not fallen.any():
        return scale
    with np.errstate(all="ignore"):
        tried = np.where(own > 0.0, 1.0 / np.sqrt(np.where(own > 0.0, own, 1.0)), scale)
        share = (
            abs(sp.csr_array(sp.diags_array(tried) @ a @ sp.diags_array(tried))).max(axis=1).toarray().ravel()
        )
    return np.where(fallen & (share <= 1.0 + SOUND), tried, scale)


def _roots(problem: Problem) -> tuple[sp.csr_array, sp.csr_array]:
    """Two matrices of unit rows whose rank is A's: J M^-1/2, and J with the same root of a unit mass in its place.

    Each hides what is small in it: the first what heavy bodies alone would feel, the second what is small in J.
    """
    whole = problem.velocity_form().jacobian
    if problem.generalized is not None:
        bare = problem.generalized.jac
    else:
        rows = problem.rows
        assert rows is not None
        heavy = np.abs(rows.inv_inertia).max(axis=(1, 2)) if rows.n_bodies else np.zeros(0)
        light = np.where(heavy > 0.0, heavy, 1.0)[:, None, None]
        plain = replace(
            rows,
            inv_mass=(rows.inv_mass > 0.0).astype(float),
            inv_inertia=rows.inv_inertia / light,
            copy=False,
        )
        bare = Problem(problem.b, problem.cones, rows=plain, copy=False).velocity_form().jacobian
    for squared in (False, True):  # the largest entry first: squares of large ones overflow
        size = np.sqrt((bare * bare).sum(axis=1)) if squared else abs(bare).max(axis=1).toarray().ravel()
        bare = sp.csr_array(sp.diags_array(1.0 / np.where(size > 0.0, size, 1.0)) @ bare)
    return whole, bare


def _by_qr(a: FloatArray, tol: float) -> Places:
    """Find columns of `a` that depend on the others: what is left of them in QR with pivoting is at most `tol`."""
    from scipy.linalg import qr

    r, order = qr(a, mode="r", pivoting=True)
    size = np.abs(np.diagonal(r))
    rank = int(np.count_nonzero(size > tol * size[0])) if len(size) and size[0] > 0.0 else 0
    return np.sort(order[rank:])


def _even(a: FloatArray) -> FloatArray:
    """`a` with the largest entry of each row and column near 1, by factors that leave its rank."""
    for axis in (0, 1, 0, 1, 0, 1, 0, 1):
        most = np.abs(a).max(axis=axis, keepdims=True)
        a = a / np.sqrt(np.where(most > 0.0, most, 1.0))
    return a


def _by_cholesky(a: FloatArray, tol: float) -> Places:
    """Rows of a semidefinite `a` (unit diagonal) that depend on the others, by Cholesky with pivoting."""
    # Rounding alone leaves a pivot of about len(a) 2^-53.
    _, order, rank, _ = lapack.dpstrf(a, tol=max(tol**2, len(a) * 2.0**-52))
    return np.sort(order[rank:] - 1)


def _by_sparse_cholesky(a: sp.csr_array, limit: float) -> Places:
    """Return the dependent rows of a large semidefinite `a` (unit diagonal), by a sparse factor without pivoting.

    Rows N with small pivots are left out. What is new in them beside the other rows, B, is

        S = A_NN - A_NB A_BB^-1 A_BN,   S z = (A z - A x)_N,   A_BB x_B = (A z)_B,   x_N = 0 = z_B

    Products with random z show in which rows S is not zero; their block of S is factored with pivoting.
    """
    n = a.shape[0]
    panels, values = analyze_panels(a)

    def product(z: FloatArray) -> FloatArray:
        y = a @ z
        x = panels.solve(y)
        x += panels.solve(y - a @ x)
        out: FloatArray = (y - a @ x)[left]
        return out

    for pivot in (*LEFT_OUT_PIVOTS, limit):
        panels.factor(values, np.ones(n), 0.0, pivot)
        left = panels.lost_rows()
        random, new = np.random.default_rng(0), np.zeros(len(left))
        for _ in range(PROBES if len(left) else 0):
            z = np.zeros(n)
            z[left] = random.standard_normal(len(left))
            new = np.maximum(new, np.abs(product(z)))
        some = np.flatnonzero(new > limit)
        if len(some) <= DENSE:
            break
    else:
        return left
    block = np.zeros((len(some), len(some)))
    for k, i in enumerate(left[some]):
        z = np.zeros(n)
        z[i] = 1.0
        block[k] = product(z)[some]
    some = some[block.diagonal() > limit]
    block = block[np.ix_(block.diagonal() > limit, block.diagonal() > limit)]
    if not len(some):
        return left
    dependent = _by_cholesky(np.asfortranarray(0.5 * (block + block.T)), math.sqrt(limit))
    return np.delete(left, np.delete(some, dependent))


def _in_order(a: FloatArray, tail: Places, tol: float) -> Places:
    """As many rows as `tail`, each dependent on rows before it; `tail` itself where that cannot be told."""
    if len(tail) == 0:
        return tail
    m = len(a)
    problem = Problem.linear(a, np.zeros(m))
    pivoting = Pivoting(problem.csr_data, m - 1, np.arange(m, dtype=np.int32), max(tol**2, m * 2.0**-52))
    pivoting.factor_all()
    found = np.array(pivoting.skipped(), np.intp)
    return found if len(found) == len(tail) else tail


def _null_basis(a: FloatArray, found: Places) -> FloatArray:
    """Orthonormal null vectors, from (-A_BB^-1 A_Bi, e_i) for each redundant row i."""
    kept = np.setdiff1d(np.arange(len(a)), found)
    vectors = np.zeros((len(a), len(found)))
    vectors[found] = np.eye(len(found))
    if len(kept):
        _, share, info = lapack.dposv(a[np.ix_(kept, kept)], a[np.ix_(kept, found)])
        if info != 0:
            share = np.linalg.lstsq(a[np.ix_(kept, kept)], a[np.ix_(kept, found)], rcond=None)[0]
        vectors[kept] = -share
    return np.linalg.qr(vectors)[0]
