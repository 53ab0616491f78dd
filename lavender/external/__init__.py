"""Solvers of other packages, as convex programs. A table of specs; no backend is imported until it runs."""

from __future__ import annotations

from lavender.external import backends, clarabel_cone
from lavender.registry import SolverSpec

__all__ = ["SPECS"]

SPECS: tuple[SolverSpec, ...] = (*backends.SPECS, clarabel_cone.SPEC)
