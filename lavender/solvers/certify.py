"""A certificate that a problem has no solution, which `auto` looks for if all candidates fail.

    A^T y <= 0 (= 0 on free rows),  y >= 0 (any sign there),  b.y > 0

On a contact y is along the normal, as Coulomb's law requires, and z = A^T y satisfies z_n + mu |z_t| <= 0. The sum of
|z_t| replaces its norm: every certificate found this way is valid, but with two tangents a few are not found.

One infeasible island makes the problem infeasible. The unsolved islands are tried one by one, because an upper bound in
another island does not matter.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender._later import sparse as sp
from lavender.deadline import Deadline
from lavender.ordering import blocks_of_each
from lavender.problem import Problem
from lavender.solution import Claim, Status
from lavender.solvers.islands import restrict, rows_of
from lavender.solvers.setup_times import loading
from lavender.solvers.solve_log import SolveLog

__all__ = ["certify"]

CERTIFICATE_ROWS = (
    3000  # rows up to which a linear program is asked for a certificate, of all islands together
)
LINEAR_PROGRAM = 5e6  # ns that scipy takes for the smallest
CERTIFICATE_STEPS = 100  # of the simplex method for each row at most


@np.errstate(all="ignore")  # what overflows is judged
def certify(log: SolveLog) -> None:
    """Look for a certificate that a problem without upper bounds has no solution, for any A."""
    problem = log.problem
    if log.best < 1e-6 or log.ends_late(LINEAR_PROGRAM + 1e9 * loading("scipy.optimize")):
        return
    asked = 0
    for part, rows in _parts(log):
        asked += part.m
        if asked > CERTIFICATE_ROWS or log.ends_late(LINEAR_PROGRAM):
            return
        if not _is_open(part):
            continue
        y = find_direction(part, log.deadline)
        proof = None
        if y is not None:
            proof = np.zeros(problem.m)
            proof[rows] = y
        claim = Claim(Status.STALLED, 0, {"certificates": 1}, certificate=proof)
        log.note("linear program", claim, log.best)
        if log.certificate is not None:
            return


def _parts(log: SolveLog) -> Any:
    """Unsolved islands and their rows, the smallest first; the whole problem if there is only one."""
    problem = log.problem
    if log.islands[0] <= 1:
        yield problem, slice(None)
        return
    blocks = blocks_of_each(*log.islands)
    for i in sorted(log.wrong_islands(), key=lambda i: len(blocks[i])):
        rows = rows_of(problem, blocks[i])
        yield restrict(problem, blocks[i], rows), rows


def _is_open(problem: Problem) -> bool:
    """Every row is free, or bounded by 0 below alone."""
    cones = problem.cones
    free = np.isneginf(cones.lower) & np.isposinf(cones.upper)
    return bool(np.all(free | ((cones.lower == 0.0) & np.isposinf(cones.upper))))


def find_direction(problem: Problem, deadline: Deadline) -> FloatArray | None:
    """A direction y (m,) from a linear program, still to be checked."""
    from scipy.optimize import linprog  # 0.1 s to import, needed only here

    # max b.y, A^T y + R u <= 0 (= 0 on free rows), |A^T y| <= u on tangents, 0 <= y <= 1, in units of d.
    cones = problem.cones
    contact, tangent = cones.contact_rows, cones.friction_rows
    free = np.isneginf(cones.lower) & np.isposinf(cones.upper) & ~contact
    scale = 1.0 / np.sqrt(problem.d)
    normal = np.repeat(cones.ptr[:-1], np.diff(cones.ptr))
    limit = cones.reach * scale[normal] / scale
    rim = sp.csr_array(
        (limit[tangent], (normal[tangent], np.arange(tangent.sum()))), (problem.m, int(tangent.sum()))
    )
    at = (problem.csr.T.multiply(scale[:, None])).multiply(scale[None, :]).tocsr()
    if not all(np.isfinite(x).all() for x in (at.data, rim.data, scale * problem.b)):
        return None
    unit = sp.eye_array(rim.shape[1], format="csr")
    below = ~free & ~tangent
    rows = [[at[below], rim[below]], [at[tangent], -unit], [-at[tangent], -unit]]
    above = sp.vstack([sp.hstack(x) for x in rows]).tocsr()
    level = sp.hstack([at[free], rim[free]]).tocsr()
    low = np.concatenate([np.where(free, -1.0, 0.0), np.zeros(rim.shape[1])])
    high = np.concatenate([np.where(tangent, 0.0, 1.0), np.full(rim.shape[1], np.inf)])
    gain = np.concatenate([scale * problem.b, np.zeros(rim.shape[1])])
    options: dict[str, Any] = {"maxiter": CERTIFICATE_STEPS * problem.m}
    if deadline.is_set:
        options["time_limit"] = deadline.left(1e-3)
    found = linprog(
        -gain, A_ub=above, b_ub=np.zeros(above.shape[0]), A_eq=level, b_eq=np.zeros(level.shape[0]),
        bounds=np.stack([low, high], 1), method="highs", options=options,
    )  # fmt: skip
    if found.x is None:
        return None
    x = found.x[: problem.m]
    y: FloatArray = np.where((x > 0.0) | free, x, 0.0) * scale
    return y
