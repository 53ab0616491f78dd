"""The decision trace of `auto` on a problem: its tree of solvers and the counted costs that decide; nothing is run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import islice
from math import inf
from typing import Any

from lavender.base.arrays import check_float
from lavender.base.deadline import seconds
from lavender.base.errors import CapabilityError, InputError
from lavender.judge.residuals import get_reference
from lavender.problem import Problem
from lavender.solvers.auto import Stage, Tree, program_backends
from lavender.solvers.registry import get
from lavender.solvers.small import who

LINES = 6  # of the tree, that are told: then the work is doubled


@dataclass(frozen=True)
class Plan:
    """What `auto` would do with a problem: `str()` is one screen, `data()` are plain numbers and words."""

    rows: int
    law: str
    operator: str  # rows, matrix or generalized
    tol: float  # - relative residual
    small: str  # who solves it in one compiled call; "" where it is not small
    newton: float  # ns, Newton's method as counted; inf where it does not take the problem
    sweep: float  # ns, one sweep
    stages: tuple[Stage, ...]  # the first lines, each taken where those before it did not solve the problem
    in_turn: tuple[str, ...]  # who then goes on in turn, with doubled work

    def data(self) -> Mapping[str, Any]:
        """As JSON has it; costs in nanoseconds, None where a number has no bound."""
        made = asdict(self) | {"stages": [asdict(stage) for stage in self.stages]}
        return {name: _plain(value) for name, value in made.items()}

    def __str__(self) -> str:
        lines = [f"{self.rows} rows, law {self.law!r}, given as {self.operator}; tol {self.tol:.0e}"]
        if self.small:
            lines.append(f"first one compiled call: {self.small}")
        if self.in_turn:  # not a program with a singular P, which only backends solve
            lines.append(
                f"newton is counted to take {seconds(1e-9 * self.newton)}, a sweep {seconds(1e-9 * self.sweep)}"
            )
        for stage in self.stages:
            most = "to its end"
            if stage.iterations < 1e9:
                most = f"up to {max(1.0, float(round(stage.iterations))):.3g} iterations"
            lines.append(f"  {stage.solver:<23}{most:<26}{stage.why}")
        if not self.in_turn:
            return "\n".join([*lines, "then a linear program for a certificate that there is no solution"])
        told = ", ".join(self.in_turn)
        lines.append(f"then {told} in turn with doubled work, and a certificate that there is no solution")
        return "\n".join(lines)


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    return None if value == float("inf") else value


def explain(problem: Problem, tol: float = 1e-6) -> Plan:
    """Return the decision trace of `auto`: solvers, iteration limits and reasons. Nothing is solved.

    Parameters
    ----------
    problem : Problem
    tol : float, default 1e-6
        The relative residual that a solve would ask for.

    Returns
    -------
    Plan

    Raises
    ------
    InputError
        `problem` is not a Problem or has no rows, or `tol` is not above 0.
    CapabilityError
        `auto` does not take the problem.
    """
    if not isinstance(problem, Problem):
        raise InputError(f"problem is a {type(problem).__name__}; a lavender.Problem is needed")
    tol = check_float("tol", tol, above=0.0)
    if problem.m == 0:
        raise InputError("the problem has no rows: there is nothing to plan")
    reason = get("auto").refuses(problem)
    if reason is not None:
        raise CapabilityError(f"solver 'auto' {reason}")
    if problem.has_singular_program:
        why = "a quadratic program with a singular P: if those before it failed"
        stages = tuple(Stage(spec.name, inf, inf, why) for spec in program_backends())
        return Plan(
            rows=problem.m, law=problem.law, operator=problem.operator, tol=tol, small="", newton=inf, sweep=inf,
            stages=stages, in_turn=(),
        )  # fmt: skip
    problem = problem.disk  # where it has ellipses
    get_reference(problem)
    tree, small = Tree(problem), who(problem)
    tree.tried = problem.generalized is not None and bool(small)
    stages = tuple(islice(tree, LINES))
    return Plan(
        rows=problem.m, law=problem.law, operator=problem.operator, tol=tol, small=small, newton=tree.newton,
        sweep=tree.sweep, stages=stages, in_turn=tuple(stage.solver for stage in tree.in_turn(1.0)),
    )  # fmt: skip
