"""The requirements on every solver, as checks that run on built-in solvers and on plug-ins.

    from lavender import contract
    for outcome in contract.check_solver("apgd"):
        print(outcome)

`checks` has the requirements, `problems` random problems of every law, kind of contact and form, and `enumeration` all
solutions of small problems. With the extra `contract`, Hypothesis searches for small counterexamples.
"""

from lavender.contract.checks import CHECKS, Check, ContractError, list_checks
from lavender.contract.run import Outcome, check_solver

__all__ = ["CHECKS", "Check", "ContractError", "Outcome", "check_solver", "list_checks"]
