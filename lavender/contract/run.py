"""Run the checks on one solver."""

from __future__ import annotations

import traceback
import warnings
from collections.abc import Iterator
from typing import NamedTuple

from lavender.base.errors import format_error
from lavender.contract.checks import Check, ContractError, list_checks
from lavender.solvers import registry
from lavender.solvers.registry import SolverSpec


class Failure(NamedTuple):
    """Result of a check.

    Parameters
    ----------
    text : str
        Sentence of the failure; empty if the requirement is met.
    problem : str
        Name of the problem of the failure in `make_problems`, or empty.
    """

    text: str
    problem: str = ""


def check_solver(name: str) -> Iterator[tuple[Check, Failure]]:
    """Yield each check that applies to a solver, and its result.

    An unknown name raises UnknownName, a missing package SolverUnavailable.
    """
    spec = registry.get(name)
    for check in list_checks(spec):
        yield check, find_failure(spec, check)


def find_failure(spec: SolverSpec, check: Check) -> Failure:
    """Run a check, and return its result."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            check.run(spec)
    except ContractError as error:
        return Failure(str(error), error.problem)
    except Exception as error:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        return Failure(
            f"{format_error(error)} was raised in {frame.filename}, line {frame.lineno} ({frame.name})"
        )
    return Failure("")
