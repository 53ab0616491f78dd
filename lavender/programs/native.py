"""Calls of OSQP and Clarabel by their own interfaces: a warm start, iteration counts, second-order cones."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.judge.solution import Status
from lavender.programs.convex import ScaledProgram
from lavender.programs.running import Answer, Limits, classify_status


def call_clarabel(
    program: ScaledProgram,
    start: tuple[FloatArray, FloatArray] | None,
    limit: Limits,
    extra: dict[str, Any],
) -> Answer:
    """Call Clarabel: interior point, homogeneous embedding, second-order cones (Goulart, Chen 2024)."""
    import clarabel

    # All rows A x + s = b: equations, inequalities with the bounds, cones.
    equations, inequalities, _, _ = program.split_rows(True)
    rows = np.concatenate([equations, inequalities])
    n_inequalities = len(inequalities) - sum(program.cones)
    cones = [clarabel.ZeroConeT(program.free)] if program.free else []
    cones += [clarabel.NonnegativeConeT(n_inequalities)] if n_inequalities else []
    cones += [clarabel.SecondOrderConeT(size) for size in program.cones]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.max_iter = limit.max_iter
    settings.tol_feas = settings.reduced_tol_feas = limit.eps
    settings.tol_gap_abs = settings.tol_gap_rel = limit.gap
    settings.tol_ktratio = 1e-10
    # With reduced tolerances equal to the tolerances, "almost solved" is not reported for a looser tolerance.
    settings.reduced_tol_gap_abs = settings.reduced_tol_gap_rel = limit.gap
    if limit.time_limit is not None:
        settings.time_limit = limit.time_limit
    for key, value in extra.items():
        if not hasattr(settings, key):
            known = sorted(k for k in dir(settings) if not k.startswith("_"))
            raise InputError(f"clarabel has no setting {key!r}; known: {', '.join(known)}")
        setattr(settings, key, value)
    matrix = program.select_rows(rows, -1.0, False)
    data = program.make_upper_triangle(), program.q, matrix, -program.t[rows]
    result = clarabel.DefaultSolver(*data, cones, settings).solve()
    name = str(result.status)
    z = np.array(result.z)
    # "Almost infeasible" is a claim, too, because the certificate is checked.
    almost = name in ("AlmostPrimalInfeasible", "AlmostDualInfeasible")
    status = Status.INFEASIBLE if almost else classify_status(name)
    # There is one factorisation before the first step and one for each step.
    work = {"iterations": result.iterations, "factorisations": result.iterations + 1}
    lam = program.join_multipliers(-z[: program.free], z[program.free :], None, True)
    return Answer(status, name, np.array(result.x), lam, work)


@cache
def _get_osqp_algebra() -> str:
    """Return the default algebra of OSQP.

    If no algebra is passed to `osqp.OSQP()`, it searches the modules of two other algebras at every call. This takes
    0.2 ms and holds import locks, for which a process that is forked at that moment would wait forever.
    """
    import osqp

    return str(osqp.default_algebra())


def call_osqp(
    program: ScaledProgram,
    start: tuple[FloatArray, FloatArray] | None,
    limit: Limits,
    extra: dict[str, Any],
) -> Answer:
    """Call OSQP: operator splitting (Stellato et al. 2020)."""
    import osqp

    equations, inequalities, _, _ = program.split_rows(True)
    rows = np.concatenate([equations, inequalities])
    matrix = program.select_rows(rows, 1.0, False)
    low = program.t[rows]
    high = np.where(rows < program.free, low, np.inf)
    solver = osqp.OSQP(algebra=_get_osqp_algebra())
    settings = {
        "eps_abs": limit.eps,
        "eps_rel": limit.eps,
        "eps_prim_inf": 1e-11,
        "eps_dual_inf": 1e-11,
        "max_iter": max(limit.max_iter, 1),
        "polishing": False,  # The adapter does a Newton step of its own.
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
    try:
        solver.setup(
            program.make_upper_triangle(), program.q, matrix, low, high, **(settings | extra)
        )
    except osqp.OSQPException as error:
        # The text is an error code; 4: the factorisation found that P is not positive semidefinite.
        message = (
            "P is not positive semidefinite" if str(error) == "4" else "see its list of error codes"
        )
        return Answer(Status.NUMERICAL_ERROR, f"OSQPException {error}: {message}")
    if start is not None:
        solver.warm_start(x=start[0], y=-start[1][rows])
    result = solver.solve(raise_error=False)
    info = result.info
    status = classify_status(result.info.status)
    x, y = result.x, result.y
    if status is Status.INFEASIBLE:  # Return its certificates in place of the iterate.
        x, y = (
            np.zeros(size) if part is None or np.size(part) != size else np.nan_to_num(part)
            for part, size in ((result.dual_inf_cert, program.n), (result.prim_inf_cert, len(rows)))
        )
    work = {"iterations": info.iter, "factorisations": 1 + info.rho_updates}
    lam = program.join_multipliers(y[: program.free], -y[program.free :], None, True)
    return Answer(status, str(info.status), np.array(x), lam, work)
