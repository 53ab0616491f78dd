"""Rows that depend on others exactly: found modulo a prime, held to J in rational numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.later import lapack
from lavender.base.later import sparse as sp
from lavender.base.lu import sparse_lu

__all__ = ["PRIMES", "Tangled", "dependencies", "pivots"]


class Tangled(Exception):
    """Rows that depend on each other to rounding, by no simple quotients."""


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


PRIMES = (2**61 - 1, 2**521 - 1)  # the second where numbers of the first are too small for the quotients


def dependencies(flint: Any, j: Any, target: FloatArray, sure: int = 0) -> tuple[Any, Any]:
    """Rows of J that are independent of those before them, and others whose target contradicts theirs: exactly.

    Rows that are independent modulo a prime are so. Where they span all columns that they reach, the others depend on
    them; else what these are made of is read modulo the prime as quotients of whole numbers, and held to J in rational
    numbers. Rows of no target contradict nothing. The first `sure` rows are independent to rounding: as many of them as
    columns that they reach are taken for a basis, which the inverse of their equations proves.
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
        for prime in PRIMES:
            found = _dependent(flint, j[rows][:, columns], target[rows], prime)
            if found is not None:
                break
        else:
            raise Tangled(rows)
        kept.append(rows[found[0]])
        contradict.append(rows[found[1]])
    return np.sort(np.concatenate(kept)), np.sort(np.concatenate([np.zeros(0, np.int64), *contradict]))


def _dependent(flint: Any, j: Any, target: FloatArray, prime: int) -> tuple[list[int], list[int]] | None:
    m, n = j.shape
    entries, by_row = [0] * (n * m), j.tocoo()
    for i, k, x in zip(by_row.row.tolist(), by_row.col.tolist(), by_row.data.tolist(), strict=True):
        entries[k * m + i] = _residue(x, prime)
    if prime < 2**64:
        reduced, rank = flint.nmod_mat(n, m, entries, prime).rref()
    else:
        reduced, rank = flint.fmpz_mod_mat(n, m, entries, flint.fmpz_mod_ctx(prime)).rref()
    kept: list[int] = []
    for k in range(m):
        if len(kept) < rank and int(reduced[len(kept), k]) != 0:
            kept.append(k)
    others = sorted(set(range(m)) - set(kept))
    if not others or (rank == n and not target.any()):
        return kept, []
    number = _exact(flint)
    exact = [
        dict(zip(j.indices[s:e].tolist(), map(number, j.data[s:e].tolist()), strict=True))
        for s, e in zip(j.indptr[:-1].tolist(), j.indptr[1:].tolist(), strict=True)
    ]
    goal, contradict = [number(x) for x in target.tolist()], []
    for k in others:
        rest, left = dict(exact[k]), goal[k]
        for i, base in enumerate(kept):
            c = int(reduced[i, k])
            if c:
                share = flint.fmpq(*_quotient(c, prime))
                left = left - share * goal[base]
                for column, x in exact[base].items():
                    rest[column] = rest.get(column, 0) - share * x
        if any(x != 0 for x in rest.values()):
            return None
        if left != 0:
            contradict.append(k)
    return kept, contradict


def _exact(flint: Any) -> Any:
    return lambda x: flint.fmpq(*x.as_integer_ratio())


def _residue(x: float, prime: int) -> int:
    top, bottom = x.as_integer_ratio()
    return top * pow(bottom, -1, prime) % prime


def _quotient(c: int, prime: int) -> tuple[int, int]:
    """The quotient of least size that is c modulo the prime (half an extended Euclid; Wang 1981)."""
    a, b, u, v = prime, c, 0, 1
    while b * b > prime:
        q = a // b
        a, b, u, v = b, a - q * b, v, u - q * v
    return (b, v) if v > 0 else (-b, -v)
