"""The answering side of `lavender.base.apart.process`: messages in, answers out, limits, and an end with the parent."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import signal
import struct
import threading
import time
from collections.abc import Callable, Sequence
from typing import IO, Any

import numpy as np

WORDS = 500  # characters of an error
Handler = Callable[[Any], tuple[dict[str, Any], Sequence[Any]] | None]


def serve(lifeline: int, make: Callable[[], Handler], memory: int = 0) -> None:
    """Answer messages until they end.

    Parameters
    ----------
    lifeline : reading end of a pipe whose other end the parent alone holds; -1 for none
    make : callable
        Imports what is needed, within the limit of memory; what it returns gives words and arrays (None: no such) for a
        message, or None for one without an answer. What that raises is the answer: `error`, its text, and `kind`, its
        type.
    memory : bytes of address space, 0 for no limit
    """
    requests, answers = begin(lifeline)
    if memory:
        with contextlib.suppress(ImportError, ValueError, OSError):
            import resource

            resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    handle = make()
    answer(answers, "{}", b"")  # ready
    while True:
        try:
            message = receive(requests)
        except EOFError:
            return
        try:
            found = handle(message)
        except BaseException as error:  # code of others may fail in any way; a panic of Rust is no Exception
            found = {"error": str(error)[:WORDS], "kind": type(error).__name__}, ()
        if found is not None:
            words, arrays = found
            sizes = [None if x is None else int(np.size(x)) for x in arrays]
            numbers = b"".join(np.ascontiguousarray(x, float).tobytes() for x in arrays if x is not None)
            answer(answers, json.dumps({**words, "sizes": sizes}), numbers)


def limit_cpu(more: float) -> None:
    """Have the system end this process after so much more CPU time [s], should nobody be left who could."""
    with contextlib.suppress(ImportError, ValueError, OSError, OverflowError):  # the last for inf: no limit
        import resource

        hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
        resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time() + more) + 1, hard))


def begin(lifeline: int) -> tuple[IO[bytes], IO[bytes]]:
    """Streams of requests and answers; standard input and output go to nowhere from here on.

    `lifeline` is the reading end of a pipe whose other end the parent alone holds; -1 for none.
    """
    # Ctrl-C is the parent's: it decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if lifeline >= 0:
        end_with_parent(lifeline)
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, 0)
    os.dup2(nowhere, 1)
    return requests, answers


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


def receive(stream: IO[bytes]) -> Any:
    """The next message; EOFError where there is none any more."""
    head = stream.read(8)
    if len(head) < 8:
        raise EOFError
    (size,) = struct.unpack("<Q", head)
    data = stream.read(size)
    if len(data) < size:
        raise EOFError
    return pickle.loads(data)  # of the parent's


def answer(stream: IO[bytes], words: str, numbers: bytes) -> None:
    """Send words and numbers."""
    text = words.encode()
    stream.write(struct.pack("<QQ", len(text), len(numbers)) + text + numbers)
    stream.flush()
