"""What a QP backend needs and can do, as data, and one run of it: by its own interface, or through qpsolvers.

qpsolvers passes on the iterate and the multipliers of every one of them. Without a constraint it hands some backends'
problems to SciPy's LSQR; here infinite bounds, or the equality form, keep the backend itself at work, and an answer of
LSQR is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import sparse as sp
from lavender.external.as_qp import QP, bound_multipliers, bound_rows
from lavender.external.running import Answer, Call, Limits, at_least, proof, quiet
from lavender.judge.solution import Status


@dataclass(frozen=True)
class Backend:
    """One line of the table: what a backend needs and can do."""

    name: str
    modules: tuple[str, ...]  # importable where it is installed
    install: str
    summary: str
    reference: str
    call: Call | None = None  # its own interface; None goes through qpsolvers
    # through qpsolvers: by its own names fields of Limits, or what is fixed; None: runs at its own tolerances
    settings: Mapping[str, Any] | None = None
    least: float = 0.0  # tolerance that it takes
    max_iter: int = 10_000
    dense: bool = False  # takes dense matrices only
    definite: bool = False  # needs a positive definite P, which the velocity form has
    warm: bool = False  # uses a start point
    stoppable: bool = False  # takes a time limit
    linear: str = "bounds"  # what keeps it at work without constraints: "bounds", "equality", or "" (refused)
    finite: bool = False  # takes no infinite bounds: the finite ones become rows
    noisy: bool = False  # prints even when told not to
    cones: bool = False  # takes second-order cones, so the convex relaxation of friction

    def run(self, qp: QP, impulse: FloatArray, limit: Limits, settings: dict[str, Any]) -> Answer:
        """One run of it, in this process."""
        if self.call is not None:
            return self.call(qp, impulse, limit, settings)
        return _through_qpsolvers(self, qp, impulse, limit, settings)


def _through_qpsolvers(
    backend: Backend, qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]
) -> Answer:
    import qpsolvers

    known = {**vars(limit), "eps": at_least(limit.eps, backend.least) if backend.least else limit.eps}
    given = {name: known[x] if isinstance(x, str) else x for name, x in (backend.settings or {}).items()}
    settings = {name: x for name, x in given.items() if x is not None}  # no time limit, if none is asked for
    if backend.warm:
        settings.update(_warm_settings(backend.name, qp, impulse))
    settings.update(extra)
    z = qp.n_zero
    dense = backend.dense
    p = qp.P.toarray() if dense else qp.P
    rows = qp.A.toarray() if dense else qp.A
    lb, ub = qp.lb, qp.ub
    inequality, side = rows[z:], qp.b[z:]
    bounds = bound_rows(qp) if backend.finite else []
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
        xi = bound_multipliers(qp, np.asarray(solution.z)[len(qp.b) - z :])
    iterations = _iterations(extras)
    work = {} if iterations is None else {"iterations": iterations}
    words = own or words or _words(solution.found, x)
    if backend.settings is None:
        words += ", at its own tolerance"
    direction, contradiction = proof(qp, x, zeta) if status is Status.INFEASIBLE else (None, None)
    return Answer(
        status=status,
        words=words,
        x=x,
        zeta=zeta,
        xi=xi,
        work=work,
        direction=direction,
        contradiction=contradiction,
    )


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
