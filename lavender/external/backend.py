"""Description of a QP backend, and one run of it by its own interface or through qpsolvers.

qpsolvers returns iterates and multipliers of all backends. For some backends it solves problems without constraints by
SciPy's LSQR instead. To prevent this, such problems are passed with infinite bounds or in the equality form, and a
result of LSQR is rejected.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import sparse as sp
from lavender.external.as_qp import QP, make_bound_rows, merge_bound_multipliers
from lavender.external.running import (
    Answer,
    Call,
    Limits,
    capture_backend_output,
    clamp_tolerance,
    keep_if_infeasibility_certificate,
)
from lavender.judge.solution import Status


@dataclass(frozen=True)
class Backend:
    """Requirements and capabilities of a backend.

    Parameters
    ----------
    name : str
    modules : tuple of str
        Modules that can be imported if the backend is installed.
    install : str
        Packages that pip installs.
    summary, reference : str
    call : callable, optional
        Function that calls the backend's own interface. Default: the backend is called through qpsolvers.
    settings : mapping, optional
        Options to pass through qpsolvers: name -> a field of `Limits` (a str), or a fixed value. None if the backend
        runs at its own tolerances.
    min_tolerance : float
        Smallest tolerance that the backend accepts.
    max_iter : int
        Default limit of iterations.
    dense : bool
        Whether the backend accepts dense matrices only.
    definite : bool
        Whether the backend needs a positive definite P, as in the velocity form.
    warm : bool
        Whether the backend uses a start point.
    stoppable : bool
        Whether the backend accepts a time limit.
    linear : {"bounds", "equality", ""}
        How problems without constraints are passed: with infinite bounds, in the equality form, or not at all.
    finite : bool
        Whether the backend rejects infinite bounds; finite bounds are then passed as rows.
    noisy : bool
        Whether the backend prints even if its output is disabled.
    cones : bool
        Whether the backend accepts second-order cones, and so the convex relaxation of friction.
    """

    name: str
    modules: tuple[str, ...]
    install: str
    summary: str
    reference: str
    call: Call | None = None
    settings: Mapping[str, Any] | None = None
    min_tolerance: float = 0.0
    max_iter: int = 10_000
    dense: bool = False
    definite: bool = False
    warm: bool = False
    stoppable: bool = False
    linear: str = "bounds"
    finite: bool = False
    noisy: bool = False
    cones: bool = False

    def run(self, qp: QP, impulse: FloatArray, limit: Limits, settings: dict[str, Any]) -> Answer:
        """Run the backend once, in this process."""
        if self.call is not None:
            return self.call(qp, impulse, limit, settings)
        return _call_through_qpsolvers(self, qp, impulse, limit, settings)


def _call_through_qpsolvers(
    backend: Backend, qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]
) -> Answer:
    """Call a backend through qpsolvers."""
    import qpsolvers

    eps = clamp_tolerance(limit.eps, backend.min_tolerance) if backend.min_tolerance else limit.eps
    limits = {**vars(limit), "eps": eps}
    options = {name: limits[x] if isinstance(x, str) else x for name, x in (backend.settings or {}).items()}
    settings = {name: x for name, x in options.items() if x is not None}  # Leave out a time limit of None.
    if backend.warm:
        settings.update(_make_warm_start_settings(backend.name, qp, impulse))
    settings.update(extra)
    # Split the rows: the first `n_zero` are equalities, the others inequalities.
    z = qp.n_zero
    dense = backend.dense
    p = qp.P.toarray() if dense else qp.P
    rows = qp.A.toarray() if dense else qp.A
    lb, ub = qp.lb, qp.ub
    inequality, rhs = rows[z:], qp.b[z:]
    bounds = make_bound_rows(qp) if backend.finite else []
    if bounds:
        lb = ub = None
        inequality = sp.csc_matrix(sp.vstack([inequality, *(s * m for s, m, _, _ in bounds)]))
        inequality = inequality.toarray() if dense else inequality
        rhs = np.concatenate([rhs, *(h for _, _, h, _ in bounds)])
    g, h = (inequality, rhs) if len(rhs) else (None, None)
    a, b = (rows[:z], qp.b[:z]) if z else (None, None)
    if lb is None and g is None and a is None:
        # If bounds are given, qpsolvers does not use LSQR.
        lb, ub = np.full(qp.n, -np.inf), np.full(qp.n, np.inf)
    problem = qpsolvers.Problem(p, qp.q, g, h, a, b, lb, ub)
    x0 = settings.pop("initvals", None)
    with capture_backend_output(False) as warnings:
        solution = qpsolvers.solve_problem(problem, backend.name, initvals=x0, **settings)
    warning = "; ".join(warnings)
    if "LSQR" in warning:
        return Answer(
            Status.NUMERICAL_ERROR, f"qpsolvers ran LSQR in place of {backend.name}; its answer is not used"
        )
    # Collect the status, the iterate and the multipliers.
    extras = solution.extras or {}
    status, status_text = _get_status(solution, extras)
    zeta = np.zeros(len(qp.b))
    x = None if solution.x is None else np.asarray(solution.x, float).ravel()
    if z and _has_size(solution.y, z):
        zeta[:z] = solution.y
    elif z:
        x = x if qp.form == "impulse" else None
    if len(qp.b) > z and _has_size(solution.z, len(rhs)):
        zeta[z:] = np.asarray(solution.z)[: len(qp.b) - z]
    elif len(qp.b) > z:
        x = None  # In the velocity form, impulses are computed from the multipliers alone.
    xi = np.asarray(solution.z_box, float) if _has_size(solution.z_box, qp.n) else None
    if bounds and _has_size(solution.z, len(rhs)):
        xi = merge_bound_multipliers(qp, np.asarray(solution.z)[len(qp.b) - z :])
    iterations = _get_iterations(extras)
    work = {} if iterations is None else {"iterations": iterations}
    message = status_text or warning or _describe_result(solution.found, x)
    if backend.settings is None:
        message += ", at its own tolerance"
    direction, contradiction = (
        keep_if_infeasibility_certificate(qp, x, zeta) if status is Status.INFEASIBLE else (None, None)
    )
    return Answer(
        status=status,
        message=message,
        x=x,
        zeta=zeta,
        xi=xi,
        work=work,
        direction=direction,
        contradiction=contradiction,
    )


def _has_size(y: Any, size: int) -> bool:
    return y is not None and np.size(y) == size


def _describe_result(is_solved: bool | None, x: Any) -> str:
    return "solved" if is_solved else "not solved" if x is not None else "not solved, nothing returned"


def _get_iterations(extras: Mapping[str, Any]) -> int | None:
    """Return the number of iterations from the additional data of a backend, or None if they do not contain it."""
    info = extras.get("info", extras)
    for source in (info, extras):
        for name in ("iter", "iterations", "num_iterations", "nbIter", "num_iter"):
            value = source.get(name) if isinstance(source, Mapping) else getattr(source, name, None)
            if isinstance(value, (int, np.integer)):
                return int(value)
            if isinstance(value, (tuple, list, np.ndarray)) and len(value):
                return int(value[0])  # quadprog returns two counts, of added and of dropped constraints.
    stats = extras.get("stats")
    return len(stats) if isinstance(stats, list) else None


def _get_status(solution: Any, extras: Mapping[str, Any]) -> tuple[Status, str]:
    """Return the status, and the backend's text for it if qpsolvers returns one."""
    info = extras.get("info", extras)
    text = ""
    for name in ("status", "exitFlag"):
        value = info.get(name) if isinstance(info, Mapping) else getattr(info, name, None)
        if value is None:
            value = extras.get(name)
        if value is not None:
            text = str(getattr(value, "name", value))
            text = f"status {text}" if text.lstrip("-").isdigit() else text
            break
    lower_case = text.lower()
    if solution.found:
        return Status.CONVERGED, text
    if "exitFlag" in (info if isinstance(info, Mapping) else ()):
        ecos = {1: Status.INFEASIBLE, 2: Status.INFEASIBLE, 10: Status.STALLED, -1: Status.MAX_ITERATIONS}
        return ecos.get(int(info["exitFlag"]), Status.NUMERICAL_ERROR), text
    if "infeas" in lower_case or "unbounded" in lower_case:
        return Status.INFEASIBLE, text
    if "time" in lower_case:
        return Status.TIME_LIMIT, text
    if "max" in lower_case and "iter" in lower_case:
        return Status.MAX_ITERATIONS, text
    if "inaccurate" in lower_case or "unknown" in lower_case:
        return Status.STALLED, text
    return Status.NUMERICAL_ERROR, text


def _make_warm_start_settings(name: str, qp: QP, impulse: FloatArray) -> dict[str, Any]:
    """Return the settings that start a backend from an impulse (m,) [N s]."""
    x, zeta, xi = qp.make_start(impulse)
    if name == "proxqp":
        from proxsuite import proxqp

        z = zeta[qp.n_zero :]
        if qp.lb is not None or len(qp.b) == 0:
            z = np.concatenate([z, xi])
        settings = {"initvals": x, "initial_guess": proxqp.InitialGuess.WARM_START}
        settings |= {"y": zeta[: qp.n_zero]} if qp.n_zero else {}
        return settings | ({"z": z} if len(z) else {})
    return {"initvals": x}
