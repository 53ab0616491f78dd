"""Rows that depend on others exactly: found modulo a prime, held to the rank of J in whole numbers."""

from __future__ import annotations

from itertools import count
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import lapack
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import sparse_lu


class Tangled(Exception):
    """Rows that depend on each other, too many to tell from rounding."""


SPARSE = 1000  # rows above which the factor is sparse: it does not take the farthest row first

DEPENDS = 1e-10  # of a row's length squared, to the span of those before it: depends on them to rounding

SHIFT = 1e-13  # of the diagonal: what a row that depends on others keeps of itself


def pivots(j: Any) -> tuple[Any, int]:
    """An order of the rows of J in which those that depend on others to rounding come last, and how many do not."""
    size = np.maximum(np.sqrt(j.multiply(j).sum(axis=1)), np.finfo(float).tiny)
    unit = sp.csr_array(sp.diags_array(1.0 / size) @ j)
    gram = sp.csc_array(unit @ unit.T)
    m = gram.shape[0]
    if m <= SPARSE:
        _, order, rank, _ = lapack.dpstrf(gram.toarray(), tol=DEPENDS)
        return np.concatenate([np.sort(order[:rank]), np.sort(order[rank:])]) - 1, int(rank)
    shifted = gram + SHIFT * sp.eye_array(m)
    options = {"SymmetricMode": True}
    factor = sparse_lu(shifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    # Pivots of a Cholesky factor: the squared distances of rows from the span of those before them.
    alone = abs(factor.U.diagonal()[factor.perm_c]) > DEPENDS
    return np.concatenate([np.flatnonzero(alone), np.flatnonzero(~alone)]), int(np.count_nonzero(alone))


PRIME = 2**61 - 1

EXACT = 600  # rank up to which rows that look dependent are held to it in whole numbers: seconds


def dependencies(flint: Any, j: Any, target: FloatArray, sure: int = 0) -> tuple[Any, Any]:
    """Rows of J that are independent of those before them, and others whose target contradicts theirs: exactly.

    Rows that are independent modulo a prime are so. Where they span all columns that they reach, the others depend on
    them; else the rank in whole numbers says so, with the targets as one more column for those that contradict nothing.
    The first `sure` rows are independent to rounding: as many of them as columns that they reach are taken for a basis,
    which the inverse of their equations proves.

    Raises
    ------
    Tangled
        Rows whose rank modulo a prime is above EXACT and below the number of their columns.
    """
    _, label = sp.csgraph.connected_components(
        sp.block_array([[None, j != 0], [(j != 0).T, None]]).astype(float), directed=False
    )
    kept, contradict = [], []
    for k in np.unique(label[: j.shape[0]]):
        rows = np.flatnonzero(label[: j.shape[0]] == k)
        columns = np.flatnonzero(label[j.shape[0] :] == k)
        basis = rows[rows < sure]
        if len(basis) == len(columns) and not target[rows].any():
            kept.append(basis)
            continue
        found = _dependent(flint, j[rows][:, columns], target[rows])
        if found is None:
            raise Tangled(rows)
        kept.append(rows[found[0]])
        contradict.append(rows[found[1]])
    return np.sort(np.concatenate(kept)), np.sort(np.concatenate([np.zeros(0, np.int64), *contradict]))


def _dependent(flint: Any, j: Any, target: FloatArray) -> tuple[list[int], list[int]] | None:
    m, n = j.shape
    whole = _whole(np.column_stack([j.toarray(), target]))
    prime = PRIME
    while True:
        reduced, rank = flint.nmod_mat(
            n, m, [row[k] % prime for k in range(n) for row in whole], prime
        ).rref()
        kept: list[int] = []
        for k in range(m):
            if len(kept) < rank and int(reduced[len(kept), k]) != 0:
                kept.append(k)
        others = sorted(set(range(m)) - set(kept))
        if not others or (rank == n and not target.any()):
            return kept, []
        made = [(i, k) for i in range(rank) for k in others if int(reduced[i, k]) != 0]
        goal = [(i, whole[k][n]) for i, k in enumerate(kept) if whole[k][n]]
        left = {k: (whole[k][n] - sum(int(reduced[i, k]) * t for i, t in goal)) % prime for k in others}
        held = [_spanned(flint, whole, part, left) for part in _parted(m, [(kept[i], k) for i, k in made])]
        if None in held:
            return None
        if all(held):
            return kept, [k for k in others if left[k]]
        prime = next(
            p for p in count(prime + 2, 2) if flint.fmpz(p).is_prime()
        )  # this one divides what is not 0


def _parted(m: int, pairs: list[tuple[int, int]]) -> list[Any]:
    """Sets of rows, of m, that pairs join; a row that is in none stands by itself."""
    at = tuple(np.array(pairs, np.int64).reshape(-1, 2).T)
    joined = sp.coo_array((np.ones(len(pairs)), at), shape=(m, m))
    n, label = sp.csgraph.connected_components(joined, directed=False)
    return [np.flatnonzero(label == k).tolist() for k in range(n)]


def _spanned(flint: Any, whole: list[list[int]], rows: list[int], left: dict[int, int]) -> bool | None:
    """Whether rows depend on those without `left`, targets (the last column) too where that is 0; None: too many."""
    base = [k for k in rows if k not in left]
    if len(base) == len(rows):
        return True
    if len(base) > EXACT:
        return None
    agree = [whole[k] for k in rows if not left.get(k)]
    return _rank(flint, [whole[k][:-1] for k in rows]) == len(base) == _rank(flint, agree)


def _rank(flint: Any, rows: list[list[int]]) -> int:
    live = [k for k in range(len(rows[0])) if any(row[k] for row in rows)] if rows else []
    return int(flint.fmpz_mat(len(rows), len(live), [row[k] for row in rows for k in live]).rank())


def _whole(a: FloatArray) -> list[list[int]]:
    """Each row times a power of two, in whole numbers."""
    share, power = np.frexp(a)
    power = np.where(a != 0.0, power, power.max(axis=1, keepdims=True, initial=0))
    power -= power.min(axis=1, keepdims=True, initial=power.max(initial=0))
    digits = (share * 2.0**53).astype(np.int64)
    return [
        [x << p for x, p in zip(row, by, strict=True)]
        for row, by in zip(digits.tolist(), power.tolist(), strict=True)
    ]
