"""The other side of `lavender.lab.bench.running.worker`: a process that runs tasks, for code that is not ours."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

from lavender.base.apart import served as apart
from lavender.lab.bench.record import plain

if TYPE_CHECKING:
    from lavender.lab.bench.running.timing import Outcome

ORPHAN = 60.0  # s of CPU, beyond what any task may take


def serve(memory: int, lifeline: int) -> None:
    """Answer tasks, until they end; `memory`: bytes of address space, 0 for no limit."""
    apart.serve(lifeline, _runner, memory)


def _runner() -> apart.Handler:
    from lavender.lab.bench.running.timing import attempt

    problem: Any = None

    def run(message: Any) -> tuple[dict[str, Any], bytes] | None:
        nonlocal problem
        if message[0] == "problem":
            problem = message[1]
            return None
        apart.limit_cpu(3.0 * message[1].time_limit + ORPHAN)
        return _as_data(attempt(problem, message[1], message[2]))

    return run


def _as_data(found: Outcome | str) -> tuple[dict[str, Any], bytes]:
    """An outcome as words and numbers (`lavender.lab.bench.running.worker` reads them)."""
    if isinstance(found, str):
        return {"error": found[:500]}, b""
    found = replace(found, message=str(found.message)[:500], form=str(found.form)[:500])
    arrays = ("impulse", "certificate")
    said = {f.name: plain(getattr(found, f.name)) for f in fields(found) if f.name not in arrays}
    more = b"" if found.certificate is None else found.certificate.tobytes()
    return {**said, "certificate": found.certificate is not None}, found.impulse.tobytes() + more
