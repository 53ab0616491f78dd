"""The requirements on every solver, as checks on small problems for built-in solvers and plug-ins."""

from lavender.contract.checks import (
    CHECKS,
    Check,
    ContractError,
    Failure,
    check_solver,
    list_checks,
)
from lavender.contract.problems import make_problems

__all__ = [
    "CHECKS",
    "Check",
    "ContractError",
    "Failure",
    "check_solver",
    "list_checks",
    "make_problems",
]
__dir__ = sorted(__all__).copy  # Completion shows public names only.
