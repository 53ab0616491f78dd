"""`redundancy`: ranks known by hand, names, uniqueness."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from kkt_truth import eliminate
from random_problems import as_matrix, seeds

import lavender as lv
from lavender.diagnostics.redundancy import redundancy


def test_redundancy_of_two_equal_hinges_names_the_second():
    rng = np.random.default_rng(3)
    jac = rng.normal(size=(5, 12))
    rows = lv.Rows(
        inv_mass=[1.0, 0.5, 2.0],
        inv_inertia=np.tile(np.eye(3), (3, 1, 1)),
        v_free=rng.normal(size=(3, 6)),
        jac=np.vstack([jac, jac, rng.normal(size=(2, 12))]),
        joint_ptr=[0, 5, 10, 12],
        joint_body=[[0, 1], [0, 1], [1, 2]],
    )
    problem = lv.Problem.from_rows(rows, names=["hinge", "spare hinge", "rod"])
    found = redundancy(problem)
    assert found.rank == 7
    assert found.block_names == ("spare hinge",)
    assert found.rows == (5, 6, 7, 8, 9)
    assert found.impulse_is_unique.tolist() == 10 * [False] + 2 * [True]
    assert "spare hinge" in str(found)


@given(seed=seeds)
def test_redundancy_of_an_indefinite_matrix_has_its_rank(seed):
    rng = np.random.default_rng(seed)
    m, r = int(rng.integers(2, 12)), int(rng.integers(2, 12))
    g = rng.normal(size=(m, r))
    signs = rng.permutation([1.0, -1.0, *rng.choice([1.0, -1.0], r - 2)])
    a = g * signs @ g.T
    a = np.block(
        [
            [0.5 * (a + a.T), np.zeros((m, 2))],
            [np.zeros((2, m)), np.array([[0.0, 1.0], [1.0, 0.0]])],
        ]
    )
    problem = lv.Problem.linear(a, a @ rng.normal(size=m + 2))
    found = redundancy(problem)
    assert found.rank == np.linalg.matrix_rank(a, tol=1e-9 * np.linalg.norm(a, 2))
    assert found.unique == ()
    kept = np.setdiff1d(np.arange(m + 2), found.rows)
    assert np.linalg.matrix_rank(a[kept], tol=1e-9 * np.linalg.norm(a, 2)) == found.rank


@pytest.mark.parametrize("share", [1e-4, 1e-8, 1e-10])
def test_redundancy_keeps_a_row_that_differs_by_more_than_tol(share):
    """`tol` is a share of directions: 1e-12 of squares called rows redundant that were 1e-8 apart."""
    rng = np.random.default_rng(5)
    jac = rng.normal(size=(4, 6))
    jac /= np.linalg.norm(jac, axis=1)[:, None]
    new = np.linalg.svd(jac[:3])[2][-1]
    jac[3] = rng.normal(size=3) @ jac[:3]
    jac[3] = jac[3] / np.linalg.norm(jac[3]) + share * new
    problem = lv.Problem.from_jacobian(jac, np.eye(6), np.zeros(6), cones=lv.Cones.free(4))
    kept = redundancy(problem)
    dropped = redundancy(problem, tol=10.0 * share)
    assert (kept.rank, dropped.rank) == (4, 3)
    assert kept.tol == 1e-12 and dropped.tol == 10.0 * share
    assert redundancy(replace(problem, precision="float32")).rank == (4 if share > 1e-6 else 3)
    matrix = redundancy(as_matrix(problem))  # A has the squares of shares
    assert matrix.rank == (4 if share > 1e-6 else 3) and matrix.tol == 1e-6


def test_redundancy_rank_of_a_sparse_island_is_that_of_its_eigenvalues():
    rng = np.random.default_rng(1)
    m = 300
    jac = sp.csr_array(sp.random_array((m, 240), density=4.0 / 240, rng=rng))
    jac = jac[np.diff(jac.indptr) > 0]
    a = sp.csr_array(jac @ jac.T)
    unit = sp.diags_array(1.0 / np.sqrt(a.diagonal()))
    values = np.linalg.eigvalsh((unit @ a @ unit).toarray())
    found = redundancy(lv.Problem.linear(a, np.zeros(a.shape[0])))
    assert not (
        (values > 1e-13) & (values < 1e-7)
    ).any()  # zeros are roundings, all others far above
    assert found.rank == np.count_nonzero(values > 1e-7)
    kept = np.delete(np.arange(a.shape[0]), found.rows)
    np.linalg.cholesky((unit @ a @ unit).toarray()[np.ix_(kept, kept)])  # and they are independent


@pytest.mark.parametrize("form", ["masses", "rows of J", "matrix"])
@pytest.mark.parametrize(
    "spread", [0, 30, 44, 50, 66, 88, 96]
)  # A_ii up to 1e59, the door is at 1e60
def test_redundancy_rank_at_any_scale_is_that_of_exact_numbers(form, spread):
    """Powers of two, so that nothing is rounded: the rank of J is the rank of J M^-1 J^T, and of its rows scaled."""
    rng = np.random.default_rng(spread)
    seen = set()
    for _ in range(10):
        m, n = rng.integers(2, 6, 2)
        jac = rng.integers(-2, 3, (m, n)).astype(float)
        if m > 2 and rng.random() < 0.5:
            jac[-1] = jac[0] + jac[1]
        if not jac.any(axis=1).all():
            continue
        truth = len(eliminate([[Fraction(x) for x in row] for row in jac.tolist()], n))
        size = 2.0 ** (spread * rng.integers(0, 2, n if form == "masses" else m))
        if form == "matrix":
            jac = np.sqrt(2.0 ** (2 * (np.log2(size) // 2)))[:, None] * jac
            problem = lv.Problem.linear(jac @ jac.T, np.zeros(m))
        else:
            mass = np.diag(size) if form == "masses" else np.eye(n)
            jac = jac if form == "masses" else size[:, None] * jac
            problem = lv.Problem.from_jacobian(jac, mass, np.zeros(n), cones=lv.Cones.free(m))
        found = lv.redundancy(problem)
        assert found.rank == truth, (jac, size, str(found))
        assert len(found.rows) == m - truth
        seen.add(m - truth)
    assert len(seen) > 1
