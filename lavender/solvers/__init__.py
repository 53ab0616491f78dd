"""Table of the built-in solvers. A new solver needs a file in this folder and a line in the table.

`auto` calls other solvers in the sequence of every solve, so its file is in `lavender.solving`.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

from lavender.base.lazy_import import import_module_under_lock
from lavender.solvers.registry import SolverSpec

__all__ = ["SPECS", "get_spec"]

# Names of the files in this folder that define a SPEC, from exact to simple methods.
_TABLE = (
    "auto",
    "direct",
    "newton",
    "lemke",
    "admm",
    "block_gauss_seidel",
    "nncg",
    "anderson",
    "pgs",
    "sequential_impulses",
    "jacobi",
    "sor",
    "gauss_seidel",
)

SPECS: tuple[
    SolverSpec, ...
]  # The specs of all solvers; `__getattr__` imports them at the first access.


def get_spec(name: str) -> SolverSpec | None:
    """Return the spec of one solver, importing its file if necessary; None if it is not in the table."""
    package = "lavender.solving" if name == "auto" else __name__
    return import_module_under_lock(f"{package}.{name}").SPEC if name in _TABLE else None


def __getattr__(name: str) -> Any:
    if name != "SPECS":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return tuple(map(get_spec, _TABLE))


class _SolversModule(ModuleType):
    """Module that raises an error when it is called: `lavender.solvers()` names the functions that list solvers."""

    def __call__(self, *args: Any, **arguments: Any) -> Any:
        raise TypeError(
            "lavender.solvers is a module; lavender.available(problem) lists the solvers that accept a problem, and "
            "lavender.known() describes all solvers"
        )


sys.modules[__name__].__class__ = _SolversModule
