"""auto: what it chooses, that it says so, islands, certificates, and that it gets there."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from random_problems import (
    FORMS,
    as_matrix,
    good,
    random_contact_problem,
    random_lcp,
    seeds,
    side_by_side,
)

import lavender as lv
from lavender.judge import residuals
from lavender.solvers.islands import islands, restrict, rows_of
from lavender.solvers.solve_log import SolveLog


@pytest.mark.parametrize("form", FORMS)
@given(seed=seeds)
@settings(max_examples=25)
def test_islands_are_those_of_the_matrix_and_each_can_stand_alone(form, seed):
    rolls = bool(seed % 2)
    problem = FORMS[form](
        random_contact_problem(seed, spin=not rolls, rolling=rolls, bodies=9, joints=2, contacts=6)
    )
    count, label = islands(problem)
    # Blocks that share a body may still not touch in A, where rows happen to be orthogonal; not at random.
    count_of_matrix, label_of_matrix = islands(as_matrix(problem))
    assert count == count_of_matrix
    assert np.array_equal(label, label_of_matrix)
    assert np.array_equal(np.unique(label), np.arange(count))
    a, lam = problem.dense(), np.random.default_rng(seed).normal(size=problem.m)
    for i in range(count):
        blocks = np.flatnonzero(label == i)
        rows = rows_of(problem, blocks)
        part = restrict(problem, blocks, rows)
        assert part.operator == problem.operator
        # Sums over one body in another order: a few roundings.
        np.testing.assert_allclose(part.dense(), a[np.ix_(rows, rows)], rtol=0, atol=1e-13 * np.abs(a).max())
        np.testing.assert_array_equal(part.b, problem.b[rows])
        alone, whole = lv.residual(part, lam[rows]).error, lv.residual(problem, lam).error[rows]
        np.testing.assert_allclose(alone, whole, rtol=0, atol=1e-9 * np.abs(whole).max())
        others = np.setdiff1d(np.arange(problem.m), rows)
        assert not a[np.ix_(rows, others)].any()


@pytest.mark.parametrize("friction", ["coulomb", "cone"])
def test_islands_are_solved_to_their_share(friction):
    parts = [random_contact_problem(i, friction, bodies=4, contacts=4, joints=1) for i in range(6)]
    problem = side_by_side([as_matrix(replace(p, compliance=p.compliance + 0.2)) for p in parts])
    solution = lv.solve(problem, "auto", tol=1e-9)
    assert good(solution, 1e-9), solution
    # Each island alone, by the judge of its own problem, is where the whole says it is.
    count, label = islands(problem)
    assert count >= 6
    for i in range(count):
        blocks = np.flatnonzero(label == i)
        rows = rows_of(problem, blocks)
        alone = lv.residual(restrict(problem, blocks, rows), solution.impulse[rows])
        whole = np.sqrt((problem.d * solution.residual.error**2)[rows].sum())
        np.testing.assert_allclose(
            alone.energy, whole, rtol=1e-6, atol=1e-15 * solution.residual.energy_start
        )


def test_what_gave_up_at_once_is_not_called_solved():
    cones = lv.Cones.contacts([0.0], 2)
    jac = np.sqrt(np.arange(1.0, 7.0)).reshape(3, 2)
    problem = lv.Problem.from_jacobian(jac, np.eye(2), np.full(2, -1e59), cones=cones)
    assert "the start is a solution ->" not in lv.solve(problem).message


@pytest.mark.parametrize("seed", range(6))
def test_the_same_object_goes_the_same_way_again(seed):
    """What a first solve found out of a problem does not choose for the second."""
    rng = np.random.default_rng(seed)
    parts = []
    for _ in range(30):
        k = int(rng.integers(2, 7))
        root = rng.normal(size=(k, max(1, k - 1)))
        parts.append(root @ root.T)
    a = sp.block_diag(parts, format="csr")
    problem = lv.Problem.lcp(a, a @ rng.normal(size=a.shape[0]))
    first, second = (lv.solve(problem, tol=1e-3) for _ in range(2))
    assert first.message == second.message
    assert first.impulse.tobytes() == second.impulse.tobytes()


def twice_touching(n):
    """n masses in a line, each in contact with the next at two points: A is singular, of half bandwidth 3."""
    jac = sp.lil_array((2 * n, n))
    for i in range(2 * n):
        jac[i, i // 2] = 1.0
        if i >= 2:
            jac[i, i // 2 - 1] = -1.0
    return lv.Problem.lcp((jac @ jac.T).tocsr(), np.repeat(np.random.default_rng(0).uniform(0.5, 2.0, n), 2))


def test_a_singular_band_is_shifted_once_where_it_stands():
    """Every contact given twice, which sweeps hardly notice: what `direct` does with one shift, once."""
    problem = twice_touching(60)
    solution = lv.solve(problem, tol=1e-6)
    assert solution.success
    assert solution.message.startswith("direct")
    assert solution.message.count("direct") == 1
    assert solution.work["shifts"] == 1
    assert solution.work == lv.solve(problem, "direct", tol=1e-6).work


def test_newton_comes_first_on_many_soft_rows_of_few_velocities():
    """A soft body under Coulomb's law: a few factorisations of 99 velocities end what sweeps need hundreds for."""
    rng = np.random.default_rng(2)
    velocities, contacts = 99, 700
    jac = np.zeros((3 * contacts, velocities))
    for i in range(contacts):
        one, other = rng.integers(0, velocities // 3, 2)
        for k in range(3):
            jac[3 * i + k, 3 * one + k] += 1.0
            jac[3 * i + k, 3 * other + k] -= 1.0
            jac[3 * i + k, 3 * one : 3 * one + 3] += 0.1 * rng.normal(size=3)
    problem = lv.Problem.from_jacobian(
        sp.csr_array(jac), sp.diags_array(rng.uniform(0.5, 2.0, velocities)), rng.normal(size=velocities),
        cones=lv.Cones.contacts(0.7, count=contacts), compliance=0.8,
    )  # fmt: skip
    solution = lv.solve(problem, tol=1e-6, max_iter=2000)
    assert solution.success
    assert solution.turns[0].solver == "newton"
    assert solution.work["factorisations"] <= 20
    assert "sweeps" not in solution.work


def test_a_net_in_generalised_coordinates_whose_factor_fills_is_left_to_sweeps():
    """Without short separators neither the rows of A nor the velocities have a sparse factor; they are soft, though."""
    rng = np.random.default_rng(0)
    m, nv = 3000, 4000
    columns = rng.integers(0, nv, (m, 4))
    jac = sp.csr_array((rng.normal(size=4 * m), (np.repeat(np.arange(m), 4), columns.ravel())), shape=(m, nv))
    problem = lv.Problem.from_jacobian(
        jac, sp.eye_array(nv), rng.normal(size=nv), cones=lv.Cones.free(m), compliance=np.full(m, 8.0)
    )
    solution = lv.solve(problem, tol=1e-6)
    assert solution.success and "factorisations" not in solution.work, solution


@pytest.mark.parametrize("problem", [random_lcp(1), random_contact_problem(2)], ids=["lcp", "bodies"])
def test_a_start_at_its_floor_is_told_as_one(problem):
    # The precision is the floor's, and there was no limit.
    start = lv.solve(problem, tol=1e-30)
    again = lv.solve(problem, tol=1e-30, impulse=start.impulse)
    assert (again.status, again.iterations) == (lv.Status.FLOOR, 0)
    assert "at its floor" in again.message and "time" not in again.message


def test_a_start_that_solves_a_as_it_was_formed_is_judged_by_the_problem():
    # Masses over 15 decades: forming A of J and M rounds more than the tolerance, which lies between both residuals.
    rng = np.random.default_rng(40)
    jac, q = rng.normal(size=(30, 90)), np.linalg.qr(rng.normal(size=(90, 90)))[0]
    mass = (q * 10.0 ** -rng.uniform(0, 15, 90)) @ q.T
    problem = lv.Problem.from_jacobian(
        jac, 0.5 * (mass + mass.T) + 1e-15 * np.eye(90), rng.normal(size=90), cones=lv.Cones.free(30)
    )
    formed = lv.Problem(problem.b, problem.cones, problem.delassus())
    start = lv.solve(formed, "direct", tol=1e-14).impulse
    exact, rounded = lv.residual(problem, start).relative, lv.residual(formed, start).relative
    assert rounded < exact
    log = SolveLog(problem, (exact * rounded) ** 0.5, 100, by=formed.metric)
    assert log.offer(start) == log.best == exact


@pytest.mark.parametrize("solver", ["auto", "pgs"])
def test_the_result_is_not_judged_twice(solver, monkeypatch):
    problem = lv.Problem.contact(4.0 * np.eye(90) + 0.01, np.linspace(-1.0, 1.0, 90), np.full(30, 0.5))
    found = []
    judged = residuals.judged
    monkeypatch.setattr("lavender.judge.residuals.judged", lambda *given: found.append(1) or judged(*given))
    assert lv.solve(problem, solver, max_iter=150, time_limit=10.0).success
    assert not found  # what the solver had judged last is what it hands over


@pytest.mark.parametrize("budget", [1, 2, 3, 5, 10])
def test_a_turn_of_newton_takes_no_step_more_than_is_left(budget):
    # A step is two factorisations here, the first of which fails; drawn, and made smaller.
    a, b = np.diag([-1e-30, -1e30, -1e60, -1e-60]), [0.0, -1e-20, 1e60, 1.0]
    rng = np.random.default_rng(0)
    for _ in range(20):
        start = rng.normal(size=4) * 10.0 ** rng.integers(-3, 4, 4)
        assert (
            lv.solve(lv.Problem.linear(a, b), impulse=start, tol=1e-6, max_iter=budget).iterations <= budget
        )
