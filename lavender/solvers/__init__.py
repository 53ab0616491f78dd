"""The table of built-in solvers. A new solver is one file here and one line in this table."""

from __future__ import annotations

from lavender.registry import SolverSpec
from lavender.solvers import gauss_seidel, jacobi, pgs, sequential_impulses, sor

SPECS: tuple[SolverSpec, ...] = (
    gauss_seidel.SPEC,
    sor.SPEC,
    jacobi.SPEC,
    pgs.SPEC,
    sequential_impulses.SPEC,
)
