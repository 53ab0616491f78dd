"""What a QP backend needs and can do, as data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lavender._arrays import FloatArray
from lavender.external._running import Answer, Call, Limits
from lavender.external.as_qp import QP

__all__ = ["Backend"]


@dataclass(frozen=True)
class Backend:
    """One line of the table: what a backend needs and can do."""

    name: str
    modules: tuple[str, ...]  # importable where it is installed
    install: str
    summary: str
    reference: str
    call: Call | None = None  # its own interface; None goes through qpsolvers
    settings: Any = None  # Limits -> settings, through qpsolvers; None: runs at its own tolerances
    max_iter: int = 10_000
    dense: bool = False  # takes dense matrices only
    definite: bool = False  # needs a positive definite P, which the velocity form has
    warm: bool = False  # uses a start point
    stoppable: bool = False  # takes a time limit
    linear: str = "bounds"  # what keeps it at work without constraints: "bounds", "equality", or "" (refused)
    finite: bool = False  # takes no infinite bounds: the finite ones become rows
    noisy: bool = False  # prints even when told not to

    def run(self, qp: QP, impulse: FloatArray, limit: Limits, settings: dict[str, Any]) -> Answer:
        """One run of it, in this process."""
        if self.call is not None:
            return self.call(qp, impulse, limit, settings)
        from lavender.external.generic import through_qpsolvers  # which asks what a Backend is

        return through_qpsolvers(self, qp, impulse, limit, settings)
