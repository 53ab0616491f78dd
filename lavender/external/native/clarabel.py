"""Clarabel: interior point, homogeneous embedding, second-order cones (Goulart, Chen 2024)."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.later import sparse as sp
from lavender.external.as_qp import QP, bound_rows
from lavender.external.running import Answer, Limits, set_all
from lavender.judge.solution import Status


def call(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    """One run of the backend."""
    import clarabel

    first = qp.n_zero + qp.n_nonneg
    bounds = bound_rows(qp)
    n_bounds = sum(len(at) for *_, at in bounds)
    stacked = sp.csc_matrix(sp.vstack([qp.A[:first], *(sign * m for sign, m, _, _ in bounds), qp.A[first:]]))
    rhs = np.concatenate([qp.b[:first], *(h for _, _, h, _ in bounds), qp.b[first:]])
    cones = []
    if qp.n_zero:
        cones.append(clarabel.ZeroConeT(qp.n_zero))
    if qp.n_nonneg + n_bounds:
        cones.append(clarabel.NonnegativeConeT(qp.n_nonneg + n_bounds))
    cones += [clarabel.SecondOrderConeT(size) for size in qp.soc]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.max_iter = limit.max_iter
    settings.tol_feas = limit.eps
    settings.tol_gap_abs = limit.gap
    settings.tol_gap_rel = limit.gap_relative
    settings.tol_ktratio = 1e-10
    # Where it cannot get further it says so; "almost solved" is no claim at these tolerances.
    settings.reduced_tol_feas, settings.reduced_tol_gap_abs = limit.eps, limit.gap
    settings.reduced_tol_gap_rel = limit.gap_relative
    if limit.time_limit is not None:
        settings.time_limit = limit.time_limit
    set_all(settings, extra, "clarabel")
    solver = clarabel.DefaultSolver(sp.csc_matrix(sp.triu(qp.P)), qp.q, stacked, rhs, cones, settings)
    result = solver.solve()
    name = str(result.status)
    status = {
        "Solved": Status.CONVERGED,
        "AlmostSolved": Status.STALLED,
        "InsufficientProgress": Status.STALLED,
        "PrimalInfeasible": Status.INFEASIBLE,
        "DualInfeasible": Status.INFEASIBLE,
        "AlmostPrimalInfeasible": Status.STALLED,
        "AlmostDualInfeasible": Status.STALLED,
        "MaxIterations": Status.MAX_ITERATIONS,
        "MaxTime": Status.TIME_LIMIT,
    }.get(name, Status.NUMERICAL_ERROR)
    x, z = np.array(result.x), np.array(result.z)
    zeta = np.concatenate([z[:first], z[first + n_bounds :]])
    xi = np.zeros(qp.n)
    at0 = first
    for sign, _, _, at in bounds:
        xi[at] += sign * z[at0 : at0 + len(at)]
        at0 += len(at)
    # One factorisation before the first step and one for each.
    work = {"iterations": result.iterations, "factorisations": result.iterations + 1}
    return Answer(
        status=status, words=name, x=x, zeta=zeta, xi=xi, work=work, direction=x, contradiction=zeta
    )
