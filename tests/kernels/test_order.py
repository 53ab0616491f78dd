"""Orders of least degree: all vertices, whatever the graph, with little fill on grids."""

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from lavender_ext.factor import symbolic
from lavender_ext.factor.graph import least_degree


def graph(n, pairs):
    a, b = np.array(
        sorted({(i, j) for i, j in pairs if i != j} | {(j, i) for i, j in pairs if i != j}) or [(0, 0)]
    ).T
    matrix = sp.csr_array((np.ones(len(a)), (a, b)), shape=(n, n))
    matrix.setdiag(0)
    matrix.eliminate_zeros()
    matrix.sort_indices()
    return matrix


def fill(matrix, order):
    """Blocks of the factor when the vertices are eliminated in that order."""
    lower = sp.csr_array(sp.tril(matrix[order][:, order] + sp.eye_array(len(order))))
    lower.sort_indices()
    return int(symbolic.factor_pattern(lower.indptr.astype(np.int32), lower.indices.astype(np.int32))[0][-1])


def grid(side):
    index = np.arange(side**3).reshape(side, side, side)
    pairs = [(index[:-1], index[1:]), (index[:, :-1], index[:, 1:]), (index[:, :, :-1], index[:, :, 1:])]
    return graph(
        side**3, {(int(i), int(j)) for a, b in pairs for i, j in zip(a.ravel(), b.ravel(), strict=True)}
    )


@given(
    n=st.integers(1, 60),
    pairs=st.lists(st.tuples(st.integers(0, 59), st.integers(0, 59)), max_size=150),
)
@settings(max_examples=200, deadline=None)
def test_every_vertex_has_one_place_in_any_graph(n, pairs):
    matrix = graph(n, [(i, j) for i, j in pairs if i < n and j < n])
    order = least_degree(matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32))
    assert np.array_equal(np.sort(order), np.arange(n))


@pytest.mark.parametrize("side", [8, 12])
def test_fill_of_a_grid_is_far_below_that_of_its_own_order(side):
    matrix = grid(side)
    order = least_degree(matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32))
    # Planes in their own order fill side^2 a column; the best orders O(side^4) of side^5 in all (George 1973).
    assert fill(matrix, order) < 0.6 * fill(matrix, np.arange(side**3))


def test_columns_of_one_pattern_stand_beside_each_other():
    """Places are those of a postorder: what is below a vertex and not below its parent comes right before it."""
    matrix = grid(6)
    order = least_degree(matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32))
    lower = sp.csr_array(sp.tril(matrix[order][:, order] + sp.eye_array(len(order))))
    lower.sort_indices()
    lptr, lind, _, _ = symbolic.factor_pattern(lower.indptr.astype(np.int32), lower.indices.astype(np.int32))
    size = np.ones(len(order), int)  # of the subtree of each
    has_parent = np.flatnonzero(np.diff(lptr))
    parent = lind[lptr[has_parent]]
    for j, p in zip(has_parent, parent, strict=True):
        size[p] += size[j]
    first = np.arange(len(order)) - size + 1  # where a subtree begins that ends at its root
    assert (first[parent] <= first[has_parent]).all() and (first >= 0).all()
