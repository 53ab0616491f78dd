"""OSQP: operator splitting with polishing (Stellato et al. 2020)."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.base.later import sparse as sp
from lavender.external.as_qp import QP, two_sided
from lavender.external.running import Answer, Limits, certificate
from lavender.judge.solution import Status


@cache
def _algebra() -> str:
    """The algebra that OSQP takes by itself, found once.

    `osqp.OSQP()` would look for the modules of two others every time, which takes 0.2 ms and locks of the import: a
    process that is forked meanwhile waits for them for ever.
    """
    import osqp

    return str(osqp.default_algebra())


def call(qp: QP, impulse: FloatArray, limit: Limits, extra: dict[str, Any]) -> Answer:
    """One run of the backend."""
    import osqp

    rows, low, high = two_sided(qp, True)
    solver = osqp.OSQP(algebra=_algebra())
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
    solver.warm_start(x=x, y=np.concatenate([zeta, xi])[: len(low)])
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
        words=f"{info.status}{polished}",
        x=np.asarray(result.x),
        zeta=y[:r],
        xi=y[r:],
        work={"iterations": info.iter, "factorisations": 1 + info.rho_updates},
        direction=certificate(result.dual_inf_cert, qp.n),
        contradiction=certificate(None if result.prim_inf_cert is None else result.prim_inf_cert[:r], r),
    )
