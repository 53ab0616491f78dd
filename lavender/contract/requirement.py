"""The list of requirements on solvers, and the problems and tolerances that the checks share.

A check is a function of a `SolverSpec`. It returns if the solver meets the requirement, and raises `ContractError`
with a sentence if it does not: the problem, the result and the required result.
"""

from __future__ import annotations

import functools
import inspect
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.contract.problems import (
    CONTACTS,
    FORMS,
    as_matrix,
    random_contact_problem,
    random_generalized_problem,
)
from lavender.judge.solution import Solution
from lavender.problem import LAWS, Problem
from lavender.solvers.registry import SolverSpec
from lavender.solving.solve import solve

#: Backends of other packages that must solve every example. Any other backend may fail if its result reports it.
REQUIRED_BACKENDS = frozenset({"osqp", "clarabel", "piqp", "daqp", "clarabel_cone"})
OWN_TOLERANCE = 1e-8  # [-] Relative residual that a solver must reach on well-posed problems.
BACKEND_TOLERANCE = 1e-6  # [-] Value of OWN_TOLERANCE for code of another project (`SolverSpec.external`).
MAX_CONDITION = 1e3  # [-] An impulse error of tol moves the slack of the examples by at most this multiple.
MIN_BUDGET = 20_000  # Iterations that a resumable solver may use on a well-posed problem.
HISTORY_COUNTS = [*range(17), 18, 20, 22, 24, 27, 30, 33, 37, 40]  # Iterations recorded in a solve of 40.
CHECKED_DRAWS = 30  # Number of random small problems for which claims are compared with all solutions.
# Largest number of rows of the random problems; finding all solutions takes a time ~ 3^rows.
MAX_DRAWN_ROWS = 6
THREADS = 4
#: Remedy in messages about false claims: the judge's residual decides, whatever the solver's own test measures.
STOP_TEST_REMEDY = (
    ". Claim CONVERGED only if lv.residual(problem, impulse).relative <= tol, or if the solver's own test implies "
    "this"
)


class ContractError(AssertionError):
    """A solver does not meet a requirement; the message is a sentence with the problem and the wrong result."""


@dataclass(frozen=True)
class Check:
    """One requirement.

    Parameters
    ----------
    name : str
    requirement : str
        The requirement as a sentence.
    applies_to : str
        Description of the solvers to which the requirement applies.
    applies : callable
        Returns whether the requirement applies to a `SolverSpec`.
    run : callable
        Raises ContractError if a `SolverSpec` does not meet the requirement.
    """

    name: str
    requirement: str
    applies_to: str
    applies: Callable[[SolverSpec], bool]
    run: Callable[[SolverSpec], None]


#: All checks by name, in the order in which they run.
CHECKS: dict[str, Check] = {}


def get_check_name(function: Callable[[SolverSpec], None]) -> str:
    """Return the name of the check that a function implements."""
    return function.__name__.removeprefix("require_")


def register_check(
    applies_to: str, applies: Callable[[SolverSpec], bool] = lambda spec: True
) -> Callable[[Callable[[SolverSpec], None]], Callable[[SolverSpec], None]]:
    """Return a decorator that adds a function to `CHECKS`; its docstring is "Require that ..."."""

    def add(function: Callable[[SolverSpec], None]) -> Callable[[SolverSpec], None]:
        summary = (inspect.getdoc(function) or "").partition("\n\n")[0].replace("\n", " ")
        text = summary.removeprefix("Require that ")
        name = get_check_name(function)
        CHECKS[name] = Check(name, text[:1].upper() + text[1:], applies_to, applies, function)
        return function

    return add


def list_checks(spec: SolverSpec) -> list[Check]:
    """Return the checks that a solver has to pass."""
    return [check for check in CHECKS.values() if check.applies(spec)]


def raise_unless(condition: bool | np.bool_, sentence: str) -> None:
    """Raise ContractError with the sentence unless the condition holds."""
    if not condition:
        raise ContractError(sentence)


# -- problems -----------------------------------------------------------------------------------------


def add_compliance(problem: Problem, compliance: float) -> Problem:
    """Return the problem with more compliance [1/kg], which adds to the smallest eigenvalue of A."""
    present = np.zeros(problem.m) if problem.compliance is None else problem.compliance
    return replace(problem, compliance=present + compliance)


@functools.cache
def make_well_posed_problem(law: str, rows: bool) -> Problem:
    """Return a problem of a law, given by rows or as a matrix; the smallest eigenvalue of A is far from zero."""
    if law == "linear":
        base = random_contact_problem(21, contacts=0, joints=12, bodies=6)
        free = replace(base.cones, lower=np.full(base.m, -np.inf), upper=np.full(base.m, np.inf))
        problem = add_compliance(replace(base, cones=free), 0.5)
    elif law == "lcp":
        base = random_contact_problem(22, tangents=0, spin=False)
        problem = add_compliance(base, 0.3)
    else:
        base = random_contact_problem(23, friction=law, tangents=2, spin=False)
        problem = add_compliance(base, 0.3)
    assert problem.law == law
    return problem if rows else as_matrix(problem)


def make_well_posed_problems(spec: SolverSpec) -> Iterator[Problem]:
    """Yield the well-posed problems of every law and form that a solver accepts."""
    for law in LAWS:
        for rows in (True, False):
            problem = make_well_posed_problem(law, rows)
            if spec.refuses(problem) is None:
                yield problem


def make_first_well_posed_problem(spec: SolverSpec) -> Problem:
    """Return the first well-posed problem that a solver accepts."""
    for problem in make_well_posed_problems(spec):
        return problem
    raise ContractError(
        f"the solver accepts none of the well-posed problems of the laws {', '.join(sorted(spec.laws))} that its spec "
        "lists; at least one is required"
    )


@functools.cache
def make_problems_of_every_kind() -> dict[tuple[str, str], tuple[list[Problem], FloatArray]]:
    """Return {(law, kind of block): (a well-posed problem in each form of A, its slack (m,) [m/s])}."""
    problems: dict[tuple[str, str], list[Problem]] = {}
    for law in ("linear", "lcp"):
        problems[law, "rows"] = [convert(make_well_posed_problem(law, True)) for convert in FORMS.values()]
    for law, (kind, draw) in itertools.product(("coulomb", "cone"), CONTACTS.items()):
        base = draw(23, law)
        soft = add_compliance(base, 0.3)
        problems[law, kind] = [convert(soft) for convert in FORMS.values()]
    for tangents in (3, 4, 5):
        base = random_generalized_problem(tangents, "cone", n=12, contacts=4, tangents=tangents)
        problems["cone", f"round, {tangents} tangents"] = [base, as_matrix(base)]
    result = {}
    for key, forms in problems.items():
        best = min((solve(p, tol=1e-12) for p in forms), key=lambda s: s.residual.relative)
        assert best.residual.relative <= 1e-11, best
        result[key] = forms, best.slack
    return result


def describe_problem(problem: Problem, kind: str = "") -> str:
    """Return a phrase such as "a problem of 24 rows (law coulomb, disks, given as rows)"."""
    form = "J and M" if problem.operator == "generalized" else problem.operator
    details = ", ".join(filter(None, (f"law {problem.law}", kind, f"given as {form}")))
    return f"a problem of {problem.m} row{'s' * (problem.m != 1)} ({details})"


def choose_iteration_budget(spec: SolverSpec) -> int | None:
    """Return the number of iterations that a solver may use on a well-posed problem; None for its own limit."""
    return max(spec.max_iter, MIN_BUDGET) if spec.resumable else None


def choose_tolerance(spec: SolverSpec) -> float:
    """Return the relative residual that a solver must reach on a well-posed problem."""
    return BACKEND_TOLERANCE if spec.external else OWN_TOLERANCE


def are_bit_identical(first: Solution, second: Solution) -> bool:
    """Return whether impulses, status and iterations are equal, the impulses bit by bit."""
    return first.impulse.tobytes() == second.impulse.tobytes() and (first.status, first.iterations) == (
        second.status,
        second.iterations,
    )


def describe_difference(first: Solution, second: Solution) -> str:
    """Return how two results differ, for a sentence."""
    if first.status is not second.status or first.iterations != second.iterations:
        return (
            f"{first.status.name} after {first.iterations} iterations instead of "
            f"{second.status.name} after {second.iterations}"
        )
    return f"the impulses differ by up to {np.abs(first.impulse - second.impulse).max(initial=0.0):.3g} N s"
