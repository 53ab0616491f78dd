"""Results of one setting of an engine."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lavender.audit.settings import MujocoSetting
from lavender.base.arrays import FloatArray

ERROR_QUANTILE = 0.99  # Settings are compared by this quantile of the error over all steps.


@dataclass(eq=False)
class Measured:
    """Results of one setting on some worlds.

    Parameters
    ----------
    setting : MujocoSetting
    solver : str
    error : (steps,) m/s
    motion : (stretches,) m
    times : (steps,) s
        Each time is the minimum of all repeats, which removes interruptions.
    rows, contacts : (steps,) int
    """

    setting: MujocoSetting
    solver: str
    error: FloatArray = field(repr=False)
    motion: FloatArray = field(repr=False)
    times: FloatArray = field(repr=False)
    rows: Any = field(default=(), repr=False)
    contacts: Any = field(default=(), repr=False)

    @property
    def mean_step_time(self) -> float:
        """Mean time of a step [s]; infinite if it was not timed."""
        return float(self.times.mean())

    @property
    def worst_error(self) -> float:
        """Error [m/s] that 1 % of the steps exceed."""
        return float(np.quantile(self.error, ERROR_QUANTILE, method="higher"))

    @property
    def worst_motion(self) -> float:
        """Distance [m] that 1 % of the stretches exceed."""
        return float(np.quantile(self.motion, ERROR_QUANTILE, method="higher"))


def make_unmeasured(setting: MujocoSetting, solver: str) -> Measured:
    """Build the result of a setting with which a world diverges: its error, motion and times are infinite."""
    never = np.full(1, np.inf)
    return Measured(setting, solver, never, never, never)
