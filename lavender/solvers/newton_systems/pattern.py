"""Which blocks of the matrix over bodies are not zero, in an order of elimination that keeps its factor sparse."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender._arrays import IntArray
from lavender._later import sparse as sp
from lavender_ext.factor import graph, symbolic

FEW_BODIES = 1500  # up to here bits hold the neighbours of a body


def block_pattern(n: int, body: IntArray) -> tuple[IntArray, ...]:
    """Lower block rows (nptr, nind); places (larger first) and slots of each element; which ones were turned."""
    if n <= FEW_BODIES:
        nptr, nind, node, slot, turned = graph.body_pattern(body, n)
        return nptr, nind, node, slot, turned
    chain = symbolic.chain_pattern(body, n)
    if chain is not None:
        return chain
    a, b = body[:, 0].astype(np.int64), body[:, 1].astype(np.int64)
    both = (a >= 0) & (b >= 0)
    code = np.unique(np.minimum(a, b)[both] * n + np.maximum(a, b)[both])
    low, high = code // n, code % n
    return _pattern(n, body, low, high, _fill_reducing(n, low, high))


def postordered(n: int, node: IntArray, nptr: IntArray, nind: IntArray) -> tuple[IntArray, ...]:
    """The same pattern with columns of one pattern beside each other; node (k, 2) the places of each element.

    `turned` says which elements are turned from what they were.
    """
    rank = symbolic.postorder(nptr, nind).astype(np.int64)
    row = np.repeat(np.arange(n), np.diff(nptr))
    off = nind < row
    return _pattern(n, node, nind[off].astype(np.int64), row[off].astype(np.int64), rank)


def _pattern(n: int, body: IntArray, low: Any, high: Any, rank: Any) -> tuple[IntArray, ...]:
    both = (body >= 0).all(axis=1)
    r_low, r_high = rank[low], rank[high]
    row, column = np.maximum(r_low, r_high), np.minimum(r_low, r_high)
    row, column = np.concatenate([row, np.arange(n)]), np.concatenate([column, np.arange(n)])
    key = np.sort(row * n + column)
    nptr = np.concatenate([[0], np.cumsum(np.bincount(key // n, minlength=n))]).astype(np.int32)
    nind = (key % n).astype(np.int32)
    node = np.where(body >= 0, rank[np.maximum(body, 0)], -1).astype(np.int32)
    turned = node[:, 0] < node[:, 1]
    node[turned] = node[turned][:, ::-1]
    node = np.ascontiguousarray(node)
    first, second = node[:, 0].astype(np.int64), node[:, 1].astype(np.int64)
    slot = np.zeros((len(body), 3), np.int32)
    slot[:, 0] = nptr[np.maximum(first, 0) + 1] - 1
    slot[:, 1] = nptr[np.maximum(second, 0) + 1] - 1
    slot[both, 2] = np.searchsorted(key, first[both] * n + second[both])
    return nptr, nind, node, slot, turned.astype(np.int32)


def _fill_reducing(n: int, low: Any, high: Any) -> Any:
    # Minimum degree (through qdldl) on the graph of bodies; a band of width 1 is left as it is.
    if len(low) == 0 or int((high - low).max()) <= 1:
        return np.arange(n)
    degree = np.bincount(low, minlength=n) + np.bincount(high, minlength=n) + 1.0
    index = np.concatenate([low, np.arange(n)])
    other = np.concatenate([high, np.arange(n)])
    value = np.concatenate([np.full(len(low), -1.0), degree])
    graph = sp.csc_matrix((value, (index, other)), shape=(n, n))
    import qdldl

    order = np.asarray(qdldl.Solver(graph, upper=True).factors()[2], np.int64)
    rank = np.empty(n, np.int64)
    rank[order] = np.arange(n)
    return rank
