"""The task of every call that solves a quadratic program: backends in turn, the judge's best point, and a proof.

`lavender.solve` (`QPSolver.run`) and `solve_qp` (`quadratic.py`) run it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray, mark_read_only
from lavender.base.deadline import Deadline
from lavender.judge.certificates import Proof, prove_infeasibility
from lavender.judge.solution import INFEASIBLE, Status
from lavender.problem import Problem
from lavender.problem.program import QuadraticProgram
from lavender.programs.forms import get_program
from lavender.programs.judges import ProgramJudge
from lavender.programs.proofs import RAY_TOLERANCE, find_infeasibility_proof, find_ray
from lavender_ext.program.error import TERM_ROUNDING

MIN_TOL = 1e-13  # Smallest error that further solves are to reach; smaller ones are rounding.


class Run(NamedTuple):
    """One solver that ran on a program, and its claim."""

    name: str
    status: Status
    message: str
    work: dict[str, int]
    error: float  # Smallest error of the program after the run.
    form: str = "program"
    shift: float = 0.0  # Number that was added to the diagonal of the scaled P.


@dataclass(eq=False)
class ProgramTask:
    """A program to solve: the best point so far, the solvers that ran, and a proof or ray if there is one."""

    qp: QuadraticProgram
    given: Problem | None  # Its constraint problem, if there is one already.
    tol: float
    deadline: Deadline
    max_iter: int | None  # Iterations of each solver; None for its own limit.
    start: FloatArray | None = None  # (m,) or (n + m,): impulses.
    initial_x: FloatArray | None = None
    runs: list[Run] = field(default_factory=list)
    rays: list[FloatArray] = field(default_factory=list)  # Multipliers of claims of infeasibility.
    proof: Proof | None = None
    ray: FloatArray | None = None

    def __post_init__(self) -> None:
        self.program = get_program(self.qp)
        self.judge = ProgramJudge(self.program, max(self.tol, MIN_TOL), self.deadline)

    @cached_property
    def problem(self) -> Problem:
        """The constraint problem, which a backend does not need."""
        return Problem(**self.qp.problem_fields(), qp=self.qp) if self.given is None else self.given

    @cached_property
    def problem_without_cost(self) -> Problem:
        """The constraint problem with q = 0, in which proofs that no x satisfies the rows are checked."""
        qp = self.qp.with_vectors(q=np.zeros(len(self.qp.q)))
        return Problem(**qp.problem_fields(), qp=qp)

    @property
    def impulse(self) -> FloatArray:
        """The impulses (m,) of the best point, or x and the multipliers (n + m,) if P is singular."""
        x, lam = self.judge.x, self.judge.lam
        assert x is not None and lam is not None
        return np.concatenate([x, lam]) if self.qp.is_singular else np.array(lam)

    @property
    def best_run(self) -> Run:
        """The run with the smallest error; the last one if it is the only one."""
        return min(self.runs, key=lambda run: run.error) if len(self.runs) > 1 else self.runs[-1]

    @property
    def certificate(self) -> FloatArray | None:
        """The proof, or a ray as a direction of the impulses of a singular P, (m,) or (n + m,); None without one."""
        if self.proof is not None or self.ray is None:
            return None if self.proof is None else self.proof.y
        return np.concatenate([self.ray, np.zeros(len(self.qp.target))])

    @property
    def is_over(self) -> bool:
        """Whether a point meets tol, no point can, or no solver may begin."""
        if self.judge.error <= self.judge.tol or self.proof is not None:
            return True
        return self.runs[-1].status is Status.INTERRUPTED or self.deadline.has_passed()

    def call_backend(self, solver: Any, max_iter: int | None) -> None:
        """Solve the program by a backend (`QPSolver`), from the start if it accepts one."""
        qp = self.qp
        start = None
        if solver.backend.starts and self.start is not None:
            start = qp.recover_variables(self.start), qp.select_row_multipliers(self.start)
            start = start if all(np.isfinite(part).all() for part in start) else None
        elif solver.backend.starts and self.initial_x is not None:
            start = self.initial_x, np.zeros(len(qp.target))
        judge, result = solver.solve_program(qp, self.judge.tol, max_iter, self.deadline, start)
        if judge.error < self.judge.error or self.judge.x is None:
            self.judge = judge
        if result.status is INFEASIBLE and result.point is not None:
            self.rays.append(result.point[1])
        name, claim = solver.backend.name, (result.status, result.message, result.work)
        self.runs.append(Run(name, *claim, judge.error, shift=result.shift))

    def prove(self, has_budget: bool = True) -> None:
        """Search for a proof that no x satisfies the rows and for a ray, unless the best point rules them out.

        Large x makes the violations of rows that contradict each other small: a proof has precedence, also over a
        point that meets tol. Without a budget, nothing is searched unless a point meets tol.
        """
        judge = self.judge
        if judge.x is None:  # Without a point, x = 0 is judged.
            judge.keep(np.zeros(len(self.qp.q)), np.zeros(len(self.qp.target)))
        if self.runs[-1].status is Status.INTERRUPTED or self.deadline.has_passed():
            return
        if not (has_budget or judge.error <= judge.tol) or not len(self.qp.q):
            return
        is_strict = judge.strict_error <= judge.tol
        if not (is_strict and judge.hidden_error <= judge.tol):
            if self._has_near_solution():
                return
            self.proof = self.proof or find_infeasibility_proof(
                self.problem_without_cost,
                self.program,
                judge.x,
                judge.tol,
                self.rays[-1] if self.rays else None,
                self.deadline,
                only_small=is_strict,
            )
            if self.proof is None and self.qp.is_singular and not is_strict:
                self._search_ray((RAY_TOLERANCE, RAY_TOLERANCE), self._exact_ray)
        elif self.qp.is_singular:
            assert judge.x is not None and judge.lam is not None
            if self.program.has_hidden_column(judge.x, judge.lam, judge.tol):
                self._search_ray(self._exact_ray)

    def prove_from_empty_row(self) -> bool:
        """Prove from the worst row without coefficients that no x satisfies the rows; return whether there is one."""
        qp, rows = self.qp, self.qp.violated_empty_rows
        if len(rows):
            row = rows[np.argmax(np.abs(qp.target[rows]))]
            y = np.zeros(self.problem.m)
            y[self.problem.m - len(qp.target) + row] = np.sign(qp.target[row])
            proof = prove_infeasibility(self.problem_without_cost, y)
            # J^T y = 0 and t.y > 0 hold exactly, however small t is beside other rows.
            self.proof = Proof(y, math.inf) if proof.reason else proof
        return len(rows) > 0

    @property
    def _exact_ray(self) -> tuple[float, float]:
        """Tolerances of a ray beside a point that may be a solution: up to rounding, and a slope above tol."""
        return TERM_ROUNDING, max(self.judge.tol, TERM_ROUNDING)

    def _search_ray(self, *tolerances: tuple[float, float]) -> None:
        """Search for a ray and a feasible point; with a ray alone, the best point is no solution."""
        found = find_ray(self.program, self.judge.x, self.deadline, tolerances)
        if found is None:
            return
        ray, x = found
        none = np.zeros(len(self.qp.target))
        if x is None:
            # No optimum exists: a point is judged without multipliers, with which large x looks like one.
            for point in (self.judge.x, np.zeros(len(ray))):
                judge = ProgramJudge(self.program, self.judge.tol, self.deadline)
                assert point is not None
                judge.keep(point, none)
                if judge.error > judge.tol:
                    break
            self.judge = judge
            return
        self.ray = mark_read_only(ray)
        self.judge.x, self.judge.lam = x, none

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
