"""DAQP: dual active set, dense (Arnström, Bemporad, Axehill 2022)."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.external.as_qp import QP, two_sided
from lavender.external.running import Answer, Limits, at_least, proof
from lavender.judge.solution import Status


def call(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    """One run of the backend."""
    import daqp

    _, low, high = two_sided(qp, False)
    lb = np.zeros(0) if qp.lb is None else qp.lb
    ub = np.zeros(0) if qp.ub is None else qp.ub
    low, high = (np.clip(np.concatenate(p), -1e30, 1e30) for p in ((lb, low), (ub, high)))
    sense = np.zeros(len(low), np.int32)
    sense[len(lb) : len(lb) + qp.n_zero] = 5
    x0, _, _ = qp.start(impulse)
    settings: dict[str, Any] = {
        "iter_limit": limit.max_iter,
        "primal_tol": at_least(limit.eps, 1e-11),
        "dual_tol": at_least(limit.eps, 1e-13),
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
    direction, contradiction = proof(qp, np.asarray(x), multipliers[k:])
    return Answer(
        status=status.get(int(flag), Status.NUMERICAL_ERROR),
        words=f"{words} (exit flag {flag})",
        x=np.asarray(x),
        zeta=multipliers[k:],
        xi=multipliers[:k],
        work={"iterations": info["iterations"]},
        direction=direction,
        contradiction=contradiction,
    )
