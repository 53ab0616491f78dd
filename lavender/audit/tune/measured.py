"""Settings of an engine, their results, and the timing in which settings alternate.

A `Stage` holds worlds of a model and measures settings on them. Each world is run with the present setting and cut
into stretches of `horizon` steps. Each setting steps from the start of every stretch by itself. Measured are

    time    [s] of each step, per world: the minimum of several repeats, in which settings alternate
    error   [m/s] of the engine's answer to the problem of each step, computed by the judge
    motion  [m] largest distance of a body, at the end of a stretch, from its position in a run with converged solves
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lavender.audit.settings import MujocoSetting
from lavender.base.arrays import FloatArray
from lavender.report import machine
from lavender.report.runner import Event

ERROR_QUANTILE = 0.99  # Settings are compared by this quantile of the error over all steps.
# Only the first round times a setting that takes more than this multiple of the present setting's time.
MAX_TIME_RATIO = 2.0


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


class Progress:
    """Number of measurements that are done and, estimated, to come.

    Parameters
    ----------
    watch : callable, optional
        Called with an `Event` at the beginning of each measurement.
    """

    def __init__(self, watch: Callable[[Event], None] | None) -> None:
        self.watch = watch
        self.done = self.expected = 0
        self.loads: list[float | None] = []  # Number of runnable processes at each timing.

    def begin_measurement(self, kind: str, text: str) -> None:
        """Show the progress before a measurement, "judging" or "timing", which then counts as done."""
        if self.watch is not None:
            self.watch(Event(self.done, self.done + max(1, self.expected), f"{kind}: {text}", ""))
        if kind == "timing":
            self.loads.append(machine.count_runnable_processes())
        self.done += 1
        self.expected -= 1


def make_unmeasured(setting: MujocoSetting, solver: str) -> Measured:
    """Build the result of a setting with which a world diverges: its error, motion and times are infinite."""
    never = np.full(1, np.inf)
    return Measured(setting, solver, never, never, never)
