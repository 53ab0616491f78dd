"""The table of built-in solvers. A new solver is one file here and one line in this table."""

from __future__ import annotations

from importlib import import_module

from lavender.registry import SolverSpec

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

SPECS: tuple[SolverSpec, ...] = tuple(import_module(f"{__name__}.{name}").SPEC for name in _TABLE)
