"""The other side of `lavender.bench.running.worker`: a process that runs tasks, for code that is not ours."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import signal
import struct
import threading
import time
from typing import IO, Any

__all__ = ["serve"]

ORPHAN = 60.0  # s of CPU, beyond what any task may take


def serve(memory: int, lifeline: int) -> None:
    """Read problems and tasks from standard input, answer on standard output, until the input ends.

    Parameters
    ----------
    memory : bytes of address space, 0 for no limit
    lifeline : reading end of a pipe whose other end the parent alone holds; -1 for none
    """
    # Ctrl-C is the parent's: it decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if lifeline >= 0:
        end_with_parent(lifeline)
    if memory:
        with contextlib.suppress(ImportError, ValueError, OSError):
            import resource

            resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, 0)
    os.dup2(nowhere, 1)
    from lavender.bench.running.timing import attempt

    _answer(answers, "{}", b"")  # ready
    problem: Any = None
    while True:
        try:
            message = _receive(requests)
        except EOFError:
            return
        if message[0] == "problem":
            problem = message[1]
        else:
            _limit_cpu(3.0 * message[1].time_limit + ORPHAN)
            _answer(answers, *_as_data(attempt(problem, message[1], message[2])))


def end_with_parent(lifeline: int) -> None:
    """Let the system end this process, and those that it started, when the parent is gone, whatever they do.

    On Linux the kernel itself sends the signal when the last writing end of the pipe closes, so code that never
    returns ends too; elsewhere a thread waits for it.
    """
    os.set_inheritable(lifeline, False)
    with contextlib.suppress(ImportError, AttributeError):  # F_SETSIG is Linux's
        import fcntl
        import select

        fcntl.fcntl(lifeline, fcntl.F_SETSIG, signal.SIGKILL)
        fcntl.fcntl(lifeline, fcntl.F_SETOWN, -os.getpgrp())
        fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | os.O_ASYNC)
        if select.select([lifeline], [], [], 0.0)[0]:  # it went before this was set up
            os.killpg(0, signal.SIGKILL)
        return

    def wait() -> None:
        os.read(lifeline, 1)
        os.killpg(0, signal.SIGKILL)

    threading.Thread(target=wait, daemon=True).start()


def _receive(stream: IO[bytes]) -> Any:
    head = stream.read(8)
    if len(head) < 8:
        raise EOFError
    (size,) = struct.unpack("<Q", head)
    data = stream.read(size)
    if len(data) < size:
        raise EOFError
    return pickle.loads(data)  # of the parent's


def _answer(stream: IO[bytes], words: str, numbers: bytes) -> None:
    text = words.encode()
    stream.write(struct.pack("<QQ", len(text), len(numbers)) + text + numbers)
    stream.flush()


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
