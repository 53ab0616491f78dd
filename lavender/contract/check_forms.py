"""Checks of laws, forms and options: each capability that the spec of a solver lists is exercised."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np

from lavender.base.errors import CapabilityError, LavenderError, UnknownName
from lavender.contract.requirement import (
    MAX_CONDITION,
    REQUIRED_BACKENDS,
    STOP_TEST_REMEDY,
    ContractError,
    choose_iteration_budget,
    choose_tolerance,
    describe_problem,
    make_first_well_posed_problem,
    make_problems_of_every_kind,
    make_well_posed_problem,
    raise_unless,
    register_check,
)
from lavender.judge.residuals import residual
from lavender.judge.solution import MATRIX_PASS_COUNTERS, OTHER_WORK_COUNTERS, Status
from lavender.solvers.registry import SolverSpec
from lavender.solving.solve import solve

WORK_COUNTERS = MATRIX_PASS_COUNTERS | OTHER_WORK_COUNTERS

# -- laws, forms and options --------------------------------------------------------------------------


@register_check("all solvers")
def require_every_listed_law_is_solved(spec: SolverSpec) -> None:
    """Require that the solver solves every law that it lists, in every form that it accepts, and counts its work."""
    must_solve = not spec.external or spec.name in REQUIRED_BACKENDS
    tol, accepted = choose_tolerance(spec), set()
    for (law, kind), (forms, slack) in make_problems_of_every_kind().items():
        for problem in forms:
            phrase = describe_problem(problem, kind)
            if spec.refuses(problem) is not None:
                try:
                    solve(problem, spec.name)
                except CapabilityError:
                    continue
                raise ContractError(
                    f"the spec of the solver refuses {phrase}, but lavender.solve accepted this problem and "
                    "returned a result; a refused problem must raise CapabilityError"
                )
            accepted.add(law)
            solution = solve(problem, spec.name, tol=tol, max_iter=choose_iteration_budget(spec))
            text = f"for {phrase} the result is: {solution}"
            if must_solve and not (spec.external and kind.startswith("round")):
                raise_unless(
                    solution.success,
                    f"{text}. CONVERGED within a relative residual of {tol:g} is required, because the spec lists "
                    f"the law {law!r}{'' if solution.status is not Status.CONVERGED else STOP_TEST_REMEDY}",
                )
                raise_unless(
                    solution.claim_check == "confirmed",
                    f"{text}. The judge must confirm the claim; it found: {solution.claim_check}{STOP_TEST_REMEDY}",
                )
            # Other backends may fail, unless they claim convergence and the result does not report the conflict.
            raise_unless(
                solution.success or bool(solution.status_conflict) or solution.status is not Status.CONVERGED,
                f"{text}. The claim CONVERGED is wrong and not reported as such",
            )
            raise_unless(
                solution.solver.name == spec.name, f"{text}. It names another solver: {solution.solver.name}"
            )
            raise_unless(
                sum(solution.work.values()) > 0,
                f"{text}. Its work counts nothing; the claim must count sweeps, products or other work",
            )
            raise_unless(
                not WORK_COUNTERS.isdisjoint(solution.work),
                f"{text}. Its work counts {', '.join(map(repr, solution.work))}; at least one of "
                f"{', '.join(sorted(WORK_COUNTERS))} is needed, so that reports can compare it",
            )
            raise_unless(
                solution.iterations > 0 or not spec.resumable,
                f"{text}. It reports 0 iterations although the start is not a solution",
            )
            judged = residual(problem, solution.impulse).slack
            raise_unless(np.array_equal(solution.slack, judged), f"{text}. Its slack is not A impulse - b")
            if law != "coulomb" and solution.success:
                size = np.abs(problem.slack(problem.start())).max()
                error = np.abs(solution.slack - slack).max()
                raise_unless(
                    error <= MAX_CONDITION * tol * size + 1e-7 * np.abs(slack).max(),
                    f"{text}. Its slack differs by {error:.3g} m/s from the unique solution; at most "
                    f"{MAX_CONDITION * tol * size:.3g} m/s is accepted",
                )
    missing = set(spec.laws) - accepted
    raise_unless(
        not missing,
        f"the spec lists the laws {', '.join(sorted(missing))}, but the solver refuses every problem of them",
    )


@register_check("solvers with an option `form`", lambda spec: "form" in spec.options)
def require_forms_agree(spec: SolverSpec) -> None:
    """Require that every value of the option `form` gives the same solution."""
    tol, must_solve = choose_tolerance(spec), not spec.external or spec.name in REQUIRED_BACKENDS
    for (law, kind), (forms, slack) in make_problems_of_every_kind().items():
        if kind.startswith("round") or spec.refuses(forms[0]):
            continue  # Problems with round cones can be written in one form only.
        if kind == "boxes" and law not in spec.laws:
            continue  # Friction boxes are always converted to bounded rows of a matrix.
        for form in ("impulse",) if kind == "ellipses" else ("impulse", "velocity"):
            solution = solve(forms[0], spec.name, tol=tol, form=form)
            text = f"for {describe_problem(forms[0], kind)} with form={form!r} the result is: {solution}"
            raise_unless(
                str(solution.solver.form).startswith(form),
                f"{text}. Another form ran: {solution.solver.form}",
            )
            raise_unless(solution.success or not must_solve, f"{text}. CONVERGED is required")
            if solution.success and law != "coulomb":
                size = np.abs(forms[0].slack(forms[0].start())).max()
                error = np.abs(solution.slack - slack).max()
                limit = MAX_CONDITION * tol * size + 1e-7 * np.abs(slack).max()
                raise_unless(
                    error <= limit, f"{text}. Its slack differs by {error:.3g} m/s from the unique solution"
                )
    try:
        solve(make_well_posed_problem("lcp", True), spec.name, form="velocities")
    except LavenderError as error:
        raise_unless(
            "velocity" in str(error),
            f"the error for an unknown form does not list the known ones: {error}",
        )
    else:
        raise ContractError(
            "the solver accepted form='velocities', which is not one of its forms; an unknown form must "
            "raise an error that lists the known forms"
        )


@register_check("all solvers")
def require_unknown_options_are_rejected(spec: SolverSpec) -> None:
    """Require that an option that the solver does not have raises an error that names it."""
    problem = make_first_well_posed_problem(spec)
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
            raise_unless(word in str(error), f"the error for {word} does not name it: {error}")
        else:
            raise ContractError(
                f"{spec.name}: {word}= was accepted, but the spec does not list it: add it there, or raise an error"
            )


@register_check("all solvers")
def require_options_match_the_factory(spec: SolverSpec) -> None:
    """Require that the spec lists exactly the options that the factory accepts."""
    parameters = set(inspect.signature(spec.load()).parameters)
    extra, missing = sorted(spec.accepts - parameters), sorted(parameters - spec.accepts)
    raise_unless(
        not extra, f"the spec lists the options {', '.join(extra)}, which the factory does not accept"
    )
    raise_unless(
        not missing, f"the factory accepts the options {', '.join(missing)}, which the spec does not list"
    )
