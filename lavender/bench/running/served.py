"""The other side of `lavender.bench.running.worker`: a process that runs tasks, for code that is not ours."""

from __future__ import annotations

from typing import Any

from lavender.apart import served as apart

__all__ = ["serve"]

ORPHAN = 60.0  # s of CPU, beyond what any task may take


def serve(memory: int, lifeline: int) -> None:
    """Answer tasks, until they end; `memory`: bytes of address space, 0 for no limit."""
    apart.serve(lifeline, _runner, memory)


def _runner() -> apart.Handler:
    from lavender.bench.running.timing import attempt

    problem: Any = None

    def run(message: Any) -> tuple[dict[str, Any], bytes] | None:
        nonlocal problem
        if message[0] == "problem":
            problem = message[1]
            return None
        apart.limit_cpu(3.0 * message[1].time_limit + ORPHAN)
        return _as_data(attempt(problem, message[1], message[2]))

    return run


def _as_data(found: Any) -> tuple[dict[str, Any], bytes]:
    """An outcome as words and numbers (`lavender.bench.running.worker` reads them)."""
    if isinstance(found, str):
        return {"error": found[:500]}, b""
    certificate = found.certificate
    said = {
        "status": found.status.name,
        "iterations": int(found.iterations),
        "work": {str(k): int(n) for k, n in found.work.items()},
        "message": str(found.message)[:500],
        "form": str(found.form)[:500],
        "setups": found.setups,
        "solves": found.solves,
        "times": found.times,
        "pace": found.pace,
        "own": found.own,
        "certificate": certificate is not None,
    }
    more = b"" if certificate is None else certificate.tobytes()
    return said, found.impulse.tobytes() + more
