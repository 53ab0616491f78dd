"""QPALM: proximal augmented Lagrangian, semismooth Newton (Hermans, Themelis, Patrinos 2022)."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.external.as_qp import QP, two_sided
from lavender.external.running import Answer, Limits, certificate, set_all
from lavender.judge.solution import Status


def call(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    """One run of the backend."""
    import qpalm

    rows, low, high = two_sided(qp, True)
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
    set_all(settings, extra, "qpalm")
    solver = qpalm.Solver(data, settings)
    x, zeta, xi = qp.start(impulse)
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
        words=name,
        x=np.array(solver.solution.x),
        zeta=y[:r],
        xi=y[r:],
        work={"iterations": solver.info.iter, "outer": solver.info.iter_out},
        direction=certificate(np.array(solver.dual_inf_certificate), qp.n) if "dual inf" in name else None,
        contradiction=certificate(np.array(solver.prim_inf_certificate)[:r], r)
        if "primal inf" in name
        else None,
    )
