"""What a QP backend needs and can do, as data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lavender.external._running import Call

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
