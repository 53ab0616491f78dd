"""The answering side of `lavender.apart.process`: streams of messages and answers, and an end with the parent."""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import struct
import threading
from typing import IO, Any

__all__ = ["answer", "begin", "receive"]


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
    """The next message.

    Raises
    ------
    EOFError
        There is none any more.
    """
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
