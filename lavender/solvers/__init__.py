"""The table of built-in solvers. A new solver is one file here and one line in this table."""

from __future__ import annotations

from typing import Any

from lavender.base.lazy_import import import_locked
from lavender.solvers.registry import SolverSpec

__all__ = ["SPECS", "spec_of"]

# File in this folder, with its SPEC; from the exact to the plain.
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

SPECS: tuple[SolverSpec, ...]  # of all, imported when they are first asked for


def spec_of(name: str) -> SolverSpec | None:
    """The spec of one solver, whose file is imported now if it was not before; None if it is not in the table."""
    return import_locked(f"{__name__}.{name}").SPEC if name in _TABLE else None


def __getattr__(name: str) -> Any:
    if name != "SPECS":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return tuple(map(spec_of, _TABLE))
