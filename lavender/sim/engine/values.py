"""The eight solver values of a step: names, units, and an array that prints with them."""

from __future__ import annotations

import numpy as np

#: The eight values of `observation["solver"]`, of the final substep: sweep budget, warm-start mode (0 or 1),
#: contacts, contacts found in the cache, max |e_n| [N s] before the first sweep and after the last, and
#: max(0, -w_n) [m/s] likewise.
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
    """An array whose text, if it holds eight numbers of float64, is one line for each name with its unit."""

    def __str__(self) -> str:
        if self.shape != (len(SOLVER_FIELDS),) or self.dtype != np.float64:
            return str(self.view(np.ndarray))
        lines = zip(SOLVER_FIELDS, self.tolist(), SOLVER_UNITS, strict=True)
        return "\n".join(f"{name:<18} {x:<10.4g}{unit}".rstrip() for name, x, unit in lines)

    def __repr__(self) -> str:
        return repr(self.view(np.ndarray))
