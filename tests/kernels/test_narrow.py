"""Orders of elimination for a narrow band: every row once, and the bandwidth they say."""

import numpy as np
import scipy.sparse as sp
from hypothesis import example, given
from hypothesis import strategies as st

from lavender_ext.factor.narrow import narrow_order


def pattern(n, density, seed, symmetric):
    a = sp.random_array((n, n), density=density, rng=np.random.default_rng(seed), format="csr")
    a = sp.csr_array(a + a.T + sp.eye_array(n)) if symmetric else sp.csr_array(a)
    a.sort_indices()
    return a


def order_of(a):
    return narrow_order(a.indptr.astype(np.int32), a.indices.astype(np.int32))


@given(n=st.integers(0, 60), density=st.floats(0.0, 0.3), seed=st.integers(0, 2**16), symmetric=st.booleans())
@example(n=1, density=0.0, seed=0, symmetric=True)
def test_every_row_once_and_the_bandwidth_is_that_of_the_order(n, density, seed, symmetric):
    a = pattern(n, density, seed, symmetric)  # a pattern that is not symmetric must not be trusted either
    order, band = order_of(a)
    assert sorted(order) == list(range(n))
    place = np.empty(n, int)
    place[order] = np.arange(n)
    rows, columns = sp.coo_array(a).coords
    assert band == np.abs(place[rows] - place[columns]).max(initial=0)


def test_chains_and_strips_are_found_whatever_their_rows_are_called():
    n, rng = 400, np.random.default_rng(0)
    for width in (1, 2, 5):
        a = sp.diags_array([np.ones(n - k) for k in range(width + 1)], offsets=list(range(width + 1)))
        shuffled = rng.permutation(n)
        a = sp.csr_array(sp.csr_array(a + a.T)[shuffled][:, shuffled])
        a.sort_indices()
        assert order_of(a)[1] <= 2 * width - 1


def test_a_star_is_sorted_by_a_heap():
    n = 5000
    a = sp.lil_array((n, n))
    a[n // 2, :] = 1.0
    a[:, n // 2] = 1.0
    a.setdiag(1.0)
    a[3, 4] = a[4, 3] = 1.0
    order, band = order_of(sp.csr_array(a))
    assert sorted(order) == list(range(n)) and band >= n // 2
