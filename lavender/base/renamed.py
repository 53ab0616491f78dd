"""Names that users try, and the names to use: earlier names of this package, and names of similar packages."""

from __future__ import annotations

#: Owner -> {name that does not exist: name to use}.
INSTEAD = {
    "lavender": {
        "Motions": "SolutionSet",
        "Suspicion": "Diagnostic",
        "Turn": "SolverStage",
        "motions": "find_solutions",
        "solvers": "available or known",
    },
    "Solution": {
        "contradicted": "status_conflict",
        "impulses": "impulse",
        "lam": "impulse",
        "turns": "stages",
        "x": "impulse",
    },
    "Residual": {
        "energy_at_zero": "energy_at_zero",
        "floor": "roundoff_floor",
        "velocity_at_zero": "velocity_at_zero",
    },
    "Status": {"ROUNDOFF_LIMIT": "ROUNDOFF_LIMIT", "INVALID_PROBLEM": "INVALID_PROBLEM"},
}


def build_attribute_error(owner: str, subject: str, name: str) -> AttributeError:
    """Build the error for a missing attribute `name` of `subject`, with the name to use if `INSTEAD[owner]` has one."""
    instead = INSTEAD[owner].get(name)
    hint = f"; use {instead}" if instead else ""
    return AttributeError(f"{subject} has no attribute {name!r}{hint}")
