"""Every backend of qpsolvers by its own name, on linear problems and boxed LCPs with symmetric A.

    min 1/2 l.A l - b.l,  lower <= l <= upper        (impulse form), or the velocity form of `as_qp`

Backends of which qpsolvers passes on the iterate but not what happened (iterations, exit flag,
certificates, warm start) are called by their own interface. Without a constraint qpsolvers hands some
backends' problems to SciPy's LSQR; here infinite bounds, or the equality form, keep the backend itself
at work, and an answer of LSQR is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse as sp

from lavender._arrays import FloatArray
from lavender.certificates import check_certificate
from lavender.errors import CapabilityError, InputError
from lavender.external._running import (
    Answer,
    Call,
    Limits,
    ask,
    definite_refusal,
    quiet,
    symmetric_refusal,
)
from lavender.external.as_qp import QP, impulse_form, pick_form, velocity_form
from lavender.problem import Problem
from lavender.registry import SolverSpec
from lavender.solution import Claim, Status

__all__ = ["BACKENDS", "SPECS", "Backend", "QPSolver"]

DENSE_LIMIT = 2**30  # bytes of one dense matrix; beyond, a dense backend is refused


@dataclass(frozen=True)
class Backend:
    """One line of the table: what a backend needs and can do."""

    name: str
    modules: tuple[str, ...]  # importable where it is installed
    install: str
    summary: str
    reference: str
    call: Call | None = None  # its own interface; None goes through qpsolvers
    settings: Any = None  # Limits -> settings, through qpsolvers; None: runs at its own tolerances
    max_iter: int = 10_000
    dense: bool = False  # takes dense matrices only
    definite: bool = False  # needs a positive definite P, which the velocity form has
    warm: bool = False  # uses a start point
    stoppable: bool = False  # takes a time limit
    linear: str = "bounds"  # what keeps it at work without constraints: "bounds", "equality", or "" (refused)
    finite: bool = False  # takes no infinite bounds: the finite ones become rows
    noisy: bool = False  # prints even when told not to


@dataclass
class State:
    """A converted problem."""

    problem: Problem
    qp: QP


@dataclass(frozen=True)
class QPSolver:
    """A backend with its options.

    Parameters
    ----------
    backend : Backend
    form : {"auto", "impulse", "velocity"}
    unit_diagonal : bool
        Impulse form: scale P to a unit diagonal.
    settings : mapping
        Passed to the backend as they are, over those that `tol` gives.
    """

    backend: Backend
    form: str = "auto"
    unit_diagonal: bool = True
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.settings, Mapping):
            raise InputError(
                f"settings is a {type(self.settings).__name__}; a mapping of names to values is needed"
            )

    @np.errstate(all="ignore")  # what overflows is judged
    def prepare(self, problem: Problem) -> State:
        b = self.backend
        qp = velocity_form(problem) if pick_form(problem, self.form, b.definite) == "velocity" else None
        if qp is not None and b.definite and self.form == "auto" and not qp.is_definite:
            qp = None
        if qp is None:
            qp = impulse_form(
                problem,
                unit_diagonal=self.unit_diagonal,
                equality=b.linear == "equality" and problem.cones.is_free,
            )
        if len(qp.kept) and qp.is_bounds_only and not b.linear:
            raise CapabilityError(
                f"solver {b.name!r} takes no problem without inequalities, and qpsolvers would hand it to LSQR; "
                "use direct or another backend"
            )
        if b.dense and 8 * qp.n * max(qp.n, len(qp.b)) > DENSE_LIMIT:
            raise CapabilityError(
                f"solver {b.name!r} takes dense matrices only: {max(qp.n, len(qp.b))} x {qp.n} would need more "
                f"than {DENSE_LIMIT >> 20} MiB; use a sparse backend (osqp, piqp, clarabel)"
            )
        return State(problem, qp)

    def update(self, state: State, problem: Problem) -> State:
        return self.prepare(problem)

    @np.errstate(all="ignore")  # what overflows is judged
    def run(
        self, state: State, impulse: FloatArray, n: int, tol: float, time_limit: float | None = None
    ) -> Claim:
        b = self.backend
        call: Call = partial(_through_qpsolvers, b) if b.call is None else b.call
        return ask(
            state.problem, state.qp, impulse, call, n, tol, time_limit, self.settings,
            stoppable=b.stoppable, noisy=b.noisy,
        )  # fmt: skip


def refusal(problem: Problem) -> str | None:
    """Why no QP backend can take this problem, before any conversion."""
    return symmetric_refusal(problem) or definite_refusal(problem)


# -- through qpsolvers ----------------------------------------------------------------------------


def _through_qpsolvers(
    backend: Backend, qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]
) -> Answer:
    import qpsolvers

    settings = {} if backend.settings is None else backend.settings(limit)
    if backend.warm:
        settings.update(_warm_settings(backend.name, qp, impulse))
    settings.update(extra)
    z = qp.n_zero
    dense = backend.dense
    p = qp.P.toarray() if dense else qp.P
    rows = qp.A.toarray() if dense else qp.A
    lb, ub = qp.lb, qp.ub
    inequality, side = rows[z:], qp.b[z:]
    bounds = _bound_rows(qp) if backend.finite else []
    if bounds:
        lb = ub = None
        inequality = sp.csc_matrix(sp.vstack([inequality, *(s * m for s, m, _, _ in bounds)]))
        inequality = inequality.toarray() if dense else inequality
        side = np.concatenate([side, *(h for _, _, h, _ in bounds)])
    g, h = (inequality, side) if len(side) else (None, None)
    a, b = (rows[:z], qp.b[:z]) if z else (None, None)
    if lb is None and g is None and a is None:
        lb, ub = np.full(qp.n, -np.inf), np.full(qp.n, np.inf)  # infinite bounds: no hand-over to LSQR
    problem = qpsolvers.Problem(p, qp.q, g, h, a, b, lb, ub)
    x0 = settings.pop("initvals", None)
    with quiet(False) as said:
        solution = qpsolvers.solve_problem(problem, backend.name, initvals=x0, **settings)
    words = "; ".join(said)
    if "LSQR" in words:
        return Answer(
            Status.NUMERICAL_ERROR, f"qpsolvers ran LSQR in place of {backend.name}; its answer is not used"
        )
    extras = solution.extras or {}
    status, own = _status_of(solution, extras)
    zeta = np.zeros(len(qp.b))
    x = None if solution.x is None else np.asarray(solution.x, float).ravel()
    if z and _given(solution.y, z):
        zeta[:z] = solution.y
    elif z:
        x = x if qp.form == "impulse" else None
    if len(qp.b) > z and _given(solution.z, len(side)):
        zeta[z:] = np.asarray(solution.z)[: len(qp.b) - z]
    elif len(qp.b) > z:
        x = None  # multipliers are the answer of the velocity form
    xi = np.asarray(solution.z_box, float) if _given(solution.z_box, qp.n) else None
    if bounds and _given(solution.z, len(side)):
        xi, at0 = np.zeros(qp.n), len(qp.b) - z
        for sign, _, _, at in bounds:
            xi[at] += sign * np.asarray(solution.z)[at0 : at0 + len(at)]
            at0 += len(at)
    iterations = _iterations(extras)
    work = {} if iterations is None else {"iterations": iterations}
    words = own or words or _words(solution.found, x)
    if backend.settings is None:
        words += ", at its own tolerance"
    proof = _proof(qp, x, zeta) if status is Status.INFEASIBLE else (None, None)
    return Answer(status, words, x, zeta, xi, work, *proof)


def _proof(
    qp: QP, x: FloatArray | None, zeta: FloatArray | None
) -> tuple[FloatArray | None, FloatArray | None]:
    """The iterate as a certificate, where it is one: backends without a field for it return it as iterate."""
    y = qp.direction(x, zeta)
    return (x, zeta) if y is not None and check_certificate(qp.problem, y) is None else (None, None)


def _bound_rows(qp: QP) -> list[tuple[float, sp.csr_matrix, FloatArray, Any]]:
    """Finite bounds as rows sign x[at] <= h: (sign, rows of the identity, h, at) for upper, then lower."""
    if qp.lb is None or qp.ub is None:
        return []
    eye = sp.csr_matrix(sp.eye_array(qp.n))
    found = []
    for sign, bound in ((1.0, qp.ub), (-1.0, qp.lb)):
        at = np.flatnonzero(np.isfinite(bound))
        found.append((sign, eye[at], sign * bound[at], at))
    return found


def _given(y: Any, size: int) -> bool:
    return y is not None and np.size(y) == size


def _words(found: bool | None, x: Any) -> str:
    return "solved" if found else "not solved" if x is not None else "not solved, nothing returned"


def _iterations(extras: Mapping[str, Any]) -> int | None:
    info = extras.get("info", extras)
    for source in (info, extras):
        for name in ("iter", "iterations", "num_iterations", "nbIter", "num_iter"):
            value = source.get(name) if isinstance(source, Mapping) else getattr(source, name, None)
            if isinstance(value, (int, np.integer)):
                return int(value)
            if isinstance(value, (tuple, list, np.ndarray)) and len(value):
                return int(value[0])  # quadprog: added and dropped constraints
    stats = extras.get("stats")
    return len(stats) if isinstance(stats, list) else None


def _status_of(solution: Any, extras: Mapping[str, Any]) -> tuple[Status, str]:
    """Status and the backend's own words, as far as qpsolvers passes them on."""
    info = extras.get("info", extras)
    words = ""
    for name in ("status", "exitFlag"):
        value = info.get(name) if isinstance(info, Mapping) else getattr(info, name, None)
        if value is None:
            value = extras.get(name)
        if value is not None:
            words = str(getattr(value, "name", value))
            words = f"status {words}" if words.lstrip("-").isdigit() else words
            break
    low = words.lower()
    if solution.found:
        return Status.CONVERGED, words
    if "exitFlag" in (info if isinstance(info, Mapping) else ()):
        ecos = {1: Status.INFEASIBLE, 2: Status.INFEASIBLE, 10: Status.STALLED, -1: Status.MAX_ITERATIONS}
        return ecos.get(int(info["exitFlag"]), Status.NUMERICAL_ERROR), words
    if "infeas" in low or "unbounded" in low:
        return Status.INFEASIBLE, words
    if "time" in low:
        return Status.TIME_LIMIT, words
    if "max" in low and "iter" in low:
        return Status.MAX_ITERATIONS, words
    if "inaccurate" in low or "unknown" in low:
        return Status.STALLED, words
    return Status.NUMERICAL_ERROR, words


def _warm_settings(name: str, qp: QP, impulse: FloatArray) -> dict[str, Any]:
    x, zeta, xi = qp.start(impulse)
    if name == "proxqp":
        from proxsuite import proxqp

        z = zeta[qp.n_zero :]
        if qp.lb is not None or len(qp.b) == 0:
            z = np.concatenate([z, xi])
        settings = {"initvals": x, "initial_guess": proxqp.InitialGuess.WARM_START}
        settings |= {"y": zeta[: qp.n_zero]} if qp.n_zero else {}
        return settings | ({"z": z} if len(z) else {})
    return {"initvals": x}


def _at(limit: float, least: float) -> float:
    return min(max(limit, least), 1e-2)


# -- backends by their own interface ---------------------------------------------------------------


def _two_sided(qp: QP, identity: bool) -> tuple[sp.csc_matrix, FloatArray, FloatArray]:
    """Rows l <= C x <= u; with `identity` the bounds of x as rows after them."""
    low = np.full(len(qp.b), -np.inf)
    low[: qp.n_zero] = qp.b[: qp.n_zero]
    if not identity or qp.lb is None or qp.ub is None:
        return qp.A, low, qp.b
    rows = sp.csc_matrix(sp.vstack([qp.A, sp.eye_array(qp.n)]))
    return rows, np.concatenate([low, qp.lb]), np.concatenate([qp.b, qp.ub])


def _set_all(target: Any, settings: Mapping[str, Any], name: str) -> None:
    for key, value in settings.items():
        if not hasattr(target, key):
            known = sorted(k for k in dir(target) if not k.startswith("_"))
            raise InputError(f"{name} has no setting {key!r}; known: {', '.join(known)}")
        setattr(target, key, value)


def _osqp(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    import osqp

    rows, low, high = _two_sided(qp, True)
    solver = osqp.OSQP()
    settings = {
        "eps_abs": limit.eps,
        "eps_rel": 0.0,
        "eps_prim_inf": 1e-11,
        "eps_dual_inf": 1e-11,
        "max_iter": max(limit.max_iter, 1),
        "polishing": True,
        "polish_refine_iter": 10,
        "scaled_termination": False,
        "check_dualgap": False,  # its multipliers are complementary by construction
        "check_termination": 25,
        "adaptive_rho": True,
        "adaptive_rho_interval": 50,  # iterations, never times: the same bits every run
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
        # Its text is a number: 4 = the factorisation met a P that is not positive semidefinite.
        words = "P is not positive semidefinite" if str(error) == "4" else "see its list of error codes"
        return Answer(Status.NUMERICAL_ERROR, f"OSQPException {error}: {words}")
    x, zeta, xi = qp.start(impulse)
    bounded = qp.lb is not None
    solver.warm_start(x=x, y=np.concatenate([zeta, xi]) if bounded else zeta)
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
        status,
        f"{info.status}{polished}",
        np.asarray(result.x),
        y[:r],
        y[r:] if bounded else np.zeros(qp.n),
        {"iterations": info.iter, "factorisations": 1 + info.rho_updates},
        _certificate(result.dual_inf_cert, qp.n),
        _certificate(None if result.prim_inf_cert is None else result.prim_inf_cert[:r], r),
    )


def _certificate(y: Any, size: int) -> FloatArray | None:
    if y is None or np.size(y) != size or not np.isfinite(y).all() or not np.any(y):
        return None
    return np.array(y, float)


def _clarabel(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    import clarabel

    first = qp.n_zero + qp.n_nonneg
    bounds = _bound_rows(qp)
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
    _set_all(settings, extra, "clarabel")
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
    return Answer(status, name, x, zeta, xi, work, x, zeta)


def _daqp(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    import daqp

    _, low, high = _two_sided(qp, False)
    bounded = qp.lb is not None
    lb = np.zeros(0) if qp.lb is None else qp.lb
    ub = np.zeros(0) if qp.ub is None else qp.ub
    low, high = (np.clip(np.concatenate(p), -1e30, 1e30) for p in ((lb, low), (ub, high)))
    sense = np.zeros(len(low), np.int32)
    sense[len(lb) : len(lb) + qp.n_zero] = 5
    x0, _, _ = qp.start(impulse)
    settings: dict[str, Any] = {
        "iter_limit": limit.max_iter,
        "primal_tol": _at(limit.eps, 1e-11),
        "dual_tol": _at(limit.eps, 1e-13),
    }
    if limit.time_limit is not None:
        settings["time_limit"] = limit.time_limit
    dense = qp.A.toarray() if len(qp.b) else np.zeros((0, qp.n))
    x, _, flag, info = daqp.solve(
        qp.P.toarray(), qp.q.copy(), dense, high, low, sense, primal_start=x0, **{**settings, **extra}
    )
    words = {
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
    return Answer(
        status.get(int(flag), Status.NUMERICAL_ERROR),
        f"{words} (exit flag {flag})",
        np.asarray(x),
        multipliers[k:],
        multipliers[:k] if bounded else np.zeros(qp.n),
        {"iterations": info["iterations"]},
        *_proof(qp, np.asarray(x), multipliers[k:]),
    )


def _highs(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    import highspy

    rows, low, high = _two_sided(qp, False)
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
        "primal_feasibility_tolerance": _at(limit.eps, 1e-10),
        "dual_feasibility_tolerance": _at(limit.eps, 1e-10),
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
        {
            "Optimal": Status.CONVERGED,
            "Infeasible": Status.INFEASIBLE,
            "Unbounded": Status.INFEASIBLE,
            "Iteration limit reached": Status.MAX_ITERATIONS,
            "Time limit reached": Status.TIME_LIMIT,
        }.get(name, Status.NUMERICAL_ERROR),
        name,
        x,
        -np.array(answer.row_dual) if dual else None,
        -np.array(answer.col_dual) if dual else None,
        {"iterations": max(0, solver.getInfo().qp_iteration_count)},
    )


def _qpalm(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    import qpalm

    rows, low, high = _two_sided(qp, True)
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
    _set_all(settings, extra, "qpalm")
    solver = qpalm.Solver(data, settings)
    x, zeta, xi = qp.start(impulse)
    bounded = qp.lb is not None
    solver.warm_start(x, np.concatenate([zeta, xi]) if bounded else zeta)
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
        status,
        name,
        np.array(solver.solution.x),
        y[:r],
        y[r:] if bounded else np.zeros(qp.n),
        {"iterations": solver.info.iter, "outer": solver.info.iter_out},
        _certificate(np.array(solver.dual_inf_certificate), qp.n) if "dual inf" in name else None,
        _certificate(np.array(solver.prim_inf_certificate)[:r], r) if "primal inf" in name else None,
    )


# -- settings of those that go through qpsolvers -----------------------------------------------------


def _piqp(limit: Limits) -> dict[str, Any]:
    return {
        "eps_abs": limit.eps, "eps_rel": 0.0, "max_iter": limit.max_iter,
        "check_duality_gap": True, "eps_duality_gap_abs": limit.gap, "eps_duality_gap_rel": limit.gap_relative,
    }  # fmt: skip


def _proxqp(limit: Limits) -> dict[str, Any]:
    # Without the gap it accepts multipliers on bounds that are not active (met on a redundant stack).
    return {
        "eps_abs": limit.eps, "eps_rel": 0.0, "max_iter": limit.max_iter,
        "check_duality_gap": True, "eps_duality_gap_abs": limit.gap, "eps_duality_gap_rel": limit.gap_relative,
    }  # fmt: skip


def _scs(limit: Limits) -> dict[str, Any]:
    more = {} if limit.time_limit is None else {"time_limit_secs": limit.time_limit}
    return {"eps_abs": limit.eps, "eps_rel": 0.0, "eps_infeas": 1e-11, "max_iters": limit.max_iter, **more}


def _cvxopt(limit: Limits) -> dict[str, Any]:
    return {
        "feastol": limit.eps,
        "abstol": limit.gap,
        "reltol": limit.gap_relative,
        "maxiters": limit.max_iter,
    }


def _ecos(limit: Limits) -> dict[str, Any]:
    return {
        "feastol": limit.eps,
        "abstol": limit.gap,
        "reltol": limit.gap_relative,
        "max_iters": limit.max_iter,
    }


def _gurobi(limit: Limits) -> dict[str, Any]:
    more = {} if limit.time_limit is None else {"TimeLimit": limit.time_limit}
    eps = _at(limit.eps, 1e-9)
    return {
        "FeasibilityTol": eps, "OptimalityTol": eps, "BarConvTol": limit.gap,
        "BarIterLimit": limit.max_iter, "IterationLimit": limit.max_iter, "Threads": 1, **more,
    }  # fmt: skip


def _copt(limit: Limits) -> dict[str, Any]:
    more = {} if limit.time_limit is None else {"TimeLimit": limit.time_limit}
    eps = _at(limit.eps, 1e-9)
    return {"FeasTol": eps, "DualTol": eps, "BarIterLimit": limit.max_iter, "Threads": 1, **more}


def _qtqp(limit: Limits) -> dict[str, Any]:
    return {
        "tol_feas": limit.eps, "tol_gap_abs": limit.gap, "tol_gap_rel": limit.gap_relative,
        "max_iter": limit.max_iter, "collect_stats": True,
    }  # fmt: skip


def _pyqpmad(limit: Limits) -> dict[str, Any]:
    return {"tolerance": _at(limit.eps, 1e-12), "max_iter": limit.max_iter}


def _qpax(limit: Limits) -> dict[str, Any]:
    return {"solver_tol": _at(limit.eps, 1e-12)}


ADMM = "Stellato et al. 2020, OSQP: an operator splitting solver for quadratic programs"
BACKENDS: tuple[Backend, ...] = (
    Backend("osqp", ("osqp",), "osqp", "operator splitting with polishing", ADMM,
            _osqp, max_iter=100_000, warm=True, stoppable=True),
    Backend("clarabel", ("clarabel",), "clarabel", "interior point, homogeneous embedding",
            "Goulart, Chen 2024, Clarabel", _clarabel, max_iter=200, stoppable=True),
    Backend("piqp", ("qpsolvers", "piqp"), "piqp", "proximal interior point",
            "Schwan, Jiang, Kuhn, Jones 2023, PIQP", settings=_piqp, max_iter=250),
    Backend("proxqp", ("qpsolvers", "proxsuite"), "proxsuite", "proximal augmented Lagrangian",
            "Bambade et al. 2022, ProxQP", settings=_proxqp, warm=True),
    Backend("qpalm", ("qpalm",), "qpalm", "proximal augmented Lagrangian, semismooth Newton",
            "Hermans, Themelis, Patrinos 2022, QPALM", _qpalm, warm=True, stoppable=True),
    Backend("daqp", ("daqp",), "daqp", "dual active set", "Arnström, Bemporad, Axehill 2022, DAQP",
            _daqp, dense=True, warm=True, stoppable=True),
    Backend("highs", ("highspy",), "highspy", "null-space active set", "Huangfu, Hall 2018, HiGHS",
            _highs, max_iter=100_000, stoppable=True),
    Backend("scs", ("qpsolvers", "scs"), "scs", "operator splitting, homogeneous embedding",
            "O'Donoghue 2021, SCS 3", settings=_scs, max_iter=100_000, warm=True, stoppable=True),
    Backend("quadprog", ("qpsolvers", "quadprog"), "quadprog", "dual active set, positive definite A",
            "Goldfarb, Idnani 1983", dense=True, definite=True),
    Backend("cvxopt", ("qpsolvers", "cvxopt"), "cvxopt", "interior point", "Vandenberghe 2010, CVXOPT",
            settings=_cvxopt, max_iter=100),
    Backend("kvxopt", ("qpsolvers", "kvxopt"), "kvxopt", "interior point, CVXOPT with more factorisations",
            "Vandenberghe 2010, CVXOPT", settings=_cvxopt, max_iter=100),
    Backend("ecos", ("qpsolvers", "ecos"), "ecos", "interior point for second-order cones",
            "Domahidi, Chu, Boyd 2013, ECOS", settings=_ecos, max_iter=100, dense=True, definite=True,
            linear="equality", finite=True),
    Backend("gurobi", ("qpsolvers", "gurobipy"), "gurobipy", "interior point and simplex", "Gurobi manual",
            settings=_gurobi, stoppable=True, noisy=True),
    Backend("copt", ("qpsolvers", "coptpy"), "coptpy", "interior point", "COPT manual",
            settings=_copt, stoppable=True, noisy=True),
    Backend("mosek", ("qpsolvers", "cvxopt", "mosek"), "cvxopt mosek", "interior point", "MOSEK manual", noisy=True),
    Backend("qtqp", ("qpsolvers", "qtqp"), "qtqp", "primal-dual interior point", "QTQP manual",
            settings=_qtqp, max_iter=200, linear=""),
    Backend("pyqpmad", ("qpsolvers", "pyqpmad"), "pyqpmad", "dual active set, positive definite A",
            "Goldfarb, Idnani 1983", settings=_pyqpmad, dense=True, definite=True),
    Backend("qpax", ("qpsolvers", "qpax"), "qpax", "interior point in JAX", "Tracy, Manchester 2024, qpax",
            settings=_qpax, max_iter=30, dense=True, noisy=True),
    Backend("jaxopt_osqp", ("qpsolvers", "jaxopt"), "jaxopt", "operator splitting in JAX", ADMM,
            dense=True, noisy=True),
    Backend("hpipm", ("qpsolvers", "hpipm_python"), "hpipm_python (github.com/giaf/hpipm)", "interior point",
            "Frison, Diehl 2020, HPIPM", dense=True),
    Backend("nppro", ("qpsolvers", "nppro"), "nppro", "active set", "NPPro manual", dense=True),
    Backend("pdhcg", ("qpsolvers", "pdhcg"), "pdhcg", "primal-dual hybrid conjugate gradient",
            "Huang et al. 2024, PDHCG", noisy=True),
    Backend("qpoases", ("qpsolvers", "qpoases"), "qpoases", "online active set",
            "Ferreau et al. 2014, qpOASES", dense=True),
    Backend("qpswift", ("qpsolvers", "qpSWIFT"), "qpSWIFT", "interior point",
            "Pandala, Ding, Park 2019, qpSWIFT", dense=True, linear="", finite=True),
    Backend("sip", ("qpsolvers", "sip_qp_python"), "sip-qp-python", "interior point", "SIP manual"),
)  # fmt: skip

OPTIONS = {
    "form": "'impulse', 'velocity' (needs rows) or 'auto' (default): by size, mass ratio and backend",
    "unit_diagonal": "impulse form: scale A to a unit diagonal, default True",
    "settings": "mapping passed to the backend, over those that tol gives",
}


def _spec(backend: Backend) -> SolverSpec:
    return SolverSpec(
        name=backend.name,
        factory=partial(QPSolver, backend),
        laws=frozenset({"linear", "lcp"} if backend.linear else {"lcp"}),
        resumable=False,
        external=True,
        impulse=backend.warm,
        max_iter=backend.max_iter,
        options=OPTIONS,
        requires=backend.modules,
        install=backend.install,
        summary=f"{backend.summary} (QP backend)",
        reference=backend.reference,
        refusal=refusal,
    )


SPECS: tuple[SolverSpec, ...] = tuple(map(_spec, BACKENDS))
