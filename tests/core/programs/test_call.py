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
    assert lv.qp.solve_qp(P, q, lb=np.ones(2), ub=np.zeros(2)) is None
    assert lv.qp.solve_problem(qpsolvers.Problem(P, q, *ROWS.values())).found


def test_available_solvers_solve_a_program():
    assert {"auto", "newton", "osqp"} <= set(
        lv.available_solvers
    ) and lv.available_solvers is lv.qp.available_solvers
    for name in lv.available_solvers:
        assert lv.solve_qp(P, q, lb=[0.0, 0.0], solver=name, tol=1e-6).found, name


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
