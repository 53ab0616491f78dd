"""Sparse factors by panels: an order of all vertices in any graph, little fill, factors that solve to the same bits."""

import os
import signal

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st

from lavender.base.lu import splu
from lavender_ext.factor.graph import order_for_elimination
from lavender_ext.factor.linear import LinearSystem
from lavender_ext.factor.sparse import extract_free_part, has_symmetric_pattern

EPS = np.finfo(float).eps


def mirrored(rng, n, block, density):
    """A random matrix (n, n) with a symmetric pattern and a diagonal, of blocks of equal patterns."""
    k = -(-n // block)
    pattern = sp.random_array((k, k), density=density, rng=rng, format="csr")
    pattern = sp.kron(pattern + pattern.T + sp.eye_array(k), np.ones((block, block)))
    a = sp.csr_array(sp.csr_array(pattern)[:n, :n])
    a.sort_indices()
    a.data = rng.normal(size=a.nnz)
    return a


def raw(a):
    a = sp.csr_array(a)
    a.sort_indices()
    return a.indptr.astype(np.int32), a.indices.astype(np.int32)


def definite(a):
    lower = sp.tril(a, -1)
    a = lower + lower.T
    a = sp.csr_array(a + sp.diags_array(abs(a).sum(axis=1) + 0.1))
    a.sort_indices()
    return a


@pytest.mark.parametrize("n", [1, 47, 48, 49, 200])
def test_dense_factor_solves_and_counts_lost_pivots(n):
    """Of rank n / 2 the pivots after it are roundings: a right side in the range is solved all the same.

    Backward errors |a x - b| / (|a| |x|) are n roundings, at rank n / 2 as many times more as the last pivot is small.
    """
    rng = np.random.default_rng(n)
    half = rng.normal(size=(n, n))
    b = rng.normal(size=n)
    a = half @ half.T + np.eye(n)
    wide, narrow = (LinearSystem(n, lanes) for lanes in (True, False))
    assert (
        wide.factor(a, a.diagonal(), 0.0, 1e-13) == narrow.factor(a, a.diagonal(), 0.0, 1e-13) == 0
    )
    np.testing.assert_allclose(
        wide.multiply(b), a @ b, rtol=0, atol=n * EPS * np.abs(a).sum() * np.abs(b).max()
    )
    np.testing.assert_array_equal(wide.solve(b), narrow.solve(b))
    x = wide.solve(b)
    assert np.linalg.norm(a @ x - b) <= n * EPS * np.linalg.norm(a, 2) * np.linalg.norm(x)
    rank = -(-n // 2)
    a = half[:, :rank] @ half[:, :rank].T
    found = LinearSystem(n)
    assert found.factor(a, a.diagonal(), 0.0, 1e-13) == n - rank
    x = found.solve(a @ b)
    pivots = np.linalg.eigvalsh(a)[-rank:]
    most = n * EPS * pivots[-1] / pivots[0]
    assert np.linalg.norm(a @ x - a @ b) <= most * pivots[-1] * np.linalg.norm(x)


@given(
    n=st.integers(1, 60),
    pairs=st.lists(st.tuples(st.integers(0, 59), st.integers(0, 59)), max_size=250),
    heavy=st.integers(1, 9),
)
def test_ordering_of_any_graph_is_a_permutation(n, pairs, heavy):
    """`heavy`: rows of one pattern, which are one vertex of panels."""
    met = np.eye(n)
    for i, j in pairs:
        if i < n and j < n:
            met[i, j] = met[j, i] = 1.0
    order = order_for_elimination(*raw(met - np.eye(n)))
    assert np.array_equal(np.sort(order), np.arange(n))
    of = np.repeat(np.arange(n), 1 + np.arange(n) % heavy)
    panels = LinearSystem(raw(met[of][:, of]))
    assert np.array_equal(np.sort(panels.order), np.arange(len(of)))


def test_sparse_factor_of_trees_and_stars_fills_nothing():
    rng = np.random.default_rng(0)
    for n in (2, 50, 3000):
        parent = np.array(
            [rng.integers(0, i) if n < 3000 else 0 for i in range(1, n)]
        )  # the last: a star
        a = sp.csr_array((np.ones(n - 1), (parent, np.arange(1, n))), shape=(n, n))
        a = definite(sp.csr_array(a + a.T + sp.eye_array(n)))
        f = LinearSystem(raw(a))
        assert f.factor(a.data, a.diagonal(), 0.0, 1e-13) == 0
        b = rng.normal(size=n)
        np.testing.assert_allclose(a @ f.solve(b), b, atol=1e-9)
        assert f.entries <= 8 * n  # 2 n - 1, and zeros that are held as numbers


def factor_of(matrix, order):
    """Columns and rows of the factor when the vertices are eliminated in that order, a column at a time."""
    a = matrix[order][:, order]
    below = [
        {int(i) for i in a.indices[a.indptr[j] : a.indptr[j + 1]] if i > j}
        for j in range(len(order))
    ]
    for rows in below:
        if rows:
            parent = min(rows)
            below[parent] |= rows - {parent}
    return np.cumsum([0, *map(len, below)]), np.array([i for rows in below for i in sorted(rows)])


@pytest.mark.parametrize("piles", [1, 2])
def test_sparse_factor_by_dissection_halves_the_work_on_a_cube(piles):
    """Blocks of a grid of 14 x 14 x 14 with 26 neighbours, alone or beside others: each vertex has one place."""
    line = sp.diags_array([np.ones(13), np.ones(14), np.ones(13)], offsets=[-1, 0, 1])
    cube = sp.csr_array(sp.kron(sp.kron(line, line), line))
    graph = sp.csr_array(sp.block_diag([cube] * piles) - sp.eye_array(piles * 2744))
    graph.eliminate_zeros()
    graph.sort_indices()
    order = order_for_elimination(*raw(graph))
    assert np.array_equal(np.sort(order), np.arange(len(order)))
    pattern = sp.csr_array(graph + sp.eye_array(graph.shape[0]))
    work = [
        (np.diff(factor_of(pattern, x)[0]) ** 2.0).sum()
        for x in (order, LinearSystem(raw(pattern), True).order)
    ]
    # The order of LinearSystem is that of minimum degree. Other software for nested dissection reaches 0.4 as well.
    assert work[0] < 0.5 * work[1]


@pytest.mark.parametrize("lu", [False, True])
def test_wide_supernodes_give_the_bits_of_two_lanes(lu):
    """Products from 16,384 entries on copy their matrices in blocks; edges of 1 to 11 rows and columns remain."""
    rng = np.random.default_rng(4)
    corner = mirrored(rng, 301, 7, 0.02)
    a = definite(
        sp.block_array([[corner, None], [None, rng.normal(size=(613, 613))]])
        + sp.eye_array(914, k=300)
    )
    found = []
    for wide in (True, False):
        f = LinearSystem(raw(a), wide)
        assert f.factor(a.data, a.diagonal(), 0.0, 1e-13, lu) == 0
        found.append(f.solve(np.ones(914)))
    assert found[0].tobytes() == found[1].tobytes()
    # The residual is a sum of up to 914 rounded terms.
    rounding = 914 * EPS * abs(a).sum(axis=1).max() * np.abs(found[0]).max()
    np.testing.assert_allclose(a @ found[0], 1.0, rtol=0, atol=rounding)


@given(seed=st.integers(0, 10**6), n=st.integers(1, 150), block=st.integers(1, 6), lu=st.booleans())
def test_sparse_factor_solves_with_the_same_bits_in_all_lanes(seed, n, block, lu):
    rng = np.random.default_rng(seed)
    a = mirrored(rng, n, block, rng.choice([0.005, 0.03, 0.2]))
    if lu:
        a = sp.csr_array(a + sp.diags_array(3.0 * np.sqrt(np.diff(a.indptr))))
    else:
        a = definite(a)
    scale = sp.diags_array(10.0 ** rng.uniform(-4.0, 4.0, n))
    a = sp.csr_array(scale @ a @ scale)
    a.sort_indices()
    assert has_symmetric_pattern(*raw(a))
    d = a.diagonal()
    b = rng.normal(size=n)
    found = []
    for wide in (True, False):
        f = LinearSystem(raw(a), wide)
        assert np.array_equal(np.sort(f.order), np.arange(n))
        assert f.factor(a.data, abs(d), 0.0, 1e-13, lu) == 0
        found.append(f.solve(b))
    assert found[0].tobytes() == found[1].tobytes()
    f.factor(a.data, abs(d), 0.0, 1e-13, not lu)  # one analysis serves both factorisations
    assert f.factor(a.data, abs(d), 0.0, 1e-13, lu) == 0
    assert f.solve(b).tobytes() == found[0].tobytes()
    product = abs(a) @ abs(b)
    assert (np.abs(f.multiply(b) - a @ b) <= n * EPS * product).all()
    s = 1.0 / np.sqrt(abs(d))
    error = s * (a @ found[0] - b)
    assert np.abs(error).max() <= 1e-9 * np.abs(s * b).max()


def test_sparse_factor_with_shifts_and_lost_pivots_solves():
    rng = np.random.default_rng(3)
    n = 90
    edge = np.flatnonzero(np.arange(n - 1) % 18 != 17)  # five paths: Laplacians of rank 17
    path = sp.csr_array((np.ones(len(edge)), (edge, edge + 1)), shape=(n, n))
    a = path + path.T
    a = sp.csr_array(sp.diags_array(a.sum(axis=1)) - a)
    a.sort_indices()
    d = a.diagonal()
    f = LinearSystem(raw(a))
    assert f.factor(a.data, d, 0.0, 1e-12) == 5
    assert f.factor(a.data, d, 1e-3, 1e-12) == 0
    b = rng.normal(size=n)
    np.testing.assert_allclose((a + 1e-3 * sp.diags_array(d)) @ f.solve(b), b, atol=1e-9)
    free = rng.random(n) < 0.5
    place = np.where(free, np.cumsum(free) - 1, -1).astype(np.int32)
    ptr, ind, val = extract_free_part(*raw(a), a.data, place, int(free.sum()))
    np.testing.assert_array_equal(
        sp.csr_array((val, ind, ptr)).toarray(), a.toarray()[np.ix_(free, free)]
    )
    lost = LinearSystem(raw(a)).factor(np.full(a.nnz, np.nan), d, 0.0, 1e-13, True)
    assert lost > 0
    with pytest.raises(ValueError, match="entries of the analysed matrix"):
        f.factor(a.data[1:], d, 0.0, 0.0)
    with pytest.raises(ValueError, match="r has"):
        f.solve(b[1:])
    with pytest.raises(ValueError, match="must be called first"):
        LinearSystem(raw(a)).solve(b)
    with pytest.raises(ValueError, match="d has"):
        f.factor(a.data, d[1:])


@pytest.mark.parametrize(
    ("diagonal", "loses_pivots"), [(1e-9, False), (1e-12, False), (1e-20, True)]
)
def test_sparse_factor_without_pivots_or_digits_is_replaced_by_superlu(diagonal, loses_pivots):
    """Pivots of a chain of small diagonal are its neighbours', in other supernodes: 1e-9 is refined, 1e-20 is lost."""
    n = 200
    chain = [np.full(n - 1, 1.0), np.full(n, diagonal), np.full(n - 1, -1.0)]
    a = sp.csr_array(sp.diags_array(chain, offsets=[-1, 0, 1]))
    a.sort_indices()
    r = np.random.default_rng(0).normal(size=n)
    alone = LinearSystem(raw(a))
    system = LinearSystem(raw(a), True, splu)
    assert (alone.factor(a.data, tiny=1e-13, lu=True) > 0) == loses_pivots
    assert system.factor(a.data, tiny=1e-13, lu=True) == 0 and system.uses_fallback == loses_pivots
    x = system.solve(r, True)
    assert np.abs(a @ x - r).max() <= 1e-11 * np.abs(x).max()
    assert system.uses_fallback == (alone.solve(r, True) is None)
    with pytest.raises(KeyboardInterrupt):
        LinearSystem(raw(a), True, interrupt).factor(np.full(a.nnz, -1.0))


def interrupt(_):
    raise KeyboardInterrupt


def test_symmetric_pattern_of_an_asymmetric_matrix_is_false():
    a = sp.csr_array(np.array([[1.0, 2.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 1.0]]))
    assert not has_symmetric_pattern(*raw(a))
    assert not has_symmetric_pattern(*raw(sp.csr_array(a.T)))
    assert has_symmetric_pattern(*raw(sp.csr_array(a + a.T)))
    assert has_symmetric_pattern(*raw(sp.csr_array((4, 4))))


@pytest.mark.skipif(os.name != "posix", reason="a timer that sends a signal is of POSIX")
def test_a_signal_ends_a_long_factorisation_and_leaves_no_factor():
    """The grid takes 7e8 multiply-adds, and signals are checked after every 2e8: the handler runs inside the call."""
    n = 24
    line = sp.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(n, n))
    one = sp.eye_array(n)
    grid = (
        sp.kron(sp.kron(line, one), one)
        + sp.kron(sp.kron(one, line), one)
        + sp.kron(sp.kron(one, one), line)
    )
    a = sp.csr_array(grid)
    a.sort_indices()
    system = LinearSystem((a.indptr.astype(np.int32), a.indices.astype(np.int32)))
    system.analyse()

    class Stopped(Exception):
        pass

    def stop(*_):
        raise Stopped

    before = signal.signal(signal.SIGALRM, stop)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        with pytest.raises(Stopped):
            system.factor(a.data)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert system.sign == 0  # The factor is incomplete.
    assert system.factor(a.data) == 0
    x = np.ones(system.n)
    np.testing.assert_allclose(a @ system.solve(x), x, rtol=0, atol=1e-10)


@pytest.mark.parametrize("is_sparse", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_factor_has_the_sign_of_the_determinant_and_counts_infinite_pivots_as_lost(seed, is_sparse):
    rng = np.random.default_rng(seed)
    n = 7 + seed
    pattern = mirrored(rng, n, 2, 0.6) if is_sparse else sp.csr_array(rng.normal(size=(n, n)))
    a = pattern.toarray()
    system = LinearSystem(raw(pattern), True) if is_sparse else LinearSystem(n, True)
    assert system.factor(pattern.data.copy() if is_sparse else a.copy(), lu=True) == 0
    assert system.sign == np.linalg.slogdet(a)[0]
    for value in (np.inf, -np.inf, np.nan):
        data = pattern.data.copy() if is_sparse else a.copy()
        data.flat[seed] = value
        assert system.factor(data, lu=True) > 0
