"""The other side of `lavender.bench.running.worker`: a process that runs tasks, for code that is not ours."""

from __future__ import annotations

import contextlib
import json
import time
from typing import Any

from lavender.apart.served import answer, begin, receive

__all__ = ["serve"]

ORPHAN = 60.0  # s of CPU, beyond what any task may take


def serve(memory: int, lifeline: int) -> None:
    """Read problems and tasks from standard input, answer on standard output, until the input ends.

    Parameters
    ----------
    memory : bytes of address space, 0 for no limit
    lifeline : reading end of a pipe whose other end the parent alone holds; -1 for none
    """
    requests, answers = begin(lifeline)
    if memory:
        with contextlib.suppress(ImportError, ValueError, OSError):
            import resource

            resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    from lavender.bench.running.timing import attempt

    answer(answers, "{}", b"")  # ready
    problem: Any = None
    while True:
        try:
            message = receive(requests)
        except EOFError:
            return
        if message[0] == "problem":
            problem = message[1]
        else:
            _limit_cpu(3.0 * message[1].time_limit + ORPHAN)
            answer(answers, *_as_data(attempt(problem, message[1], message[2])))


def _as_data(found: Any) -> tuple[str, bytes]:
    """An outcome as words and numbers (`lavender.bench.running.worker` reads them)."""
    if isinstance(found, str):
        return json.dumps({"error": found[:500]}), b""
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
    return json.dumps(said), found.impulse.tobytes() + more


def _limit_cpu(more: float) -> None:
    """The system ends this process after so much more CPU time, should nobody be left who could."""
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
        resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time() + more) + 1, hard))
