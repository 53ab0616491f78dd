"""Checks of the requirements on every solver: each capability that the spec of a solver lists is exercised.

A check is a function of a `SolverSpec`. It returns if the solver meets the requirement, and raises `ContractError`
with a sentence if it does not: the problem, the result and the required result.
"""

from __future__ import annotations

import functools
import inspect
import itertools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError, LavenderError, UnknownName
from lavender.contract.enumeration import enumerate_lcp, random_bounds
from lavender.contract.problems import (
    CONTACTS,
    FORMS,
    as_matrix,
    make_problem_with_other_numbers,
    make_touching_bodies,
    random_contact_problem,
    random_generalized_problem,
)
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import residual
from lavender.judge.solution import Solution, Status
from lavender.problem import LAWS, Problem
from lavender.problem.cones import Cones
from lavender.solvers.registry import SolverSpec
from lavender.solving.prepared import prepare
from lavender.solving.solve import solve

__all__ = [
    "CHECKS",
    "Check",
    "ContractError",
    "get_check_name",
    "list_checks",
    "make_problems_of_every_kind",
    "make_well_posed_problems",
]

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


def _register_check(
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


def _raise_unless(condition: bool | np.bool_, sentence: str) -> None:
    if not condition:
        raise ContractError(sentence)


# -- problems -----------------------------------------------------------------------------------------


def _add_compliance(problem: Problem, compliance: float) -> Problem:
    """Return the problem with more compliance [1/kg], which adds to the smallest eigenvalue of A."""
    present = np.zeros(problem.m) if problem.compliance is None else problem.compliance
    return replace(problem, compliance=present + compliance)


@functools.cache
def make_well_posed_problem(law: str, rows: bool) -> Problem:
    """Return a problem of a law, given by rows or as a matrix; the smallest eigenvalue of A is far from zero."""
    if law == "linear":
        base = random_contact_problem(21, contacts=0, joints=12, bodies=6)
        free = replace(base.cones, lower=np.full(base.m, -np.inf), upper=np.full(base.m, np.inf))
        problem = _add_compliance(replace(base, cones=free), 0.5)
    elif law == "lcp":
        base = random_contact_problem(22, tangents=0, spin=False)
        problem = _add_compliance(base, 0.3)
    else:
        base = random_contact_problem(23, friction=law, tangents=2, spin=False)
        problem = _add_compliance(base, 0.3)
    assert problem.law == law
    return problem if rows else as_matrix(problem)


def make_well_posed_problems(spec: SolverSpec) -> Iterator[Problem]:
    """Yield the well-posed problems of every law and form that a solver accepts."""
    for law in LAWS:
        for rows in (True, False):
            problem = make_well_posed_problem(law, rows)
            if spec.refuses(problem) is None:
                yield problem


def _make_first_well_posed_problem(spec: SolverSpec) -> Problem:
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
        soft = _add_compliance(base, 0.3)
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


def _describe_problem(problem: Problem, kind: str = "") -> str:
    """Return a phrase such as "a problem of 24 rows (law coulomb, disks, given as rows)"."""
    form = "J and M" if problem.operator == "generalized" else problem.operator
    details = ", ".join(filter(None, (f"law {problem.law}", kind, f"given as {form}")))
    return f"a problem of {problem.m} row{'s' * (problem.m != 1)} ({details})"


def _choose_iteration_budget(spec: SolverSpec) -> int | None:
    return max(spec.max_iter, MIN_BUDGET) if spec.resumable else None


def _choose_tolerance(spec: SolverSpec) -> float:
    return BACKEND_TOLERANCE if spec.external else OWN_TOLERANCE


def _are_bit_identical(first: Solution, second: Solution) -> bool:
    return first.impulse.tobytes() == second.impulse.tobytes() and (first.status, first.iterations) == (
        second.status,
        second.iterations,
    )


def _describe_difference(first: Solution, second: Solution) -> str:
    """Return how two results differ, for a sentence."""
    if first.status is not second.status or first.iterations != second.iterations:
        return (
            f"{first.status.name} after {first.iterations} iterations instead of "
            f"{second.status.name} after {second.iterations}"
        )
    return f"the impulses differ by up to {np.abs(first.impulse - second.impulse).max(initial=0.0):.3g} N s"


# -- laws, forms and options --------------------------------------------------------------------------


@_register_check("all solvers")
def require_every_listed_law_is_solved(spec: SolverSpec) -> None:
    """Require that the solver solves every law that it lists, in every form that it accepts, and counts its work."""
    must_solve = not spec.external or spec.name in REQUIRED_BACKENDS
    tol, accepted = _choose_tolerance(spec), set()
    for (law, kind), (forms, slack) in make_problems_of_every_kind().items():
        for problem in forms:
            phrase = _describe_problem(problem, kind)
            if spec.refuses(problem) is not None:
                try:
                    solve(problem, spec.name)
                except CapabilityError:
                    continue
                raise ContractError(f"the solver refuses {phrase}, but solve returned a result for it")
            accepted.add(law)
            solution = solve(problem, spec.name, tol=tol, max_iter=_choose_iteration_budget(spec))
            text = f"for {phrase} the result is: {solution}"
            if must_solve and not (spec.external and kind.startswith("round")):
                _raise_unless(
                    solution.success,
                    f"{text}. CONVERGED within a relative residual of {tol:g} is required, because the spec lists "
                    f"the law {law!r}{'' if solution.status is not Status.CONVERGED else STOP_TEST_REMEDY}",
                )
                _raise_unless(
                    solution.claim_check == "confirmed",
                    f"{text}. The judge must confirm the claim; it found: {solution.claim_check}{STOP_TEST_REMEDY}",
                )
            # Other backends may fail, unless they claim convergence and the result does not report the conflict.
            _raise_unless(
                solution.success or bool(solution.status_conflict) or solution.status is not Status.CONVERGED,
                f"{text}. The claim CONVERGED is wrong and not reported as such",
            )
            _raise_unless(
                solution.solver.name == spec.name, f"{text}. It names another solver: {solution.solver.name}"
            )
            _raise_unless(
                sum(solution.work.values()) > 0,
                f"{text}. Its work counts nothing; the claim must count sweeps, products or other work",
            )
            _raise_unless(
                solution.iterations > 0 or not spec.resumable,
                f"{text}. It reports 0 iterations although the start is not a solution",
            )
            judged = residual(problem, solution.impulse).slack
            _raise_unless(np.array_equal(solution.slack, judged), f"{text}. Its slack is not A impulse - b")
            if law != "coulomb" and solution.success:
                size = np.abs(problem.slack(problem.start())).max()
                error = np.abs(solution.slack - slack).max()
                _raise_unless(
                    error <= MAX_CONDITION * tol * size + 1e-7 * np.abs(slack).max(),
                    f"{text}. Its slack differs by {error:.3g} m/s from the unique solution; at most "
                    f"{MAX_CONDITION * tol * size:.3g} m/s is accepted",
                )
    missing = set(spec.laws) - accepted
    _raise_unless(
        not missing,
        f"the spec lists the laws {', '.join(sorted(missing))}, but the solver refuses every problem of them",
    )


@_register_check("solvers with an option `form`", lambda spec: "form" in spec.options)
def require_forms_agree(spec: SolverSpec) -> None:
    """Require that every value of the option `form` gives the same solution."""
    tol, must_solve = _choose_tolerance(spec), not spec.external or spec.name in REQUIRED_BACKENDS
    for (law, kind), (forms, slack) in make_problems_of_every_kind().items():
        if kind.startswith("round") or spec.refuses(forms[0]):
            continue  # Problems with round cones can be written in one form only.
        if kind == "boxes" and law not in spec.laws:
            continue  # Friction boxes are always converted to bounded rows of a matrix.
        for form in ("impulse",) if kind == "ellipses" else ("impulse", "velocity"):
            solution = solve(forms[0], spec.name, tol=tol, form=form)
            text = f"for {_describe_problem(forms[0], kind)} with form={form!r} the result is: {solution}"
            _raise_unless(
                str(solution.solver.form).startswith(form),
                f"{text}. Another form ran: {solution.solver.form}",
            )
            _raise_unless(solution.success or not must_solve, f"{text}. CONVERGED is required")
            if solution.success and law != "coulomb":
                size = np.abs(forms[0].slack(forms[0].start())).max()
                error = np.abs(solution.slack - slack).max()
                limit = MAX_CONDITION * tol * size + 1e-7 * np.abs(slack).max()
                _raise_unless(
                    error <= limit, f"{text}. Its slack differs by {error:.3g} m/s from the unique solution"
                )
    try:
        solve(make_well_posed_problem("lcp", True), spec.name, form="velocities")
    except LavenderError as error:
        _raise_unless(
            "velocity" in str(error),
            f"the error for an unknown form does not list the known ones: {error}",
        )
    else:
        raise ContractError("form='velocities' does not exist and raised no error")


@_register_check("all solvers")
def require_unknown_options_are_rejected(spec: SolverSpec) -> None:
    """Require that an option that the solver does not have raises an error that names it."""
    problem = _make_first_well_posed_problem(spec)
    unavailable: list[tuple[dict[str, Any], type[LavenderError], str]] = [
        ({"no_such_option": 1}, UnknownName, "no_such_option")
    ]
    if not spec.order:
        unavailable.append(({"order": "reverse"}, CapabilityError, "order"))
    if not spec.seed:
        unavailable.append(({"seed": 3}, CapabilityError, "seed"))
    if not spec.callback:
        unavailable.append(({"callback": print}, CapabilityError, "callback"))
    if not spec.history:
        unavailable.append(({"history": True}, CapabilityError, "history"))
    for option, kind, word in unavailable:
        try:
            solve(problem, spec.name, **option)
        except kind as error:
            _raise_unless(word in str(error), f"the error for {word} does not name it: {error}")
        else:
            raise ContractError(
                f"{spec.name}: {word}= was accepted, but the spec does not list it: add it there, or raise an error"
            )


@_register_check("all solvers")
def require_options_match_the_factory(spec: SolverSpec) -> None:
    """Require that the spec lists exactly the options that the factory accepts."""
    parameters = set(inspect.signature(spec.load()).parameters)
    extra, missing = sorted(spec.accepts - parameters), sorted(parameters - spec.accepts)
    _raise_unless(
        not extra, f"the spec lists the options {', '.join(extra)}, which the factory does not accept"
    )
    _raise_unless(
        not missing, f"the factory accepts the options {', '.join(missing)}, which the spec does not list"
    )


# -- iterations ---------------------------------------------------------------------------------------


@_register_check("all solvers except code of another project", lambda spec: not spec.external)
def require_budgets_are_kept(spec: SolverSpec) -> None:
    """Require that iteration limits are kept: 0 returns the start, and with tol = 0 exactly max_iter iterations run."""
    for problem in make_well_posed_problems(spec):
        phrase = _describe_problem(problem)
        none = solve(problem, spec.name, tol=1e-12, max_iter=0)
        _raise_unless(
            none.status is Status.MAX_ITERATIONS and none.iterations == 0,
            f"for {phrase} max_iter=0 returned {none.status.name} after {none.iterations} iterations",
        )
        _raise_unless(
            none.impulse.tobytes() == problem.start().tobytes(),
            f"for {phrase} max_iter=0 changed the start",
        )
        for n in (1, 3, 8):
            few = solve(problem, spec.name, tol=1e-12, max_iter=n)
            _raise_unless(few.iterations <= n, f"for {phrase} max_iter={n} ran {few.iterations} iterations")
            _raise_unless(
                few.claim_check == "confirmed",
                f"for {phrase} max_iter={n} gave a claim that the judge does not confirm: {few}",
            )
            # The residual of a resumable solver may increase in the first iterations.
            _raise_unless(
                few.residual.relative <= 1.0 or spec.resumable,
                f"for {phrase} max_iter={n} returned a result that is worse than the start: {few}",
            )
        if spec.resumable:
            exact = solve(problem, spec.name, tol=0.0, max_iter=5)
            _raise_unless(
                exact.status is Status.MAX_ITERATIONS and exact.iterations == 5,
                f"for {phrase} tol=0 and max_iter=5 ended as {exact.status.name} after {exact.iterations} "
                "iterations; exactly 5 are required",
            )
            _raise_unless(
                sum(exact.work.values()) >= 5,
                f"for {phrase} 5 iterations count a work of {sum(exact.work.values())}; at least 5 are required",
            )


@_register_check(
    "solvers with `resumable`, except code of another project",
    lambda spec: spec.resumable and not spec.external,
)
def require_runs_can_be_continued(spec: SolverSpec) -> None:
    """Require that a run of n1 and then n2 iterations gives the bits of a run of n1 + n2 iterations."""
    for problem in make_well_posed_problems(spec):
        for tol in (0.0, 1e-14):
            whole, parts = (_run_in_parts(spec, problem, sizes, tol) for sizes in ([23], [1, 7, 15]))
            _raise_unless(
                whole == parts,
                f"for {_describe_problem(problem)} and tol={tol:g}, 1 + 7 + 15 iterations ended as {parts[1].name} "
                f"after {parts[0]} iterations, and 23 iterations as {whole[1].name} after {whole[0]}"
                + (", with other bits of the impulse" if whole[:2] == parts[:2] else "")
                + ". The same result is required: keep everything that changes in the state",
            )


def _run_in_parts(
    spec: SolverSpec, problem: Problem, sizes: list[int], tol: float
) -> tuple[int, Status, bytes]:
    """Return (iterations, last status, bits of the impulse) of consecutive runs of these sizes."""
    solver, impulse, done, status = spec.load()(), problem.start().copy(), 0, Status.MAX_ITERATIONS
    state = solver.prepare(problem.disk)
    for size in sizes:
        claim = solver.run(state, impulse, size, tol, None)
        done, status = done + claim.iterations, claim.status
        if status is not Status.MAX_ITERATIONS:
            break
    return done, status, impulse.tobytes()


@_register_check("solvers with `resumable`", lambda spec: spec.resumable)
def require_time_limit_returns_the_iterate(spec: SolverSpec) -> None:
    """Require that a time limit ends a long solve with TIME_LIMIT and at least one iteration."""
    problem = _make_first_well_posed_problem(spec)
    solve(problem, spec.name, max_iter=1)  # Solve once before, so that imports do not count.
    solution = solve(problem, spec.name, tol=0.0, max_iter=2**31 - 1, time_limit=0.05)
    _raise_unless(
        solution.status is Status.TIME_LIMIT and solution.iterations > 0,
        f"for {_describe_problem(problem)} tol=0 and a time limit of 0.05 s ended as {solution.status.name} after "
        f"{solution.iterations} iterations; TIME_LIMIT after at least 1 is required",
    )


@_register_check("solvers with `history`", lambda spec: spec.history and not spec.delegates)
def require_history_at_fixed_counts(spec: SolverSpec) -> None:
    """Require that a history records the residual at fixed iteration counts and does not change the result."""
    problem = _make_first_well_posed_problem(spec)
    solution = solve(problem, spec.name, history=True, tol=0.0, max_iter=40)
    history = solution.history
    assert history is not None
    counts = history.iterations.tolist()
    _raise_unless(
        counts == HISTORY_COUNTS,
        f"the history of 40 iterations has the counts {counts}; {HISTORY_COUNTS} are required",
    )
    _raise_unless(
        abs(history.relative[0] - 1.0) <= 1e-6, f"the history begins at {history.relative[0]}, not at 1"
    )
    _raise_unless(
        history.relative[-1] == solution.residual.relative,
        f"the history ends at {history.relative[-1]}, but the residual is {solution.residual.relative}",
    )
    _raise_unless(bool(np.all(np.diff(history.time) >= 0.0)), "the times of the history decrease")
    without = solve(problem, spec.name, tol=0.0, max_iter=40)
    _raise_unless(
        without.impulse.tobytes() == solution.impulse.tobytes(),
        "history=True changes the bits of the result; runs must give the same bits in parts",
    )


@_register_check("solvers with `callback`", lambda spec: spec.callback)
def require_callback_may_stop(spec: SolverSpec) -> None:
    """Require that a callback receives copies of the iterates and can stop the solve."""
    problem, counts = _make_first_well_posed_problem(spec), []

    def callback(n: int, impulse: FloatArray, _: Any) -> bool:
        counts.append(n)
        impulse[:] = np.nan  # The callback gets a copy, so this must not change the solve.
        return n >= 3

    solution = solve(problem, spec.name, callback=callback, tol=0.0, max_iter=50)
    _raise_unless(
        solution.status is Status.INTERRUPTED and counts == [0, 1, 2, 3],
        f"a callback that stops at iteration 3 was called at {counts}, and the status is {solution.status.name}; "
        "[0, 1, 2, 3] and INTERRUPTED are required",
    )
    _raise_unless(
        bool(np.isfinite(solution.impulse).all()), "a callback that overwrites its impulse changed the result"
    )


# -- starts, orders and seeds -------------------------------------------------------------------------


@_register_check("solvers with `impulse`", lambda spec: spec.impulse)
def require_a_solution_as_start_is_kept(spec: SolverSpec) -> None:
    """Require that a solve that starts at a solution ends there, and does not modify the array of the start."""
    for problem in make_well_posed_problems(spec):
        first = solve(problem, spec.name, tol=1e-9, max_iter=_choose_iteration_budget(spec))
        if not first.success:
            continue
        start = first.impulse.copy()
        again = solve(problem, spec.name, tol=1e-8, impulse=start)
        text = f"for {_describe_problem(problem)}, a solve that starts at the solution ended as: {again}"
        _raise_unless(again.success, f"{text}. CONVERGED is required")
        _raise_unless(again.iterations == 0 or not spec.resumable, f"{text}. 0 iterations are required")
        _raise_unless(
            start.tobytes() == first.impulse.tobytes(), f"{text}. The array of the start was modified"
        )


@_register_check(
    "solvers of the law cone with `impulse`, except code of another project",
    lambda spec: spec.impulse and not spec.external and "cone" in spec.laws,
)
def require_a_normal_without_inverse_mass_bears_friction(spec: SolverSpec) -> None:
    """Require that a normal with a zero row of A may bear the friction of the relaxed law.

    The solution then has w_n = mu |w_t| > 0 and lambda_n > 0.
    """
    b, impulse = np.array([-0.5, 2.0, 0.0]), np.array([2.0, 1.0, 0.0])  # The slack is w = (0.5, -1, 0) m/s.
    problems = [
        Problem.contact(np.diag([0.0, 1.0, 1.0]), b, [0.5], friction="cone"),
        Problem.from_jacobian(
            np.eye(3)[:, 1:], np.eye(2), [0, 0], target=b, cones=Cones.contacts([0.5]), friction="cone"
        ),
    ]
    for problem in problems:
        if spec.refuses(problem) is not None:
            continue
        kept = solve(problem, spec.name, tol=1e-9, impulse=impulse)
        _raise_unless(
            kept.status is Status.CONVERGED
            and kept.iterations == 0
            and bool(np.array_equal(kept.impulse, impulse)),
            f"for {_describe_problem(problem)}, the start is a solution and was not kept: {kept}",
        )
        cold = solve(problem, spec.name, tol=1e-9)
        _raise_unless(
            cold.success, f"for {_describe_problem(problem)} the result is: {cold}. CONVERGED is required"
        )


@_register_check("solvers with `order`", lambda spec: spec.order)
def require_orders_change_the_sweep(spec: SolverSpec) -> None:
    """Require that each order sweeps differently and all orders lead to a solution."""
    problem = next((p for p in make_well_posed_problems(spec) if p.law != "coulomb"), None)
    if problem is None:
        problem = _make_first_well_posed_problem(spec)
    early: dict[bytes, str] = {}
    for order in ("given", "reverse", "random", "colored"):
        solution = solve(problem, spec.name, order=order, tol=1e-10, max_iter=MIN_BUDGET)
        _raise_unless(
            solution.success,
            f"for {_describe_problem(problem)} the order {order!r} ended as: {solution}. CONVERGED is required",
        )
        bits = solve(problem, spec.name, order=order, tol=0.0, max_iter=2).impulse.tobytes()
        _raise_unless(
            bits not in early,
            f"for {_describe_problem(problem)} the orders {early.get(bits)!r} and {order!r} give the same bits "
            "after 2 sweeps; each order must sweep differently",
        )
        early[bits] = order


@_register_check("solvers with `seed`", lambda spec: spec.seed)
def require_seeds_change_random_sweeps(spec: SolverSpec) -> None:
    """Require that equal seeds give equal bits and different seeds give different random sweeps."""
    problem = _make_first_well_posed_problem(spec)
    first, same, other = (
        solve(problem, spec.name, order="random", seed=seed, tol=0.0, max_iter=2).impulse.tobytes()
        for seed in (1, 1, 2)
    )
    _raise_unless(first == same, "two random sweeps with seed=1 differ; equal bits are required")
    _raise_unless(first != other, "random sweeps with seed=1 and seed=2 are equal; the seed has no effect")


# -- reproducible results -----------------------------------------------------------------------------


def _make_short_options(spec: SolverSpec) -> dict[str, Any]:
    return {"tol": 1e-7, "max_iter": 60 if spec.resumable else None}


@_register_check("all solvers except code of another project", lambda spec: not spec.external)
def require_results_are_reproducible(spec: SolverSpec) -> None:
    """Require that the same call gives the same bits, also from several threads at once."""
    options = _make_short_options(spec)
    for problem in make_well_posed_problems(spec):
        first = solve(problem, spec.name, **options)

        def repeat(_: int, problem: Problem = problem) -> Solution:
            return solve(problem, spec.name, **options)

        again = repeat(0)
        _raise_unless(
            _are_bit_identical(again, first),
            f"for {_describe_problem(problem)} the same call gave another result: {_describe_difference(again, first)}",
        )
        with ThreadPoolExecutor(THREADS) as pool:
            for other in pool.map(repeat, range(THREADS)):
                _raise_unless(
                    _are_bit_identical(other, first),
                    f"for {_describe_problem(problem)} a call from one of {THREADS} threads gave another result: "
                    f"{_describe_difference(other, first)}. The object of the factory holds options only",
                )


@_register_check("all solvers except code of another project", lambda spec: not spec.external)
def require_update_equals_prepare(spec: SolverSpec) -> None:
    """Require that `update` to new numbers gives the bits of a new `prepare`."""
    options = _make_short_options(spec)
    for problem in make_well_posed_problems(spec):
        changed = make_problem_with_other_numbers(problem)
        if spec.refuses(changed) is not None:
            continue
        prepared = prepare(changed, spec.name)
        prepared.solve(**options)
        updated, fresh = prepared.solve(problem, **options), solve(problem, spec.name, **options)
        _raise_unless(
            _are_bit_identical(updated, fresh),
            f"for {_describe_problem(problem)}, the result after `update` is not the one after `prepare`: "
            f"{_describe_difference(updated, fresh)}",
        )


@_register_check("all solvers except code of another project", lambda spec: not spec.external)
def require_units_do_not_matter(spec: SolverSpec) -> None:
    """Require that impulses scale with the units of mass and velocity."""
    mass, velocity = 2.0**10, 2.0**-20  # Units are scaled by powers of two, which are exact in float64.
    for problem in make_well_posed_problems(spec):
        if problem.operator != "matrix":
            continue
        cones, matrix = problem.cones, problem.matrix
        assert matrix is not None
        scaled = Problem(
            problem.b * velocity,
            replace(cones, lower=cones.lower * (mass * velocity), upper=cones.upper * (mass * velocity)),
            matrix / mass,
            friction=problem.friction,
        )
        if spec.refuses(scaled) is not None:
            continue
        first, second = (
            solve(p, spec.name, tol=OWN_TOLERANCE, max_iter=_choose_iteration_budget(spec))
            for p in (problem, scaled)
        )
        description = f"{_describe_problem(problem)} in other units of mass (2^10) and velocity (2^-20)"
        text = f"for {description} the result is: {second}"
        _raise_unless(second.success or not first.success, f"{text}. CONVERGED is required, as in SI units")
        error = np.abs(second.impulse / (mass * velocity) - first.impulse).max()
        limit = 1e4 * OWN_TOLERANCE * max(1.0, np.abs(first.impulse).max())
        _raise_unless(
            not first.success or error <= limit,
            f"{text}. Its impulse, in SI units, differs by {error:.3g} N s from the one of SI units",
        )


# -- problems that are unusual, hard or have no solution ----------------------------------------------


def make_soft_static_contacts() -> Problem:
    """Return two contacts of a body that cannot move: compliance alone makes A = diag(1, 2, 1, 2)."""
    rows = make_touching_bodies([[-1, 0], [-1, 0]], inv_mass=[0.0], inv_inertia=np.zeros((1, 3, 3)))
    return Problem.from_rows(rows, [1.0, 2.0, 1.0, -2.0], mu=0.5, tangents=1, compliance=[1.0, 2.0, 1.0, 2.0])


def make_unusual_problems() -> dict[str, Problem]:
    """Return unusual but valid problems by their description."""
    return {
        "0 rows (linear)": Problem.linear(np.zeros((0, 0)), []),
        "0 rows (lcp)": Problem.lcp(np.zeros((0, 0)), []),
        "1 free row": Problem.linear([[2.0]], [1.0]),
        "1 active row": Problem.lcp([[2.0]], [1.0]),
        "1 inactive row": Problem.lcp([[2.0]], [-1.0]),
        "1 row with a negative A": Problem.lcp([[-2.0]], [1.0]),
        "a zero row of A that is inactive": Problem.lcp(np.diag([1.0, 0.0]), [1.0, -1.0]),
        "a zero row of A with an upper bound": Problem.lcp(np.diag([1.0, 0.0]), [1.0, 1.0], upper=3.0),
        "three equal bounded rows": Problem.lcp(np.ones((3, 3)), [1.0, 1.0, 1.0]),
        "three equal free rows": Problem.linear(np.ones((3, 3)), [1.0, 1.0, 1.0]),
        "a zero diagonal": Problem.lcp([[0.0, 1.0], [1.0, 0.0]], [1.0, 1.0]),
        "an indefinite A": Problem.lcp([[-1.0, 2.0], [2.0, -1.0]], [1.0, 1.0]),
        "an asymmetric A": Problem.lcp([[2.0, 1.0], [-1.0, 2.0]], [1.0, 1.0]),
        "a contact with tangents that cannot move": Problem.contact(
            np.diag([1.0, 0.0, 0.0]), [1.0, 0.2, 0.1], [0.5]
        ),
        "two soft contacts of a static body": make_soft_static_contacts(),
    }


@_register_check("all solvers")
def require_unusual_problems_have_a_result(spec: SolverSpec) -> None:
    """Require that unusual but valid problems have a finite result, or are refused with a CapabilityError."""
    for name, problem in make_unusual_problems().items():
        try:
            solution = solve(problem, spec.name)
        except CapabilityError:
            continue
        _raise_unless(
            bool(np.isfinite(solution.impulse).all()), f"for {name} the impulse is {solution.impulse}"
        )
        _raise_unless(
            spec.external or solution.claim_check == "confirmed",
            f"for {name} the judge does not confirm the claim ({solution.claim_check}): {solution}",
        )
        _raise_unless(problem.m > 0 or solution.success, f"{name} are not CONVERGED: {solution}")


@_register_check("all solvers except code of another project", lambda spec: not spec.external)
def require_claims_are_true(spec: SolverSpec) -> None:
    """Require that every claim about a small random matrix is true: solutions, and that there is none."""

    def compare(seed: int, m: int) -> None:
        rng = np.random.default_rng(seed)
        a = np.rint(2.0 * rng.normal(size=(m, m)))
        low, high = random_bounds(rng, m)
        problem = Problem.lcp(a, np.rint(3.0 * rng.normal(size=m)), low, high)
        if spec.refuses(problem):
            return
        solution = solve(problem, spec.name, tol=1e-9)
        text = f"for A = {a.tolist()}, b = {problem.b.tolist()}, bounds {low.tolist()} and {high.tolist()}: {solution}"
        _raise_unless(
            solution.claim_check == "confirmed",
            f"{text}. The judge does not confirm the claim: {solution.claim_check}",
        )
        _raise_unless(bool(np.isfinite(solution.impulse).all()), f"{text}. The impulse is not finite")
        if solution.status is Status.INFEASIBLE:
            exact = enumerate_lcp(a, problem.b, low, high)
            _raise_unless(not exact, f"{text}. But {exact and exact[0][0].tolist()} N s is a solution")

    check_on_random_problems(compare)


def check_on_random_problems(compare: Callable[[int, int], None]) -> None:
    """Call `compare(seed, m)` for random small problems of m rows.

    If Hypothesis is installed, it reduces a failure to a small example.
    """
    try:
        import hypothesis
        from hypothesis import strategies
    except ImportError:
        for seed in range(CHECKED_DRAWS):
            compare(seed, 1 + seed % MAX_DRAWN_ROWS)
        return
    draw = hypothesis.given(seed=strategies.integers(0, 2**32 - 1), m=strategies.integers(1, MAX_DRAWN_ROWS))
    settings = hypothesis.settings(
        max_examples=CHECKED_DRAWS,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(hypothesis.HealthCheck),  # pyright: ignore[reportArgumentType]
    )

    def call(seed: int, m: int) -> None:
        compare(seed, m)

    settings(draw(call))()


@_register_check("all solvers")
def require_failures_have_a_message(spec: SolverSpec) -> None:
    """Require that DIVERGED, STALLED and NUMERICAL_ERROR come with a message."""
    for matrix in UNSOLVABLE_MATRICES:
        for build, second in itertools.product((Problem.linear, Problem.lcp), (1.0, -1.0)):
            problem = build(matrix, [1.0, second])
            if spec.refuses(problem) is not None:
                continue
            solution = solve(problem, spec.name, tol=1e-6)
            failed = solution.status in (Status.DIVERGED, Status.STALLED, Status.NUMERICAL_ERROR)
            _raise_unless(
                bool(solution.message) or not failed,
                f"for A = {matrix}, b = {[1.0, second]} the status is {solution.status.name} without a message",
            )


#: Matrices with a zero and a negative diagonal entry, and an indefinite one: sweeps do not solve these problems.
UNSOLVABLE_MATRICES = ([[0.0, 1.0], [1.0, 2.0]], [[2.0, 3.0], [3.0, -1.0]], [[1.0, 3.0], [3.0, 1.0]])


@_register_check("all solvers")
def require_infeasible_rows_are_reported(spec: SolverSpec) -> None:
    """Require that a row that no impulse can satisfy gives INFEASIBLE with a certificate that names the row."""
    problem = Problem.lcp(np.diag([1.0, 0.0]), [1.0, 1.0])
    if spec.refuses(problem):
        return
    solution = solve(problem, spec.name)
    text = f"for A = diag(1, 0), b = (1, 1) and impulses >= 0 the result is: {solution}"
    _raise_unless(
        solution.status is Status.INFEASIBLE,
        f"{text}. INFEASIBLE is required: no impulse satisfies row 1",
    )
    _raise_unless("row 1" in solution.message, f"{text}. Its message must name row 1: {solution.message!r}")
    _raise_unless(
        solution.certificate is not None and check_certificate(problem, solution.certificate) is None,
        f"{text}. Its certificate is not valid",
    )
    _raise_unless(solution.claim_check == "confirmed", f"{text}. The judge does not confirm it")
