"""Another Python that answers messages, ended with everything that it started, at the latest with this process.

What is sent is pickled; what comes back is data, words and numbers of a stated form and size, never an object that is
unpickled. What it prints goes to nowhere.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import queue
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from typing import IO, Any

import numpy as np

START_TIME = 60.0  # s, to import everything on a loaded machine
WORDS = 2**20  # bytes of the words of one answer
PIECE = 2**20  # bytes read at once
GROUPS = os.name == "posix"  # processes can be ended together with what they started
END_TIME = 10.0  # s, for the system to end a killed process; one that waits for a dead disk may take longer


def _read(stream: IO[bytes], size: int) -> bytes:
    """Exactly so many bytes of an unbuffered stream; EOFError where it ended before."""
    parts = []
    while size:
        part = stream.read(min(size, PIECE))
        if not part:
            raise EOFError
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


class Ended(Exception):
    """The process ended before it answered; its text says how."""


class NoAnswer(ValueError):
    """What came is no answer; its text says why."""


class Raised(Exception):
    """What the process was asked for raised an error; `kind` is its type, by name."""

    def __init__(self, text: str, kind: str) -> None:
        super().__init__(text)
        self.kind = kind


def opened(answer: tuple[bytes, bytes]) -> tuple[dict[str, Any], list[Any]]:
    """Words of an answer, and its arrays of float64, each copied.

    Raises
    ------
    Raised
    NoAnswer
        No table of words, or arrays of other sizes than they say. It may hold anything.
    """
    try:
        said = json.loads(answer[0])
        if "error" in said:
            raise Raised(str(said["error"]), str(said.get("kind", "")))
        numbers, at, arrays = np.frombuffer(answer[1], float), 0, []
        for size in said.pop("sizes"):
            if size is not None and not 0 <= size <= len(numbers) - at:
                raise ValueError("arrays of another length")
            arrays.append(None if size is None else numbers[at : at + size].copy())
            at += size or 0
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise NoAnswer(f"{type(error).__name__}: {error}") from None
    return said, arrays


class Process:
    """A Python that runs `module.serve(*arguments, lifeline)` and answers messages with it (`served.py`).

    It is started by `start`, again after it ended, and kept between questions.

    Parameters
    ----------
    module : dotted name
    arguments : whole numbers
    environment : mapping, optional
        Beside that of this process.
    """

    def __init__(self, module: str, *arguments: int, environment: Mapping[str, str] | None = None) -> None:
        # Not `-m`: that puts the current folder first, and in a checkout its sources would hide the installed package.
        start = (
            f"import sys; sys.path[:] = filter(None, sys.path); from {module} import serve; "
            "serve(*map(int, sys.argv[1:]))"
        )
        self._command = [sys.executable, "-c", start, *map(str, arguments)]
        self._environment = environment or {}
        self.popen: subprocess.Popen[bytes] | None = None
        self._lifeline = -1  # the writing end of a pipe that ends when this process does
        self._answers: queue.Queue[Any] = queue.Queue()
        self._room = 0  # bytes of numbers that an answer may have

    @property
    def alive(self) -> bool:
        """It was started, not ended, and has not ended."""
        return self.popen is not None and _ended(self.popen, 0.0) is None

    def start(self) -> str:
        """Start it where it does not run, and wait until it is ready; why it is not, or nothing."""
        if self.alive:
            return ""
        self.end()
        try:
            self._start()
        except OSError as error:  # the system starts no process
            return str(error)
        try:
            first = self._answers.get(timeout=START_TIME)
        except queue.Empty:
            first = None
        except KeyboardInterrupt:
            self.end()
            raise
        return "" if first is not None else self._cause()

    def _start(self) -> None:
        paths = os.pathsep.join(p or os.getcwd() for p in sys.path)
        more: dict[str, Any] = {}
        alive = -1
        if GROUPS:
            alive, self._lifeline = os.pipe()
            more = {"start_new_session": True, "pass_fds": (alive,)}
        try:
            self.popen = subprocess.Popen(
                [*self._command, str(alive)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={**os.environ, **self._environment, "PYTHONPATH": paths},
                bufsize=0,
                **more,
            )
        except BaseException:
            if GROUPS:
                os.close(self._lifeline)
                self._lifeline = -1
            raise
        finally:
            if alive >= 0:
                os.close(alive)
        self._answers = queue.Queue()
        stream = self.popen.stdout
        assert stream is not None
        # A process of the backend's that left the group may keep the pipe open for ever: this thread then waits
        # alone, and nobody waits for it.
        threading.Thread(target=self._listen, args=(stream, self._answers), daemon=True).start()

    def ask(self, messages: Sequence[Any], limit: float, room: int) -> tuple[dict[str, Any], list[Any]]:
        """The answer to messages, `opened`, of at most `room` bytes of numbers.

        Raises
        ------
        pickle.PicklingError, TypeError, AttributeError
            A message cannot be sent; the process runs on.
        TimeoutError
            It did not read them and answer within `limit` [s], and was ended, as it is after Ctrl-C.
        Ended
            It ended by itself.
        Raised
        NoAnswer
            It was ended.
        """
        frames = [pickle.dumps(m, pickle.HIGHEST_PROTOCOL) for m in messages]
        self._room = room
        limit = min(limit, threading.TIMEOUT_MAX)  # inf, and what no lock waits for
        until = time.monotonic() + limit
        try:
            self._send(b"".join(struct.pack("<Q", len(f)) + f for f in frames), limit)
            found: tuple[bytes, bytes] | None = self._answers.get(timeout=max(0.0, until - time.monotonic()))
        except queue.Empty:
            self.end()
            raise TimeoutError from None
        except BaseException:
            self.end()
            raise
        if found is None:
            raise Ended(self._cause())
        try:
            return opened(found)
        except NoAnswer:
            self.end()
            raise

    def _send(self, message: bytes, limit: float) -> None:
        process = self.popen
        assert process is not None and process.stdin is not None
        stream, data = process.stdin, memoryview(message)

        def write() -> None:
            done = 0
            with contextlib.suppress(OSError, ValueError):  # it died: the answer is its end
                while done < len(data):
                    done += stream.write(data[done : done + PIECE]) or 0

        if len(data) <= 4096:  # a pipe takes that at once, and it is empty: every message was answered
            write()
            return
        writer = threading.Thread(target=write, daemon=True)
        writer.start()
        writer.join(limit)
        if writer.is_alive():
            raise TimeoutError

    def _listen(self, stream: IO[bytes], answers: queue.Queue[Any]) -> None:
        with contextlib.suppress(Exception), stream:
            while True:
                words, numbers = struct.unpack("<QQ", _read(stream, 16))
                if words > WORDS or numbers > self._room:
                    answers.put((b"", b""))  # no answer has such a size: it is not read
                    break
                answers.put((_read(stream, words), _read(stream, numbers)))
        answers.put(None)  # the end, however it came

    def _cause(self) -> str:
        """How it ended, after it was ended with all that it started."""
        process = self.popen
        assert process is not None
        code = _ended(process, 1.0)
        self.end()
        if code is None:
            return "no answer"
        if code < 0:
            with contextlib.suppress(ValueError):
                return signal.Signals(-code).name
        return f"exit status {code}"

    def end(self) -> None:
        """End it and what it started."""
        process, self.popen = self.popen, None
        lifeline, self._lifeline = self._lifeline, -1
        if process is None:
            return
        if GROUPS:
            # Before it is waited for: until then nobody else can have its number.
            with contextlib.suppress(OSError):
                os.killpg(process.pid, signal.SIGKILL)
            os.close(lifeline)
        process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(END_TIME)
        if process.stdin is not None:
            with contextlib.suppress(OSError):
                process.stdin.close()


def _ended(process: subprocess.Popen[bytes], limit: float) -> int | None:
    """Exit status of a process, -N for signal N; None where it runs on. It is not reaped: its group may live."""
    if process.returncode is not None:
        return process.returncode
    if not GROUPS or not hasattr(os, "waitid"):
        with contextlib.suppress(subprocess.TimeoutExpired):
            return process.wait(limit)
        return None
    until = time.monotonic() + limit
    while True:
        with contextlib.suppress(ChildProcessError):
            found = os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG)
            if found is not None:
                return found.si_status if found.si_code == os.CLD_EXITED else -found.si_status
        if time.monotonic() >= until:
            return None
        time.sleep(0.01)
