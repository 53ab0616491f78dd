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
from lavender_ext.core.assemble import mirrored, transposed
from lavender_ext.newton.program import Iterate, balanced, scaled


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


def linear_program(seed, n):
    """min q.x, A x = b, x >= 0 with sparse rows, of a known solution x and multipliers."""
    rng = np.random.default_rng(seed)
    A = sp.random_array(
        (n // 2, n), density=5.0 / n, rng=rng, data_sampler=lambda size: rng.normal(size=size)
    )
    x = rng.random(n) * (rng.random(n) < 0.5)
    q = A.T @ rng.normal(size=n // 2) + rng.random(n) * (x == 0.0)
    return {"P": sp.csr_array((n, n)), "q": q, "A": A.tocsr(), "b": A @ x, "lb": np.zeros(n)}, q @ x


@pytest.mark.parametrize(("seed", "n"), [(0, 300), (1, 800)])
def test_linear_programs_of_many_variables_reach_their_optimum(seed, n):
    """A tenth of the error is the objective's: x and multipliers are of size 1 to 100 in q.x - b.y."""
    program, optimum = linear_program(seed, n)
    answer = lv.solve_qp(lv.Problem.from_qp(**program))
    assert answer.found and [turn.solver for turn in answer.solution.turns] == ["interior point"]
    assert abs(answer.objective - optimum) <= 1e-7 * (1.0 + abs(optimum))


def steered(seed, steps=40, states=8, inputs=3):
    """A plant that runs away, one state kept below 1 at a price: inputs do not reach, so multipliers are large."""
    rng = np.random.default_rng(seed)
    grows = np.eye(states) + 0.1 * rng.normal(size=(states, states)) / np.sqrt(states)
    moves = 0.1 * rng.normal(size=(states, inputs))
    start = 2.0 * np.random.default_rng(seed + 50).normal(size=states)
    n, m, each = steps * states, steps * inputs, sp.eye_array(steps)
    cost = np.concatenate([np.tile(np.arange(states) < states // 2, steps), np.full(m, 0.1), [1e3]])
    motion = sp.kron(sp.eye_array(steps, k=-1), grows) - sp.eye_array(n)
    b = np.zeros(n)
    b[:states] = -grows @ start
    free = np.full(n, np.inf)
    return {
        "P": sp.diags_array(cost),
        "q": np.zeros(n + m + 1),
        "G": sp.hstack([sp.kron(each, np.eye(1, states)), sp.csr_array((steps, m)), -np.ones((steps, 1))]),
        "h": np.ones(steps),
        "A": sp.hstack([motion, sp.kron(each, moves), sp.csr_array((n, 1))]),
        "b": b,
        "lb": np.concatenate([-free, np.full(m, -0.5), [0.0]]),
        "ub": np.concatenate([free, np.full(m, 0.5), [np.inf]]),
    }


@pytest.mark.parametrize(("seed", "steps", "states"), [(3, 40, 8), (5, 80, 6)])
def test_a_plant_that_runs_away_is_steered_by_the_interior_point(seed, steps, states):
    """Its multipliers grow for thirty steps, and only then does the gap close."""
    program = steered(seed, steps, states)
    answer = lv.solve_qp(lv.Problem.from_qp(**program))
    assert answer.found and [turn.solver for turn in answer.solution.turns] == ["interior point"]
    x, size = answer.x, np.abs(answer.x).max()
    assert np.abs(program["A"] @ x - program["b"]).max() <= 1e-8 * size
    assert (program["G"] @ x - program["h"]).max() <= 1e-8 * size
    forces = program["P"] @ x + program["A"].T @ answer.y + program["G"].T @ answer.z + answer.z_box
    assert np.abs(forces).max() <= 1e-8 * np.abs(answer.y).max()
    assert answer.duality_gap <= 1e-8 * abs(answer.objective)


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
    assert none.solution.status is lv.Status.INFEASIBLE and none.solution.claim_check == "confirmed"
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


def laid_out(seed):
    """P (n, n), J (m, n) full, as matrices in compressed rows, q and target; some rows and columns empty."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 9)), int(rng.integers(1, 12))
    root = rng.normal(size=(n, n)) * (rng.random((n, n)) < 0.4)
    P, J = root.T @ root, rng.normal(size=(m, n)) * (rng.random((m, n)) < 0.5)
    lower = sp.csr_array(np.tril(P) + np.eye(n))  # each has its diagonal
    lower.data[lower.indptr[1:] - 1] -= 1.0
    j = sp.csr_array(J)
    j = tuple(x.astype(t) for x, t in zip((j.indptr, j.indices, j.data), "iid", strict=True))
    p = mirrored(
        *(x.astype(t) for x, t in zip((lower.indptr, lower.indices, lower.data), "iid", strict=True))
    )
    return P, J, p, j, rng.normal(size=n), rng.normal(size=m), rng


def full(matrix, shape):
    return sp.csr_array(matrix[::-1], shape=shape).toarray()


@pytest.mark.parametrize("seed", range(8))
def test_balanced_rows_and_columns_have_entries_near_1(seed):
    P, J, p, j, _, _, rng = laid_out(seed)
    m, n = J.shape
    units = 10.0 ** rng.uniform(-4, 4, n), 10.0 ** rng.uniform(-4, 4, m)
    column, row = balanced(scaled(p, units[0], units[0]), scaled(j, units[1], units[0]), 30)
    P, J = (
        (column * units[0])[:, None] * P * column * units[0],
        (row * units[1])[:, None] * J * column * units[0],
    )
    whole = np.abs(np.block([[P, J.T], [J, np.zeros((m, m))]]))
    largest = whole.max(axis=0)
    # Ruiz halves the logarithm in each pass: 30 leave 2^-30 of a factor of 1e16.
    np.testing.assert_allclose(largest[largest > 0.0], 1.0, rtol=1e-6)


@pytest.mark.parametrize("seed", range(8))
def test_columns_that_are_held_keep_their_factor_and_the_others_come_near_1_beside_them(seed):
    _, J, p, j, _, _, rng = laid_out(seed)
    n = J.shape[1]
    start, moves = 10.0 ** rng.uniform(-2, 2, n), rng.random(n) < 0.5
    nothing = np.zeros_like(p[0]), p[1][:0], p[2][:0]
    column, row = balanced(nothing, j, 40, start, moves)
    np.testing.assert_array_equal(column[~moves], start[~moves])
    J = np.abs(row[:, None] * J * column)
    for largest in (J.max(axis=0)[moves], J.max(axis=1)):
        np.testing.assert_allclose(largest[largest > 0.0], 1.0, rtol=1e-6)  # of a factor of 1e9, as above


@pytest.mark.parametrize("seed", range(8))
def test_the_iterate_measures_and_steps_as_its_formulas_say(seed):
    """And what is left of a solution with rho and delta in it."""
    _, J, p, j, q, target, rng = laid_out(seed)
    m, n = J.shape
    P, free = full(p, (n, n)), int(rng.integers(0, m + 1))
    at = Iterate(p, j, transposed(*j, n), q, target, free)
    assert at.theta.tolist() == [0.0] * free + [1.0] * (m - free)
    at.begin(rng.normal(size=n + m))
    x, lam, w = at.x.copy(), at.lam.copy(), at.w.copy()
    assert (w[:free] == 0.0).all() and min(w[free:].min(initial=1.0), lam[free:].min(initial=1.0)) > 0.0
    rows, forces, gap, left, proves = at.measure()
    dual, primal = P @ x + q - J.T @ lam, J @ x - target - w
    short = np.minimum(w, lam)[free:].max(initial=0.0)
    mean = w @ lam / m
    sizes = [np.abs(v).max() for v in (P @ x, q, J.T @ lam)]
    along = max(np.abs(J @ x).max(), np.abs(target).max())
    terms = np.array([x @ P @ x, q @ x, -target @ lam])
    np.testing.assert_allclose(rows, max(short, np.abs(primal).max()) / along, rtol=1e-12)
    np.testing.assert_allclose(forces, np.abs(dual).max() / max(sizes), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(gap, abs(terms.sum()) / np.abs(terms).max(), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(left, max(np.abs(dual).max(), np.abs(primal).max(), mean), rtol=1e-12)
    sums = (np.abs(J.T) @ np.abs(lam)).max()
    if target @ lam > 0.0:
        np.testing.assert_allclose(proves, sizes[2] / sums if sums > 0.0 else 0.0, rtol=1e-9, atol=1e-15)
    else:
        assert proves == np.inf
    theta = at.theta.copy()
    np.testing.assert_allclose(theta[free:], (w / lam)[free:], rtol=1e-15)
    system = np.block([[P + 1e-3 * np.eye(n), J.T], [J, -np.diag(theta + 1e-3)]])
    u = np.linalg.solve(system, at.right)
    whole = system - 1e-3 * np.diag(np.r_[np.ones(n), -np.ones(m)])
    rest = at.right - whole @ u
    np.testing.assert_allclose(at.left_of(u), np.abs(rest).max() / np.abs(at.right).max(), rtol=1e-9)
    np.testing.assert_allclose(at.rest, rest, atol=1e-12 * (1.0 + np.abs(rest).max()))
    if free < m:
        z, dz = lam[free:], -u[n + free :]
        ds = -w[free:] - theta[free:] * dz
        ways = [1.0, *(-v / d for v, d in zip([*w[free:], *z], [*ds, *dz], strict=True) if d < 0.0)]
        t, mu = min(ways), w[free:] @ z / (m - free)
        after = (w[free:] + t * ds) @ (z + t * dz) / (m - free)
        second = (ds * dz - mu * (after / mu) ** 3) / z
        right = at.right.copy()
        at.correct(u)
        right[n + free :] -= second
        np.testing.assert_allclose(at.right, right, rtol=1e-9, atol=1e-12 * np.abs(right).max())
    at.step(u)
    moved = np.r_[at.x - x, lam - at.lam]
    t = moved @ u / (u @ u)
    np.testing.assert_allclose(moved, t * u, atol=1e-9 * (1.0 + np.abs(u).max()))
    assert (
        0.0 < t <= 1.0 + 1e-15 * (m + n)
        and min(at.w[free:].min(initial=1.0), at.lam[free:].min(initial=1.0)) > 0.0
    )
