"""All checks of the requirements on every solver, in the order in which they run."""

# Importing a module of checks adds its functions to `CHECKS`.
from lavender.contract import check_forms, check_iterations, check_results
from lavender.contract.check_results import UNSOLVABLE_MATRICES
from lavender.contract.requirement import (
    CHECKS,
    Check,
    ContractError,
    get_check_name,
    list_checks,
    make_problems_of_every_kind,
    make_well_posed_problems,
)

__all__ = [
    "CHECKS",
    "UNSOLVABLE_MATRICES",
    "Check",
    "ContractError",
    "check_forms",
    "check_iterations",
    "check_results",
    "get_check_name",
    "list_checks",
    "make_problems_of_every_kind",
    "make_well_posed_problems",
]
