"""Quadratic programs: signs as in OSQP and qpsolvers, errors by a judge of its own, no solution, a singular P."""

from time import perf_counter

import numpy as np
import pytest
import scipy.sparse as sp
from calls import installed
from hypothesis import given
from hypothesis import strategies as st
from kkt_truth import OF_PROGRAM as NAMES
from kkt_truth import of_program as kkt
from kkt_truth import relative_of_program as relative_kkt
from random_problems import seeds

import lavender as lv


def drawn(seed, singular=False):
    """A feasible program of up to 8 variables: rows that repeat or are empty, fixed variables, sides at infinity."""
    rng = np.random.default_rng(seed)
    n, me, mi = int(rng.integers(1, 9)), int(rng.integers(0, 3)), int(rng.integers(0, 8))
    root = rng.normal(size=(int(rng.integers(0, n + 1)), n))
    x = rng.normal(size=n)
    qp = dict.fromkeys(NAMES) | {"P": root.T @ root, "q": rng.normal(size=n)}
    if singular and rng.random() < 0.5:
        qp["P"] = np.diag(rng.integers(0, 2, n).astype(float))
    if not singular:
        qp["P"] = qp["P"] + rng.uniform(0.05, 1.0) * np.eye(n)
    if me:
        qp["A"] = rng.normal(size=(me, n))
        if rng.random() < 0.3:
            qp["A"] = np.vstack([qp["A"], qp["A"][:1]])
        qp["b"] = qp["A"] @ x
    if mi:
        qp["G"] = rng.normal(size=(mi, n)) * (rng.random((mi, 1)) < 0.8)
        qp["h"] = qp["G"] @ x + rng.random(mi) * rng.integers(0, 2, mi)
        qp["h"][rng.random(mi) < 0.1] = np.inf
    if (
        singular or rng.random() < 0.6
    ):  # a box around all variables, so that no objective falls for ever
        share = 1.0 if singular else 0.7
        fixed = rng.random(n) < 0.15
        for bound, sign in (("lb", -1.0), ("ub", 1.0)):
            some = np.where(rng.random(n) < share, x + sign * rng.random(n), sign * np.inf)
            qp[bound] = np.where(fixed, x, some)
    return qp


@given(seed=seeds, tol=st.sampled_from([1e-3, 1e-6]), off=st.integers(-9, 0))
def test_solve_qp_found_holds_by_the_errors_of_osqp(seed, tol, off):
    """The three errors of OSQP's paper, from the arrays as given; the objective is within the tolerance, too."""
    qp = drawn(seed, singular=bool(seed % 2))
    rng = np.random.default_rng(seed)
    problem = lv.Problem.from_qp(**qp)
    best = lv.solve_qp(problem, tol=1e-9)
    wrong = best.impulse + 10.0**off * rng.normal(size=len(best.impulse)) * np.abs(best.impulse)
    answer = problem.qp.solution(np.clip(wrong, problem.cones.lower, problem.cones.upper), tol)
    primal, dual, gap, cancelled = relative_kkt(qp, answer)
    # Each row is compared with its own terms, which are no larger than all; acting rows may give a zero row some.
    if answer.found:
        assert primal <= 10.0 * tol and dual <= tol * (1.0 + 1e-9)
        assert gap <= 10.0 * tol or cancelled < 1e-4  # a sum over rows, of which each is within tol
    if max(primal, dual, gap) <= 1e-3 * tol:
        assert answer.found, (answer.error, primal, dual, gap)
    if answer.found and best.found and cancelled > 1e-2:
        size = np.abs(best.impulse).sum() + np.abs(best.x).sum() + 1.0
        assert abs(answer.objective - best.objective) <= 10.0 * tol * size * (
            1.0 + abs(best.objective)
        )


def sparse(qp, make=sp.csc_matrix):
    return {k: make(v) if k in "PGA" and v is not None else v for k, v in qp.items()}


@given(seed=seeds)
def test_solve_qp_answer_has_no_residual_and_no_gap(seed):
    qp = drawn(seed)
    answer = lv.solve_qp(lv.Problem.from_qp(**qp))
    # Relative to v* or x, of programs whose entries are near 1; multipliers divide by rows that are nearly dependent.
    size = 1.0 + np.abs(answer.x).sum() + np.abs(answer.impulse).sum()
    found = kkt(qp, answer)
    assert max(found) <= 1e-7 * size
    own = answer.primal_residual, answer.dual_residual, answer.duality_gap
    np.testing.assert_allclose(own, found, atol=1e-11 * size**2)  # rounding alone
    assert answer.found
    x = answer.x
    np.testing.assert_allclose(
        answer.objective, 0.5 * x @ qp["P"] @ x + qp["q"] @ x, atol=1e-11 * size**2
    )


def nearly_singular(seed):
    """A bounded or one-sided program whose P has a condition of 1e4 to 1e10, in five ways."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 41))
    least = 10.0 ** -rng.uniform(4.0, 10.0)
    spread = least ** rng.random(n)
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    load = rng.normal(size=(n, 1 + n // 3))
    chain = np.diff(np.eye(n), axis=0)
    P = (
        (turn * spread) @ turn.T,
        np.diag(spread),
        np.diag(np.where(rng.random(n) < 0.5, 1.0, least)),
        load @ load.T / n + least * np.eye(n),
        chain.T @ chain + least * np.eye(n),
    )[seed % 5]
    G = rng.normal(size=(int(rng.integers(n, 4 * n)), n))
    x = rng.normal(size=n)
    qp = dict.fromkeys(NAMES) | {"P": 0.5 * (P + P.T), "q": rng.normal(size=n), "G": G}
    qp["h"] = G @ x + rng.exponential(size=len(G)) * rng.integers(0, 2, len(G))
    box = rng.exponential(size=(2, n)) if rng.random() < 0.7 else np.full((2, n), np.inf)
    return qp | {"lb": x - box[0], "ub": x + box[1]}


@given(seed=seeds)
def test_solve_qp_with_a_nearly_singular_p_is_solved(seed):
    qp = nearly_singular(seed)
    answer = lv.solve_qp(lv.Problem.from_qp(**qp), tol=1e-8)
    assert answer.error <= 1e-6, str(answer)  # one in 400 is not found: x of 1e9 without rows
    if not answer.found:
        return
    primal, dual, _ = kkt(qp, answer)
    # `error` is relative to forces and velocities; those of x are sums of n terms, each its own size.
    assert primal <= 1e-7 * np.abs(qp["G"] @ answer.x).max() + 1e-7
    assert dual <= 1e-7 * max(np.abs(qp["q"]).max(), np.abs(qp["G"].T @ answer.z).max())


@pytest.mark.filterwarnings(
    "ignore:Converted", "ignore:The default value of raise_error", "ignore:Direct access"
)
@pytest.mark.parametrize("backend", ["osqp", "piqp", "daqp"])
@given(seed=seeds)
def test_x_and_multipliers_equal_qpsolvers(backend, seed):
    qpsolvers = pytest.importorskip("qpsolvers")
    if backend not in qpsolvers.available_solvers:
        pytest.skip(f"{backend} is not installed")
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(4, 4))
    inside = rng.uniform(-0.4, 0.4, 4)
    G, A = rng.normal(size=(1, 4)), rng.normal(size=(1, 4))
    lb = np.array([-0.4, -np.inf, -0.5, -np.inf])
    ub = np.array([0.4, 0.5, np.inf, np.inf])
    hessian = root.T @ root + 0.5 * np.eye(4)
    q = 3.0 * rng.normal(size=4)
    qp = qpsolvers.Problem(hessian, q, G, G @ inside, A, A @ inside, lb, ub)
    tight = {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 100_000} if backend == "osqp" else {}
    other = qpsolvers.solve_problem(qp, solver=backend, **tight)
    answer = lv.solve_qp(lv.Problem.from_qp(qp))
    assert other.is_optimal(1e-5)
    size = 1.0 + max(np.abs(part).max() for part in (answer.x, answer.y, answer.z, answer.z_box))
    for name in (
        "x",
        "y",
        "z",
        "z_box",
    ):  # wrong by the backend's tolerance over curvatures and angles of rows
        np.testing.assert_allclose(
            getattr(answer, name), getattr(other, name), atol=1e-3 * size, err_msg=name
        )


@given(seed=seeds)
def test_from_qp_of_sparse_and_dense_matrices_is_the_same_problem(seed):
    qp = drawn(seed)
    dense = lv.Problem.from_qp(**qp)
    for make in (sp.csc_matrix, sp.csr_array, sp.coo_array, sp.lil_matrix):
        other = lv.Problem.from_qp(**sparse(qp, make))
        assert other == dense
        assert lv.solve_qp(other).x.tobytes() == lv.solve_qp(dense).x.tobytes()
    fortran = {k: None if v is None else np.asfortranarray(v) for k, v in qp.items()}
    assert lv.Problem.from_qp(**fortran) == dense


# -- rows that do not act --------------------------------------------------------------------------


def with_far_rows(qp, seed, far):
    """The program with more rows of G that are satisfied by far, of any direction."""
    rng = np.random.default_rng(seed)
    n = len(qp["q"])
    more = rng.normal(size=(3, n)) * 10.0 ** rng.uniform(-3.0, 3.0, (3, 1))
    G, h = (np.zeros((0, n)), []) if qp["G"] is None else (qp["G"], qp["h"])
    return qp | {
        "G": np.vstack([G, more]),
        "h": np.concatenate([h, far * rng.uniform(1.0, 2.0, 3)]),
    }


@given(seed=seeds, far=st.integers(4, 19), off=st.sampled_from([0.0, 1e-6, 1e-2]))
def test_solve_qp_error_does_not_depend_on_inactive_rows(seed, far, off):
    """An unsatisfied equation was hidden by a bound of 1e9: the largest target of any row was what errors were over."""
    qp = drawn(seed)
    one = lv.Problem.from_qp(**qp)
    two = lv.Problem.from_qp(**with_far_rows(qp, seed, 10.0**far))
    impulse = lv.solve_qp(one).impulse
    impulse = impulse * (1.0 + off) + (off if len(impulse) else 0.0)
    kept = one.qp.n_inequalities or 0 if one.qp.kept is None else len(one.qp.kept)
    end = one.qp.free + kept
    more = np.concatenate([impulse[:end], np.zeros(3), impulse[end:]])
    here, there = one.qp.solution(impulse), two.qp.solution(more)
    np.testing.assert_array_equal(here.x, there.x)
    assert there.error == pytest.approx(here.error, rel=1e-9, abs=1e-15)


def test_solve_qp_within_the_tolerance_of_the_program_has_converged(plug_in):
    """Residuals of the constraint problem are relative to its own start; those of the program decide."""

    def run(problem, impulse):
        impulse[:] = (1.0 + 1e-7) * lv.solve(problem, "newton", tol=1e-12).impulse
        return lv.Claim(lv.Status.STALLED, 1, message="its last digits")

    # v* is far from x, so that the program's error is larger than the residual.
    problem = lv.Problem.from_qp(
        2.0 * np.eye(2), [-4.0, -2.0], A=[[1.0, 1.0]], b=[1.0], ub=[5.0, 5.0]
    )
    answer = lv.solve_qp(problem, plug_in(run), tol=1e-6)
    assert (
        answer.found and answer.solution.status is lv.Status.CONVERGED and answer.solution.success
    )


# -- what has no solution --------------------------------------------------------------------------


def test_solve_qp_of_an_infeasible_program_has_the_residual_of_its_impulse():
    """Of more than 64 rows an interior point proves it; impulses are within their bounds and judged as they are."""
    rng = np.random.default_rng(0)
    n = 40
    root = rng.normal(size=(n, n))
    G = rng.normal(size=(120, n))
    h = G @ rng.normal(size=n)
    problem = lv.Problem.from_qp(
        root.T @ root, rng.normal(size=n), G=np.vstack([G, -G[0]]), h=[*h, -h[0] - 1.0]
    )
    solution = lv.solve_qp(problem).solution
    assert solution.status is lv.Status.INFEASIBLE and solution.claim_check == "confirmed"
    assert (solution.impulse >= 0.0).all()
    assert solution.residual.relative == lv.residual(problem, solution.impulse).relative


@pytest.mark.parametrize(
    ("hessian", "q", "rows"),
    [
        (np.zeros((2, 2)), [-1.0, 0.0], {"lb": [0.0, 0.0]}),
        (np.diag([1.0, 0.0]), [1.0, -1.0], {"G": [[1.0, 0.0]], "h": [1.0]}),
        (np.ones((2, 2)), [1.0, -1.0], {"A": [[0.0, 0.0]], "b": [0.0]}),
        (np.zeros((2, 2)), [8.0, -28.0], {"lb": [-0.5, 0.5], "ub": [0.25, np.inf]}),
        *(
            (np.zeros((2, 2)), [-1.0, 0.0], {"G": -np.eye(2), "h": h})
            for h in ([-2.0, -1.0], [-0.5, 3.0])
        ),
    ],
)
@pytest.mark.parametrize("tol", [1e-3, 1e-6, 1e-9])
def test_solve_qp_of_an_unbounded_program_returns_a_ray(hessian, q, rows, tol):
    answer = lv.solve_qp(lv.Problem.from_qp(hessian, q, **rows), tol=tol)
    assert not answer.found
    assert str(answer).startswith("unbounded: the objective decreases without end")
    d = answer.ray
    assert np.abs(d).max() == 1.0
    np.testing.assert_allclose(hessian @ d, 0.0, atol=1e-6)
    assert np.dot(q, d) < -0.5
    assert rows.get("lb") is None or d.min() >= -1e-6
    assert (
        "G" not in rows
        or ((rows["G"] @ answer.x <= np.array(rows["h"]) + 1e-9) & (rows["G"] @ d <= 1e-12)).all()
    )


@pytest.mark.parametrize("solver", ["auto", "osqp"])
@pytest.mark.parametrize("tol", [1e-3, 1e-9])
def test_infeasible_program_is_never_called_unbounded(solver, tol):
    """x_0 falls for ever; rows ask x_1 + x_2 <= -1 and >= 1, and x_2 <= 1 + x_0 for a coupling."""
    rows = np.array([[0.0, 1.0, 1.0], [0.0, -1.0, -1.0], [-1.0, 0.0, 1.0]])
    program = {"P": np.diag([0.0, 1.0, 0.0]), "q": [-1.0, 0.5, 0.0], "G": rows}
    none, some = (
        lv.solve_qp(lv.Problem.from_qp(**program, h=[-1.0, side, 1.0]), solver, tol=tol)
        for side in (-1.0, 1.0)
    )
    assert none.ray is None and not none.found
    assert some.ray is not None and not some.found


# -- a singular P ----------------------------------------------------------------------------------

SINGULAR = lv.Problem.from_qp(
    np.diag([1.0, 0.0]), [1.0, 1.0], G=[[1.0, 1.0]], h=[1.0], lb=[-4.0, -4.0]
)
BACKENDS = [name for name in lv.available(SINGULAR) if name != "auto"]


def test_solve_qp_with_a_singular_p_runs_a_backend_that_is_named():
    P = np.array([[2.0, 2.0, 0.0], [2.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
    problem = lv.Problem.from_qp(
        P, [-1.0, -1.0, 1.0], A=[[1.0, 1.0, 1.0]], b=[1.0], lb=np.zeros(3), name="flat"
    )
    assert problem.generalized is None and problem.has_singular_program
    np.testing.assert_array_equal(problem.dense()[:3, :3], P)
    np.testing.assert_array_equal(problem.qp.generalized.mass.toarray(), P)
    first = next(name for name in ("piqp", "clarabel", "osqp") if name in BACKENDS)
    for solution in (
        lv.solve(problem, tol=1e-9),
        lv.solve_qp(problem).solution,
        lv.prepare(problem).solve(),
    ):
        assert solution.stages[0].solver == first and first in solution.message
        assert (
            solution.success
            and solution.residual.relative == lv.residual(problem, solution.impulse).relative
        )
    plan = lv.explain(problem)
    assert plan.stages[0].solver == first and first in str(plan)
    assert problem.row_name(2) == "variable 2" and problem.row_name(3) == "constraint 0"


def test_program_is_singular_from_a_pivot_of_1e_13():
    for pivot, is_singular in ((1e-12, False), (1e-15, True)):
        beside = np.sqrt(1.0 - pivot)
        problem = lv.Problem.from_qp([[1.0, beside], [beside, 1.0]], [1.0, 1.0], lb=[-1.0, -1.0])
        assert problem.has_singular_program == is_singular
        assert lv.solve_qp(problem).found
    tiny = lv.Problem.from_qp(
        np.diag([1.0, 1e-20]), [1.0, 1e-20]
    )  # each pivot is its diagonal entry
    assert not tiny.has_singular_program


def test_solve_many_and_updated_accept_singular_programs():
    many = lv.solve_many([SINGULAR, SINGULAR, lv.Problem.lcp(np.eye(2), [1.0, 1.0])], tol=1e-9)
    assert many.success.all()
    np.testing.assert_array_equal(many[0].impulse, lv.solve(SINGULAR, tol=1e-9).impulse)
    answer = lv.solve_qp(SINGULAR)
    warm = lv.solve_qp(SINGULAR, impulse=answer.solution.impulse)
    assert warm.found and warm.solution.iterations == 0
    other = SINGULAR.updated(b=1.5 * SINGULAR.b)  # q and all sides times 1.5
    np.testing.assert_allclose(lv.solve_qp(other).x, 1.5 * answer.x, atol=1e-6)


@pytest.mark.parametrize("limit", [1e-6, 5.0])
def test_solve_qp_of_a_singular_program_ends_at_its_time_limit(limit):
    answer = lv.solve_qp(SINGULAR, time_limit=limit)
    assert (
        answer.found if limit > 1.0 else answer.solution.status.name in ("TIME_LIMIT", "CONVERGED")
    )


@pytest.mark.parametrize(("seed", "n"), [(0, 300), (1, 800)])
def test_linear_programs_of_many_variables_reach_their_optimum(seed, n):
    rng = np.random.default_rng(seed)
    A = sp.random_array(
        (n // 2, n), density=5.0 / n, rng=rng, data_sampler=lambda size: rng.normal(size=size)
    )
    x = rng.random(n) * (rng.random(n) < 0.5)
    q = A.T @ rng.normal(size=n // 2) + rng.random(n) * (x == 0.0)
    problem = lv.Problem.from_qp(sp.csr_array((n, n)), q, A=A.tocsr(), b=A @ x, lb=np.zeros(n))
    answer = lv.solve_qp(problem)
    assert answer.found and abs(answer.objective - q @ x) <= 1e-7 * (1.0 + abs(q @ x))


@pytest.mark.parametrize("seed", range(3))
def test_solve_qp_without_forces_is_found_only_if_rows_hold(seed):
    """q = 0: every x of P x = 0 that fulfils the rows is a solution."""
    rng = np.random.default_rng(seed)
    n = 90
    rows = rng.normal(size=(70, 90))
    root = rng.normal(size=(40, 90))
    P = root.T @ root
    answer = lv.solve_qp(lv.Problem.from_qp(P, np.zeros(n), G=rows, h=rows @ rng.normal(size=n)))
    assert answer.found and np.abs(P @ answer.x).max() <= 1e-6 and answer.primal_residual <= 1e-7


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("side", [1.0, 0.0])
def test_two_rows_over_a_singular_p_that_contradict_each_other_are_infeasible(unit, side):
    """a.x = 1 and 3 a.x = 4, or a.x <= -1 and 3 a.x >= 0, whose violations are small relative to a large x."""
    rng = np.random.default_rng(3)
    a = rng.normal(size=11)
    root = rng.normal(size=(11, 5))
    rows = {"A": [a, 3.0 * a], "b": [1.0, 4.0]} if side else {"G": [a, -3.0 * a], "h": [-1.0, 0.0]}
    answer = lv.solve_qp(unit * root @ root.T, np.zeros(11), **rows)
    assert answer.solution.status is lv.Status.INFEASIBLE and not answer.found
    assert not lv.solve_qp(unit * root @ root.T, np.zeros(11), max_iter=10_000, **rows).found


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2))]
)
def test_solve_qp_of_contradicting_rows_among_many_returns_a_proof(seed):
    rng = np.random.default_rng(seed)
    n = 120
    conflict = rng.choice(200, 3, replace=False)
    G = rng.normal(size=(200, n))
    x = rng.normal(size=n)
    weight = rng.uniform(0.5, 1.5, 3)
    h = G @ x + rng.uniform(0.1, 1.0, 200)
    last, side = -weight @ G[conflict], -weight @ h[conflict]
    P = np.diag((rng.random(n) < 0.5).astype(float))
    box = {"lb": x - 2.0, "ub": x + 2.0}
    sides = side - 0.1, side + 2.0 * weight @ (h - G @ x)[conflict]
    none, some = (
        lv.solve_qp(
            lv.Problem.from_qp(P, rng.normal(size=n), np.vstack([G, last]), np.append(h, at), **box)
        )
        for at in sides
    )
    assert none.solution.status is lv.Status.INFEASIBLE and none.solution.claim_check == "confirmed"
    _, z, z_box = none.qp.multipliers(none.solution.certificate)
    h = np.append(h, sides[0])
    assert h @ z + np.maximum(z_box, 0.0) @ box["ub"] - np.maximum(-z_box, 0.0) @ box["lb"] < 0.0
    assert some.found


# -- what is refused -------------------------------------------------------------------------------


def test_solve_qp_found_holds_to_the_requested_tolerance():
    rng = np.random.default_rng(0)
    for n in (3, 10, 30):
        root, rows = rng.normal(size=(n, n)), rng.normal(size=(n, n))
        for p in (root @ root.T, root[:, :2] @ root[:, :2].T):
            problem = lv.Problem.from_qp(
                p, rng.normal(size=n), G=rows, h=np.ones(n), lb=-np.ones(n), ub=np.ones(n)
            )
            for tol in (1e-2, 1e-5, 1e-9):
                answer = lv.solve_qp(problem, tol=tol)
                assert answer.found and answer.error <= tol
            # Another demand on the same answer: its impulses alone have the default of 1e-6.
            rough = problem.qp.solution((1.0 + 1e-4) * answer.impulse)
            assert rough.found == (rough.error <= 1e-6)
            strict = lv.solve_qp(problem, tol=0.0)
            assert strict.found == (strict.error == 0.0) == str(strict).startswith("solved")


def test_solve_qp_with_a_contradicted_claim_is_not_found(plug_in):
    def run(problem, impulse):
        impulse[:] = 0.5 * lv.solve(problem, "newton", tol=1e-12).impulse
        return lv.Claim(lv.Status.CONVERGED, 1)

    problem = lv.Problem.from_qp(
        2.0 * np.eye(2), [-4.0, -2.0], A=[[1.0, 1.0]], b=[1.0], ub=[1e9, 1e9]
    )
    answer = lv.solve_qp(problem, plug_in(run))
    assert answer.solution.claim_check == "contradicted" and "CONTRADICTED" in str(answer)
    assert not answer.found and not str(answer).startswith("solved")


def test_solve_qp_limits_reach_the_solver_and_a_start_that_is_a_solution_is_returned():
    rng = np.random.default_rng(0)
    n = 40
    half = rng.normal(size=(n, n))
    problem = lv.Problem.from_qp(
        half @ half.T + 1e-6 * np.eye(n),
        rng.normal(size=n),
        rng.normal(size=(60, n)),
        rng.uniform(0.1, 1.0, 60),
    )
    begin = perf_counter()
    answer = lv.solve_qp(problem, "pgs", tol=1e-15, time_limit=0.05, max_iter=10**8)
    assert answer.solution.status is lv.Status.TIME_LIMIT and perf_counter() - begin < 10.0
    answer = lv.solve_qp(problem, "pgs", tol=1e-12, max_iter=3)
    assert answer.solution.status is lv.Status.MAX_ITERATIONS and answer.solution.work == {
        "sweeps": 3
    }
    solved = lv.solve_qp(problem)
    for name in ("auto", *installed("osqp", "clarabel")):
        again = lv.solve_qp(problem, name, tol=1e-6, impulse=solved.impulse)
        assert again.found and not any(again.solution.work.values()), name
        np.testing.assert_allclose(again.x, solved.x, atol=1e-12)
    # A start near the solution is better than the point of a backend that is stopped early: the answer says so.
    start = (1.0 + 1e-6) * solved.impulse
    for name in installed("clarabel", "daqp", "highs", "piqp", "qpalm"):
        answer = lv.solve_qp(problem, name, tol=1e-12, impulse=start, max_iter=1)
        is_of_start = np.array_equal(answer.impulse, start)
        assert is_of_start == ("the start" in answer.solution.message), name
        assert is_of_start == (answer.solution.status is lv.Status.STALLED), name
        assert "is a solution" not in answer.solution.message, name


@pytest.mark.parametrize(
    "solver", ["auto", "newton", *installed("clarabel", "piqp", "daqp", "quadprog", "osqp")]
)
@pytest.mark.parametrize("h", [[], [1.0, 0.0], [1.0, -1.0]])
@pytest.mark.parametrize("b", [[], [0.0], [0.0, 1e-3], [-2.0]])
def test_program_without_variables_is_found_unless_a_row_contradicts_itself(solver, h, b):
    rows = {"G": np.zeros((len(h), 0)), "h": np.array(h)} if h else {}
    rows |= {"A": np.zeros((len(b), 0)), "b": np.array(b)} if b else {}
    answer = lv.solve_qp(P=np.zeros((0, 0)), q=np.zeros(0), solver=solver, **rows)
    is_solvable = min(h, default=0.0) >= 0.0 and not np.any(b)
    assert answer.found == is_solvable and (
        answer.x.shape == (0,) if is_solvable else answer.x is None
    )
    assert answer.solution.status is (lv.Status.CONVERGED if is_solvable else lv.Status.INFEASIBLE)


PLACEHOLDERS = [1e4, 1e7, 1e9, 1e12, 1e15, 1e17, 9e19]


@pytest.mark.parametrize(
    "name", lv.available(lv.Problem.from_qp(np.eye(2), np.zeros(2), lb=np.zeros(2)))
)
@pytest.mark.parametrize("tol", [1e-6, 1e-9])
def test_solve_qp_with_placeholder_bounds_fulfils_its_equation(name, tol):
    """(x - 2)^2 + (y - 1)^2 with x + y = 1 is least at (1, 0); (2, 1) was found, or x off by 1.7."""
    for far in PLACEHOLDERS:
        problem = lv.Problem.from_qp(
            2.0 * np.eye(2), [-4.0, -2.0], A=[[1.0, 1.0]], b=[1.0], ub=[far, far], lb=[-far, -far]
        )
        answer = lv.solve_qp(problem, name, tol=tol)
        if answer.found:
            np.testing.assert_allclose(answer.x, [1.0, 0.0], atol=10.0 * tol)
        # quadprog needs a definite A; rounding of a bound of 1e9 is 1e-7.
        if name != "quadprog" and far <= (1e12 if lv.get(name).external else 1e7):
            assert answer.found, str(answer)


def test_solve_qp_error_ignores_the_multiplier_of_a_far_row():
    """The gap of 1e-4 of a multiplier of 1e-10 at a bound of 1e6 is a residual, and the point is a solution."""
    problem = lv.Problem.from_qp(
        2.0 * np.eye(2), [-4.0, -2.0], A=[[1.0, 1.0]], b=[1.0], ub=[1e6, 1e6]
    )
    impulse = lv.solve_qp(problem, "newton", tol=1e-12).impulse.copy()
    impulse[-1] = 1e-10
    answer = problem.qp.solution(impulse, 1e-9)
    assert answer.duality_gap == pytest.approx(1e-4, rel=1e-3)
    assert answer.found and answer.error <= 1e-10


def test_solve_qp_violation_of_cancelling_terms_is_relative_to_their_sum():
    """A second difference of 1e7 - 2e7 + 1e7 is violated by 0.5, which is 2.5e-8 of the sum of its terms."""
    difference = 1000.0 * np.array([[1.0, -2.0, 1.0]])
    problem = lv.Problem.from_qp(
        np.zeros((3, 3)),
        [1.0, -2.0, 0.0],
        G=-difference,
        h=[1.0],
        A=[[0, 0, 1.0], [1.0, 0, 0]],
        b=[5e3, 5e3],
    )
    answer = lv.solve_qp(problem)
    np.testing.assert_allclose(answer.x, 5e3, rtol=1e-6)
    impulse = answer.impulse.copy()
    impulse[1] += 2.5e-4  # a violation of 0.5
    off = problem.qp.solution(impulse, 1e-8)
    assert off.primal_residual == pytest.approx(0.5, rel=1e-3)
    assert answer.found and not off.found
    multipliers = problem.qp.select_row_multipliers(impulse)
    assert problem.qp.judge(off.x, multipliers)[2] == pytest.approx(2.5e-8, rel=1e-3)


def test_solve_qp_error_adds_gaps_of_opposite_signs():
    problem = lv.Problem.from_qp(np.zeros((2, 2)), [1.0, 1.0], lb=[1.0, 1.0])
    exact = lv.solve_qp(problem, tol=1e-12).impulse
    off = problem.qp.solution(exact + np.array([1e-3, -1e-3, 0.0, 0.0]), 1e-6)
    assert off.duality_gap <= 1e-9 and off.error >= 0.9e-3


@pytest.mark.parametrize(
    "solver", ["auto", "newton", "osqp", *installed("piqp", "clarabel", "daqp")]
)
@pytest.mark.parametrize("side", [7e-18, 1e-15])
def test_row_of_zeros_with_a_side_of_rounding_holds_with_a_warning(solver, side):
    with pytest.warns(UserWarning, match=r"without coefficients.*G\[0\]"):
        problem = lv.Problem.from_qp(
            np.eye(2), [-1.0, -2.0], G=[[0.0, 0.0], [1.0, 1.0]], h=[-side, 100.0]
        )
    answer = lv.solve_qp(problem, solver, tol=1e-6)
    assert answer.found
    np.testing.assert_allclose(answer.x, [1.0, 2.0], rtol=1e-5)
    with pytest.warns(UserWarning, match="without coefficients"):
        assert lv.solve_qp(problem, solver, h=[-side, 101.0], tol=1e-6).found


@pytest.mark.parametrize("solver", ["auto", "newton", "osqp"])
@pytest.mark.parametrize("h", [[-1e-12, 100.0], [-1e-15, 1e-9], [-np.inf, 1e17]])
def test_row_of_zeros_that_no_x_satisfies_is_named(solver, h):
    # A bound is no right-hand side of G or A.
    arrays = {"P": np.eye(2), "q": [-1.0, -2.0], "G": [[0.0, 0.0], [1.0, 1.0]], "ub": [1e16, 1e16]}
    answer = lv.solve_qp(**arrays, h=h, solver=solver, tol=1e-6)
    assert answer.solution.status is lv.Status.INFEASIBLE and not answer.found
    assert answer.x is None and answer.error == np.inf and np.isnan(answer.objective)
    assert answer.solution.message.endswith("contradicting rows: G[0]") and "infeasible" in str(
        answer
    )


@pytest.mark.parametrize(
    "solver", installed("piqp", "osqp", "clarabel", "daqp", "highs", "scs", "qpalm", "quadprog")
)
def test_backend_that_does_not_run_has_no_point(solver):
    for n in (2, 3, 40):
        q = -np.arange(1.0, n + 1.0)
        answer = lv.solve_qp(np.eye(n), q, lb=-np.ones(n), ub=np.ones(n), solver=solver, max_iter=0)
        assert (
            answer.solution.status is lv.Status.MAX_ITERATIONS and answer.solution.iterations == 0
        )
        assert not answer.found and not answer.x.any()


@pytest.mark.parametrize("solver", installed("piqp", "osqp", "scs", "qpalm"))
def test_backend_that_refuses_its_settings_has_no_point(solver):
    for n in (2, 3, 40):
        q = -np.arange(1.0, n + 1.0)
        answer = lv.solve_qp(
            np.eye(n), q, lb=-np.ones(n), ub=np.ones(n), solver=solver, settings={"eps_abs": -1.0}
        )
        assert (
            answer.solution.status is lv.Status.NUMERICAL_ERROR and answer.solution.iterations == 0
        )
        assert not answer.found and not answer.x.any()
