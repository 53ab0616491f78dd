"""HiGHS: null-space active set (Huangfu, Hall 2018)."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.base.later import sparse as sp
from lavender.external.as_qp import QP, two_sided
from lavender.external.running import Answer, Limits, at_least
from lavender.judge.solution import Status


def call(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    """One run of the backend."""
    import highspy

    rows, low, high = two_sided(qp, False)
    model = highspy.HighsModel()
    lower = sp.csc_matrix(sp.tril(qp.P))
    model.hessian_.dim_ = qp.n
    model.hessian_.start_, model.hessian_.index_, model.hessian_.value_ = (
        lower.indptr,
        lower.indices,
        lower.data,
    )
    lp = model.lp_
    lp.num_col_, lp.col_cost_ = qp.n, qp.q
    lp.col_lower_ = np.full(qp.n, -np.inf) if qp.lb is None else qp.lb
    lp.col_upper_ = np.full(qp.n, np.inf) if qp.ub is None else qp.ub
    lp.num_row_ = len(qp.b)
    if len(qp.b):
        lp.a_matrix_.format_ = highspy.MatrixFormat.kColwise
        lp.a_matrix_.start_, lp.a_matrix_.index_, lp.a_matrix_.value_ = rows.indptr, rows.indices, rows.data
        lp.a_matrix_.num_row_, lp.a_matrix_.num_col_ = rows.shape
        lp.row_lower_, lp.row_upper_ = low, high
    solver: Any = highspy.Highs()  # type: ignore[no-untyped-call]
    settings: dict[str, Any] = {
        "output_flag": False,
        "threads": 1,
        "primal_feasibility_tolerance": at_least(limit.eps, 1e-10),
        "dual_feasibility_tolerance": at_least(limit.eps, 1e-10),
        "qp_regularization_value": 1e-13,  # its default shifts the diagonal by 1e-7: another problem
        "qp_iteration_limit": limit.max_iter,
    }
    if limit.time_limit is not None:
        settings["time_limit"] = limit.time_limit
    for key, value in {**settings, **extra}.items():
        if solver.setOptionValue(key, value) != highspy.HighsStatus.kOk:
            raise InputError(f"highs does not take the setting {key}={value!r}")
    solver.passModel(model)
    solver.run()
    status = solver.getModelStatus()
    name = solver.modelStatusToString(status)
    answer = solver.getSolution()
    x = np.array(answer.col_value) if answer.value_valid else None
    dual = answer.dual_valid
    return Answer(
        status={
            "Optimal": Status.CONVERGED,
            "Infeasible": Status.INFEASIBLE,
            "Unbounded": Status.INFEASIBLE,
            "Iteration limit reached": Status.MAX_ITERATIONS,
            "Time limit reached": Status.TIME_LIMIT,
        }.get(name, Status.NUMERICAL_ERROR),
        words=name,
        x=x,
        zeta=-np.array(answer.row_dual) if dual else None,
        xi=-np.array(answer.col_dual) if dual else None,
        work={"iterations": max(0, solver.getInfo().qp_iteration_count)},
    )
