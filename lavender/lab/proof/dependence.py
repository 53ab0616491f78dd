"""Find rows of J that depend on others exactly: by elimination modulo a prime, confirmed by the rank over integers."""

from __future__ import annotations

from itertools import count
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import lapack
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import factor_sparse_lu


class Tangled(Exception):
    """Too many rows depend on each other to rounding to decide whether they do so exactly."""


# Above this many rows the factor is sparse; it does not eliminate the row with the largest pivot first.
MAX_DENSE_GRAM_ROWS = 1000

# A row depends on others to rounding if its squared distance from their span is up to this fraction of its squared
# length.
ROUNDING_DEPENDENCE_TOL = 1e-10

SPARSE_GRAM_SHIFT = 1e-13  # Fraction of the diagonal that is added to it; dependent rows keep this pivot.


def order_by_dependence(j: Any) -> tuple[Any, int]:
    """Order the rows of J such that rows that depend on others up to rounding come last.

    Return the order, and the number of rows that are independent.
    """
    size = np.maximum(np.sqrt(j.multiply(j).sum(axis=1)), np.finfo(float).tiny)
    unit = sp.csr_array(sp.diags_array(1.0 / size) @ j)
    gram = sp.csc_array(unit @ unit.T)
    m = gram.shape[0]
    if m <= MAX_DENSE_GRAM_ROWS:
        _, order, rank, _ = lapack.dpstrf(gram.toarray(), tol=ROUNDING_DEPENDENCE_TOL)
        return np.concatenate([np.sort(order[:rank]), np.sort(order[rank:])]) - 1, int(rank)
    shifted = gram + SPARSE_GRAM_SHIFT * sp.eye_array(m)
    options = {"SymmetricMode": True}
    factor = factor_sparse_lu(shifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    # Each pivot of the Cholesky factor is the squared distance of a row from the span of the rows before it.
    independent = abs(factor.U.diagonal()[factor.perm_c]) > ROUNDING_DEPENDENCE_TOL
    return np.concatenate([np.flatnonzero(independent), np.flatnonzero(~independent)]), int(
        np.count_nonzero(independent)
    )


PRIME = 2**61 - 1

# Up to this rank, rows that look dependent are confirmed over the integers, which takes seconds.
MAX_INTEGER_RANK = 600


def find_dependent_rows(flint: Any, j: Any, target: FloatArray, sure: int = 0) -> tuple[Any, Any]:
    """Return rows of J that are independent of those before them, and dependent rows with contradicting targets.

    Rows that are independent modulo a prime are independent. If their number equals the number of columns that they
    use, the other rows depend on them. Otherwise the rank of J over the integers decides. To find contradicting
    targets, the rank is computed again with the targets as an additional column of J: if it grows by one, a target
    contradicts others. The first `sure` rows are independent up to rounding. If a connected component of J has as many
    of these rows as columns, they are a basis of its rows; the inverse of their square matrix, which the proof
    computes, confirms this.

    Raises
    ------
    Tangled
        The rank of some rows modulo a prime is above MAX_INTEGER_RANK and below the number of their columns.
    """
    _, label = sp.csgraph.connected_components(
        sp.block_array([[None, j != 0], [(j != 0).T, None]]).astype(float), directed=False
    )
    independent_rows, contradict = [], []
    for k in np.unique(label[: j.shape[0]]):
        rows = np.flatnonzero(label[: j.shape[0]] == k)
        columns = np.flatnonzero(label[j.shape[0] :] == k)
        basis = rows[rows < sure]
        if len(basis) == len(columns) and not target[rows].any():
            independent_rows.append(basis)
            continue
        split = _split_independent_and_contradicting_rows(flint, j[rows][:, columns], target[rows])
        if split is None:
            raise Tangled(rows)
        independent_rows.append(rows[split[0]])
        contradict.append(rows[split[1]])
    return np.sort(np.concatenate(independent_rows)), np.sort(
        np.concatenate([np.zeros(0, np.int64), *contradict])
    )


def _split_independent_and_contradicting_rows(
    flint: Any, j: Any, target: FloatArray
) -> tuple[list[int], list[int]] | None:
    """Return (independent rows, rows that contradict them) of one component of J, or None if its rank is too large."""
    m, n = j.shape
    integer_rows = _scale_rows_to_integers(np.column_stack([j.toarray(), target]))
    prime = PRIME
    while True:
        reduced, rank = flint.nmod_mat(
            n, m, [row[k] % prime for k in range(n) for row in integer_rows], prime
        ).rref()
        independent_rows: list[int] = []
        for k in range(m):
            if len(independent_rows) < rank and int(reduced[len(independent_rows), k]) != 0:
                independent_rows.append(k)
        others = sorted(set(range(m)) - set(independent_rows))
        if not others or (rank == n and not target.any()):
            return independent_rows, []
        entries = [(i, k) for i in range(rank) for k in others if int(reduced[i, k]) != 0]
        targets = [(i, integer_rows[k][n]) for i, k in enumerate(independent_rows) if integer_rows[k][n]]
        residuals = {
            k: (integer_rows[k][n] - sum(int(reduced[i, k]) * t for i, t in targets)) % prime for k in others
        }
        proofs = [
            _residual_rows_depend_on_others(flint, integer_rows, rows, residuals)
            for rows in _group_connected_rows(m, [(independent_rows[i], k) for i, k in entries])
        ]
        if None in proofs:
            return None
        if all(proofs):
            return independent_rows, [k for k in others if residuals[k]]
        # The present prime divides an entry that is not zero: try the next one.
        prime = next(p for p in count(prime + 2, 2) if flint.fmpz(p).is_prime())


def _group_connected_rows(m: int, pairs: list[tuple[int, int]]) -> list[Any]:
    """Partition `m` rows into sets that pairs connect; a row without a pair is a set of its own."""
    at = tuple(np.array(pairs, np.int64).reshape(-1, 2).T)
    joined = sp.coo_array((np.ones(len(pairs)), at), shape=(m, m))
    n, label = sp.csgraph.connected_components(joined, directed=False)
    return [np.flatnonzero(label == k).tolist() for k in range(n)]


def _residual_rows_depend_on_others(
    flint: Any, integer_rows: list[list[int]], rows: list[int], residuals: dict[int, int]
) -> bool | None:
    """Return whether the rows in `residuals` depend exactly on the others; None if there are too many to decide.

    A row's target is included if its residual modulo the prime is 0.
    """
    independent = [k for k in rows if k not in residuals]
    if len(independent) == len(rows):
        return True
    if len(independent) > MAX_INTEGER_RANK:
        return None
    agree = [integer_rows[k] for k in rows if not residuals.get(k)]
    return (
        _compute_rank(flint, [integer_rows[k][:-1] for k in rows])
        == len(independent)
        == _compute_rank(flint, agree)
    )


def _compute_rank(flint: Any, rows: list[list[int]]) -> int:
    """Return the rank of an integer matrix, its zero columns removed."""
    live = [k for k in range(len(rows[0])) if any(row[k] for row in rows)] if rows else []
    return int(flint.fmpz_mat(len(rows), len(live), [row[k] for row in rows for k in live]).rank())


def _scale_rows_to_integers(a: FloatArray) -> list[list[int]]:
    """Multiply each row by a power of two that makes its numbers integers, exactly."""
    mantissa, power = np.frexp(a)
    power = np.where(a != 0.0, power, power.max(axis=1, keepdims=True, initial=0))
    power -= power.min(axis=1, keepdims=True, initial=power.max(initial=0))
    digits = (mantissa * 2.0**53).astype(np.int64)
    return [
        [x << p for x, p in zip(row, by, strict=True)]
        for row, by in zip(digits.tolist(), power.tolist(), strict=True)
    ]
