"""A proof that a problem has no solution, which `auto` looks for where nobody gets there.

A^T y <= 0 (= 0 on free rows),  y >= 0 (any sign there),  b.y > 0
"""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np

from lavender.certificates import check_certificate
from lavender.solvers._trail import Trail

__all__ = ["certify"]

CERTIFICATE_ROWS = 3000  # rows up to which a linear program is asked for a certificate
CERTIFICATE_STEPS = 100  # of the simplex method for each row at most


@np.errstate(all="ignore")  # what overflows is judged
def certify(trail: Trail) -> None:
    """Look for a proof that an LCP without upper bounds has no solution, whatever its A."""
    problem = trail.problem
    cones = problem.cones
    if (
        problem.law not in ("linear", "lcp")
        or problem.m > CERTIFICATE_ROWS
        or trail.best < 1e-6
        or trail.late
    ):
        return
    free = np.isneginf(cones.lower) & np.isposinf(cones.upper)
    if not np.all(free | ((cones.lower == 0.0) & np.isposinf(cones.upper))):
        return
    from scipy.optimize import linprog  # 0.1 s to import, needed only here

    # max b.y, A^T y <= 0 (= 0 on free rows), 0 <= y <= 1, in units of d.
    scale = 1.0 / np.sqrt(problem.d)
    at = (problem.csr.T.multiply(scale[:, None])).multiply(scale[None, :]).tocsr()
    if not (np.isfinite(at.data).all() and np.isfinite(scale * problem.b).all()):
        return
    bounds = np.stack([np.where(free, -1.0, 0.0), np.ones(problem.m)], 1)
    options: dict[str, Any] = {"maxiter": CERTIFICATE_STEPS * problem.m}
    if trail.deadline < np.inf:
        options["time_limit"] = max(trail.deadline - perf_counter(), 1e-3)
    found = linprog(
        -(scale * problem.b),
        A_ub=at[~free] if (~free).any() else None, b_ub=np.zeros(int((~free).sum())) if (~free).any() else None,
        A_eq=at[free] if free.any() else None, b_eq=np.zeros(int(free.sum())) if free.any() else None,
        bounds=bounds, method="highs", options=options,
    )  # fmt: skip
    trail.steps.append("linear program for a certificate")
    trail.work["certificates"] = trail.work.get("certificates", 0) + 1
    if found.x is not None:
        y = np.where((found.x > 0.0) | free, found.x, 0.0) * scale
        if check_certificate(problem, y) is None:
            trail.certificate = y
