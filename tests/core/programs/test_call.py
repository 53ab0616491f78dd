"""The calls of qpsolvers: arguments of `solve_qp`, `lavender.qp`, and outcomes of infeasible input."""

import inspect

import numpy as np
import pytest
import scipy.sparse as sp
from calls import installed

import lavender as lv

P = np.array([[4.0, 1.0], [1.0, 2.0]])
q = np.array([1.0, 1.0])
ROWS = {
    "G": np.array([[-1.0, 1.0]]),
    "h": np.array([0.0]),
    "A": np.array([[1.0, 1.0]]),
    "b": np.array([1.0]),
}
X = np.array([0.5, 0.5])


@pytest.mark.filterwarnings("ignore:Converted", "ignore:The default value of raise_error")
def test_qp_solve_qp_has_the_signature_and_the_result_of_qpsolvers():
    qpsolvers = pytest.importorskip("qpsolvers")
    own, other = (inspect.signature(module.solve_qp).parameters for module in (lv.qp, qpsolvers))
    assert list(own) == list(other)
    assert [own[name].default for name in own] == [other[name].default for name in other]
    box = {"lb": np.zeros(2), "ub": np.full(2, 0.7)}
    for name in installed("osqp", "clarabel", "piqp", "daqp"):
        here, there = (
            m.solve_qp(P, q, **ROWS, **box, solver=name, verbose=False) for m in (lv.qp, qpsolvers)
        )
        np.testing.assert_allclose(here, there, atol=2e-3)  # OSQP stops at 1e-3
        np.testing.assert_allclose(here, X, atol=1e-6)
        here[0] = 1.0  # x is the caller's own array
    assert lv.qp.solve_qp(P, q, lb=np.ones(2), ub=np.zeros(2), solver="auto") is None
    assert lv.qp.solve_problem(qpsolvers.Problem(P, q, *ROWS.values())).found


@pytest.mark.filterwarnings("ignore:Converted")
@pytest.mark.parametrize("solver", ["auto", *installed("osqp", "clarabel", "daqp")])
def test_qp_solution_has_the_fields_and_methods_of_qpsolvers(solver):
    qpsolvers = pytest.importorskip("qpsolvers")
    for arrays in (
        {},
        ROWS,
        {"G": ROWS["G"], "h": [np.inf]},
        {"lb": [0.0, -np.inf], "ub": [0.2, 9.0]},
    ):
        problem = qpsolvers.Problem(P, q, **{name: np.array(x) for name, x in arrays.items()})
        own = lv.qp.solve_problem(problem, solver)
        assert own.found and own.is_optimal(1e-8) and own.problem is problem
        other = qpsolvers.Solution(
            problem, found=True, x=own.x, y=own.y, z=own.z, z_box=own.z_box, obj=own.obj
        )
        for name in ("primal_residual", "dual_residual"):
            assert getattr(own, name)() == pytest.approx(getattr(other, name)(), abs=1e-12)
        if "h" not in arrays or np.isfinite(arrays["h"]).all():  # qpsolvers: inf times 0
            assert own.duality_gap() == pytest.approx(other.duality_gap(), abs=1e-12)
        sizes = [0 if name not in arrays else len(arrays[name]) for name in ("b", "h", "ub")]
        assert [len(part) for part in (own.y, own.z, own.z_box)] == sizes
        assert own.obj == pytest.approx(0.5 * own.x @ P @ own.x + q @ own.x)
        assert min(own.build_time, own.solve_time) >= 0.0 and own.extras["answer"].found
    lost = lv.qp.solve_problem(qpsolvers.Problem(P, q, lb=np.ones(2), ub=np.zeros(2)), solver)
    assert lost.found is False and lost.x is None and lost.obj is None
    assert lost.primal_residual() == lost.dual_residual() == lost.duality_gap() == np.inf
    assert lv.qp.Solution(problem).found is None and not lv.qp.Solution(problem).is_optimal(1.0)


def test_qp_has_the_names_of_qpsolvers():
    qpsolvers = pytest.importorskip("qpsolvers")
    assert not [name for name in qpsolvers.__all__ if not hasattr(lv.qp, name)]
    assert lv.qp.Problem is qpsolvers.Problem and lv.qp.ProblemError is qpsolvers.ProblemError
    assert set(lv.qp.sparse_solvers) | set(lv.qp.dense_solvers) == set(lv.qp.available_solvers)
    np.testing.assert_allclose(lv.qp.osqp_solve_qp(P, q, **ROWS), X, atol=1e-8)
    with pytest.raises(AttributeError, match="nosuchname"):
        _ = lv.qp.nosuchname


def test_qp_raises_the_exceptions_of_qpsolvers():
    qpsolvers = pytest.importorskip("qpsolvers")
    for error, call in (
        ("NoSolverSelected", lambda: lv.qp.solve_qp(P, q)),
        ("SolverNotFound", lambda: lv.qp.solve_qp(P, q, solver="nosuch")),
        ("ProblemError", lambda: lv.qp.solve_qp(P, np.ones(3), solver="auto")),
        ("ProblemError", lambda: lv.qp.solve_qp(-P, q, solver="auto")),
        ("ProblemError", lambda: lv.qp.solve_qp(np.zeros((2, 2)), q, solver="newton")),
        ("ProblemError", lambda: lv.qp.solve_qp(np.zeros((2, 2)), q, solver="osqp")),
        ("ParamError", lambda: lv.qp.solve_qp(P, q, solver="osqp", eps_abz=1.0)),
    ):
        with pytest.raises(getattr(qpsolvers, error)) as raised:
            call()
        assert isinstance(raised.value, lv.LavenderError), error


@pytest.mark.filterwarnings("ignore:Converted")
@pytest.mark.parametrize("sparse", [False, True])
def test_qp_solves_least_squares_as_qpsolvers_does(sparse):
    qpsolvers = pytest.importorskip("qpsolvers")
    rng = np.random.default_rng(0)
    R, s, W = rng.normal(size=(5, 3)), rng.normal(size=5), np.diag([1.0, 2.0, 3.0, 4.0, 5.0])
    rows = {"G": rng.normal(size=(2, 3)), "h": np.ones(2), "A": np.ones((1, 3)), "b": np.ones(1)}
    box = {"lb": np.full(3, -0.4), "ub": np.full(3, 0.9)}
    for W_given in (None, W):
        given = {"R": R, "s": s, **rows, **box, "W": W_given, "solver": "clarabel"}
        there = qpsolvers.solve_ls(**given, tol_feas=1e-12, tol_gap_abs=1e-12, tol_gap_rel=1e-12)
        given |= {"R": sp.csc_matrix(R), "G": sp.csc_matrix(rows["G"])} if sparse else {}
        here = lv.qp.solve_ls(**given | {"solver": "osqp", "initvals": np.zeros(3)})
        np.testing.assert_allclose(here, there, atol=1e-7)


def test_available_solvers_solve_a_program():
    assert {"auto", "osqp"} <= set(lv.available_solvers)
    assert lv.available_solvers is lv.qp.available_solvers
    for name in lv.available_solvers:
        assert lv.solve_qp(P, q, lb=[0.0, 0.0], solver=name, tol=1e-6).found, name
        assert lv.solve_qp(None, -q, ub=[1.0, 2.0], solver=name, tol=1e-6).found, name


@pytest.mark.parametrize(
    "changes",
    [
        {"q": q[:, None], "h": ROWS["h"][:, None], "b": ROWS["b"][:, None]},
        {"P": np.triu(P)},
        {"P": sp.csc_matrix(np.triu(P))},
        {"P": P + np.array([[0.0, 1e-9], [0.0, 0.0]])},
        {"initvals": np.ones(2), "verbose": False},
    ],
)
def test_solve_qp_accepts_the_arguments_of_qpsolvers(changes):
    answer = lv.solve_qp(**({"P": P, "q": q, **ROWS} | changes), solver="osqp")
    np.testing.assert_allclose(answer.x, X, atol=1e-8)
    assert answer.found and answer.obj == answer.objective and answer.is_optimal(1e-6)
    assert not answer.is_optimal(0.0)


def test_solve_qp_passes_settings_by_name_to_the_backend():
    problem = lv.Problem.from_qp(P, q, **ROWS)
    work = [
        lv.solve_qp(problem, "osqp", max_iter=100, check_termination=n).solution.work
        for n in (1, 25)
    ]
    assert work[0]["iterations"] < work[1]["iterations"]
    with pytest.raises(lv.LavenderError, match="eps_abz"):
        lv.solve_qp(problem, "osqp", eps_abz=1e-3)
    with pytest.raises(lv.LavenderError):
        lv.solve_qp(problem, "newton", eps_abs=1e-3)


def test_bounds_that_cross_by_rounding_are_equal_and_others_are_infeasible():
    answer = lv.solve_qp(P, q, lb=[0.1 + 0.2, 0.0], ub=[0.3, 1.0])
    assert answer.found
    np.testing.assert_allclose(answer.x, [0.3, 0.0], atol=1e-12)
    for name in ("auto", *installed("osqp", "clarabel", "daqp")):
        for arrays, row in (
            ({"lb": [0.0, 1.0], "ub": [1.0, 0.0]}, "lb[1], ub[1]"),
            ({"G": [[1.0, 2.0], [1.0, 0.0]], "h": [-np.inf, 1.0]}, "G[0]"),
            ({"A": [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], "b": [1.0, 1.0, 3.0]}, "A[0], A[1], A[2]"),
        ):
            answer = lv.solve_qp(P, q, **arrays, solver=name, tol=1e-6)
            assert answer.solution.status is lv.Status.INFEASIBLE and not answer.found
            assert answer.solution.message.endswith(row), answer.solution.message
