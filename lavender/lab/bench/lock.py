"""One writer for a file of records: a lock that names its holder and ends with it.

The lock is the operating system's, on FILE.lock (`flock`, or one of Windows' bytes), so a process that died holds
nothing; the text inside says who holds it. A text of another host is believed, because its lock may not be seen from
here.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
from pathlib import Path
from typing import Any

from lavender.base.errors import InputError
from lavender.lab.bench.record import printable

TRIES = 100  # a holder that leaves takes its file with it; so often in a row nobody leaves
HEAD = 64  # bytes left free for Windows, where a locked byte cannot be read


class Lock:
    """Hold `path`.lock until `release`.

    Raises
    ------
    InputError
        Another process, or another user of this one, holds it: with its host and process.
    OSError
        The folder cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.with_name(path.name + ".lock")
        for _ in range(TRIES):
            if self._take():
                return
        raise InputError(f"{self.path} changes hands all the time; run the command again later")

    def _take(self) -> bool:
        """True when it is ours; False when the file went away meanwhile."""
        descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if not _lock(descriptor):
                raise self._refusal(*_holder(descriptor))
            there = None
            with contextlib.suppress(OSError):
                there = os.stat(self.path)
            if there is not None and os.path.samestat(there, os.fstat(descriptor)):
                pid, host = _holder(descriptor)
                if host and host != socket.gethostname():
                    raise self._refusal(pid, host)
                # Of a process of this host that died, or of nobody.
                _write(descriptor, {"pid": os.getpid(), "host": socket.gethostname()})
                self._descriptor = descriptor
                return True
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
        return False

    def _refusal(self, pid: Any, host: str) -> InputError:
        who = f"process {pid} on {host}" if host else "another process"
        return InputError(
            f"{self.path.with_suffix('')} is being written by {who}: wait for it, or give another folder; "
            f"if it no longer runs, remove {self.path}"
        )

    def release(self) -> None:
        """Let go; a second call does nothing."""
        if self._descriptor < 0:
            return
        # The file goes first: who opened it before finds that it went, and tries again.
        with contextlib.suppress(OSError):
            os.unlink(self.path)
        os.close(self._descriptor)
        self._descriptor = -1
        if os.name == "nt":
            with contextlib.suppress(OSError):  # an open file cannot be removed there
                os.unlink(self.path)


def _lock(descriptor: int) -> bool:
    """Take the system's lock; False where somebody has it, or where the file system has none and a text is there."""
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined, unused-ignore]
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        return not _holder(descriptor)[1]
    return True


def _holder(descriptor: int) -> tuple[Any, str]:
    """(process, host) that the file names; ("", "") of an empty or torn one."""
    try:
        os.lseek(descriptor, HEAD, os.SEEK_SET)
        found = json.loads(os.read(descriptor, 4096))
        return int(found["pid"]), printable(str(found["host"]))
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return "", ""


def _write(descriptor: int, what: dict[str, Any]) -> None:
    os.ftruncate(descriptor, 0)
    os.lseek(descriptor, 0, os.SEEK_SET)
    os.write(descriptor, b"lavender".ljust(HEAD - 1) + b"\n" + json.dumps(what).encode() + b"\n")
