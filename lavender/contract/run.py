"""Run the checks on one solver; a plug-in runs in another process, which may crash or hang."""

from __future__ import annotations

import traceback
import warnings
from collections.abc import Iterator
from typing import NamedTuple

from lavender.base.errors import format_error
from lavender.base.subprocesses import ProcessBackend, ProcessEnded, RemoteError
from lavender.contract.checks import CHECKS, Check, ContractError, list_checks
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


def check_solver(name: str, timeout: float = 600.0) -> Iterator[tuple[Check, Failure]]:
    """Yield each check that applies to a solver, and its result.

    Each check of a plug-in with an entry point runs in another process, for at most `timeout` [s]. An unknown name
    raises UnknownName, a missing package SolverUnavailable.
    """
    spec = registry.get(name)
    process = ProcessBackend({"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"})
    try:
        for check in list_checks(spec):
            remote = bool(spec.distribution)
            yield check, run_remotely(process, name, check, timeout) if remote else find_failure(spec, check)
    finally:
        process.close()


def run_remotely(process: ProcessBackend, name: str, check: Check, timeout: float) -> Failure:
    """Run a check in another process, and return its result."""
    try:
        failure: Failure = process.call_function(run_check, name, check.name, timeout=timeout)
        return failure
    except TimeoutError:
        return Failure(f"the check did not end within {timeout:g} s; its process was killed")
    except (ProcessEnded, RemoteError) as error:
        return Failure(f"the code of the solver ended its process ({error}), or sent no answer")


def run_check(name: str, check: str) -> Failure:
    """Run a check by name, in the other process."""
    return find_failure(registry.get(name), CHECKS[check])


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
