"""The interior point on quadratic programs: answers by a judge of its own, factors, units, ends, and its kernels."""

import time

import numpy as np
import pytest
import scipy.sparse as sp
from kkt_truth import OF_PROGRAM as NAMES
from kkt_truth import of_program as kkt

import lavender as lv
from lavender.base.deadline import NEVER, Deadline
from lavender.solvers import interior_point


def chained(seed, n=150, singular=False):
    """A trajectory of n places with limits on them, on its steps and on some sums, a few places fixed or free."""
    rng = np.random.default_rng(seed)
    bend = sp.diags_array(
        [np.ones(n - 2), -2.0 * np.ones(n - 2), np.ones(n - 2)], offsets=[0, 1, 2], shape=(n - 2, n)
    )
    step = sp.diags_array([-np.ones(n - 1), np.ones(n - 1)], offsets=[0, 1], shape=(n - 1, n))
    x = np.cumsum(rng.uniform(-0.05, 0.05, n))
    h = np.full(2 * (n - 1), 0.1)
    h[rng.random(len(h)) < 0.1] = np.inf
    some = sp.csr_array(rng.normal(size=(3, n)) * (rng.random((3, n)) < 0.1))
    lb, ub = x - rng.random(n), x + rng.random(n)
    fixed = rng.random(n) < 0.05
    lb[fixed] = ub[fixed] = x[fixed]
    if not singular:
        lb[rng.random(n) < 0.3], ub[rng.random(n) < 0.3] = -np.inf, np.inf
    P = bend.T @ bend + (0.0 if singular else 0.05) * sp.eye_array(n)
    G = sp.csr_array(sp.vstack([step, -step]))
    return dict(zip(NAMES, (sp.csr_array(P), rng.normal(size=n), G, h, some, some @ x, lb, ub), strict=True))


@pytest.mark.parametrize("seed", range(6))
def test_a_hessian_that_fills_j_in_is_solved_by_an_interior_point_to_the_same_judge(seed):
    qp = chained(seed)
    problem = lv.Problem.from_qp(*(qp[name] for name in NAMES))
    answer = lv.solve_qp(problem, tol=1e-9)
    assert answer.solution.message.startswith("interior point")
    assert answer.found
    other = lv.solve_qp(problem, "newton", tol=1e-9)
    # The least eigenvalue of P is 0.05: x is known to the error of the forces over that.
    np.testing.assert_allclose(answer.x, other.x, atol=1e-6)
    assert max(kkt(qp, answer)) <= 1e-6  # of forces and sides of size 1
    assert answer.solution.residual.relative <= 1e-6  # the judge of the constraint problem, asked later
    warm = lv.solve_qp(problem, tol=1e-9, impulse=answer.solution.impulse)
    assert warm.found
    assert warm.solution.work.get("factorisations", 0) <= answer.solution.work.get("factorisations", 0)


@pytest.mark.parametrize("seed", range(3))
def test_controls_that_are_coupled_from_stage_to_stage_are_solved_by_an_interior_point(seed):
    """States follow controls, whose changes cost: one call over velocities solves none."""
    n, nx, nu, rng = 30, 6, 3, np.random.default_rng(seed)
    step = sp.csr_array(sp.eye_array(n) - sp.eye_array(n, k=-1))
    change = sp.kron(0.1 * sp.eye_array(n) + 0.5 * step.T @ step, sp.eye_array(nu))
    turn = np.linalg.qr(rng.normal(size=(nx, nx)))[0]  # states neither grow nor fade
    states = sp.eye_array(n * nx) - sp.kron(sp.eye_array(n, k=-1), turn)
    A = sp.hstack([states, -sp.kron(sp.eye_array(n), 0.3 * rng.normal(size=(nx, nu)))])
    b = np.r_[turn @ rng.normal(size=nx), np.zeros((n - 1) * nx)]
    q = np.r_[-np.tile(rng.normal(size=nx), n), np.zeros(n * nu)]
    wide = np.r_[np.full(n * nx, np.inf), np.full(n * nu, 0.3)]
    P = sp.csr_array(sp.block_diag([sp.eye_array(n * nx), change]))
    problem = lv.Problem.from_qp(P, q, A=sp.csr_array(A), b=b, lb=-wide, ub=wide)
    answer = lv.solve_qp(problem, tol=1e-6)
    assert answer.found and "interior point" in answer.solution.message
    np.testing.assert_allclose(answer.x, lv.solve_qp(problem, "newton", tol=1e-6).x, atol=1e-4)


@pytest.mark.parametrize("seed", range(6))
def test_full_and_sparse_factors_of_the_interior_point_lead_to_one_answer(seed, monkeypatch):
    """And where neither may be made, velocities do."""
    problem = lv.Problem.from_qp(*(chained(seed)[name] for name in NAMES))
    found = {}
    for system, share in (("_Full", 0.0), ("_Sparse", 2.0)):
        monkeypatch.setattr(interior_point, "FULL", share)
        point = interior_point.InteriorPoint(problem.qp)
        assert type(point.system).__name__ == system
        found[system], proof = point.run(1e-10, NEVER, lambda impulse: None)
        assert proof is None and found[system].found
    # The least eigenvalue of P is 0.05: x is known to the error of the forces over that.
    np.testing.assert_allclose(found["_Full"].x, found["_Sparse"].x, atol=1e-7)
    monkeypatch.setattr(interior_point, "WATCHED", 0.0)
    answer = lv.solve_qp(problem)
    assert answer.found and "interior point" not in answer.solution.message
    np.testing.assert_allclose(answer.x, found["_Full"].x, atol=1e-7)


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_a_few_rows_that_contradict_each_other_among_many_are_proven_by_these(seed, coupled):
    """No turns with doubled work: it ends at the proof, and its twin is solved."""
    rng = np.random.default_rng(seed)
    n, fight = 120, rng.choice(200, 3, replace=False)
    G, x, weight = rng.normal(size=(200, n)), rng.normal(size=n), rng.uniform(0.5, 1.5, 3)
    h = G @ x + rng.uniform(0.1, 1.0, 200)
    root = rng.normal(size=(n, n)) if coupled else np.eye(n)
    box = {"lb": x - 2.0, "ub": x + 2.0} if coupled else {}
    last, side = -weight @ G[fight], -weight @ h[fight]
    P, q = root.T @ root / n + 0.1 * np.eye(n), rng.normal(size=n)
    sides = side - 0.1, side + 2.0 * weight @ (h - G @ x)[fight]
    none, twin = (
        lv.solve_qp(lv.Problem.from_qp(P, q, np.vstack([G, last]), np.append(h, at), **box)) for at in sides
    )
    assert none.solution.status is lv.Status.INFEASIBLE and not none.solution.contradicted
    assert not {turn.solver for turn in none.solution.turns} & {"nncg", "admm"}
    _, z, _ = none.qp.multipliers(none.solution.certificate)
    assert set(np.flatnonzero(z)) == {*fight, 200}
    assert twin.found


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("seed", "curved"), [(0, True), (1, True), (0, False)])
def test_forces_that_all_vanish_are_told_from_those_that_do_not(seed, curved):
    """q = 0: P x = J^T lambda = 0 is a solution if some x of P x = 0 is feasible; impulses had shrunk to 0 / 0."""
    rng = np.random.default_rng(seed)
    n, rows, root = 90, rng.normal(size=(70, 90)), rng.normal(size=(40, 90))
    P = root.T @ root if curved else np.zeros((n, n))
    problem = lv.Problem.from_qp(P, np.zeros(n), G=rows, h=rows @ rng.normal(size=n))
    answer, _ = interior_point.InteriorPoint(problem.qp).run(1e-9, NEVER, lambda impulse: None)
    assert answer.found and np.abs(P @ answer.x).max() <= 1e-7 and answer.primal_residual <= 1e-7


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("cost", "far"), [(1e-6, 1e6), (1e-8, 1e-6)])
def test_units_of_the_objective_and_of_x_are_none_of_the_interior_point(seed, cost, far):
    """P had been left so small beside J that J^T (W + delta)^-1 J hid it."""
    rng = np.random.default_rng(seed)
    root, A, x = rng.normal(size=(120, 120)), rng.normal(size=(70, 120)), rng.normal(size=120)
    P, q, b = root.T @ root, rng.normal(size=120), A @ x
    problem = lv.Problem.from_qp(cost * P, cost * far * q, A=A, b=far * b, lb=far * (x - rng.random(120)))
    found, _ = interior_point.InteriorPoint(problem.qp).run(1e-9, NEVER, lambda impulse: None)
    assert found.found
    plain = lv.solve_qp(lv.Problem.from_qp(P, q, A=A, b=b, lb=problem.qp.target[70:] / far))
    np.testing.assert_allclose(found.x / far, plain.x, atol=1e-6)  # curvatures of P along A x = b exceed 1e-3


def test_sides_of_1e20_are_infinite():
    """Relative to them any A x = b would count as fulfilled."""
    qp = chained(0)
    big = qp | {name: np.clip(qp[name], -1e20, 1e20) for name in ("h", "lb", "ub")}
    plain, other = (lv.Problem.from_qp(*(of[name] for name in NAMES)) for of in (qp, big))
    assert other == plain


@pytest.mark.parametrize("seed", range(12))
def test_units_that_are_far_from_1_end_in_an_answer(seed):
    """Impulses beyond 1e60, or P + D without a factor, had come out as errors of the input."""
    rng = np.random.default_rng(seed)
    G, x, P = rng.normal(size=(66, 70)), rng.normal(size=70), np.diag((rng.random(70) < 0.5) * 1e42)
    lv.solve_qp(lv.Problem.from_qp(P, 1e52 * G.T @ rng.normal(size=66), G, 1e10 * G @ x))
    none = 1e-40 * np.vstack([G, -G]), 1e-40 * np.r_[G @ x - 1.0, -G @ x]
    problem = lv.Problem.from_qp(np.zeros((70, 70)), np.full(70, 1e40), *none)
    answer, _ = interior_point.InteriorPoint(problem.qp).run(1e-9, NEVER, lambda impulse: None)
    assert answer is None or not answer.found


def test_a_second_factor_is_not_begun_where_the_first_tells_that_it_ends_too_late(monkeypatch):
    point = interior_point.InteriorPoint(lv.Problem.from_qp(*(chained(0)[name] for name in NAMES)).qp)
    factor = point.system.factor
    monkeypatch.setattr(point.system, "factor", lambda theta: (time.sleep(0.05), factor(theta)))
    point.run(1e-9, Deadline(0.08), lambda impulse: None)
    assert point.factorisations == 1 and point.late
