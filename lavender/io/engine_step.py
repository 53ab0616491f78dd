"""Results of importers of other engines: the problems of one step of all worlds, the engine's answer and its claims."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.batch.data import Batch


class Claims(NamedTuple):
    """The engine's own report about each world's solve.

    Parameters
    ----------
    converged : (n,) bool
    iterations : (n,) int
        -1 if the engine does not count them for each world.
    residuals : dict of (n,) arrays
        The numbers that the engine compared with its tolerances, by its own names (PADMM: r_p, r_d, r_c).
    """

    converged: np.ndarray
    iterations: np.ndarray
    residuals: dict[str, FloatArray]


class EngineStep(NamedTuple):
    """Problems of one step of all worlds of an engine, its impulses, and its claims.

    Parameters
    ----------
    batch : Batch
    impulse : array of the batch's shape, N s
        The engine's answer in the rows of the batch.
    claims : Claims
    state : dict of (n, ...) arrays, optional
        State before the step by the engine's names. Importers, which read the state after the step, leave it empty;
        `lavender.audit.engine_scenes` fills it.
    """

    batch: Batch
    impulse: FloatArray
    claims: Claims
    state: dict[str, FloatArray] | None = None
