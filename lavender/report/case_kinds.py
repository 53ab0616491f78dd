"""The two kinds of cases, contact problems and quadratic programs: each is solved and judged in its own terms.

make_case(problem).solve("pgs", tol=1e-6)      # lv.solve, judged by the residual of the impulses
make_case(program).solve("piqp", tol=1e-6)     # lv.solve_qp, judged by the error of the program
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import sparse as sp
from lavender.diagnostics import diagnose
from lavender.io.contact_count import count_contacts
from lavender.judge.residuals import WRONG, is_solved_by_zero, residual
from lavender.judge.solution import Solution
from lavender.problem import Problem
from lavender.programs.quadratic import solve_qp
from lavender.report.store import Row
from lavender.report.structure import classify_structure_and_count_islands, compute_mass_ratio
from lavender.report.text import format_residual
from lavender.solving.solve import solve

MIN_SPARSE_SIZE, MAX_SPARSE_FILL = (
    20,
    0.2,
)  # P and the rows of a program are "sparse" with at most this fill.
ENERGY_ROUNDING = 2.0**-48  # Rounding of a sum of products, divided by the sum of their sizes.
ROUNDING = 2.0**-50  # [-] Rounding error of a sum, relative to the sum of its absolute terms.


def compute_energy_gain(problem: Problem, impulse: FloatArray, slack: FloatArray) -> float:
    """Return the energy [J] that an impulse (m,) [N s] adds beyond the work of the targets, 0 within its rounding.

    With A lambda = w + b it is lambda.(w - b) / 2 - lambda.diag(compliance) lambda / 2, which is not positive at a
    solution if the bounds of all rows contain 0; nan if they do not, or if the bodies are not known.
    """
    cones = problem.cones
    if problem.matrix is not None or (cones.lower > 0.0).any() or (cones.upper < 0.0).any():
        return math.nan
    soft = 0.0 if problem.compliance is None else problem.compliance * impulse
    gain = 0.5 * float(impulse @ (slack - problem.b - soft))
    rounding = float(np.abs(impulse) @ (np.abs(slack) + 2.0 * np.abs(problem.b)))
    return gain if gain > ENERGY_ROUNDING * rounding else 0.0


class ContactCase:
    """A problem of rows, boxes or contacts."""

    call = "solve"  # Function of lavender that is timed.
    #: Columns of a cross-check with their heads.
    heads: Mapping[str, str] = {
        "relative": "relative [-]",
        "roundoff_floor": "floor [-]",
        "velocity": "error [m/s]",
        "distance": "distance [√J]",
        "allowed": "allowed [√J]",
        "objective": "objective [J]",
        "time": "time [s]",
    }

    def __init__(self, problem: Problem) -> None:
        self.problem = problem

    def copy(self, start: str = "") -> ContactCase:
        """Copy the problem into newly written arrays, with nothing derived from them, as a simulator leaves it.

        With `start` "cold", the copy has no guess, as in the printed call.
        """
        problem = self.problem
        rows = None if problem.rows is None else replace(problem.rows, copy=True)
        guess = None if start == "cold" else problem.guess
        return ContactCase(replace(problem, rows=rows, guess=guess, copy=True))

    def solve(self, solver: str, **arguments: Any) -> Solution:
        """Make the call that a report times."""
        return solve(self.problem, solver, **arguments)

    def judge(self, solution: Solution) -> Row:
        """Return the errors of an answer, by the names of columns."""
        r, impulse, problem = solution.residual, solution.impulse, self.problem
        change = gain = math.nan
        if problem.matrix is None and np.isfinite(impulse).all():
            change = problem.energy_change(impulse)
            gain = compute_energy_gain(problem, impulse, r.slack)
        return {
            "relative": float(r.relative),
            "error_energy": float(r.energy),
            "velocity": float(r.velocity),
            "roundoff_floor": float(r.roundoff_floor),
            "worst_row": int(r.worst_row),
            "worst_name": r.worst_label,
            "energy_change": change,
            "energy_gain": gain,
        }

    def judge_impulse(self, impulse: FloatArray) -> float:
        """Return the relative error of an impulse (m,) [N s]."""
        return float(residual(self.problem, impulse).relative)

    def describe(self) -> Row:
        """Return facts about the problem, by the names of columns."""
        p = self.problem
        structure, islands = classify_structure_and_count_islands(p)
        return {
            "law": p.law,
            "rows": p.m,
            "blocks": p.n_blocks,
            "islands": islands,
            "contacts": count_contacts(p),
            "mass_ratio": compute_mass_ratio(p),
            "structure": ", ".join(structure),
            "symmetric": bool(p.is_symmetric),
            "nothing_to_do": bool(is_solved_by_zero(p)),
        }

    def list_diagnostics(self) -> list[str]:
        """Return possible mistakes in the problem's data."""
        return list(map(str, diagnose(self.problem)))

    def list_arrays(self) -> list[Any]:
        """Return the arrays that determine the problem; the v* of bodies is part of b."""
        problem = self.problem
        c, r, g = problem.cones, problem.rows, problem.generalized
        arrays: list[Any] = [
            problem.b,
            problem.guess,
            c.ptr,
            c.kind,
            c.lower,
            c.upper,
            c.mu,
            c.patch_radius,
        ]
        arrays += [c.rolling] if c.has_rolling else []
        if r is None:
            for a in (problem.csr,) if g is None else (g.jac, g.mass):
                arrays += [a.indptr, a.indices, a.data]
            return arrays + ([] if g is None else [g.v_free, problem.compliance])
        arrays += [
            r.jac,
            r.joint_body,
            r.normal,
            r.tangent,
            r.arm_a,
            r.arm_b,
            r.contact_body,
            r.inv_mass,
        ]
        return [*arrays, r.inv_inertia, problem.compliance]

    def explain_no_reference(self) -> str:
        """Return the reason why the problem has no optimum with which answers are compared; empty if it has one."""
        p = self.problem
        if not p.is_symmetric:
            return f"A is not symmetric (by {format_residual(p.asymmetry)}), so the problem is not a QP"
        if not p.is_semidefinite:
            return (
                "A is not positive semidefinite: several solutions with different motions may exist"
            )
        return ""

    def compute_objective(self, solution: Solution) -> float:
        """Return 1/2 l.A l - b.l [J]."""
        return float(0.5 * (solution.impulse @ (solution.slack - self.problem.b)))

    def compute_separation(self, one: Any, two: Any) -> tuple[float, float]:
        """Return |Delta|_A [sqrt J] of two judged answers and the largest value that `report.check` (1) allows."""
        problem = self.problem
        delta = problem.on_disk(one.impulse - two.impulse)
        eps = problem.on_disk(one.residual.error - two.residual.error)
        problem = problem.disk
        d: Any = problem.d
        a_delta, a_eps = _multiply_by_a(problem, delta), _multiply_by_a(problem, eps)
        delta_norm = float(np.sqrt(max(delta @ a_delta, 0.0)))
        # The errors e are known up to the round-off floors of both residuals, in the norm of D.
        uncertainty = float(sum(s.residual.floor_energy for s in (one, two)))
        root = 1.0 / np.sqrt(d)
        max_stiffness = float(
            np.sqrt(np.max(root * _multiply_by_a(problem, root, abs), initial=0.0))
        )
        eps_d = float(np.sqrt(np.sum(d * eps * eps))) + uncertainty
        eps_a = float(np.sqrt(max(eps @ a_eps, 0.0))) + max_stiffness * uncertainty
        delta_d = float(np.sqrt(np.sum(d * delta * delta)))
        # x^2 <= x eps_a + eps_d delta_d bounds x = |Delta|_A by the larger root. `rounding`: of Delta.A Delta.
        rounding = ROUNDING * max_stiffness * delta_d
        allowed = 0.5 * (eps_a + np.sqrt(eps_a * eps_a + 4.0 * eps_d * delta_d))
        return delta_norm, float(
            allowed * (1.0 + 1e-9) + np.sqrt(rounding * max_stiffness * delta_d)
        )

    def describe_zero(self, solution: Solution) -> str:
        """Return the errors of an answer to a problem that the zero impulse solves; empty for other problems."""
        r = solution.residual
        if not r.nothing_to_do or r.verdict == WRONG:
            return ""
        return (
            f"{format_residual(r.velocity)} {r.velocity_unit}, {format_residual(r.energy)} sqrt(J)"
        )

    def is_solved(self, solution: Solution) -> bool:
        """Return whether an answer meets its tolerance, or rounding prevents a better one."""
        return solution.success or solution.residual.at_floor


class ProgramCase(ContactCase):
    """A quadratic program (`Problem.from_qp`). `QPSolution` defines its errors, which have no unit."""

    call = "solve_qp"
    heads: Mapping[str, str] = {
        "relative": "error [-]",
        "distance": "distance [√cost]",
        "allowed": "allowed [√cost]",
        "objective": "objective [cost]",
        "time": "time [s]",
    }

    def copy(self, start: str = "") -> ProgramCase:
        """Build the program again from its arrays; it has no guess."""
        return ProgramCase(Problem.from_qp(**self.problem.qp.arrays, name=self.problem.name))

    def solve(self, solver: str, **arguments: Any) -> Solution:
        """Make the call that a report times."""
        solution: Solution = solve_qp(self.problem, solver, **arguments).solution
        return solution

    def judge(self, solution: Solution) -> Row:
        """Return the error of the program; it is above rounding."""
        error = solution.program_error
        if error is None:  # from `solve`, which judges the program as a contact problem
            error = self.judge_impulse(solution.impulse)
        return {
            "relative": error,
            "error_energy": math.nan,
            "velocity": math.nan,
            "roundoff_floor": 0.0,
        }

    def judge_impulse(self, impulse: FloatArray) -> float:
        """Return the error of the x and the multipliers that belong to an impulse (m,)."""
        return float(self.problem.qp.solution(impulse).error)

    def describe(self) -> Row:
        """Return facts about the program, by the names of columns."""
        qp = self.problem.qp
        (p_ptr, _, p), (j_ptr, _, j) = qp.hessian, qp.jacobian
        n, m = len(p_ptr) - 1, len(j_ptr) - 1
        kind = "linear program" if not p.any() else "singular P" if qp.is_singular else "definite P"
        general = np.flatnonzero(qp.variable < 0)
        entries = len(p) + len(j) - (m - len(general))
        size = n * (n + len(general))
        fill = "sparse" if n >= MIN_SPARSE_SIZE and entries <= MAX_SPARSE_FILL * size else "dense"
        return {
            "law": "program",
            "rows": m,
            "variables": n,
            "blocks": m,
            "structure": f"{kind}, {fill}",
        }

    def list_diagnostics(self) -> list[str]:
        """Return an empty list."""
        return []

    def list_arrays(self) -> list[Any]:
        """Return the arrays that determine the program."""
        qp = self.problem.qp
        return [qp.q, qp.target, np.array([qp.free]), *qp.hessian, *qp.jacobian]

    def explain_no_reference(self) -> str:
        """Return an empty text: every program is convex."""
        return ""

    def compute_objective(self, solution: Solution) -> float:
        """Return 1/2 x.P x + q.x."""
        return float(self.problem.qp.solution(solution).objective)

    def compute_separation(self, one: Any, two: Any) -> tuple[float, float]:
        """Return sqrt(Delta.P Delta) of two answers and the largest value that `report.check` (2) allows."""
        qp = self.problem.qp
        n = len(qp.q)
        P, J = (
            sp.csr_array((x[2], x[1], x[0]), (len(x[0]) - 1, n)) for x in (qp.hessian, qp.jacobian)
        )
        points = (_measure_point(qp, P, J, solution.impulse) for solution in (one, two))
        (x, lam, r, s, broken, r_terms, s_terms), other = points
        delta = x - other[0]
        square = float(delta @ (P @ delta))
        allowed = (
            np.abs(lam) @ (np.abs(s) + other[4])
            + np.abs(other[1]) @ (np.abs(other[3]) + broken)
            + np.abs(delta) @ np.abs(r - other[2])
        )
        terms = np.abs(delta) @ (abs(P) @ np.abs(delta) + r_terms + other[5]) + (
            np.abs(lam) + np.abs(other[1])
        ) @ (s_terms + other[6])
        return math.sqrt(max(square, 0.0)), math.sqrt((1.0 + 1e-9) * allowed + ROUNDING * terms)

    def describe_zero(self, solution: Solution) -> str:
        """Return an empty text: no program is solved without a solver."""
        return ""

    def is_solved(self, solution: Solution) -> bool:
        """Return whether the error meets the tolerance."""
        return solution.success


def make_case(problem: Problem) -> ContactCase:
    """Return the case of a problem, of its kind."""
    return ContactCase(problem) if problem.qp is None else ProgramCase(problem)


def _measure_point(qp: Any, P: Any, J: Any, impulse: FloatArray) -> tuple[Any, ...]:
    """Return x, multipliers, residuals of columns and rows, violations of rows, and the terms of both residuals."""
    x, lam = qp.recover_variables(impulse), qp.select_row_multipliers(impulse)
    r = P @ x + qp.q - J.T @ lam
    s = J @ x - qp.target
    violated = np.maximum(-s, 0.0)
    violated[: qp.free] = np.abs(s[: qp.free])
    r_terms = abs(P) @ np.abs(x) + np.abs(qp.q) + abs(J).T @ np.abs(lam)
    return x, lam, r, s, violated, r_terms, abs(J) @ np.abs(x) + np.abs(qp.target)


def _multiply_by_a(problem: Problem, x: Any, transform: Callable[[Any], Any] = lambda a: a) -> Any:
    """Compute A x (m,), without forming A if J and M are known.

    `transform` is applied to the entries of each factor; with `abs`, the result is a bound of |A| x for x >= 0.
    """
    if problem.generalized is not None:
        y = transform(problem.whitened)
        return y @ (y.T @ x) + problem.compliance * x
    if problem.rows is None:
        return transform(problem.csr) @ x
    assert problem.compliance is not None
    jac = transform(problem.jacobian)
    return (
        jac @ (transform(problem.rows.inverse_mass_matrix()) @ (jac.T @ x)) + problem.compliance * x
    )
