"""Orders of elimination: every row once in any graph, and little fill on grids."""

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from lavender_ext.factor.graph import least_degree
from lavender_ext.factor.sparse import SparsePanels


def raw(a):
    a = sp.csr_array(a)
    a.sort_indices()
    return a.indptr.astype(np.int32), a.indices.astype(np.int32)


@given(
    n=st.integers(1, 60),
    pairs=st.lists(st.tuples(st.integers(0, 59), st.integers(0, 59)), max_size=250),
    heavy=st.integers(1, 9),
)
@settings(max_examples=200)
def test_every_vertex_has_one_place_in_any_graph(n, pairs, heavy):
    """`heavy`: rows of one pattern, which are one vertex of panels."""
    met = np.eye(n)
    for i, j in pairs:
        if i < n and j < n:
            met[i, j] = met[j, i] = 1.0
    order = least_degree(*raw(met - np.eye(n)))
    assert np.array_equal(np.sort(order), np.arange(n))
    of = np.repeat(np.arange(n), 1 + np.arange(n) % heavy)
    panels = SparsePanels(*raw(met[of][:, of]), False)
    assert np.array_equal(np.sort(panels.order), np.arange(len(of)))


def factor_of(matrix, order):
    """Columns and rows of the factor when the vertices are eliminated in that order, a column at a time."""
    a = matrix[order][:, order]
    below = [{int(i) for i in a.indices[a.indptr[j] : a.indptr[j + 1]] if i > j} for j in range(len(order))]
    for rows in below:
        if rows:
            parent = min(rows)
            below[parent] |= rows - {parent}
    return np.cumsum([0, *map(len, below)]), np.array([i for rows in below for i in sorted(rows)])


def grid(side):
    line = sp.diags_array([np.ones(side - 1), np.ones(side - 1)], offsets=[-1, 1])
    one = sp.eye_array(side)
    return sp.csr_array(
        sp.kron(sp.kron(line, one), one) + sp.kron(sp.kron(one, line), one) + sp.kron(sp.kron(one, one), line)
    )


@pytest.mark.parametrize("side", [8, 12])
def test_fill_of_a_grid_is_far_below_that_of_its_own_order(side):
    matrix = grid(side)
    order = least_degree(*raw(matrix))
    # Planes in their own order fill side^2 a column; the best orders O(side^4) of side^5 in all (George 1973).
    assert factor_of(matrix, order)[0][-1] < 0.6 * factor_of(matrix, np.arange(side**3))[0][-1]


def test_columns_of_one_pattern_stand_beside_each_other():
    """Places are those of a postorder: what is below a vertex and not below its parent comes right before it."""
    matrix = grid(6)
    order = least_degree(*raw(matrix))
    lptr, lind = factor_of(matrix, order)
    size = np.ones(len(order), int)  # of the subtree of each
    has_parent = np.flatnonzero(np.diff(lptr))
    parent = lind[lptr[has_parent]]
    for j, p in zip(has_parent, parent, strict=True):
        size[p] += size[j]
    first = np.arange(len(order)) - size + 1  # where a subtree begins that ends at its root
    assert (first[parent] <= first[has_parent]).all() and (first >= 0).all()
