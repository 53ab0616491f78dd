"""`solve_qp`: quadratic programs by backends, `auto` or another solver, judged in the program's own terms.

A named backend receives the program in scaled variables, and its x is kept (`lavender/external`). `auto` solves a
program with a positive definite P as a constraint problem in J and M first, and then calls backends until the error
meets tol. Other solvers solve the constraint problem. A point that does not meet tol is followed by a search for a
proof that there is no solution (`proofs.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from time import perf_counter
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray, as_array, check_float, mark_read_only
from lavender.base.deadline import Deadline
from lavender.base.errors import InputError
from lavender.base.lazy_import import sparse as sp
from lavender.external.forms import get_program
from lavender.external.proofs import (
    EXACT_RAY_TOLERANCE,
    RAY_TOLERANCE,
    find_infeasibility_proof,
    find_ray,
)
from lavender.external.qp_solver import OPTION_HELP, ProgramJudge, QPSolver, get_false_claim_error
from lavender.judge.certificates import Proof, prove_infeasibility
from lavender.judge.residuals import residual
from lavender.judge.solution import (
    CONFIRMED,
    CONTRADICTED,
    CONVERGED,
    INFEASIBLE,
    STALLED,
    Solution,
    SolverRun,
    SolverStage,
    Status,
    sum_work_counts,
)
from lavender.problem import Problem, QPSolution
from lavender.problem.program import QuadraticProgram, make_quadratic_program
from lavender.solvers.registry import SolverSpec, get
from lavender.solving.limits import check_time_limit
from lavender.solving.singular_programs import program_backends
from lavender.solving.solve import solve

MIN_TOL = 1e-13  # Smallest error that further solves are to reach; smaller ones are rounding.
MAX_SOLVES = 5  # Maximum number of solves of one constraint problem, each with a smaller tol.
# The next tol is this fraction of the tol that would suffice if the program's error were proportional to tol.
TOL_RATIO = 0.1
# `auto` solves the constraint problem to this fraction of tol: Newton's last steps cost less than a step in SciPy.
AUTO_TOL_RATIO = 1e-3


class Run(NamedTuple):
    """One solver that ran on a program, and its claim."""

    name: str
    status: Status
    message: str
    work: dict[str, int]
    error: float  # Smallest error of the program after the run.
    form: str = "program"


def solve_qp(
    P: Any,
    q: Any = None,
    G: Any = None,
    h: Any = None,
    A: Any = None,
    b: Any = None,
    lb: Any = None,
    ub: Any = None,
    solver: str = "auto",
    initvals: Any = None,
    verbose: bool = False,
    *,
    tol: float = 1e-9,
    time_limit: float | None = None,
    max_iter: int | None = None,
    impulse: Any = None,
    **options: Any,
) -> QPSolution:
    """Solve a convex quadratic program: min 1/2 x.P x + q.x subject to G x <= h, A x = b, lb <= x <= ub.

    Two forms of the call: `solve_qp(P, q, G, h, A, b, lb, ub, solver=...)` with arrays as in `Problem.from_qp`, and
    `solve_qp(problem, solver)` with a problem of `Problem.from_qp`, for which the program is built only once.

    Parameters
    ----------
    P : (n, n) array or sparse, None for a linear program, or a Problem
    q : (n,), or str
        With a problem: the name of the solver, or another q of the same program; its matrices are kept.
    G, h, A, b, lb, ub : arrays, optional
        With a problem: only h and b, as other right-hand sides of the same program.
    solver : str
        "auto", a QP backend, or a solver of bounded rows if P is positive definite.
    initvals : (n,), optional
        Start x, for backends that accept one; other solvers start from `impulse` only.
    verbose : bool
        Whether a backend prints its output.
    tol : float
        `QPSolution.error` to reach.
    time_limit : float, optional, s
    max_iter : int, optional
        Largest number of iterations of the solver.
    impulse : (m,) or (n + m,), optional
        Start from the impulses of an earlier program (`answer.impulse`).
    **options
        Options of the solver; of a backend, also its own settings by name, such as eps_abs.

    Returns
    -------
    QPSolution
        x, y, z, z_box with their `error`. `found` is True exactly if `solution.status` is CONVERGED, exactly if the
        error is at most `tol`. INFEASIBLE: no x satisfies the constraints, x is None, and
        `answer.qp.multipliers(answer.solution.certificate)` proves it. UNBOUNDED: the objective decreases without
        limit along `ray`, and x satisfies the constraints.

    Raises
    ------
    InputError
        A problem was not made by `Problem.from_qp`; arrays are invalid.
    CapabilityError
        P is singular, and the solver needs a positive definite P.

    Examples
    --------
    A linear program:

    >>> import lavender as lv
    >>> answer = lv.solve_qp(None, [-1.0, -2.0], G=[[1.0, 1.0]], h=[1.0], lb=[0.0, 0.0], solver="highs")
    >>> (answer.x.round(9) + 0.0).tolist(), answer.found
    ([0.0, 1.0], True)
    """
    begun = perf_counter()
    problem = None
    if isinstance(P, Problem):
        if isinstance(q, str):
            solver = q
            q = None
        problem = P
        qp = P.qp
        if qp is None:
            raise InputError(
                "the problem contains no quadratic program; one of Problem.from_qp is needed"
            )
        if any(x is not None for x in (G, A, lb, ub)):
            raise InputError(
                "G, A, lb or ub is given with a problem; only q, h and b of it can be replaced"
            )
        if not (q is None and h is None and b is None):
            qp = qp.with_vectors(q, h, b)
            problem = Problem(**(qp.problem_fields() | {"qp": qp, "name": P.name, "copy": False}))
    else:
        if P is None:
            if q is None:
                raise InputError(
                    "P and q are missing; q is needed, and P unless the program is linear"
                )
            P = sp.csr_array((np.size(q), np.size(q)))
        qp = make_quadratic_program((P, q, G, h, A, b, lb, ub))
    tol = check_float("tol", tol, low=0.0)
    limit = check_time_limit(time_limit)
    deadline = Deadline(None if limit == math.inf else limit)
    spec = get(solver)
    if _is_program_backend(spec, options):
        own = {name: x for name, x in options.items() if name in OPTION_HELP}
        settings = {name: x for name, x in options.items() if name not in own} | (
            {"verbose": True} if verbose else {}
        )
        options = own | ({"settings": {**own.get("settings", {}), **settings}} if settings else {})
    task = _Task(qp, problem, spec, tol, deadline, max_iter, impulse, options)
    if initvals is not None:
        task.initial_x = as_array("initvals", initvals, (len(qp.q),))
    return task.solve(begun)


@dataclass(eq=False)
class _Task:
    """One call of `solve_qp`: its arguments, the best point, and the solvers that ran."""

    qp: QuadraticProgram
    given: Problem | None
    spec: SolverSpec
    tol: float
    deadline: Deadline
    max_iter: int | None
    start: Any
    options: dict[str, Any]
    initial_x: FloatArray | None = None
    runs: list[Run] = field(default_factory=list)
    rays: list[FloatArray] = field(default_factory=list)  # Multipliers of claims of infeasibility.
    proof: Proof | None = None
    ray: FloatArray | None = None
    solution: Solution | None = None  # Last solution of the constraint problem.

    def __post_init__(self) -> None:
        self.start = None if self.start is None else self.problem.make_start(self.start)
        self.program = get_program(self.qp)
        self.judge = ProgramJudge(self.program, max(self.tol, MIN_TOL), self.deadline)

    @cached_property
    def problem(self) -> Problem:
        """The constraint problem, which a backend does not need."""
        return Problem(**self.qp.problem_fields(), qp=self.qp) if self.given is None else self.given

    def solve(self, begun: float) -> QPSolution:
        """Run the solvers, search for proofs, and build the answer."""
        rows = self.qp.violated_empty_rows
        if not len(self.qp.q) or len(rows):  # A row contradicts itself, or x has no entries.
            self.start = np.zeros(len(self.qp.target) + len(self.qp.q) * self.qp.is_singular)
            self._judge_start()
            if len(rows):
                row = rows[np.argmax(np.abs(self.qp.target[rows]))]
                y = np.zeros(self.problem.m)
                y[self.problem.m - len(self.qp.target) + row] = np.sign(self.qp.target[row])
                proof = prove_infeasibility(self.problem, y)
                # J^T y = 0 and t.y > 0 hold exactly, however small t is beside other rows.
                self.proof = Proof(y, math.inf) if proof.reason else proof
            return self._make_answer(begun)
        if (
            self.spec.delegates and self.deadline.is_set
        ):  # Later steps would import packages within the limit.
            begin = perf_counter()
            for backend in program_backends():
                backend.load()().start_workers(None, 0.0)
            self.deadline.extend(perf_counter() - begin)
        for step in self._list_steps():
            step()
            if self.judge.error <= self.judge.tol or self.proof is not None:
                break
            if self.runs[-1].status is Status.INTERRUPTED or self.deadline.has_passed():
                break
        if self.judge.x is None:  # Without a point, x = 0 is judged.
            self.judge.keep(np.zeros(len(self.qp.q)), np.zeros(len(self.qp.target)))
        is_stopped = self.runs[-1].status is Status.INTERRUPTED
        # Large x makes the violations of rows that contradict each other small: a proof has precedence, also over a
        # point that was found in `max_iter` iterations.
        has_budget = self.max_iter is None or self.judge.error <= self.judge.tol
        has_budget = has_budget and not self.deadline.has_passed() and len(self.qp.q) > 0
        is_strict = self.judge.strict_error <= self.judge.tol
        has_doubts = not (is_strict and self.judge.hidden_error <= self.judge.tol)
        if has_doubts and not is_stopped and has_budget and not self._has_near_solution():
            # Search for a proof that no x satisfies the rows and, if no point is found, for a ray.
            self.proof = self.proof or find_infeasibility_proof(
                self.problem,
                self.program,
                self.judge.x,
                self.judge.tol,
                self.rays[-1] if self.rays else None,
                self.deadline,
                only_small=is_strict,
            )
            if self.proof is None and self.qp.is_singular and not is_strict:
                self._search_ray((RAY_TOLERANCE, RAY_TOLERANCE), self._exact_ray)
        elif self.qp.is_singular and is_strict and not is_stopped and has_budget:
            x, lam = self.judge.x, self.judge.lam
            assert x is not None and lam is not None
            if self.program.has_hidden_column(x, lam, self.judge.tol):
                self._search_ray(self._exact_ray)
        return self._make_answer(begun)

    @property
    def _exact_ray(self) -> tuple[float, float]:
        """Tolerances of a ray beside a point that may be a solution: up to rounding, and a slope above tol."""
        return EXACT_RAY_TOLERANCE, max(self.judge.tol, EXACT_RAY_TOLERANCE)

    def _search_ray(self, *tolerances: tuple[float, float]) -> None:
        """Search for a ray and a feasible point."""
        found = find_ray(self.program, self.judge.x, self.deadline, tolerances)
        if found is not None:
            self.ray = mark_read_only(found[0])
            self.judge.x = found[1]
            self.judge.lam = np.zeros(len(self.qp.target))

    def _has_near_solution(self) -> bool:
        """Whether a Newton step from the best point meets tol strictly, so that no proof or ray is to be searched for.

        The step is no part of the answer. It takes a tenth of the time of a linear program.
        """
        x, lam = self.judge.x, self.judge.lam
        if x is None or lam is None or self.rays:
            return False
        near = ProgramJudge(self.program, self.judge.tol, self.deadline)
        near.accepts(x, lam)
        return max(near.strict_error, near.hidden_error) <= near.tol

    def _list_steps(self) -> Iterator[Any]:
        """Yield the runs to do, one after the other, until a point meets tol."""
        spec = self.spec
        if self.start is not None and self.tol > 0.0 and (spec.delegates or spec.external):
            yield self._judge_start
        if spec.delegates and spec.builtin:
            if not self.qp.is_singular:
                # A Newton step improves the point of the constraint problem in J and M if it misses tol.
                yield partial(self._run_solve, max(AUTO_TOL_RATIO * self.tol, MIN_TOL), self.start)
            if not self.options:
                for backend in program_backends():
                    yield partial(self._call_backend, backend, {})
        elif _is_program_backend(spec, self.options):
            yield partial(self._call_backend, spec, self.options)
        else:
            yield self._solve_constraint_problem

    def _judge_start(self) -> None:
        """Judge the start: if it meets tol, nothing runs."""
        assert self.start is not None
        self.judge.keep(
            self.qp.recover_variables(self.start), self.qp.select_row_multipliers(self.start)
        )
        status = STALLED
        message = "no better point than the start was found"
        if self.judge.error <= self.tol:
            status = CONVERGED
            message = "the start is a solution"
        self.runs.append(Run("start", status, message, {}, self.judge.error))

    def _call_backend(self, spec: SolverSpec, options: dict[str, Any]) -> None:
        """Solve the program by a backend."""
        solver = spec.load()(**options)
        assert isinstance(solver, QPSolver)
        start = None
        if self.start is not None and solver.backend.starts:
            start = (
                self.qp.recover_variables(self.start),
                self.qp.select_row_multipliers(self.start),
            )
            start = start if np.isfinite(start[0]).all() else None
        elif self.initial_x is not None and solver.backend.starts:
            start = self.initial_x, np.zeros(len(self.qp.target))
        judge, result = solver.solve_program(
            self.qp, self.judge.tol, self.max_iter, self.deadline, start
        )
        if judge.error < self.judge.error or self.judge.x is None:
            self.judge = judge
        if result.status is INFEASIBLE and result.point is not None:
            self.rays.append(result.point[1])
        self.runs.append(Run(spec.name, result.status, result.message, result.work, judge.error))

    def _solve_constraint_problem(self) -> None:
        """Solve the constraint problem by the named solver, with smaller tol until the program's error meets tol."""
        inner, start = self.tol, self.start
        for _ in range(MAX_SOLVES):
            solution = self._run_solve(inner, start)
            goal = self.tol
            error = self.judge.error
            if error <= goal or solution.status is not CONVERGED or self.deadline.has_passed():
                break
            smaller = max(TOL_RATIO * inner * goal / error, 1e-15)
            if not smaller < inner:
                break
            inner = smaller
            start = solution.impulse

    def _run_solve(self, tol: float, start: Any) -> Solution:
        """Solve the constraint problem once, and keep its point if it is the best."""
        options = self.options | ({} if self.max_iter is None else {"max_iter": self.max_iter})
        left = self.deadline.get_remaining_seconds() if self.deadline.is_set else None
        if left is not None:
            options["time_limit"] = max(left, 1e-6)
        solution = solve(self.problem, self.spec.name, impulse=start, tol=tol, **options)
        impulse = solution.impulse
        if np.isfinite(impulse).all():
            point = self.qp.recover_variables(impulse), self.qp.select_row_multipliers(impulse)
            error, _, _ = self.judge.keep(*point)
            if self.spec.delegates and not error <= self.judge.tol:
                self.judge.accepts(*point)
        if solution.certificate is not None and solution.status is INFEASIBLE:
            self.proof = Proof(solution.certificate, solution.impulse_bound or math.inf)
        self.solution = solution
        run = Run(
            self.spec.name, solution.status, solution.message, dict(solution.work), self.judge.error
        )
        self.runs.append(run._replace(form=solution.solver.form))
        return solution

    def _make_answer(self, begun: float) -> QPSolution:
        """Build the answer, with the status that the judge confirms."""
        qp, judge = self.qp, self.judge
        x, lam = judge.x, judge.lam
        assert x is not None and lam is not None
        impulse = mark_read_only(np.concatenate([x, lam]) if qp.is_singular else np.array(lam))
        y, z, box = qp.multipliers(impulse)
        last = min(self.runs, key=lambda run: run.error) if len(self.runs) > 1 else self.runs[-1]
        status = last.status
        conflict = ""
        is_found = judge.error <= self.tol and self.proof is None and self.ray is None
        if is_found:
            status = CONVERGED
            if last.status is INFEASIBLE:
                conflict = f"says INFEASIBLE, but its x has an error of {judge.error:.1e}"
        elif self.proof is not None:
            status = INFEASIBLE
        elif self.ray is not None:
            status = Status.UNBOUNDED
        elif status in (CONVERGED, INFEASIBLE, Status.ROUNDOFF_LIMIT):
            is_false = status is CONVERGED and judge.error > get_false_claim_error(self.tol)
            if self.solution is not None and self.solution.is_contradicted:
                conflict = self.solution.status_conflict
            elif is_false and self.spec.external:
                conflict = f"says CONVERGED, the program's error {judge.error:.1e} is above tol {self.tol:.1e}"
            status = STALLED
        solution = Solution.from_fields(
            {
                "impulse": impulse,
                "status": status,
                "tol": self.tol,
                "setup_time": 0.0,
                "solve_time": perf_counter() - begun,
                "program_error": judge.error,
                "_rest": (self._compute_late_fields, (impulse, last, conflict, is_found)),
            }
        )
        if conflict:
            solution = solution.with_fields(claim_check=CONTRADICTED)
        return QPSolution(
            x=mark_read_only(x) if self.proof is None else None,
            y=y,
            z=z,
            z_box=box,
            solution=solution,
            ray=self.ray,
            impulse=impulse,
            qp=qp,
            tol=self.tol,
        )

    def _compute_late_fields(
        self, impulse: FloatArray, last: Run, conflict: str, is_found: bool
    ) -> dict[str, Any]:
        """Return the fields of the solution that are computed when one is first read."""
        qp = self.qp
        judged = residual(self.problem, impulse, "float64")
        work = sum_work_counts(run.work for run in self.runs)
        message = last.message
        if self.proof is not None:
            names = qp.describe_rows(self.proof.y)
            message = f"{self.proof.message}; contradicting rows: {names}"
        elif self.ray is not None:
            message = "the objective decreases without limit along the ray"
        elif last.status is INFEASIBLE and not is_found:
            message = f"{message}; not proven: no certificate was found"
        elif self.judge.has_step and is_found:
            message = f"{message}; with one Newton step on the active rows".removeprefix("; ")
        stages: tuple[SolverStage, ...] = ()
        if self.spec.delegates:
            message = f"{', '.join(run.name for run in self.runs)}; {message}".removesuffix("; ")
            before = [math.nan, *(run.error for run in self.runs)]
            stages = tuple(
                SolverStage(run.name, MappingProxyType(run.work), before[i], run.error)
                for i, run in enumerate(self.runs)
            )
            if self.solution is not None:
                stages = (*self.solution.stages, *stages[1:])
        proof = self.proof
        return {
            "residual": judged,
            "iterations": work.get(
                "iterations", 0 if self.solution is None else self.solution.iterations
            ),
            "work": MappingProxyType(work),
            "solver": SolverRun(self.spec.name, self.options, last.form),
            "message": message,
            "history": None if self.solution is None else self.solution.history,
            "dual": None,
            "certificate": None if proof is None else proof.y,
            "impulse_bound": None if proof is None else proof.impulse_bound,
            "claim_check": CONTRADICTED if conflict else CONFIRMED,
            "status_conflict": conflict,
            "sweeps_per_decade": math.nan,
            "stages": stages,
        }


def _is_program_backend(spec: SolverSpec, options: dict[str, Any]) -> bool:
    """Return whether a solver is a backend that receives the program itself."""
    is_default = options.get("form", "auto") in ("auto", "program")
    return spec.builtin and spec.external and is_default
