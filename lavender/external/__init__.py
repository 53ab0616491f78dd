"""Solvers of other packages, as convex programs. A table of specs; no backend is imported until it runs."""

from __future__ import annotations

from lavender.external import clarabel_cone, qpsolvers_
from lavender.registry import SolverSpec

__all__ = ["SPECS"]

SPECS: tuple[SolverSpec, ...] = (*qpsolvers_.SPECS, clarabel_cone.SPEC)
