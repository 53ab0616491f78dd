"""Engines and solvers of others beside ours, as Markdown with what was lost."""

from __future__ import annotations

import math
from collections.abc import Sequence

from lavender.bench.peers.contest import Result
from lavender.bench.peers.engines import Step
from lavender.report.compared import (
    Comparison,
    compare,
    losses,
    mean_table,
    over_ours,
    ratio,
    solver_table,
    step_table,
)
from lavender.report.table import markdown

__all__ = ["engines_table", "solvers_tables"]


def solvers_tables(results: Sequence[Result]) -> list[str]:
    """Every problem and error, geometric means, losses, and what nobody reached."""
    compared = compare(results)
    reached = [c for c in compared if math.isfinite(min(c.our_time, c.peer_time))]
    lost = losses(compared)
    lines = [*markdown(solver_table(reached)), "", *markdown(mean_table(results))]
    lines += ["", f"Lost: {len(lost)} of {sum(math.isfinite(c.peer_time) for c in compared)}."]
    lines += [f"- {c.problem} at {c.target:.0e}: {c.peer} against {c.ours}, {ratio(c.ratio)}" for c in lost]
    alone = [c for c in reached if math.isinf(c.peer_time)]
    if alone:
        lines += ["", "Reached by no peer: " + _list(alone)]
    nobody = [c for c in compared if c not in reached]
    if nobody:
        lines += ["", "Reached by nobody: " + _list(nobody)]
    return lines


def _list(compared: Sequence[Comparison]) -> str:
    return ", ".join(f"{c.problem} at {c.target:.0e}" for c in compared) + "."


def engines_table(steps: Sequence[Step]) -> list[str]:
    """Each engine beside ours in the same mode, then where ours takes longer."""
    lines = markdown(step_table(steps))
    lost = sorted(((over_ours(s, steps), s) for s in steps if over_ours(s, steps) < 1.0), key=lambda x: x[0])
    if lost:
        lines += ["", f"Lost: {len(lost)}."]
        lines += [f"- {s.scene}: {s.engine}, {over:.2f} of the time of ours" for over, s in lost]
    return lines
