"""The eight solver values of a step: names, units, and an array type that prints them."""

from __future__ import annotations

import numpy as np

#: The eight values of `observation["solver"]` for the last substep: sweep budget, warm-start mode (0 or 1), number of
#: contacts, number of contacts with an entry in the cache, max |e_n| [N s] before the first and after the last sweep,
#: max(0, -w_n) [m/s] before the first and after the last sweep.
SOLVER_FIELDS = (
    "iterations",
    "warm_start",
    "contacts",
    "cache_matches",
    "residual_initial",
    "residual_final",
    "violation_initial",
    "violation_final",
)
SOLVER_UNITS = ("", "", "", "", "N s", "N s", "m/s", "m/s")


class SolverValues(np.ndarray):
    """Array that is printed as one line per value with name and unit, if it holds eight float64 numbers."""

    def __str__(self) -> str:
        if self.shape != (len(SOLVER_FIELDS),) or self.dtype != np.float64:
            return str(self.view(np.ndarray))
        lines = zip(SOLVER_FIELDS, self.tolist(), SOLVER_UNITS, strict=True)
        return "\n".join(f"{name:<18} {x:<10.4g}{unit}".rstrip() for name, x, unit in lines)

    def __repr__(self) -> str:
        return repr(self.view(np.ndarray))
