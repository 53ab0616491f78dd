"""Raise the compliance of rows with an R so small that float64 cannot hold their impulses.

MuJoCo computes the force of a row from its acceleration a: f = -r / R with r = J a - aref. If R is far below
d = (J M^-1 J^T)_ii, as on a body whose centre of mass lies on the axle of its joint, rounding of r changes f by about
2^-53 d / R of itself: the forces are noise. A problem has a larger R in rows with R below `MIN_COMPLIANCE_RATIO` d,
because float64 cannot hold the impulses of contradictory rows: `raise_compliance`. All of these rows get the same
factor, so that contradictory rows keep their weights. The velocities of the solution change by about
`MIN_COMPLIANCE_RATIO` of themselves.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.batch.data import Batch
from lavender.io.engine_motion import EngineMotions
from lavender.problem import Problem

# [1/kg] If all compliances are larger, no row is examined. A common contact has 1e-3 to 1.
MAX_EXAMINED_COMPLIANCE = 1e-4
# [-] Smallest R / d of a problem. In float64, impulses of contradictory rows have an error of 2^-53 d / R = 2e-6 of
# the velocities. The raised R changes the motion by R / d = 6e-11.
MIN_COMPLIANCE_RATIO = 2.0**-34
# [-] Rows with compliances up to this factor above the smallest one keep their weights against each other.
MAX_COMPLIANCE_SPAN = 2.0**8
MAX_RAISED_RATIO = (
    2.0**-10
)  # [-] Largest R / d of a raised row, which a row with a small d would exceed.


def raise_compliance(problem: Problem) -> FloatArray | None:
    """Return the compliance (m,) [1/kg] with which float64 can hold the impulses; None if it needs no change."""
    assert problem.compliance is not None
    compliance = np.broadcast_to(problem.compliance, problem.m)
    if not problem.m or compliance.min() > MAX_EXAMINED_COMPLIANCE:
        return None
    rigid = problem.d - compliance
    needed = MIN_COMPLIANCE_RATIO * rigid
    is_low = (compliance < needed) & (compliance > 0.0)
    if not is_low.any():
        return None
    is_alike = (compliance > 0.0) & (compliance <= MAX_COMPLIANCE_SPAN * compliance[is_low].min())
    factor = np.max(needed[is_low & is_alike] / compliance[is_low & is_alike])
    alike = np.minimum(factor * compliance, MAX_RAISED_RATIO * rigid)
    raised = np.where(is_alike, alike, np.where(is_low, needed, compliance))
    return np.maximum(raised, compliance)


def make_engine_batch(
    make_batch: Callable[[FloatArray], Batch],
    compliance: FloatArray,
    impulse: FloatArray | None = None,
    change: FloatArray | None = None,
    moved_by: str = "acceleration",
    momentum: FloatArray | None = None,
) -> Batch:
    """Raise the compliances of stiff rows of a batch, make the batch, and add the motions of the engine.

    Parameters
    ----------
    make_batch : callable
        Returns the batch with given compliances.
    compliance : array of the batch's shape, 1/kg
    impulse : array of the batch's shape, N s, optional
        The engine's forces times the time step; if it or `change` is not given, no motions are added.
    change : (n, nv), m/s, rad/s, optional
        Velocity changes by the constraints, dt (a - a0).
    moved_by : {"acceleration", "forces"}
    momentum : (n, nv), N s, N m s, optional
        See `EngineMotion`.
    """
    batch = make_batch(compliance)
    engine = compliance.reshape(-1)
    raised = compliance.reshape(-1).copy()
    stiff = set()
    for i in range(len(batch)) if engine.min(initial=np.inf) < MAX_EXAMINED_COMPLIANCE else ():
        rows = batch.rows_of(i)
        if engine[rows].min(initial=np.inf) < MAX_EXAMINED_COMPLIANCE:
            with contextlib.suppress(InputError):  # A world that is not finite is not judged.
                higher = raise_compliance(batch[i])
                raised[rows] = engine[rows] if higher is None else higher
                stiff.add(i)
    if stiff and not np.array_equal(raised, engine):
        batch = make_batch(raised.reshape(compliance.shape))
    if impulse is not None and change is not None:
        at = batch.at
        has_motion = at["rows"] > 0
        if moved_by != "acceleration":
            has_motion &= np.isin(np.arange(len(batch)), list(stiff))
        batch.engine_motions = EngineMotions(
            np.stack([at["row"], at["row"] + at["rows"]], axis=1),
            np.stack([at["velocity"], at["velocity"] + at["velocities"]], axis=1),
            has_motion,
            impulse.reshape(-1),
            change.reshape(-1),
            engine,
            moved_by,
            None if momentum is None else momentum.reshape(-1),
        )
    return batch
