"""Run the checks on one solver; a plug-in runs in another process, which may crash or hang."""

from __future__ import annotations

import traceback
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

from lavender.base.subprocesses import (
    Answer,
    InvalidAnswer,
    ProcessBackend,
    ProcessEnded,
    RemoteError,
)
from lavender.contract.checks import CHECKS, Check, ContractError, list_checks
from lavender.solvers import registry
from lavender.solvers.registry import SolverSpec

CHECK_TIMEOUT = 600.0  # [s] A check that takes longer than this counts as not met, and its process is killed.
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@dataclass(frozen=True)
class Outcome:
    """Outcome of one check.

    Parameters
    ----------
    check : Check
    failure : str
        Sentence that describes how the solver fails the requirement; empty if the requirement is met.
    """

    check: Check
    failure: str = ""

    @property
    def met(self) -> bool:
        """Whether the solver meets the requirement."""
        return not self.failure

    def __str__(self) -> str:
        return f"{self.check.name}: {self.failure or 'met'}"


def check_solver(name: str, timeout: float = CHECK_TIMEOUT) -> Iterator[Outcome]:
    """Yield the outcome of every check that applies to a solver.

    Parameters
    ----------
    name : str
        Name of a solver. A plug-in with an entry point runs in another process.
    timeout : float, s
        Limit of each check in another process.

    Raises
    ------
    UnknownName, SolverUnavailable
        There is no such solver, or its package is not installed.
    """
    spec = registry.get(name)
    if not spec.from_entry_point:
        for check in list_checks(spec):
            yield Outcome(check, find_failure(spec, check))
        return
    process = ProcessBackend(run_check, environment=ONE_THREAD)
    try:
        for check in list_checks(spec):
            yield Outcome(check, _run_in_process(process, name, check, timeout))
    finally:
        process.close()


def _run_in_process(process: ProcessBackend, name: str, check: Check, timeout: float) -> str:
    """Run a check in another process, and return the sentence of its failure; empty if the requirement is met."""
    try:
        process.start()
        answer, _ = process.call_function(name, check.name, timeout=timeout, max_bytes=0)
        return str(answer.get("failure", "the process of the solver sent no answer"))
    except TimeoutError:
        return f"the check did not end within {timeout:g} s; its process was killed"
    except ProcessEnded as error:
        return f"the code of the solver ended its process ({error})"
    except (RemoteError, InvalidAnswer) as error:
        return f"the process of the solver failed: {error}"


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
        return (
            f"{type(error).__name__} was raised in {frame.filename}, line {frame.lineno} ({frame.name}): "
            f"{str(error) or 'no text'}"
        )
    return ""
