"""Run the checks on one solver; a plug-in runs in another process, which may crash or hang."""

from __future__ import annotations

import traceback
import warnings
from collections.abc import Iterator

from lavender.base.errors import format_error
from lavender.base.subprocesses import Answer, InvalidAnswer, ProcessBackend, ProcessEnded, RemoteError
from lavender.contract.checks import CHECKS, Check, ContractError, list_checks
from lavender.solvers import registry
from lavender.solvers.registry import SolverSpec


def check_solver(name: str, timeout: float = 600.0) -> Iterator[tuple[Check, str]]:
    """Yield each check that applies to a solver, and the sentence of its failure; empty if the requirement is met.

    Each check of a plug-in with an entry point runs in another process, for at most `timeout` [s]. An unknown name
    raises UnknownName, a missing package SolverUnavailable.
    """
    spec = registry.get(name)
    process = ProcessBackend(run_check, environment={"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"})
    try:
        for check in list_checks(spec):
            remote = bool(spec.distribution)
            yield check, run_remotely(process, name, check, timeout) if remote else find_failure(spec, check)
    finally:
        process.close()


def run_remotely(process: ProcessBackend, name: str, check: Check, timeout: float) -> str:
    """Run a check in another process, and return the sentence of its failure; empty if the requirement is met."""
    try:
        process.start()
        answer, _ = process.call_function(name, check.name, timeout=timeout, max_bytes=0)
        return str(answer.get("failure", "the process of the solver sent no answer"))
    except TimeoutError:
        return f"the check did not end within {timeout:g} s; its process was killed"
    except (ProcessEnded, RemoteError, InvalidAnswer) as error:
        return f"the code of the solver ended its process ({error}), or sent no answer"


def run_check(name: str, check: str) -> Answer:
    """Run a check by name, in the other process."""
    return {"failure": find_failure(registry.get(name), CHECKS[check])}, ()


def find_failure(spec: SolverSpec, check: Check) -> str:
    """Run a check, and return the sentence of its failure, empty if the requirement is met."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            check.run(spec)
    except ContractError as error:
        return str(error)
    except Exception as error:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        return f"{format_error(error)} was raised in {frame.filename}, line {frame.lineno} ({frame.name})"
    return ""
