"""Clarabel on the convex relaxation of friction: disk and spin as second-order cones, a round cone as one.

    min 1/2 l.A l - b.l,   l_n >= 0,  |l_t| <= mu l_n,  |l_s| <= mu r l_n          (impulse form)

or the velocity form of `as_qp` with the dual cone w_n >= a |w_t| + a_s |w_s|. Bounded rows come along, so
it takes linear and boxed problems too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.external import _apart
from lavender.external._running import ask, check_options, definite_refusal, symmetric_refusal
from lavender.external.as_qp import QP, impulse_form, pick_form, velocity_form
from lavender.external.native import clarabel
from lavender.external.qp_solver import OPTIONS
from lavender.problem import Problem
from lavender.registry import SolverSpec
from lavender.solution import Claim

NAME = "clarabel_cone"


@dataclass(frozen=True)
class ClarabelCone:
    """Options as those of the QP backends."""

    form: str = "auto"
    unit_diagonal: bool = True
    settings: Mapping[str, Any] = field(default_factory=dict)
    isolate: bool = True

    def __post_init__(self) -> None:
        check_options(self.settings, self.isolate)

    @np.errstate(all="ignore")  # what overflows is judged
    def prepare(self, problem: Problem) -> tuple[Problem, QP]:
        if pick_form(problem, self.form) == "velocity":
            return problem, velocity_form(problem)
        return problem, impulse_form(problem, unit_diagonal=self.unit_diagonal)

    def update(self, state: tuple[Problem, QP], problem: Problem) -> tuple[Problem, QP]:
        return self.prepare(problem)

    @np.errstate(all="ignore")  # what overflows is judged
    def run(
        self,
        state: tuple[Problem, QP],
        impulse: FloatArray,
        n: int,
        tol: float,
        time_limit: float | None = None,
    ) -> Claim:
        problem, qp = state
        apart = _apart.elsewhere(NAME, True) if self.isolate and time_limit is not None else None
        return ask(
            problem,
            qp,
            impulse,
            clarabel.call,
            n,
            tol,
            time_limit,
            self.settings,
            stoppable=True,
            apart=apart,
        )

    def ready(self) -> None:
        """As that of `QPSolver`."""
        if self.isolate:
            _apart.ready()


def refusal(problem: Problem) -> str | None:
    """Why it cannot take this problem."""
    return symmetric_refusal(problem) or definite_refusal(problem)


SPEC = SolverSpec(
    name=NAME,
    factory=ClarabelCone,
    laws=frozenset({"linear", "lcp", "cone"}),
    boxes=frozenset({"cone"}),
    resumable=False,
    external=True,
    impulse=False,
    round_cones=True,
    rolling=True,
    max_iter=200,
    options=OPTIONS,
    requires=("clarabel",),
    install="clarabel",
    summary="interior point on the convex relaxation of friction, second-order cones",
    reference="Goulart, Chen 2024, Clarabel; Tasora, Anitescu 2011 for the relaxation",
    refusal=refusal,
)
