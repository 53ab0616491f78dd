"""Calls of backends by their own interface, one function for each.

Through qpsolvers, these backends have no warm start, and their iterations, exit flags and certificates are lost.
"""

from __future__ import annotations

import threading
from functools import cache
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.base.lazy_import import sparse as sp
from lavender.external.as_qp import QP, make_bound_rows, make_two_sided_rows, merge_bound_multipliers
from lavender.external.running import (
    MIN_TOLERANCE,
    Answer,
    Limits,
    capture_backend_output,
    clamp_tolerance,
    copy_usable_certificate,
    keep_if_infeasibility_certificate,
    set_backend_options,
)
from lavender.judge.solution import Status

# [-] Weight of DAQP's proximal steps, for a P with unit diagonal. A much smaller weight makes steps fail: with 1e-8,
# DAQP did not solve a program that takes 64 iterations with this weight.
DAQP_PROXIMAL_WEIGHT = 1e-2


def call_clarabel(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    """Call Clarabel: interior point, homogeneous embedding, second-order cones (Goulart, Chen 2024)."""
    import clarabel

    first = qp.n_zero + qp.n_nonneg
    bounds = make_bound_rows(qp)
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
    # With reduced tolerances equal to the tolerances, "almost solved" is not reported for a looser tolerance.
    settings.reduced_tol_feas, settings.reduced_tol_gap_abs = limit.eps, limit.gap
    settings.reduced_tol_gap_rel = limit.gap_relative
    if limit.time_limit is not None:
        settings.time_limit = limit.time_limit
    set_backend_options(settings, extra, "clarabel")
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
    xi = merge_bound_multipliers(qp, z[first:])
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
        "primal_tol": clamp_tolerance(limit.eps, 1e-11),
        "dual_tol": clamp_tolerance(limit.eps, 1e-13),
    }
    if limit.repeated:
        # By default, DAQP regularises a singular P by 1e-6, which leaves multipliers of this size on inactive rows.
        # Proximal steps with a small tolerance avoid them.
        settings |= {"eps_prox": DAQP_PROXIMAL_WEIGHT, "eta_prox": MIN_TOLERANCE}
    if limit.time_limit is not None:
        settings["time_limit"] = limit.time_limit
    dense = qp.A.toarray() if len(qp.b) else np.zeros((0, qp.n))
    x, _, flag, info = daqp.solve(
        qp.P.toarray(), qp.q.copy(), dense, high, low, sense, primal_start=x0, **{**settings, **extra}
    )
    message = {
        1: "optimal",
        2: "soft optimal",
        -1: "infeasible",
        -2: "cycling detected",
        -3: "unbounded",
        -4: "iteration limit",
        -5: "nonconvex",
        -6: "overdetermined initial working set",
        -7: "time limit",
    }.get(int(flag), "unknown")
    status = {
        1: Status.CONVERGED,
        -1: Status.INFEASIBLE,
        -3: Status.INFEASIBLE,
        -4: Status.MAX_ITERATIONS,
        -7: Status.TIME_LIMIT,
    }
    multipliers = np.asarray(info["lam"])
    k = len(lb)
    direction, contradiction = keep_if_infeasibility_certificate(qp, np.asarray(x), multipliers[k:])
    return Answer(
        status=status.get(int(flag), Status.NUMERICAL_ERROR),
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
    _discard_highs_banner()
    solver: Any = highspy.Highs()  # type: ignore[no-untyped-call]
    settings: dict[str, Any] = {
        "output_flag": False,
        "threads": 1,
        "primal_feasibility_tolerance": clamp_tolerance(limit.eps, 1e-10),
        "dual_feasibility_tolerance": clamp_tolerance(limit.eps, 1e-10),
        # The default shifts the diagonal by 1e-7, which changes the problem.
        "qp_regularization_value": 1e-13,
        "qp_iteration_limit": limit.max_iter,
    }
    if limit.time_limit is not None:
        settings["time_limit"] = limit.time_limit
    for key, value in {**settings, **extra}.items():
        if solver.setOptionValue(key, value) != highspy.HighsStatus.kOk:
            raise InputError(
                f"highs rejected the setting {key}={value!r}; a name and a value of the options of HiGHS "
                "are needed"
            )
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
        message=name,
        x=x,
        zeta=-np.array(answer.row_dual) if dual else None,
        xi=-np.array(answer.col_dual) if dual else None,
        work={"iterations": max(0, solver.getInfo().qp_iteration_count)},
    )


@cache
def _get_osqp_algebra() -> str:
    """Return the default algebra of OSQP.

    If no algebra is passed to `osqp.OSQP()`, it searches the modules of two other algebras at every call. This takes
    0.2 ms and holds import locks, for which a process that is forked at that moment would wait forever.
    """
    import osqp

    return str(osqp.default_algebra())


# OSQP replaces the handler of Ctrl-C while it solves and then puts the previous one back. Two solves at the same time
# would leave OSQP's own handler, with which Ctrl-C no longer raises KeyboardInterrupt.
_OSQP_LOCK = threading.Lock()


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
    }
    if limit.time_limit is not None:
        settings["time_limit"] = limit.time_limit
    known = {k for k in dir(solver.ext.OSQPSettings()) if not k.startswith("_")} | set(settings)
    for key in extra:
        if key not in known:
            raise InputError(f"osqp has no setting {key!r}; known: {', '.join(sorted(known))}")
    p = sp.csc_matrix(sp.triu(qp.P))
    try:
        solver.setup(p, qp.q, rows, low, high, **{**settings, **extra})
    except osqp.OSQPException as error:
        # The text is an error code; 4: the factorisation found that P is not positive semidefinite.
        message = "P is not positive semidefinite" if str(error) == "4" else "see its list of error codes"
        return Answer(Status.NUMERICAL_ERROR, f"OSQPException {error}: {message}")
    x, zeta, xi = qp.make_start(impulse)
    solver.warm_start(x=x, y=np.concatenate([zeta, xi])[: len(low)])
    with _OSQP_LOCK:
        result = solver.solve(raise_error=False)
    info = result.info
    status = {
        1: Status.CONVERGED,
        2: Status.STALLED,
        3: Status.INFEASIBLE,
        4: Status.STALLED,
        5: Status.INFEASIBLE,
        6: Status.STALLED,
        7: Status.MAX_ITERATIONS,
        8: Status.TIME_LIMIT,
        10: Status.INTERRUPTED,
    }.get(int(info.status_val), Status.NUMERICAL_ERROR)
    r = len(qp.b)
    y = np.asarray(result.y)
    polished = {1: ", polished", -1: ", polishing failed"}.get(int(info.status_polish), "")
    return Answer(
        status=status,
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
    status = {
        "solved": Status.CONVERGED,
        "primal infeasible": Status.INFEASIBLE,
        "dual infeasible": Status.INFEASIBLE,
        "maximum iterations reached": Status.MAX_ITERATIONS,
        "time limit exceeded": Status.TIME_LIMIT,
    }.get(name, Status.NUMERICAL_ERROR)
    r = len(qp.b)
    y = np.array(solver.solution.y)
    return Answer(
        status=status,
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
