"""`solve_qp`: quadratic programs by backends, `auto` or another solver, judged in the program's own terms.

A named backend receives the program in scaled variables, and its x is kept (`lavender/programs`). `auto` solves a
program with a positive definite P as a constraint problem in J and M first, and then calls backends until the error
meets tol. Other solvers solve the constraint problem. A point that does not meet tol is followed by a search for a
proof that there is no solution (`proofs.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from types import MappingProxyType
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, as_array, check_float, mark_read_only
from lavender.base.deadline import Deadline, stop_clock
from lavender.base.errors import InputError
from lavender.base.lazy_import import sparse as sp
from lavender.judge.certificates import Proof
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
from lavender.programs.judges import is_false_claim
from lavender.programs.qp_solver import OPTION_HELP
from lavender.programs.task import MIN_TOL, ProgramTask, Run
from lavender.solvers.registry import SolverSpec, get, program_backends
from lavender.solving.limits import check_time_limit
from lavender.solving.solve import solve

MAX_SOLVES = 5  # Maximum number of solves of one constraint problem, each with a smaller tol.
# The next tol is this fraction of the tol that would suffice if the program's error were proportional to tol.
TOL_RATIO = 0.1
# `auto` solves the constraint problem to this fraction of tol: Newton's last steps cost less than a step in SciPy.
AUTO_TOL_RATIO = 1e-3


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
        qp = get_quadratic_program(P)
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
    return solve_program(
        qp,
        problem,
        begun,
        solver=solver,
        initvals=initvals,
        verbose=verbose,
        tol=tol,
        time_limit=time_limit,
        max_iter=max_iter,
        impulse=impulse,
        **options,
    )


def get_quadratic_program(problem: Problem) -> QuadraticProgram:
    """Return the program of a problem of `Problem.from_qp`."""
    qp: QuadraticProgram | None = problem.qp
    if qp is None:
        raise InputError(
            "the problem contains no quadratic program; one of Problem.from_qp is needed"
        )
    return qp


def solve_program(
    qp: QuadraticProgram,
    problem: Problem | None,
    begun: float,
    *,
    solver: str = "auto",
    initvals: Any = None,
    verbose: bool = False,
    tol: float = 1e-9,
    time_limit: float | None = None,
    max_iter: int | None = None,
    impulse: Any = None,
    **options: Any,
) -> QPSolution:
    """Solve a program as `solve_qp` does; `problem` is its constraint problem, if there is one already."""
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
    initial_x = None if initvals is None else as_array("initvals", initvals, (len(qp.q),))
    task = _SolveTask(
        qp, problem, tol, deadline, max_iter, impulse, initial_x, spec=spec, options=options
    )
    return task.solve(begun)


@dataclass(eq=False, kw_only=True)
class _SolveTask(ProgramTask):
    """One call of `solve_qp`: its solver, with the solutions of the constraint problem."""

    spec: SolverSpec
    options: dict[str, Any]
    solution: Solution | None = None  # Last solution of the constraint problem.

    def solve(self, begun: float) -> QPSolution:
        """Run the solvers, search for proofs, and build the answer."""
        if self.start is not None:
            self.start = self.problem.make_start(self.start)
        if self.prove_from_empty_row() or not len(self.qp.q):
            self.start = np.zeros(len(self.qp.target) + len(self.qp.q) * self.qp.is_singular)
            self._judge_start()
            return self._make_answer(begun)
        if self.spec.delegates and self.deadline.is_set:
            # Later steps would import packages within the limit.
            with stop_clock(self.deadline):
                for backend in program_backends():
                    backend.load()().start_workers(None, 0.0)
        for step in self._list_steps():
            step()
            if self.is_over:
                break
        self.prove(self.max_iter is None)
        return self._make_answer(begun)

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
                    yield partial(self.call_backend, backend.load()(), self.max_iter)
        elif _is_program_backend(spec, self.options):
            yield partial(self.call_backend, spec.load()(**self.options), self.max_iter)
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
        impulse = mark_read_only(self.impulse)
        y, z, box = qp.multipliers(impulse)
        last = self.best_run
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
            is_false = is_false_claim(status, judge.error, self.tol)
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
            x=None if judge.x is None or self.proof is not None else mark_read_only(judge.x),
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
