"""Solvers of other packages, as convex programs. A table of specs; no backend is imported until it runs."""

from __future__ import annotations

from lavender.external.backends import SPECS

__all__ = ["SPECS"]
