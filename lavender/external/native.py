"""Calls of backends by their own interface, one function for each.

Through qpsolvers, these backends have no warm start, and their iterations, exit flags and certificates are lost.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.base.lazy_import import sparse as sp
from lavender.external.as_qp import QP, ConicRows, make_two_sided_rows
from lavender.external.running import (
    MIN_TOLERANCE,
    Answer,
    Limits,
    capture_backend_output,
    clamp_tolerance,
    classify_status,
    copy_usable_certificate,
    keep_if_infeasibility_certificate,
    set_backend_options,
)
from lavender.judge.solution import Status

# [-] Weight of DAQP's proximal steps, for a P with unit diagonal. A much smaller weight makes steps fail: with 1e-8,
# DAQP did not solve a program that takes 64 iterations with this weight.
DAQP_PROXIMAL_WEIGHT = 1e-2
DAQP_OVERDETERMINED = -6  # Exit flag of DAQP if its first working set, the equations, has no solution.
# [-] Added to the diagonal of P by HiGHS, in units of about 1, in the first and in each repeated call. A large value
# changes the solution; with a small one, its active-set method ends at wrong points if P is singular.
HIGHS_REGULARIZATION = 1e-10, 1e-12, 1e-8
# [-] Factor of q, b and bounds passed to HiGHS, which returns solutions of about 1e-4 and below as exact zeros.
HIGHS_SCALE = 1024.0
# [-] HiGHS reports an unbounded program as optimal at a point of about the inverse of its regularisation. If the
# product of both is larger than this, the regularisation determines the answer.
MAX_HIGHS_SHIFT = 1e-3


def _merge(settings: dict[str, Any], extra: dict[str, Any]) -> dict[str, Any]:
    """Return the settings without those that are None (no time limit), overridden by the user's settings."""
    return {name: value for name, value in settings.items() if value is not None} | extra


def call_clarabel(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    """Call Clarabel: interior point, homogeneous embedding, second-order cones (Goulart, Chen 2024)."""
    import clarabel

    rows = ConicRows.from_program(qp)
    cones = [clarabel.ZeroConeT(qp.n_zero)] if qp.n_zero else []
    cones += [clarabel.NonnegativeConeT(rows.n_nonneg)] if rows.n_nonneg else []
    cones += [clarabel.SecondOrderConeT(size) for size in qp.soc]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.max_iter = limit.max_iter
    settings.tol_feas = limit.eps
    settings.tol_gap_abs = limit.gap
    settings.tol_gap_rel = limit.gap_relative
    settings.tol_ktratio = 1e-10
    # With reduced tolerances equal to the tolerances, "almost solved" is not reported for a looser tolerance.
    settings.reduced_tol_feas, settings.reduced_tol_gap_abs = limit.eps, limit.gap
    settings.reduced_tol_gap_rel = limit.gap_relative
    if limit.time_limit is not None:
        settings.time_limit = limit.time_limit
    set_backend_options(settings, extra, "clarabel")
    solver = clarabel.DefaultSolver(sp.csc_matrix(sp.triu(qp.P)), qp.q, rows.A, rows.b, cones, settings)
    result = solver.solve()
    name = str(result.status)
    status = classify_status(name)
    x, (zeta, xi) = np.array(result.x), rows.split_multipliers(np.array(result.z))
    almost = name in ("AlmostPrimalInfeasible", "AlmostDualInfeasible")
    if almost and any(part is not None for part in keep_if_infeasibility_certificate(qp, x, zeta)):
        status = Status.INFEASIBLE  # "Almost infeasible" suffices, because the judge checks the certificate.
    # There is one factorisation before the first step and one for each step.
    work = {"iterations": result.iterations, "factorisations": result.iterations + 1}
    return Answer(
        status=status, message=name, x=x, zeta=zeta, xi=xi, work=work, direction=x, contradiction=zeta
    )


def call_daqp(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    """Call DAQP: dual active set, dense (Arnström, Bemporad, Axehill 2022)."""
    import daqp

    _, low, high = make_two_sided_rows(qp, False)
    lb = np.zeros(0) if qp.lb is None else qp.lb
    ub = np.zeros(0) if qp.ub is None else qp.ub
    low, high = (np.clip(np.concatenate(p), -1e30, 1e30) for p in ((lb, low), (ub, high)))
    sense = np.zeros(len(low), np.int32)
    sense[len(lb) : len(lb) + qp.n_zero] = 5
    x0, _, _ = qp.make_start(impulse)
    settings: dict[str, Any] = {
        "iter_limit": limit.max_iter,
        "time_limit": limit.time_limit,
        "primal_tol": clamp_tolerance(limit.eps, 1e-11),
        "dual_tol": clamp_tolerance(limit.eps, 1e-13),
    }
    if limit.attempt:
        # By default, DAQP regularises a singular P by 1e-6, which leaves multipliers of this size on inactive rows.
        # Proximal steps with a small tolerance avoid them.
        settings |= {"eps_prox": DAQP_PROXIMAL_WEIGHT, "eta_prox": MIN_TOLERANCE}
    dense = qp.A.toarray() if len(qp.b) else np.zeros((0, qp.n))
    x, _, flag, info = daqp.solve(
        qp.P.toarray(), qp.q.copy(), dense, high, low, sense, primal_start=x0, **_merge(settings, extra)
    )
    message = {
        1: "optimal",
        2: "soft optimal",
        -1: "infeasible",
        -2: "cycling detected",
        -3: "unbounded",
        -4: "iteration limit",
        -5: "nonconvex",
        DAQP_OVERDETERMINED: "overdetermined initial working set",
        -7: "time limit",
    }.get(int(flag), "unknown")
    status = classify_status(message)
    multipliers = np.asarray(info["lam"])
    k = len(lb)
    direction, contradiction = keep_if_infeasibility_certificate(qp, np.asarray(x), multipliers[k:])
    if flag == DAQP_OVERDETERMINED:
        # DAQP returns no certificate: the residual of the equations' least-squares solution is one, if they contradict.
        fixed = np.zeros(qp.n, bool) if qp.lb is None else qp.lb == qp.ub
        rows, rhs = dense[: qp.n_zero, ~fixed], qp.b[: qp.n_zero]
        if qp.lb is not None:
            rhs = rhs - dense[: qp.n_zero, fixed] @ qp.lb[fixed]
        zeta = np.zeros(len(qp.b))
        zeta[: qp.n_zero] = rows @ np.linalg.lstsq(rows, rhs, rcond=None)[0] - rhs
        direction, contradiction = keep_if_infeasibility_certificate(qp, None, zeta)
        status = status if contradiction is None else Status.INFEASIBLE
    return Answer(
        status=status,
        message=f"{message} (exit flag {flag})",
        x=np.asarray(x),
        zeta=multipliers[k:],
        xi=multipliers[:k],
        work={"iterations": info["iterations"]},
        direction=direction,
        contradiction=contradiction,
    )


@cache
def _discard_highs_banner() -> None:
    """Create the first HiGHS object of a process, which always prints a banner to standard output, and discard it."""
    import highspy

    with capture_backend_output(noisy=True):
        highspy.Highs()  # type: ignore[no-untyped-call]


def call_highs(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    """Call HiGHS: null-space active set (Huangfu, Hall 2018)."""
    import highspy

    rows, low, high = make_two_sided_rows(qp, False)
    model = highspy.HighsModel()
    lower = sp.csc_matrix(sp.tril(qp.P))
    model.hessian_.dim_ = qp.n
    model.hessian_.start_ = lower.indptr
    model.hessian_.index_ = lower.indices
    model.hessian_.value_ = lower.data
    lp, k = model.lp_, HIGHS_SCALE
    lp.num_col_, lp.col_cost_ = qp.n, k * qp.q
    lp.col_lower_ = np.full(qp.n, -np.inf) if qp.lb is None else k * qp.lb
    lp.col_upper_ = np.full(qp.n, np.inf) if qp.ub is None else k * qp.ub
    if not len(qp.b):
        # Without rows and with the tolerances below, HiGHS returns small numbers as zeros even if scaled.
        rows, low, high = sp.csc_matrix(sp.eye_array(1, qp.n)), np.array([-np.inf]), np.array([np.inf])
    lp.num_row_, lp.row_lower_, lp.row_upper_ = len(low), k * low, k * high
    lp.a_matrix_.format_ = highspy.MatrixFormat.kColwise
    lp.a_matrix_.start_, lp.a_matrix_.index_, lp.a_matrix_.value_ = rows.indptr, rows.indices, rows.data
    lp.a_matrix_.num_row_, lp.a_matrix_.num_col_ = rows.shape
    _discard_highs_banner()
    solver: Any = highspy.Highs()  # type: ignore[no-untyped-call]
    settings: dict[str, Any] = {
        # The option `threads` is left out: HiGHS has one scheduler for the process, and every call that asks for
        # another number of threads than the first call fails.
        "output_flag": False,
        "primal_feasibility_tolerance": clamp_tolerance(HIGHS_SCALE * limit.eps, 1e-10),
        "dual_feasibility_tolerance": clamp_tolerance(HIGHS_SCALE * limit.eps, 1e-10),
        "qp_regularization_value": HIGHS_REGULARIZATION[limit.attempt % 3],
        "qp_iteration_limit": limit.max_iter,
        "time_limit": limit.time_limit,
    }
    for key, value in _merge(settings, extra).items():
        if solver.setOptionValue(key, value) != highspy.HighsStatus.kOk:
            raise InputError(
                f"highs rejected the setting {key}={value!r}; a name and a value of the options of HiGHS "
                "are needed"
            )
    has_failed = highspy.HighsStatus.kError in (solver.passModel(model), solver.run())
    name, direction = solver.modelStatusToString(solver.getModelStatus()), None
    answer = solver.getSolution()
    x = np.array(answer.col_value) / k if answer.value_valid else None
    if has_failed and x is None and "threads" in extra:
        name += "; the option threads must be that of the first call of HiGHS in the process, or be left out"
    status = classify_status(name)
    shift = solver.getOptionValue("qp_regularization_value")[1]
    if status is Status.CONVERGED and x is not None and shift * np.abs(x).max(initial=0.0) > MAX_HIGHS_SHIFT:
        name = f"Optimal with {shift:g} on the diagonal of P, which moves the answer"
        direction, _ = keep_if_infeasibility_certificate(qp, x, None)
        status = Status.STALLED if direction is None else Status.INFEASIBLE
    dual = answer.dual_valid
    return Answer(
        status=status,
        message=name,
        x=x,
        zeta=-np.array(answer.row_dual)[: len(qp.b)] / k if dual else None,
        xi=-np.array(answer.col_dual) / k if dual else None,
        work={"iterations": max(0, solver.getInfo().qp_iteration_count)},
        direction=direction,
    )


@cache
def _get_osqp_algebra() -> str:
    """Return the default algebra of OSQP.

    If no algebra is passed to `osqp.OSQP()`, it searches the modules of two other algebras at every call. This takes
    0.2 ms and holds import locks, for which a process that is forked at that moment would wait forever.
    """
    import osqp

    return str(osqp.default_algebra())


def call_osqp(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    """Call OSQP: operator splitting with polishing (Stellato et al. 2020)."""
    import osqp

    rows, low, high = make_two_sided_rows(qp, True)
    solver = osqp.OSQP(algebra=_get_osqp_algebra())
    settings = {
        "eps_abs": limit.eps,
        "eps_rel": 0.0,
        "eps_prim_inf": 1e-11,
        "eps_dual_inf": 1e-11,
        "max_iter": max(limit.max_iter, 1),
        "polishing": True,
        "polish_refine_iter": 10,
        "scaled_termination": False,
        "check_dualgap": False,  # OSQP's multipliers are complementary by construction.
        "check_termination": 25,
        "adaptive_rho": True,
        "adaptive_rho_interval": 50,  # [iterations] An interval in time would make results irreproducible.
        "verbose": False,
        "time_limit": limit.time_limit,
    }
    known = {k for k in dir(solver.ext.OSQPSettings()) if not k.startswith("_")} | set(settings)
    for key in extra:
        if key not in known:
            raise InputError(f"osqp has no setting {key!r}; known: {', '.join(sorted(known))}")
    p = sp.csc_matrix(sp.triu(qp.P))
    try:
        solver.setup(p, qp.q, rows, low, high, **_merge(settings, extra))
    except osqp.OSQPException as error:
        # The text is an error code; 4: the factorisation found that P is not positive semidefinite.
        message = "P is not positive semidefinite" if str(error) == "4" else "see its list of error codes"
        return Answer(Status.NUMERICAL_ERROR, f"OSQPException {error}: {message}")
    x, zeta, xi = qp.make_start(impulse)
    solver.warm_start(x=x, y=np.concatenate([zeta, xi])[: len(low)])
    result = solver.solve(raise_error=False)
    info = result.info
    r = len(qp.b)
    y = np.asarray(result.y)
    polished = {1: ", polished", -1: ", polishing failed"}.get(int(info.status_polish), "")
    return Answer(
        status=classify_status(info.status),
        message=f"{info.status}{polished}",
        x=np.asarray(result.x),
        zeta=y[:r],
        xi=y[r:],
        work={"iterations": info.iter, "factorisations": 1 + info.rho_updates},
        direction=copy_usable_certificate(result.dual_inf_cert, qp.n),
        contradiction=copy_usable_certificate(
            None if result.prim_inf_cert is None else result.prim_inf_cert[:r], r
        ),
    )


def call_qpalm(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    """Call QPALM: proximal augmented Lagrangian, semismooth Newton (Hermans, Themelis, Patrinos 2022)."""
    import qpalm

    rows, low, high = make_two_sided_rows(qp, True)
    data = qpalm.Data(qp.n, len(low))
    data.Q, data.q = qp.P, qp.q
    if len(low):
        data.A, data.bmin, data.bmax = rows, np.maximum(low, -1e20), np.minimum(high, 1e20)
    settings = qpalm.Settings()
    settings.verbose = False
    settings.eps_abs, settings.eps_rel = limit.eps, 0.0
    settings.eps_abs_in, settings.eps_rel_in = 1.0, 0.0
    settings.eps_prim_inf = settings.eps_dual_inf = 1e-11
    settings.max_iter = settings.inner_max_iter = max(limit.max_iter, 1)
    if limit.time_limit is not None:
        settings.time_limit = limit.time_limit
    set_backend_options(settings, extra, "qpalm")
    solver = qpalm.Solver(data, settings)
    x, zeta, xi = qp.make_start(impulse)
    solver.warm_start(x, np.concatenate([zeta, xi])[: len(low)])
    solver.solve()
    name = str(solver.info.status)
    r = len(qp.b)
    y = np.array(solver.solution.y)
    return Answer(
        status=classify_status(name),
        message=name,
        x=np.array(solver.solution.x),
        zeta=y[:r],
        xi=y[r:],
        work={"iterations": solver.info.iter, "outer": solver.info.iter_out},
        direction=copy_usable_certificate(np.array(solver.dual_inf_certificate), qp.n)
        if "dual inf" in name
        else None,
        contradiction=copy_usable_certificate(np.array(solver.prim_inf_certificate)[:r], r)
        if "primal inf" in name
        else None,
    )


def call_scs(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    """Call SCS: operator splitting, homogeneous embedding (O'Donoghue 2021); it ignores a start without x, y and s."""
    import scs

    rows = ConicRows.from_program(qp)
    settings: dict[str, Any] = {
        "eps_abs": limit.eps,
        "eps_rel": 0.0,
        "eps_infeas": 1e-11,
        "max_iters": limit.max_iter,
        "time_limit_secs": limit.time_limit,
        "verbose": False,
    }
    data = {"P": sp.csc_matrix(sp.triu(qp.P)), "A": rows.A, "b": rows.b, "c": qp.q}
    try:
        solver = scs.SCS(data, {"z": qp.n_zero, "l": rows.n_nonneg}, **_merge(settings, extra))
    except TypeError as error:
        raise InputError(f"scs rejected the settings {', '.join(extra)}: {error}") from None
    x, zeta, xi = qp.make_start(impulse)
    slack = rows.b - rows.A @ x
    slack[: qp.n_zero] = 0.0
    result = solver.solve(x=x, y=rows.join_multipliers(zeta, xi), s=np.maximum(slack, 0.0))
    info, x = result["info"], np.asarray(result["x"])
    zeta, xi = rows.split_multipliers(np.asarray(result["y"]))
    return Answer(
        status=classify_status(info["status"]), message=info["status"], x=x, zeta=zeta, xi=xi,
        work={"iterations": info["iter"]}, direction=x, contradiction=zeta,
    )  # fmt: skip
