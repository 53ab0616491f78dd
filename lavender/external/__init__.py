"""Solvers of other packages ("backends"), to which problems are passed as convex programs.

`backends` has a table of their specs. A backend is imported when it first runs.
"""

from __future__ import annotations

from lavender.external.backends import SPECS

__all__ = ["SPECS"]
