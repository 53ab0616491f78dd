"""The requirements on every solver, one function for each, and the function that tests a solver."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError, LavenderError, UnknownName, format_error
from lavender.contract.problems import (
    BALLS,
    EMPTY,
    GROUPS,
    INFEASIBLE,
    change_numbers,
    make_problems,
)
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import judge_impulse, residual
from lavender.judge.solution import Solution, Status
from lavender.problem import Problem
from lavender.problem.cones import project_impulse
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
LONG_BUDGET = 60_000  # Iterations after which a run that rounding keeps above tol must have ended.
# One penalty for all islands: an island without a solution may keep the others from Coulomb's law.
COUPLED_ISLANDS = {("admm", "coulomb")}
# The top of a solver's file may import these, besides the standard library.
LIGHT_PACKAGES = {"numpy", "lavender", "lavender_ext", "typing_extensions"}
# Returns the sentence of a failure, or an empty string.
Requirement = Callable[[SolverSpec, Problem], str]


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

    `problems` are the word of one of `GROUPS`, "all" others, the "solvable" ones of these, or the "first" that the
    solver accepts.
    """

    name: str
    requirement: str
    applies_to: str
    applies: Callable[[SolverSpec], bool]
    function: Requirement
    problems: str

    def run(self, spec: SolverSpec) -> None:
        """Raise ContractError if a solver does not meet the requirement on a problem that it accepts."""
        accepted = {
            name: problem for name, problem in make_problems().items() if not spec.refuses(problem)
        }
        if missing := find_unused_capabilities(spec, list(accepted.values())):
            raise ContractError(
                f"the spec lists {', '.join(missing)}, but refuses every problem with it"
            )
        groups = {
            word: [name for name in make() if name in accepted] for word, make in GROUPS.items()
        }
        grouped = {name for names in groups.values() for name in names}
        usual = [name for name in accepted if name not in grouped]
        names = groups | {
            "all": usual,
            "solvable": [name for name in usual if name not in (EMPTY, INFEASIBLE)],
            "first": usual[:1],
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


def get_data_bits(problem: Problem) -> list[bytes]:
    """Return the bits of the arrays of a problem that solvers read."""
    cones, csr = problem.cones, problem.csr
    arrays = (problem.b, problem.d, cones.lower, cones.upper, cones.mu, csr.data, csr.indices)
    return [np.asarray(x).tobytes() for x in arrays]


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
    data = get_data_bits(problem)
    bits = get_bits(solve(problem, spec.name, **options))
    if get_data_bits(problem) != data:
        return "the solve changed the arrays of the problem"
    for other in (
        replace(problem, b=problem.b * 1.25 + 0.01, qp=problem.qp),
        change_numbers(problem),
    ):
        if spec.refuses(other):
            continue
        prepared = prepare(other, spec.name)
        first = prepared.solve(**options)
        kept = first.impulse.tobytes()
        if get_bits(prepared.solve(problem, **options)) != bits:
            return (
                "`update` with another A, b, bounds or coefficients gives other bits than `prepare`"
            )
        if first.impulse.tobytes() != kept:
            return "a later solve changed the impulse of an earlier solution: keep no view of it"
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


@check(
    "all solvers except code of another project",
    lambda spec: not spec.external,
    problems="unsolvable",
)
def require_results_without_a_solution_are_not_worse_than_zero(
    spec: SolverSpec, problem: Problem
) -> str:
    """Require that a problem without a solution is not claimed solved, and its result is no worse than zero."""
    for max_iter in (None, 7):
        solution = solve(problem, spec.name, max_iter=max_iter)
        text = f"max_iter={max_iter} the result is: {solution}"
        if (
            solution.success
            or solution.claim_check != "confirmed"
            or solution.status == "ROUNDOFF_LIMIT"
        ):
            return f"with {text}. No impulses solve the problem: a claim may be INFEASIBLE, with a certificate"
        judged = solution.residual
        if max_iter is None and not judged.energy <= judged.energy_at_zero * (1.0 + 1e-12):
            return (
                f"with {text}. Its energy error is {judged.energy / judged.energy_at_zero:.3g} times that of zero "
                "impulses: end the run as DIVERGED or STALLED, for example by "
                "lavender.solvers.sweeping.create_stopping_test"
            )
    return ""


@check(
    "all solvers except code of another project", lambda spec: not spec.external, problems="jammed"
)
def require_islands_are_solved_next_to_an_island_without_a_solution(
    spec: SolverSpec, problem: Problem
) -> str:
    """Require that rows that contradict each other do not keep other islands from their solution."""
    solution = solve(problem, spec.name)
    relative = solution.residual.islands.relative
    if not relative.max() <= 1.0 + 1e-3:  # Rounding of large impulses may hide the rest.
        return f"the result is: {solution}. An island ends worse than with zero impulses"
    if (spec.name, problem.law) in COUPLED_ISLANDS:
        return ""
    unmet = int((relative[:BALLS] > solution.tol).sum())
    return (
        f"{unmet} of {BALLS} islands that have a solution are not solved: {solution}"
        if unmet
        else ""
    )


@check(
    "solvers with `impulse`, except code of another project",
    lambda spec: spec.impulse and not spec.external,
    problems="ill-conditioned",
)
def require_rounding_ends_a_solve(spec: SolverSpec, problem: Problem) -> str:
    """Require that a solve that only rounding keeps above tol ends early, with the status ROUNDOFF_LIMIT."""
    solution = solve(problem, spec.name, tol=1e-9, max_iter=LONG_BUDGET)
    found = solution.residual
    if not judge_impulse(problem, solution.impulse).relative <= 1e-9 < found.relative:
        return ""
    is_early = solution.iterations < LONG_BUDGET or not spec.resumable
    if solution.status is Status.ROUNDOFF_LIMIT and is_early and found.at_floor:
        return ""
    return (
        f"the result is: {solution}. ROUNDOFF_LIMIT in fewer than {LONG_BUDGET} iterations is required, as "
        "lavender.solvers.sweeping.create_stopping_test ends a run"
    )


@check("all solvers except code of another project", lambda spec: not spec.external)
def require_a_velocity_error_is_met_on_every_row(spec: SolverSpec, problem: Problem) -> str:
    """Require that a solve to velocity_tol meets it on every row, and a solve from its result ends at once."""
    budget = LONG_BUDGET if spec.resumable else None
    solution = solve(problem, spec.name, velocity_tol=1e-5, max_iter=budget)
    if not solution.success or not solution.residual.velocity <= 1e-5:
        return f"with velocity_tol=1e-5 the result is: {solution}"
    again = (
        solve(problem, spec.name, velocity_tol=1e-5, impulse=solution.impulse)
        if spec.impulse
        else solution
    )
    late = spec.impulse and spec.resumable and again.iterations > 1
    return f"a solve from its result ended as: {again}" if late or not again.success else ""


@check(
    "solvers with `impulse`, except code of another project",
    lambda spec: spec.impulse and not spec.external,
)
def require_results_are_not_worse_than_the_start(spec: SolverSpec, problem: Problem) -> str:
    """Require that a short solve from any start ends with no larger objective, or energy error, than the start."""
    start = 30.0 * np.random.default_rng(0).normal(size=problem.m)
    inside = project_impulse(problem.cones, start)
    solution = solve(problem, spec.name, impulse=start, tol=1e-12, max_iter=1)
    if solution.success or problem.law == "linear" or not problem.is_symmetric:
        return ""
    if problem.law == "coulomb":
        begun = residual(problem, inside).islands.energy
        keeps_last = getattr(spec.load(), "keeps_last", False)
        is_larger = solution.residual.islands.energy > begun * (1.0 + 1e-9)
        is_worse = not keeps_last and bool(is_larger.any())
    else:
        first, last = (
            0.5 * float(x @ (problem.slack(x) - problem.b)) for x in (inside, solution.impulse)
        )
        # Bounds that exclude zero have no zero impulse, which otherwise counts, too.
        highest = first if project_impulse(problem.cones, 0.0 * start).any() else min(first, 0.0)
        is_worse = last > highest + 1e-9 * abs(first)
    return f"a solve of one iteration ends worse than its start: {solution}" if is_worse else ""


@check(
    "all solvers except code of another project", lambda spec: not spec.external, problems="first"
)
def require_wrong_values_of_options_raise(spec: SolverSpec, problem: Problem) -> str:
    """Require that an option with a value of a wrong kind raises an InputError that names the option."""
    for name in spec.options:
        wrong: tuple[Any, ...] = ("no such word", np.nan, 1j, {1: 2})
        for value in wrong:
            option: Any = {name: value}
            try:
                solve(problem, spec.name, **option)
            except LavenderError as error:
                if name not in str(error):
                    return f"the error for {name}={value!r} does not name it: {error}"
            else:
                return (
                    f"{name}={value!r} was accepted: raise a ValueError in the factory, for example by check_float or "
                    "check_bool of lavender.base.arrays"
                )
    return ""


@check(
    "solvers with `resumable`", lambda spec: spec.resumable and not spec.external, problems="first"
)
def require_options_change_the_iterates(spec: SolverSpec, problem: Problem) -> str:
    """Require that options whose default is a number or a truth value change the iterates of a problem."""
    parameters = inspect.signature(spec.load()).parameters
    accepted = [p for p in make_problems().values() if p.m and not spec.refuses(p)]
    for name in spec.options:
        default = parameters[name].default
        if type(default) not in (bool, int, float) or not default:
            continue
        other = not default if type(default) is bool else type(default)(default / 2)
        for problem in accepted:
            options: tuple[Any, Any] = ({name: default}, {name: other})
            first, second = (
                solve(problem, spec.name, tol=0.0, max_iter=30, **option) for option in options
            )
            if not np.array_equal(first.impulse, second.impulse):
                break
        else:
            return (
                f"{name}={default!r} and {name}={other!r} give the same iterates on every problem"
            )
    return ""


@check(
    "solvers inside lavender and installed plug-ins",
    lambda spec: not spec.external and bool(spec.builtin or spec.distribution),
    problems="first",
)
def require_the_file_imports_numpy_alone(spec: SolverSpec, problem: Problem) -> str:
    """Require that the top of the solver's file imports only NumPy and lavender, since every command reads it."""
    path = inspect.getsourcefile(spec.load()) if inspect.isclass(spec.load()) else None
    if path is None or not Path(path).is_file():
        return ""
    for node in ast.parse(Path(path).read_text(encoding="utf-8")).body:
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and not node.level:
            names = [node.module or ""]
        for package in (name.partition(".")[0] for name in names):
            own = importlib.util.find_spec(package)
            is_near = (
                own is not None and own.origin and Path(own.origin).parent == Path(path).parent
            )
            if package not in LIGHT_PACKAGES | sys.stdlib_module_names and not is_near:
                return (
                    f"{path}, line {node.lineno} imports {package}: import it in the function that uses it, or from "
                    "lavender.base.lazy_import"
                )
    return ""
