"""The requirements on every solver, one function for each, and the function that tests a solver."""

from __future__ import annotations

import inspect
import traceback
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError, UnknownName, format_error
from lavender.contract.problems import (
    EMPTY,
    INFEASIBLE,
    change_numbers,
    make_large_problems,
    make_problems,
)
from lavender.judge.certificates import check_certificate
from lavender.judge.solution import Solution, Status
from lavender.problem import Problem
from lavender.solvers.registry import SolverSpec, get
from lavender.solving.prepared import prepare
from lavender.solving.solve import solve

# A solver has to count at least one of these kinds of `work`.
WORK_COUNTERS = {
    "sweeps",
    "products",
    "matvecs",
    "factorisations",
    "solves",
    "pivots",
    "backend_calls",
}
MIN_BUDGET = 5_000  # Iterations that a resumable solver may use on a problem.
Requirement = Callable[
    [SolverSpec, Problem], str
]  # Returns the sentence of a failure, or an empty string.


class ContractError(AssertionError):
    """A solver does not meet a requirement; the message is a sentence with the problem and the wrong result.

    Parameters
    ----------
    message : str
    problem : str
        Name of the problem in `make_problems`; empty if the failure concerns the spec alone.
    """

    def __init__(self, message: str, problem: str = "") -> None:
        super().__init__(message)
        self.problem = problem


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


@dataclass(frozen=True)
class Check:
    """One requirement: a name, a sentence, the solvers to which it applies, its code and its problems.

    `problems` are "all", those that are "solvable" and not large, "large", or the "first" that the solver accepts.
    """

    name: str
    requirement: str
    applies_to: str
    applies: Callable[[SolverSpec], bool]
    function: Requirement
    problems: str

    def run(self, spec: SolverSpec) -> None:
        """Raise ContractError if a solver does not meet the requirement on a problem that it accepts."""
        large = make_large_problems().keys()
        accepted = {
            name: problem for name, problem in make_problems().items() if not spec.refuses(problem)
        }
        if missing := find_unused_capabilities(spec, list(accepted.values())):
            raise ContractError(
                f"the spec lists {', '.join(missing)}, but refuses every problem with it"
            )
        names = {
            "all": [name for name in accepted if name not in large],
            "solvable": [name for name in accepted if name not in {EMPTY, INFEASIBLE, *large}],
            "large": [name for name in accepted if name in large],
            "first": [*accepted][:1],
        }
        for name in names[self.problems]:
            if failure := self.function(spec, accepted[name]):
                raise ContractError(f"for {name} (law {accepted[name].law}) {failure}", name)


#: All checks by name, in the order in which they run.
CHECKS: dict[str, Check] = {}


def find_unused_capabilities(spec: SolverSpec, accepted: list[Problem]) -> list[str]:
    """Return the capabilities of a spec that none of the accepted problems needs."""
    needed: dict[str, Callable[[Problem], bool]] = {
        **{f"the law {law}": lambda p, law=law: p.law == law for law in spec.laws},  # type: ignore[misc]
        **{
            f"boxes under the law {law}": lambda p, law=law: p.law == law and p.cones.has_box  # type: ignore[misc]
            for law in spec.box_friction_laws
        },
        **{f"the form {form}": lambda p, form=form: p.operator == form for form in spec.operators},  # type: ignore[misc]
    }
    flags = {
        "round_cones": lambda p: p.cones.has_round,
        "supports_rolling": lambda p: p.cones.has_rolling,
        "singular_programs": lambda p: p.has_singular_program,
    }
    needed |= {name: is_needed for name, is_needed in flags.items() if getattr(spec, name)}
    return sorted(name for name, is_needed in needed.items() if not any(map(is_needed, accepted)))


def check(
    applies_to: str, applies: Callable[..., bool], problems: str = "solvable"
) -> Callable[..., Requirement]:
    """Return a decorator that adds a function to `CHECKS`; `problems` as in `Check`."""

    def add(function: Requirement) -> Requirement:
        name = function.__name__.removeprefix("require_")
        text = (function.__doc__ or "").removeprefix("Require that ")
        CHECKS[name] = Check(
            name,
            text[0].upper() + text[1:],
            applies_to,
            applies,
            function=function,
            problems=problems,
        )
        return function

    return add


def list_checks(spec: SolverSpec) -> list[Check]:
    """Return the checks that a solver has to pass."""
    return [check for check in CHECKS.values() if check.applies(spec)]


def check_solver(name: str) -> Iterator[tuple[Check, Failure]]:
    """Yield each check that applies to a solver, and its result.

    An unknown name raises UnknownName, a missing package SolverUnavailable.
    """
    spec = get(name)
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


def solve_to_tolerance(spec: SolverSpec, problem: Problem, **options: Any) -> Solution:
    """Solve to the tolerance that is required of the solver, with at least `MIN_BUDGET` iterations."""
    tol = 1e-6 if spec.external else 1e-8
    budget = max(spec.max_iter, MIN_BUDGET) if spec.resumable else None
    return solve(problem, spec.name, **{"tol": tol, "max_iter": budget, **options})


def get_bits(solution: Solution) -> tuple[bytes, Status, int]:
    """Return impulse bits, status and iterations of a result."""
    return solution.impulse.tobytes(), solution.status, solution.iterations


@check("all solvers", lambda spec: True, problems="all")
def require_problems_are_solved(spec: SolverSpec, problem: Problem) -> str:
    """Require that every problem that the spec accepts is solved, with counted work and true claims."""
    solution = solve_to_tolerance(spec, problem)
    text = f"the result is: {solution}"
    silent = not solution.message and solution.status in ("DIVERGED", "STALLED", "NUMERICAL_ERROR")
    if silent or solution.solver.name != spec.name:
        return f"{text}. A failure has no message, or the name of the solver is wrong"
    if problem.name == INFEASIBLE:
        y = solution.certificate
        named = "row 1" in solution.message
        proven = named and y is not None and check_certificate(problem, y) is None
        return (
            "" if proven else f"{text}. A certificate and a message that names row 1 are required"
        )
    if spec.external:  # It may fail if the result reports it.
        false = solution.status is Status.CONVERGED and not (
            solution.success or solution.status_conflict
        )
        return f"{text}. The claim CONVERGED is wrong" if false else ""
    if not solution.success or solution.claim_check != "confirmed":
        limit = (
            f"lv.residual(problem, impulse).relative <= {solution.tol:g}, a maximum over islands"
        )
        return f"{text}. CONVERGED and {limit} are required; a spec must refuse what its solver cannot solve"
    counted = not problem.m or any(solution.work.get(word, 0) > 0 for word in WORK_COUNTERS)
    return (
        "" if counted else f"{text}. Its work must count one of {', '.join(sorted(WORK_COUNTERS))}"
    )


@check("all solvers", lambda spec: True, problems="large")
def require_claims_are_true_at_every_tolerance(spec: SolverSpec, problem: Problem) -> str:
    """Require that larger problems are solved to tolerances from 1e-2 to 1e-10, and every claim is true."""
    for tol in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10):
        solution = solve_to_tolerance(spec, problem, tol=tol)
        is_false = solution.status is Status.CONVERGED and not (
            solution.success or solution.status_conflict
        )
        if is_false or (
            not spec.external and (not solution.success or solution.claim_check != "confirmed")
        ):
            return f"to tol={tol:g} the result is: {solution}"
    return ""


@check("all solvers", lambda spec: True, problems="first")
def require_options_match_the_spec(spec: SolverSpec, problem: Problem) -> str:
    """Require that the factory accepts the options of the spec, and other options raise an error."""
    wrong = sorted(set(inspect.signature(spec.load()).parameters) ^ spec.accepts)
    if wrong:
        return f"the options {', '.join(wrong)} are in the spec or in the factory, not in both"
    options: Any = {
        "no_such_option": 1,
        "order": "reverse",
        "seed": 3,
        "callback": print,
        "history": True,
    }
    for name, value in options.items():
        if not getattr(spec, name, False):
            try:
                solve(problem, spec.name, **{name: value})
                return f"{name}= was accepted, but the spec does not list it"
            except (UnknownName, CapabilityError) as error:
                if name not in str(error):
                    return f"the error for {name}= does not name it: {error}"
    return ""


@check("all solvers except code of another project", lambda spec: not spec.external)
def require_budgets_are_kept(spec: SolverSpec, problem: Problem) -> str:
    """Require that a solve with max_iter=0 returns the start, and one with tol=0 runs exactly max_iter iterations."""
    none = solve(problem, spec.name, tol=1e-12, max_iter=0)
    if none.iterations or not np.array_equal(none.impulse, problem.start()):
        return f"max_iter=0 ran {none.iterations} iterations or changed the start"
    for n in (1, 3, 8):
        few = solve(problem, spec.name, tol=1e-12, max_iter=n)
        if few.iterations > n or few.claim_check != "confirmed":
            return f"max_iter={n} ran {few.iterations} iterations, or the claim is wrong: {few}"
    # Some problems are solved exactly within the longer run: a residual of 0 does not end it.
    for n in (5, 101) if spec.resumable else ():
        exact = solve(problem, spec.name, tol=0.0, max_iter=n)
        if exact.status is not Status.MAX_ITERATIONS or exact.iterations != n:
            return f"tol=0 and max_iter={n} must run exactly {n} iterations; the result is: {exact}"
        if max(exact.work.get(word, 0) for word in WORK_COUNTERS) < n:
            return f"{n} iterations count the work {dict(exact.work)}; at least {n} of one kind are required"
    return ""


@check("all solvers except code of another project", lambda spec: not spec.external)
def require_bits_are_reproducible(spec: SolverSpec, problem: Problem) -> str:
    """Require that threads, `update` instead of `prepare`, and 1 + 7 + 15 instead of 23 iterations change no bit."""
    options: dict[str, Any] = {"tol": 1e-7, "max_iter": 60 if spec.resumable else None}
    bits = get_bits(solve(problem, spec.name, **options))
    for other in (
        replace(problem, b=problem.b * 1.25 + 0.01, qp=problem.qp),
        change_numbers(problem),
    ):
        if spec.refuses(other):
            continue
        prepared = prepare(other, spec.name)
        prepared.solve(**options)
        if get_bits(prepared.solve(problem, **options)) != bits:
            return (
                "`update` with another A, b, bounds or coefficients gives other bits than `prepare`"
            )
    with ThreadPoolExecutor(4) as pool:
        if {*pool.map(lambda p: get_bits(solve(p, spec.name, **options)), [problem] * 4)} != {bits}:
            return "the same call gives other bits, from one of four threads"
    ends = set()
    for sizes in ((23,), (1, 7, 15)) if spec.resumable else ():
        solver = spec.load()()
        impulse = problem.start().copy()
        state = solver.prepare(problem.disk)
        for size in sizes:
            solver.run(state, impulse, size, 0.0, None)
        ends.add(impulse.tobytes())
    return (
        "1 + 7 + 15 iterations give other bits than 23: keep all changes in the state"
        if len(ends) > 1
        else ""
    )


@check(
    "solvers with `impulse`, except code of another project",
    lambda spec: spec.impulse and not spec.external,
)
def require_a_solution_as_start_is_kept(spec: SolverSpec, problem: Problem) -> str:
    """Require that a solve from a solution ends there at once, and does not modify the array of the start."""
    first = solve_to_tolerance(spec, problem, tol=1e-9)
    start = first.impulse.copy()
    again = solve(problem, spec.name, tol=1e-8, impulse=start)
    kept = (
        again.success
        and np.array_equal(start, first.impulse)
        and not (again.iterations and spec.resumable)
    )
    return (
        ""
        if kept or not first.success
        else f"a solve from the solution changed it, or ended as: {again}"
    )


@check("solvers with `resumable`", lambda spec: spec.resumable, problems="first")
def require_interruptions_return_the_iterate(spec: SolverSpec, problem: Problem) -> str:
    """Require that a time limit or a callback ends a solve with the last iterate, and a history changes no bit."""
    solve(problem, spec.name, max_iter=1)  # Solve once before, so that imports do not count.
    late = solve(problem, spec.name, tol=0.0, max_iter=2**31 - 1, time_limit=0.05)
    if late.status is not Status.TIME_LIMIT or not late.iterations:
        return f"TIME_LIMIT after at least 1 iteration is required with tol=0 and a time limit; the result is: {late}"
    counts: list[int] = []

    def callback(n: int, impulse: FloatArray, _: Any) -> bool:
        counts.append(n)
        impulse[:] = np.nan  # The callback gets a copy, so this must not change the solve.
        return n >= 3

    if spec.callback:
        ended = solve(problem, spec.name, callback=callback, tol=0.0, max_iter=50)
        if (
            ended.status is not Status.INTERRUPTED
            or counts != [0, 1, 2, 3]
            or np.isnan(ended.impulse).any()
        ):
            return f"a callback that stops at iteration 3 was called at {counts}; the result is: {ended}"
    if spec.history and not spec.delegates:
        pair = [solve(problem, spec.name, history=x, tol=0.0, max_iter=40) for x in (True, False)]
        history = pair[0].history
        end = None if history is None else history.relative[-1]
        if end != pair[0].residual.relative or len({*map(get_bits, pair)}) > 1:
            return "history=True changes the bits, or does not end at the residual"
    return ""


@check("solvers with `order` or `seed`", lambda spec: spec.order or spec.seed, problems="first")
def require_orders_change_the_sweep(spec: SolverSpec, problem: Problem) -> str:
    """Require that orders and seeds change the bits of two sweeps, and all of them lead to the solution."""
    choices: list[dict[str, Any]] = [
        {"order": order} for order in ("given", "reverse", "random", "colored")
    ]
    choices += [{"order": "random", "seed": 2}] if spec.seed else []
    for choice in choices:
        if not (found := solve_to_tolerance(spec, problem, **choice)).success:
            return f"with {choice} the result is: {found}"
    bits = [
        solve(problem, spec.name, tol=0.0, max_iter=2, **c).impulse.tobytes() for c in choices * 2
    ]
    same = len(set(bits)) == len(choices) and bits[: len(choices)] == bits[len(choices) :]
    return (
        ""
        if same
        else f"two of {choices} give the same bits after 2 sweeps, or one gives two results"
    )
