"""A = Y Y^T + D formed in compiled code: the entries and bits that SciPy's product and sum have."""

import numpy as np
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from lavender_ext.core import assemble


@given(seed=st.integers(0, 10**6), m=st.integers(0, 40), n=st.integers(1, 30), whole=st.booleans())
@settings(max_examples=200, deadline=None)
def test_product_with_its_transpose_is_that_of_scipy(seed, m, n, whole):
    rng = np.random.default_rng(seed)
    density = 1.0 if seed % 3 == 0 else rng.uniform(0.0, 0.5)
    y = sp.csr_array(sp.random_array((m, n), density=density, rng=rng))
    y.sort_indices()
    y.data = (
        rng.integers(-2, 3, y.nnz).astype(float) if whole else rng.normal(size=y.nnz)
    )  # whole: sums vanish
    d = rng.uniform(0.0, 1.0, m) * (seed % 2)
    expected = sp.csr_array(y @ y.T + sp.diags_array(d)) if m else sp.csr_array((0, 0))
    expected.sum_duplicates()
    expected.sort_indices()
    indptr, indices, data = assemble.gram(y.data, y.indices.astype(np.int32), y.indptr.astype(np.int32), n, d)
    np.testing.assert_array_equal(indptr, expected.indptr)
    np.testing.assert_array_equal(indices, expected.indices)
    assert data.tobytes() == expected.data.tobytes()
