"""Generalised coordinates: J and M as simulators hold them, against A formed densely and twins that share nothing."""

import copy
import pickle

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from random_problems import (
    as_matrix,
    random_generalized_problem,
    random_tree_parents,
    seeds,
    tree_mass,
)

import lavender as lv


def row_by_row(mass, x):
    """M^-1 x by M = L^T D L, a row after the other."""
    low = np.tril(mass)
    x = x.copy()
    n = len(x)
    for k in range(n - 1, -1, -1):
        for a in range(k - 1, -1, -1):
            f = low[k, a] * (1.0 / low[k, k])
            low[a, : a + 1] -= f * low[k, : a + 1]
            low[k, a] = f
    for k in range(n - 1, -1, -1):
        x[:k] -= low[k, :k] * x[k]
    for k in range(n):
        x[k] *= 1.0 / low[k, k]
        for a in range(k):
            x[k] -= low[k, a] * x[a]
    return x


@given(seeds)
def test_generalized_elimination_of_rows_together_has_the_bits_of_single_ones(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 48 if seed % 5 else 160))
    parent = np.arange(n) - 1 if seed % 3 == 0 else random_tree_parents(rng, n)
    mass = tree_mass(rng, parent) + 0.1 * np.eye(
        n
    )  # long chains alone lose definiteness to rounding
    if seed % 4 == 1:  # fills in
        for i, j in rng.integers(0, n, (int(rng.integers(1, n + 1)), 2)):
            mass[[i, j], [j, i]] += 1e-3
            mass[[i, j], [i, j]] += 2e-3
    mass = np.tril(mass) + np.tril(mass, -1).T  # to the last bit
    x = rng.normal(size=n)
    general = lv.Generalized(np.ones((1, n)), mass, np.zeros(n))
    order = np.arange(n) if general.order is None else general.order
    assert (
        general.solve(x)[order].tobytes()
        == row_by_row(mass[np.ix_(order, order)], x[order]).tobytes()
    )


def test_from_jacobian_of_any_matrix_type_gives_one_problem():
    rng = np.random.default_rng(3)
    blocks = [tree_mass(rng, [-1, 0, 1]), tree_mass(rng, [-1, 0])]
    mass = sp.block_diag(list(map(sp.coo_array, blocks))).toarray()
    jac = rng.normal(size=(3, 5)) * (rng.random((3, 5)) < 0.7)
    v = rng.normal(size=5)
    problems = [
        lv.Problem.from_jacobian(j, m, v, cones=lv.Cones.contacts(0.5))
        for j in (jac, sp.csr_array(jac), sp.coo_matrix(jac))
        for m in (mass, sp.csc_array(mass), blocks)
    ]
    assert all(p == problems[0] for p in problems)
    assert problems[0].operator == "generalized"
    assert problems[0] != lv.Problem.from_jacobian(jac, 2.0 * mass, v, cones=lv.Cones.contacts(0.5))
    for made in (copy.deepcopy(problems[0]), pickle.loads(pickle.dumps(problems[0]))):
        assert made == problems[0]
        assert not made.generalized.jac.data.flags.writeable


def test_from_jacobian_without_rows_or_velocities_is_solved():
    none = lv.Problem.from_jacobian(np.zeros((0, 3)), np.eye(3), np.ones(3), cones=lv.Cones.free(0))
    assert lv.solve(none, "newton").success
    assert np.array_equal(none.velocity([]), np.ones(3))
    still = lv.Problem.from_jacobian(np.zeros((2, 0)), np.zeros((0, 0)), [], cones=lv.Cones.free(2))
    assert lv.solve(still, "newton").success
    jac = np.array([[1.0, 0.0], [0.0, 0.0]])
    bounds = lv.Cones.bounded(np.zeros(2), np.full(2, 4.0))
    empty = lv.Problem.from_jacobian(jac, np.eye(2), [-1.0, 0.0], target=[0.0, 1.0], cones=bounds)
    solution = lv.solve(empty, "newton", tol=1e-12)
    np.testing.assert_allclose(
        solution.impulse, [1.0, 4.0]
    )  # the row on nothing: decided on the spot
    hopeless = lv.Problem.from_jacobian(
        jac, np.eye(2), [-1.0, 0.0], target=[0.0, 1.0], cones=lv.Cones.free(2)
    )
    assert lv.solve(hopeless, "newton").status is lv.Status.INFEASIBLE


@given(seed=seeds)
@pytest.mark.parametrize("soft", [True, False])
@pytest.mark.parametrize("friction", ["coulomb", "cone"])
def test_newton_over_velocities_reaches_the_floor_or_tol(friction, soft, seed):
    problem = random_generalized_problem(seed, friction, compliance=soft)
    tol = 1e-10 if soft else 1e-8  # of what is rigid a proximal term is taken away
    solution = lv.solve(problem, "newton", form="velocity", tol=tol)
    assert "csr" not in problem.__dict__  # A was not formed
    if soft and friction == "coulomb":  # rows of A go on where velocities stall
        assert lv.solve(problem, "newton", tol=tol).success
    elif friction == "cone":
        assert solution.residual.relative <= max(tol, 2 * solution.residual.roundoff_floor), str(
            solution
        )
    assert solution.claim_check == "confirmed"
    assert solution.solver.form in (
        "generalized coordinates",
        "velocity",
    )  # "velocity" if J and M describe free bodies


def test_problem_updated_has_the_same_structure_and_new_numbers():
    problem = random_generalized_problem(9, "cone")
    general = problem.generalized
    rng = np.random.default_rng(0)
    jac = general.jac.toarray() * 1.1
    v = rng.normal(size=general.nv)
    new = problem.updated(J=jac, M=2.0 * general.mass.toarray(), v_free=v, target=0.1)
    made = lv.Problem.from_jacobian(
        jac,
        2.0 * general.mass.toarray(),
        v,
        target=0.1,
        cones=problem.cones,
        compliance=problem.compliance,
        friction="cone",
        name=problem.name,
    )
    assert new == made
    assert problem.updated(b=2.0 * problem.b).b[0] == 2.0 * problem.b[0]
    assert problem.updated(b=problem.b) == problem


@pytest.mark.parametrize(
    "jac", [[[1.0, 1.0], [1.0, -1.0]], [[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 0.0, 1.0]]]
)
def test_generalized_matrix_leaves_out_vanishing_entries(jac):
    """Colours and islands are told by entries: of rows that all meet in the same columns, and of others."""
    n = len(jac)
    problem = lv.Problem.from_jacobian(jac, np.eye(n), np.zeros(n), cones=lv.Cones.free(n))
    assert problem.csr.nnz == n


@given(seed=seeds)
@pytest.mark.parametrize("friction", ["coulomb", "cone", "lcp"])
def test_generalized_factor_of_a_tree_has_the_pattern_of_its_branches(friction, seed):
    """Large trees, some contacts between branches: few entries in a row of N, the solution of A."""
    contacts = 0 if friction == "lcp" else 6
    problem = random_generalized_problem(
        seed, "cone" if friction == "lcp" else friction, n=200, contacts=contacts
    )
    solution = lv.solve(problem, "newton", form="velocity", tol=1e-11)
    assert solution.residual.relative <= 1e-11 or solution.residual.at_floor
    other = lv.solve(as_matrix(problem), "newton", tol=1e-11)
    # Every row is soft by 0.01 / kg or more, so residuals of 1e-11 are impulses of 1e-8 of their size.
    if friction != "coulomb":
        np.testing.assert_allclose(
            solution.impulse, other.impulse, atol=1e-7 * (1 + np.abs(other.impulse).max())
        )


@pytest.mark.parametrize(
    "cones, size, other",
    [
        (lv.Cones.bounded(np.zeros(20), 1.0), 1, "direct"),
        (lv.Cones.contacts(0.7, count=4), 3, "admm"),
        (lv.Cones.contacts([0.7, 0.0, 0.3], tangents=2, patch_radius=0.1), 4, "admm"),
    ],
    ids=["bounded", "contacts", "spinning"],
)
@given(seed=seeds, compliance=st.sampled_from([0.0, 0.1]))
def test_newton_on_rows_of_islands_that_alternate(cones, size, other, seed, compliance):
    """From any start: the judge's end, and the velocities of another solver."""
    rng = np.random.default_rng(seed)
    m = int(cones.ptr[-1])
    jac = rng.normal(size=(m, 14))
    half = rng.normal(size=(2, 7, 7))
    first = np.arange(m) // size % 2 == 0
    jac[first, 7:] = jac[~first, :7] = 0.0
    mass = scipy.linalg.block_diag(*(half @ half.swapaxes(1, 2) + np.eye(7)))
    v_free = rng.normal(size=14)
    problem = lv.Problem.from_jacobian(
        jac, mass, v_free, cones=cones, compliance=compliance, friction="cone"
    )
    start = rng.uniform(0.0, 1.0, m)
    whole = lv.solve(problem, "newton", form="velocity", impulse=start, tol=1e-9)
    assert whole.success
    apart = lv.solve(problem, other, tol=1e-9)
    np.testing.assert_allclose(
        problem.velocity(whole.impulse), problem.velocity(apart.impulse), atol=1e-6
    )


@given(
    pairs=st.lists(
        st.lists(st.integers(0, 8), min_size=2, max_size=2, unique=True), min_size=1, max_size=6
    )
)
def test_islands_of_rows_between_trees_are_the_components_of_the_matrix(pairs):
    first, second = np.array(pairs).T
    jac = np.eye(9)[first] - np.eye(9)[second]
    cones = lv.Cones.bounded(np.zeros(len(jac)), 1.0)
    problem = lv.Problem.from_jacobian(jac, np.eye(9), np.arange(1.0, 10.0) ** 2, cones=cones)
    expected = sp.csgraph.connected_components(abs(jac) @ abs(jac.T), directed=False)[1]
    for same in (problem, lv.Problem(problem.b, cones, problem.csr)):
        label = lv.residual(same, np.full(len(jac), 0.5)).islands.label
        np.testing.assert_array_equal(label, expected)


def cloth(side, seed, friction="cone"):
    """Masses on a square grid, each of one velocity, stiff rows between neighbours, contacts of three rows."""
    rng = np.random.default_rng(seed)
    n = side * side
    number = rng.permutation(n).reshape(side, side)  # in no order that anybody meant
    pairs = np.concatenate(
        [
            np.stack([number[1:], number[:-1]], -1).reshape(-1, 2),
            np.stack([number[:, 1:], number[:, :-1]], -1).reshape(-1, 2),
        ]
    )
    jac = sp.lil_array((len(pairs) + 3 * side, n))
    for i, (a, b) in enumerate(pairs):
        jac[i, a], jac[i, b] = 1.0, -1.0
    for i in range(3 * side):
        jac[len(pairs) + i, number[i // 3, i % 3]] = 1.0
    cones = lv.Cones.bounded(np.full(len(pairs), -np.inf), np.full(len(pairs), np.inf))
    return lv.Problem.from_jacobian(
        jac.tocsr(),
        sp.diags_array(rng.uniform(0.5, 2.0, n)),
        rng.normal(size=n),
        cones=cones + lv.Cones.contacts(0.5, 2, count=side),
        compliance=0.2,
        friction=friction,
    )


@pytest.mark.parametrize("seed", range(3))
def test_generalized_order_of_many_small_trees_fills_in_little(seed):
    problem = cloth(24, seed)
    assert problem.generalized.order is not None
    solution = lv.solve(problem, "newton", form="velocity", tol=1e-10)
    assert solution.success
    other = lv.solve(problem, "newton", form="impulse", tol=1e-10)
    np.testing.assert_allclose(solution.impulse, other.impulse, atol=1e-7)
    v = problem.velocity(solution.impulse)
    given = problem.generalized
    np.testing.assert_allclose(
        given.mass @ (v - given.v_free), problem.jacobian.T @ solution.impulse, atol=1e-11
    )
