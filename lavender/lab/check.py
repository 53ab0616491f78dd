"""Do solvers agree? Each against the judge, and against the optimum that a QP backend found.

Where the problem is convex, two answers are no further from each other than their residuals allow
(`lavender.lab.motion.bound`, inequality (3)). A breach means that a residual is computed wrongly. |Delta|_A [sqrt J] is
the energy of the difference of velocities, which is unique where impulses are not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from lavender.base.arrays import check_sequence
from lavender.base.errors import InputError, LavenderError, format_error
from lavender.judge.residuals import MAX_EXCUSED_RESIDUAL, WRONG
from lavender.judge.solution import CONTRADICTED, NOT_PROVEN, Solution, Status, uninterrupted
from lavender.lab.bench.running.worker import TaskFailed, Worker, solve_isolated
from lavender.lab.motion.bound import separation
from lavender.problem import Problem, check_problem
from lavender.solvers.registry import available, get, known, specs
from lavender.solving.solve import check_budget, seconds_of

REFERENCES = ("osqp", "clarabel", "piqp", "direct")
CONE_REFERENCES = ("clarabel_cone", "block_gauss_seidel")  # of relaxed friction, which is no QP
REFERENCE_TOL = 1e-9  # relative residual that a reference must reach, or 10 times the floor

AGREES = "agrees"
AGREES_UNCOMPARED = "solved, nothing to compare with"
PROVED = "no solution, proved"
NEAR_NONE = "no solution within rounding"  # of the data: theirs has huge impulses, if any
INEXACT = "no exact solution"  # a certificate holds, and others meet the tolerance
NOT_SOLVED = "not solved"
NOTHING = "nothing to do"
CLAIM_CONTRADICTED = "claim contradicted"
UNPROVED = "no solution claimed, not proved"
BREACH = "breach: a residual is computed wrongly"
REFUSED = "refused"


@dataclass(frozen=True)
class CrossCheckRow:
    """One solver beside the reference; numbers are None where they mean nothing."""

    solver: str  # as asked for
    verdict: str
    status: str = ""
    relative: float | None = None  # -, the judge's
    roundoff_floor: float | None = None  # -
    distance: float | None = None  # sqrt J, |Delta|_A to the reference
    allowed: float | None = None  # sqrt J, largest distance that (3) allows
    slack: float | None = None  # m/s, largest difference of slack
    objective: float | None = None  # J, 1/2 l.A l - b.l minus that of the reference
    time: float | None = None  # s, set-up and solve
    note: str = ""  # form, message, reason
    ran: str = ""  # the solver that is the one asked for with bounds, where that one takes free rows alone
    solution: Solution | None = None

    @property
    def contradicted(self) -> bool:
        """The solver claims what the judge does not find, or inequality (3) is broken."""
        return self.verdict in (CLAIM_CONTRADICTED, BREACH)


@dataclass(frozen=True)
class CrossCheck:
    """Table of `cross_check`; iterates over its rows, and `str()` is plain text."""

    problem: Problem
    tol: float
    reference: str | None  # name of the solver that gave the reference, None without one
    reference_note: str  # how good it is, or why there is none
    rows: tuple[CrossCheckRow, ...]

    def __iter__(self) -> Iterator[CrossCheckRow]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, solver: str) -> CrossCheckRow:
        for row in self.rows:
            if row.solver == solver:
                return row
        raise InputError(
            f"no solver {solver!r} in this check; it has {', '.join(r.solver for r in self.rows)}"
        )

    @property
    def contradicted(self) -> tuple[CrossCheckRow, ...]:
        """Rows whose claim does not hold."""
        return tuple(row for row in self.rows if row.contradicted)

    @property
    def agreed(self) -> tuple[CrossCheckRow, ...]:
        """Rows that agree with the reference."""
        return tuple(row for row in self.rows if row.verdict == AGREES)

    @property
    def refused(self) -> tuple[CrossCheckRow, ...]:
        """Rows of solvers that do not take the problem; their notes say why."""
        return tuple(row for row in self.rows if row.verdict == REFUSED)

    @property
    def ok(self) -> bool:
        """Every solver that takes the problem solves it, and agrees with the reference; False where none takes it.

        Where there is no reference, nothing is compared: `reference` is None, as always under Coulomb's law, and
        solvers may have found different motions (see `lavender.find_solutions`).
        """
        asked = {row.verdict for row in self.rows} - {REFUSED}
        return bool(asked) and asked <= {AGREES, AGREES_UNCOMPARED, NOTHING}

    def __str__(self) -> str:
        head = (
            "solver", "verdict", "status", "relative", "floor", "distance", "allowed", "objective", "ms", "what ran",
        )  # fmt: skip
        body = [
            (
                f"{r.solver} → {r.ran}" if r.ran else r.solver, r.verdict, r.status,
                _short(r.relative), _short(r.roundoff_floor), _short(r.distance),
                _short(r.allowed), _short(r.objective), "" if r.time is None else f"{1e3 * r.time:.3g}", r.note,
            )
            for r in self.rows
        ]  # fmt: skip
        widths = [max(len(line[i]) for line in (head, *body)) for i in range(len(head))]
        lines = [
            "  ".join(x.ljust(n) for x, n in zip(line, widths, strict=True)).rstrip()
            for line in (head, *body)
        ]
        name = self.problem.name or f"{self.problem.m} rows"
        reference = f"cold: reference {self.reference}" if self.reference else "cold: no reference"
        return "\n".join(
            [f"{name} ({self.problem.law}), tol {self.tol:g}, {reference}, {self.reference_note}", *lines]
        )


def _short(x: float | None) -> str:
    return "" if x is None else f"{x:.1e}"


def cross_check(
    problem: Problem,
    solvers: Iterable[str] | None = None,
    reference: str = "osqp",
    *,
    tol: float = 1e-6,
    max_iter: int | None = None,
    time_limit: float | None = None,
) -> CrossCheck:
    """Solve with every solver, from doing nothing, and compare each with a judged reference.

    The reference must reach max(1e-9, 10 floor), and 1e-5, by the judge; otherwise the next of osqp, clarabel, piqp,
    direct (relaxed friction: clarabel_cone, block_gauss_seidel) is taken, and named.

    Parameters
    ----------
    problem : Problem
    solvers : names, optional
        Default: all that take the problem here.
    reference : str
        Tried first.
    tol : float
        Relative residual asked of the solvers.
    max_iter : int, optional
        Budget of the solvers, in their own iterations; default: each spec's.
    time_limit : float, optional, s
        For each solver, where it can be stopped.

    Returns
    -------
    CrossCheck
        A solver of free rows is run as the one that is the same method with bounds ("gauss_seidel → pgs"), and `ran`
        names it. Distances, slack and objective only for symmetric positive semidefinite A without Coulomb friction
        and for quadratic programs.

    Raises
    ------
    UnknownName
        A solver or reference that does not exist.
    InputError
        Wrong `tol` or limits.
    """
    check_problem(problem)
    check_budget(specs()["auto"], tol, max_iter)
    seconds_of(time_limit)
    if problem.guess is not None:  # solvers are compared by what they do, not by where they begin
        problem = replace(problem, guess=None, copy=False)
    if isinstance(solvers, str):
        solvers = [solvers]
    names = available(problem) if solvers is None else check_sequence("solvers", solvers, "names")
    reasons = known(problem)
    for name in (reference, *names):
        if not isinstance(name, str) or name not in reasons:
            get(name)  # raises UnknownName with the nearest names
    with Worker() as worker:
        solver = partial(solve_isolated, worker, problem, time_limit=time_limit)
        optimum, chosen, note = _reference(problem, reference, reasons, solver)
        solver = partial(solver, tol=tol, max_iter=max_iter)
        rows = [_row(problem, name, reasons[name], optimum, solver) for name in names]
    if optimum is not None or any(row.verdict == AGREES_UNCOMPARED for row in rows):
        rows = [replace(r, verdict=INEXACT) if r.verdict in (PROVED, NEAR_NONE) else r for r in rows]
    return CrossCheck(problem, tol, chosen, note, tuple(rows))


def _row(
    problem: Problem, name: str, reason: str | None, optimum: Solution | None, solver: Callable[..., Solution]
) -> CrossCheckRow:
    other = None if reason is None else specs()[name].standing_in(problem)
    if reason is not None and other is None:
        return CrossCheckRow(name, REFUSED, note=reason)
    run = name if other is None else other.name
    try:
        solution = uninterrupted(solver(run))
    except Exception as error:
        if isinstance(error, TaskFailed):
            return CrossCheckRow(name, NOT_SOLVED, error.status, note=error.text)
        if isinstance(error, LavenderError) and not isinstance(error, InputError):
            return CrossCheckRow(name, REFUSED, note=str(error))  # only after a look at the numbers
        if get(run).builtin:
            raise
        # a plug-in may raise anything: it costs its own row
        return CrossCheckRow(name, NOT_SOLVED, note=format_error(error))
    return replace(compare(problem, name, solution, optimum), ran="" if other is None else run)


def _reference(
    problem: Problem, first: str, reasons: dict[str, str | None], solver: Callable[..., Solution]
) -> tuple[Solution | None, str | None, str]:
    """(solution, solver, how good) of the first that passes, or (None, None, why none does)."""
    if problem.law == "coulomb":
        return None, None, "Coulomb friction is not the optimality condition of a QP"
    if not (problem.has_singular_program or problem.is_symmetric):
        return None, None, f"A is not symmetric (by {problem.asymmetry:.1e}), so the problem is no QP"
    if not (problem.has_singular_program or problem.is_semidefinite):
        return None, None, "A is not positive semidefinite: solutions may be many, of different motions"
    usual = CONE_REFERENCES if problem.law == "cone" else REFERENCES
    chain = (first, *(r for r in usual if r != first))
    failed = []
    for name in chain:
        reason = reasons.get(name, "not registered")
        if reason is not None:
            failed.append(f"{name} {reason}")
            continue
        spec = get(name)
        try:
            budget = 100 * spec.max_iter if spec.resumable else None  # a reference may take its time
            solution = uninterrupted(solver(name, tol=0.1 * REFERENCE_TOL, max_iter=budget))
        except Exception as error:
            if spec.builtin and not isinstance(error, LavenderError):
                raise
            failed.append(f"{name}: {format_error(error)}")
            continue
        r = solution.residual
        needed = max(REFERENCE_TOL, min(10.0 * r.roundoff_floor, MAX_EXCUSED_RESIDUAL))
        if r.relative <= needed:
            note = f"relative {r.relative:.1e}"
            return solution, name, note + (f" ({'; '.join(failed)})" if failed else "")
        failed.append(f"{name}: relative {r.relative:.1e} above {needed:.1e}")
    return None, None, "; ".join(failed)


def compare(problem: Problem, name: str, solution: Solution, optimum: Solution | None) -> CrossCheckRow:
    """A row of one solver's solution beside the optimum."""
    r = solution.residual
    note = "; ".join(
        x for x in (solution.solver.form and f"{solution.solver.form} form", solution.message) if x
    )
    shared: dict[str, Any] = {
        "status": solution.status.name,
        "relative": r.relative,
        "roundoff_floor": r.roundoff_floor,
        "time": solution.setup_time + solution.solve_time,
        "solution": solution,
    }
    verdict, breached = AGREES_UNCOMPARED, False
    if optimum is not None and np.isfinite(solution.impulse).all():
        with np.errstate(over="ignore", invalid="ignore"):  # impulses whose squares are no numbers
            apart, allowed = separation(problem, solution, optimum)
            shared |= {
                "distance": apart,
                "allowed": allowed,
                "slack": float(np.abs(r.slack - optimum.slack).max(initial=0.0)),
                "objective": _objective(problem, solution) - _objective(problem, optimum),
            }
        verdict, breached = AGREES, apart > allowed
    if breached:
        verdict = BREACH
    elif solution.claim_check == CONTRADICTED:
        verdict, note = CLAIM_CONTRADICTED, f"{solution.status_conflict}; {note}".rstrip("; ")
    elif solution.claim_check == NOT_PROVEN:
        verdict = UNPROVED
    elif solution.status is Status.INFEASIBLE:
        verdict = PROVED if solution.impulse_bound == np.inf else NEAR_NONE
    elif r.nothing_to_do and r.verdict != WRONG:
        units = f"{r.velocity:.1e} m/s, {r.energy:.1e} sqrt(J)"
        verdict, note = NOTHING, f"{units}; {note}".rstrip("; ")
    elif not (solution.success or r.at_floor):
        verdict = NOT_SOLVED
    return CrossCheckRow(name, verdict, note=note, **shared)


def _objective(problem: Problem, solution: Solution) -> float:
    """1/2 l.A l - b.l [J], or 1/2 x.P x + q.x of a program with a singular P."""
    if problem.has_singular_program:
        return float(problem.qp.solution(solution).objective)
    lam = solution.impulse
    return float(0.5 * (lam @ (solution.slack - problem.b)))
