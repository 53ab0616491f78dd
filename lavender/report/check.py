"""Compare solvers with the judge and with a reference optimum, by default from a QP solver.

If the problem is convex, the distance of two answers is bounded by their residuals. With two answers l1, l2 and their
errors e1, e2 by the judge, Delta = l1 - l2 and eps = e1 - e2 satisfy

    |Delta|_A^2 <= |Delta|_A |eps|_A + |eps|_D |Delta|_D                                          (1)

Both p = l - e are projections of l - w/d in the metric of D, so (w1 - w2 - D eps).(Delta - eps) <= 0; expand and use
Cauchy-Schwarz. Two points x1, x2 of a quadratic program with multipliers l, row residuals s = J x - t, violations
v = max(-s, 0) (|s| of equations) and column residuals r = P x + q - J^T l have

    Delta.P Delta <= |l1|.(|s1| + v2) + |l2|.(|s2| + v1) + |Delta|.|r1 - r2|                      (2)

because Delta.P Delta = Delta.(r1 - r2) + (s1 - s2).(l1 - l2). A breach of (1) means that a residual is computed
incorrectly. |Delta|_A [sqrt J] is the energy norm of the difference of velocities, which are unique even if impulses
are not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lavender.base.arrays import check_sequence
from lavender.base.errors import InputError, LavenderError, format_error
from lavender.base.lazy_import import import_numerical_modules
from lavender.base.lazy_import import pandas as pd
from lavender.judge.residuals import MAX_EXCUSED_RESIDUAL
from lavender.judge.solution import CONTRADICTED, NOT_PROVEN, Solution, Status, raise_if_interrupted
from lavender.problem import Problem, check_problem
from lavender.programs.backends import explain_contradicted_claim
from lavender.report.case_kinds import make_case
from lavender.report.render import format_cells
from lavender.report.text import format_residual, format_tolerance
from lavender.solvers.registry import available, get, known, specs
from lavender.solving.limits import check_time_limit
from lavender.solving.prepared import check_arguments

REFERENCES = ("osqp", "clarabel", "piqp", "direct")
# Reference solvers, in order, under the law "cone" (relaxed friction), which does not give a QP.
CONE_REFERENCES = ("clarabel_cone", "block_gauss_seidel")
# A reference must reach this relative residual, or 10 times the round-off floor.
REFERENCE_MAX_RESIDUAL = 1e-9

AGREES = "agrees"
AGREES_UNCOMPARED = "solved, nothing to compare with"
PROVED = "no solution, proved"
UNBOUNDED = "unbounded, proved"
# A certificate holds up to rounding: any solution has huge impulses.
NEAR_NONE = "no solution within rounding"
# A certificate holds, and another solver's answer meets the tolerance nevertheless.
INEXACT = "no exact solution"
NOT_SOLVED = "not solved"
NOTHING_TO_DO = "nothing to do"
CLAIM_CONTRADICTED = "claim contradicted"
UNPROVED = "no solution claimed, not proved"
BREACH = "breach: a residual is computed wrongly"
REFUSED = "refused"


@dataclass(frozen=True)
class CrossCheckRow:
    """Comparison of one solver with the reference; a number that does not apply is None."""

    solver: str  # Name as requested.
    verdict: str
    status: str = ""
    relative: float | None = None  # Relative residual and its round-off floor, by the judge.
    roundoff_floor: float | None = None
    velocity: float | None = None  # [m/s] Velocity error of the worst row, by the judge.
    distance: float | None = None  # [sqrt J] |Delta|_A to the reference.
    allowed: float | None = None  # [sqrt J] Largest distance that (1) and (2) allow.
    slack: float | None = None  # [m/s] Largest difference of a row's slack from the reference's.
    # [J] 1/2 l.A l - b.l of the solver's impulse l, minus the reference's value.
    objective: float | None = None
    time: float | None = None  # [s] Set-up and solve.
    note: str = ""  # Operator form, message and reason.
    ran: str = ""  # Name of the bounded variant that was run instead, if the solver accepts only free rows.
    solution: Solution | None = None

    @property
    def contradicted(self) -> bool:
        """Whether the judge contradicts the solver's claim, or inequality (1) is violated."""
        return self.verdict in (CLAIM_CONTRADICTED, BREACH)


@dataclass(frozen=True, repr=False)
class CrossCheck:
    """Result of `cross_check`; iterates over its rows, and `str()` gives a plain-text table."""

    problem: Problem
    tol: float
    reference: str | None  # Name of the solver of the reference; None without one.
    reference_note: str  # Quality of the reference, or the reason why there is none.
    rows: tuple[CrossCheckRow, ...]

    def __iter__(self) -> Iterator[CrossCheckRow]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, solver: str) -> CrossCheckRow:
        rows = {row.solver: row for row in self.rows}
        if solver not in rows:
            raise InputError(f"no solver {solver!r} in this check; it has {', '.join(rows)}")
        return rows[solver]

    def _select(self, *verdicts: str) -> tuple[CrossCheckRow, ...]:
        """Return the rows with one of these verdicts."""
        return tuple(row for row in self.rows if row.verdict in verdicts)

    @property
    def contradicted(self) -> tuple[CrossCheckRow, ...]:
        """Rows with a contradicted claim."""
        return self._select(CLAIM_CONTRADICTED, BREACH)

    @property
    def agreed(self) -> tuple[CrossCheckRow, ...]:
        """Rows that agree with the reference."""
        return self._select(AGREES)

    @property
    def unsolved(self) -> tuple[CrossCheckRow, ...]:
        """Rows of solvers that do not solve the problem, or claim without proof that it has no solution."""
        return self._select(NOT_SOLVED, UNPROVED)

    @property
    def refused(self) -> tuple[CrossCheckRow, ...]:
        """Rows of solvers that do not accept the problem; their notes give the reason."""
        return self._select(REFUSED)

    @property
    def ok(self) -> bool:
        """Whether all solvers that accept the problem solve it and agree with the reference; False if none does.

        Without a reference nothing is compared: `reference` is None, as always under Coulomb's law, and solvers may
        have found different motions.
        """
        good = len(self._select(AGREES, AGREES_UNCOMPARED, NOTHING_TO_DO))
        return good > 0 and good + len(self.refused) == len(self.rows)

    def __repr__(self) -> str:
        return f"<CrossCheck of {len(self)} solvers: {len(self.agreed)} agree, {len(self.unsolved)} did not solve it>"

    def _repr_html_(self) -> str:
        """Return the table for notebooks."""
        return str(format_cells(self.frame).to_html(index=False, border=0))

    @property
    def frame(self) -> pd.DataFrame:
        """Row for each solver; the bounded variant that ran is named after an arrow."""
        heads = make_case(self.problem).heads
        columns = ["solver", "verdict", "status", *heads, "note"]
        rows = [{name: getattr(r, name) for name in columns} for r in self.rows]
        table = pd.DataFrame(rows, columns=columns).astype(dict.fromkeys(heads, float))
        table["solver"] = [f"{r.solver} → {r.ran}" if r.ran else r.solver for r in self.rows]
        return table.rename(columns={**heads, "note": "what ran"})

    @property
    def description(self) -> str:
        """Name and law of the problem, tolerance and, if there is one, reference with its residual."""
        name = self.problem.name or f"{self.problem.m} rows"
        reference = f", reference {self.reference}, {self.reference_note}" if self.reference else ""
        law = self.problem.law if self.problem.qp is None else "program"
        return f"{name} ({law}), cold, tol {format_tolerance(self.tol)}{reference}"

    def __str__(self) -> str:
        table = format_cells(self.frame).to_string(index=False)
        reason = [] if self.reference else [f"no reference: {self.reference_note}"]
        return "\n".join([self.description, *reason, table])


def cross_check(
    problem: Problem,
    solvers: Iterable[str] | None = None,
    reference: str = "osqp",
    *,
    tol: float = 1e-6,
    max_iter: int | None = None,
    time_limit: float | None = None,
) -> CrossCheck:
    """Solve from the zero impulse with every solver, and compare each with a judged reference.

    A quadratic program is solved by `solve_qp` and judged by its error. The error of the reference (of other problems
    the relative residual) must be at most max(1e-9, 10 floor), with the round-off floor, and at most 1e-5. Otherwise
    the next solver of osqp, clarabel, piqp, direct (relaxed friction: clarabel_cone, block_gauss_seidel) computes the
    reference; the result names it.

    Parameters
    ----------
    problem : Problem
    solvers : names, optional
        Default: all available solvers that accept the problem.
    reference : str
        Solver that is tried first as the reference. Under Coulomb's law it is not used; `reference_note` of the result
        states the reason.
    tol : float
        Relative residual tolerance of the solvers.
    max_iter : int, optional
        Largest number of iterations of each solver; default: the solver's own.
    time_limit : float, optional, s
        Time limit of each solver, as of `lavender.solve`.

    Returns
    -------
    CrossCheck
        If a solver accepts only free rows, its bounded variant is run ("gauss_seidel → pgs"), and `ran` names it.
        Distances, slack and objective are computed only for symmetric positive semidefinite A without Coulomb friction
        and for quadratic programs.

    Raises
    ------
    UnknownName
        A solver or reference does not exist.
    InputError
        `tol` or a limit is invalid.
    """
    check_problem(problem)
    check_arguments(specs()["auto"], tol, max_iter)
    check_time_limit(time_limit)
    if problem.guess is not None:  # All solvers start from the zero impulse.
        problem = replace(problem, guess=None, copy=False)
    if isinstance(solvers, str):
        solvers = [solvers]
    names = available(problem) if solvers is None else check_sequence("solvers", solvers, "names")
    reasons, case = known(problem), make_case(problem)
    for name in (reference, *names):
        if not isinstance(name, str) or name not in reasons:
            get(name)  # Raises UnknownName with similar names.

    def run_solver(name: str, tol: float = tol, max_iter: int | None = max_iter) -> Solution:
        import_numerical_modules(
            *get(name).requires
        )  # The first solve's time does not include the import.
        return case.solve(name, tol=tol, max_iter=max_iter, time_limit=time_limit)

    optimum, reference_solver, note = solve_reference(problem, reference, reasons, run_solver)
    rows = [_check_solver(problem, name, reasons[name], optimum, run_solver) for name in names]
    if optimum is not None or any(row.verdict == AGREES_UNCOMPARED for row in rows):
        rows = [
            replace(r, verdict=INEXACT) if r.verdict in (PROVED, NEAR_NONE) else r for r in rows
        ]
    return CrossCheck(problem, tol, reference_solver, note, tuple(rows))


def _check_solver(
    problem: Problem,
    name: str,
    reason: str | None,
    optimum: Solution | None,
    run_solver: Callable[..., Solution],
) -> CrossCheckRow:
    """Run one solver and compare its solution with `optimum`.

    `reason` explains why the solver does not accept the problem; its bounded variant runs instead, if it has one.
    """
    other = None if reason is None else specs()[name].standing_in(problem)
    if reason is not None and other is None:
        return CrossCheckRow(name, REFUSED, note=reason)
    run = name if other is None else other.name
    try:
        solution = raise_if_interrupted(run_solver(run))
    except Exception as error:
        if isinstance(error, LavenderError) and not isinstance(error, InputError):
            # The solver rejected the numbers of the problem.
            return CrossCheckRow(name, REFUSED, note=str(error))
        if get(run).builtin:
            raise
        # A plug-in may raise any exception; only its own row is lost.
        return CrossCheckRow(name, NOT_SOLVED, note=format_error(error))
    return replace(
        compare_with_reference(problem, name, solution, optimum), ran="" if other is None else run
    )


def solve_reference(
    problem: Problem,
    first: str,
    reasons: dict[str, str | None],
    run_solver: Callable[..., Solution],
) -> tuple[Solution | None, str | None, str]:
    """Return (solution, solver, quality) of the first reference that passes, or (None, None, reason)."""
    failed = []
    if problem.law == "coulomb":
        reason = reasons.get(first, "not registered")
        if reason is None:
            reason = "solves it, but several motions may be solutions, so a distance to one of them is not an error"
        why = f"({first} {reason}); compare errors in m/s"
        return None, None, f"Coulomb friction is not the optimality condition of a QP {why}"
    case = make_case(problem)
    if reason := case.explain_no_reference():
        return None, None, reason
    for name in dict.fromkeys([first, *(CONE_REFERENCES if problem.law == "cone" else REFERENCES)]):
        reason = reasons.get(name, "not registered")
        if reason is not None:
            failed.append(f"{name} {reason}")
            continue
        spec = get(name)
        # A reference may use 100 times the solver's default number of iterations.
        budget = 100 * spec.max_iter if spec.resumable else None
        try:
            solution = run_solver(name, tol=0.1 * REFERENCE_MAX_RESIDUAL, max_iter=budget)
            raise_if_interrupted(solution)
        except Exception as error:
            if spec.builtin and not isinstance(error, LavenderError):
                raise
            failed.append(f"{name}: {format_error(error)}")
            continue
        judged = case.judge(solution)
        relative, floor = judged["relative"], judged["roundoff_floor"]
        needed = max(REFERENCE_MAX_RESIDUAL, min(10.0 * floor, MAX_EXCUSED_RESIDUAL))
        if relative <= needed:
            note = f"{case.heads['relative'].split()[0]} {format_residual(relative)}"
            return solution, name, note + (f" ({'; '.join(failed)})" if failed else "")
        failed.append(
            f"{name}: relative {format_residual(relative)} above {format_residual(needed)}"
        )
    return None, None, "; ".join(failed)


def compare_with_reference(
    problem: Problem, name: str, solution: Solution, optimum: Solution | None
) -> CrossCheckRow:
    """Compare one solver's solution with the optimum and build its row."""
    case = make_case(problem)
    form = solution.solver.form and f"{solution.solver.form} form"
    note = "; ".join(filter(None, (form, solution.message)))
    judged = case.judge(solution)
    fields: dict[str, Any] = {
        name: judged[name] for name in ("relative", "roundoff_floor", "velocity")
    } | {
        "status": solution.status.name,
        "time": solution.setup_time + solution.solve_time,
        "solution": solution,
    }
    verdict = AGREES_UNCOMPARED
    breached = False
    if optimum is not None and np.isfinite(solution.impulse).all():
        with np.errstate(over="ignore", invalid="ignore"):  # Squares of the impulses may overflow.
            distance, allowed = case.compute_separation(solution, optimum)
            objective = case.compute_objective(solution) - case.compute_objective(optimum)
            slack = float(np.abs(solution.slack - optimum.slack).max(initial=0.0))
            fields |= {
                "distance": distance,
                "allowed": allowed,
                "slack": slack,
                "objective": objective,
            }
        verdict = AGREES
        breached = distance > allowed
    if breached:
        verdict = BREACH
    elif solution.claim_check == CONTRADICTED:
        known = explain_contradicted_claim(name, problem, solution.status)
        verdict = CLAIM_CONTRADICTED
        note = "; ".join(filter(None, (solution.status_conflict, known, note)))
    elif solution.claim_check == NOT_PROVEN:
        verdict = UNPROVED
    elif solution.status is Status.INFEASIBLE:
        verdict = PROVED if solution.impulse_bound == np.inf else NEAR_NONE
    elif solution.status is Status.UNBOUNDED:
        verdict = UNBOUNDED
    elif errors := case.describe_zero(solution):
        verdict = NOTHING_TO_DO
        note = f"{errors}; {note}".rstrip("; ")
    elif not case.is_solved(solution):
        verdict = NOT_SOLVED
    return CrossCheckRow(name, verdict, note=note, **fields)
