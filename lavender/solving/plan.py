"""Explain the stages of `auto` for a problem, and the estimated costs that determine them, without running a solver."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import islice
from math import inf
from typing import Any

from lavender.base.arrays import check_float
from lavender.base.deadline import format_seconds
from lavender.base.errors import CapabilityError, InputError
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.problem import Problem, check_problem
from lavender.solvers.registry import get, program_backends
from lavender.solvers.small import describe_small_call
from lavender.solving.stages import DecisionTree, Stage

MAX_EXPLAINED_STAGES = (
    6  # Largest number of stages that are listed before the alternation with doubled work.
)


@dataclass(frozen=True)
class Plan:
    """Stages of `auto` for a problem. `str()` formats them as a page, `data()` as numbers and texts.

    Parameters
    ----------
    rows : int
    law : str
    operator : {"rows", "matrix", "generalized"}
    tol : float, -
        Relative residual to reach.
    small : str
        Description of the compiled call for small problems; empty if it is not used.
    newton : float, ns
        Estimated cost of Newton's method; inf if it does not accept the problem.
    sweep : float, ns
        Estimated cost of one sweep.
    stages : tuple of Stage
        First stages; each runs only if the stages before it did not solve the problem.
    in_turn : tuple of str
        Solvers that alternate after these stages, with doubled work in each round.
    """

    rows: int
    law: str
    operator: str
    tol: float
    small: str
    newton: float
    sweep: float
    stages: tuple[Stage, ...]
    in_turn: tuple[str, ...]

    def data(self) -> Mapping[str, Any]:
        """Return the fields as JSON-compatible values: costs in nanoseconds, None for an infinite number."""
        tables = [asdict(self), *map(asdict, self.stages)]
        values, *stages = (
            {k: None if v == inf else v for k, v in table.items()} for table in tables
        )
        return values | {"stages": stages, "in_turn": self.in_turn}

    def __str__(self) -> str:
        tol = f"{self.tol:g}".replace("e-0", "e-")
        lines = [f"{self.rows} rows, law {self.law!r}, given as {self.operator}; tol {tol}"]
        if self.small:
            lines.append(f"first one compiled call: {self.small}")
        if self.in_turn:  # It is empty for programs with a singular P, which only backends solve.
            newton, sweep = (format_seconds(1e-9 * cost) for cost in (self.newton, self.sweep))
            lines.append(f"newton is counted to take {newton}, a sweep {sweep}")
        for stage in self.stages:
            limit = "to its end"
            if stage.iterations < 1e9:
                limit = f"up to {max(1.0, float(f'{stage.iterations:.3g}')):.0f} iterations"
            lines.append(f"  {stage.solver:<27}{limit:<26}{stage.why}")
        if not self.in_turn:
            return "\n".join(
                [*lines, "then a linear program for a certificate that there is no solution"]
            )
        names = ", ".join(self.in_turn)
        lines.append(
            f"then {names} in turn with doubled work, and a certificate that there is no solution"
        )
        return "\n".join(lines)


def explain(problem: Problem, tol: float = 1e-6) -> Plan:
    """Return the stages of `auto` for a problem: solvers, iterations and reasons. Nothing is solved.

    Parameters
    ----------
    problem : Problem
    tol : float, default 1e-6
        Relative residual that a solve would have to reach.

    Returns
    -------
    Plan

    Raises
    ------
    InputError
        `problem` is not a Problem or has no rows, or `tol` is not above 0.
    CapabilityError
        `auto` does not accept the problem.
    """
    check_problem(problem)
    tol = check_float("tol", tol, above=0.0)
    if problem.m == 0:
        raise InputError("the problem has no rows; at least one is needed for a plan")
    reason = get("auto").refuses(problem)
    if reason is not None:
        raise CapabilityError(f"solver 'auto' {reason}")
    if problem.has_singular_program:
        why = "a quadratic program with a singular P: if those before it failed"
        stages = tuple(Stage(spec.name, inf, inf, why) for spec in program_backends())
        return Plan(
            rows=problem.m,
            law=problem.law,
            operator=problem.operator,
            tol=tol,
            small="",
            newton=inf,
            sweep=inf,
            stages=stages,
            in_turn=(),
        )
    problem = problem.disk  # Equal to the problem if it has no ellipses.
    get_zero_impulse_reference(problem)
    small = describe_small_call(problem)
    tree = DecisionTree(problem, call_failed=problem.generalized is not None and bool(small))
    stages = tuple(islice(tree, MAX_EXPLAINED_STAGES))
    return Plan(
        rows=problem.m,
        law=problem.law,
        operator=problem.operator,
        tol=tol,
        small=small,
        newton=tree.newton,
        sweep=tree.sweep,
        stages=stages,
        in_turn=tuple(stage.solver for stage in tree.iterate_one_round(1.0)),
    )
