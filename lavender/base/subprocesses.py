"""Run functions that call third-party code in another Python process, which can be killed.

Code that hangs, calls `os._exit`, starts processes or exhausts memory makes only its own call fail. Requests are
pickled. Answers are JSON and float64 arrays of a bounded size, and are never unpickled.

Process pools of libraries are not used: pebble 5.2.3 kills such code up to 3 s late, leaves the processes that it
started, unpickles its output, and needs `if __name__ == "__main__"` in scripts.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import IO, Any

import numpy as np

START_TIMEOUT = 60.0  # [s] On a loaded machine, importing a function and its modules may take this long.
# [s] The end of a killed process is awaited for this long; one that waits for a disk may not end.
KILL_TIMEOUT = 10.0
# [s] A pipe that stays open for this time after a kill is held by another process; it is abandoned.
PIPE_TIMEOUT = 0.1
PARENT_CHECK_INTERVAL = 0.5  # [s] Time after which a process notices that its parent has ended.
MAX_TEXT_SIZE = 2**20  # [bytes] An answer that announces more JSON than this is invalid.
MAX_ERROR_LENGTH = 500  # [characters] Longer texts of errors are cut.
#: Whether a process is killed together with the processes that it started, as one process group.
PROCESS_GROUPS = os.name == "posix"
#: Program of the other process. `python -m` is not used: it searches modules in the current folder first, where the
#: sources of a checkout would hide the installed package.
SERVE_SCRIPT = (
    "import sys; sys.path[:] = filter(None, sys.path); from lavender.base.subprocesses import serve_requests; "
    "serve_requests(*map(int, sys.argv[1:]))"
)

#: The JSON object and the arrays (None: not given) of an answer.
Answer = tuple[dict[str, Any], Sequence[Any]]


class ProcessEnded(Exception):
    """The process ended before it answered; the message describes how."""


class InvalidAnswer(ValueError):
    """The process sent bytes that are not an answer; the message has the reason."""


class RemoteError(Exception):
    """The function raised an exception; `kind` is the name of its type."""

    def __init__(self, text: str, kind: str) -> None:
        super().__init__(text)
        self.kind = kind


class ProcessBackend:
    """Calls one function in another process, which `start` starts and later calls reuse.

    When this process ends, the other one ends within `PARENT_CHECK_INTERVAL`, or when its code next returns to the
    interpreter.

    Parameters
    ----------
    function : callable
        A function at the top level of a module; it returns an `Answer`.
    memory : int, bytes
        Limit of the address space if the system has one; 0 for no limit.
    environment : mapping, optional
        Environment variables that are added to the environment of this process.
    """

    def __init__(
        self,
        function: Callable[..., Answer],
        *,
        memory: int = 0,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._function, self._memory, self._environment = function, memory, environment or {}
        self.popen: subprocess.Popen[bytes] | None = None
        self._exchange_thread: threading.Thread | None = None

    @property
    def is_alive(self) -> bool:
        """Whether the process runs."""
        return self.popen is not None and self.popen.poll() is None

    def start(self) -> None:
        """Start the process unless it runs, and wait until it has imported the function.

        Raises
        ------
        ProcessEnded
            The system starts no process, or the function cannot be imported.
        """
        if self.is_alive:
            return
        self.close()
        path = os.pathsep.join(p or os.getcwd() for p in sys.path)
        try:
            self.popen = subprocess.Popen(
                [sys.executable, "-c", SERVE_SCRIPT, str(os.getpid()), str(self._memory)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={**os.environ, **self._environment, "PYTHONPATH": path},
                start_new_session=PROCESS_GROUPS,
            )
            self.call_function(self._function, timeout=START_TIMEOUT, max_bytes=0)
        except (OSError, InvalidAnswer) as error:
            raise ProcessEnded(str(error) or "no answer") from None
        except RemoteError as error:
            self.close()
            raise ProcessEnded(f"{error.kind}: {error}") from None

    def call_function(
        self, *arguments: Any, timeout: float, max_bytes: int
    ) -> tuple[dict[str, Any], list[Any]]:
        """Call the function, and return the JSON object and the arrays of its answer.

        Parameters
        ----------
        timeout : float, s
            Time to send the arguments, call the function and receive the answer.
        max_bytes : int
            Maximum size of all arrays together.

        Raises
        ------
        pickle.PicklingError, TypeError, AttributeError
            An argument cannot be pickled; the process runs on.
        RemoteError
            The function raised; the process runs on.
        TimeoutError
            The call exceeded `timeout`; the process was killed. Ctrl-C kills it, too.
        ProcessEnded
            The process ended before it answered.
        InvalidAnswer
            The answer is invalid; the process was killed.
        """
        request = pickle.dumps(arguments, pickle.HIGHEST_PROTOCOL)
        process = self.popen
        assert process is not None
        received: list[tuple[bytes, bytes] | BaseException] = []

        # Run the exchange on a thread: if a process outside of the group keeps a pipe open, only that thread waits.
        def exchange_request_and_answer() -> None:
            try:
                assert process.stdin is not None and process.stdout is not None
                process.stdin.write(struct.pack("<Q", len(request)))
                process.stdin.write(request)
                process.stdin.flush()
                sizes = struct.unpack("<QQ", _read_bytes(process.stdout, 16))
                if sizes[0] > MAX_TEXT_SIZE or sizes[1] > max_bytes:
                    raise InvalidAnswer(
                        f"the answer has {sizes[0]} bytes of text and {sizes[1]} bytes of arrays; at most "
                        f"{MAX_TEXT_SIZE} and {max_bytes} are accepted"
                    )
                received.append(
                    (_read_bytes(process.stdout, sizes[0]), _read_bytes(process.stdout, sizes[1]))
                )
            except BaseException as error:
                _close_streams(process)
                received.append(error)

        self._exchange_thread = threading.Thread(target=exchange_request_and_answer, daemon=True)
        self._exchange_thread.start()
        try:
            self._exchange_thread.join(min(timeout, threading.TIMEOUT_MAX))
            if not received:
                raise TimeoutError
            answer = received[0]
            if isinstance(answer, OSError | EOFError):
                raise ProcessEnded(self._kill_and_describe_end())
            if isinstance(answer, BaseException):
                raise answer
            return unpack_answer(*answer)
        except RemoteError:
            raise
        except BaseException:
            self.close()
            raise

    def _kill_and_describe_end(self) -> str:
        """Kill the process and return how it ended."""
        process = self.popen
        assert process is not None
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(1.0)
        code = process.returncode
        self.close()
        if code is None:
            return "no answer"
        if code < 0:
            with contextlib.suppress(ValueError):
                return signal.Signals(-code).name
        return f"exit status {code}"

    def close(self) -> None:
        """Kill the process and the processes that it started."""
        process, self.popen = self.popen, None
        if process is None:
            return
        if PROCESS_GROUPS:
            # Kill the group. Its number, which its first process has too, is not reused while a process of it runs.
            with contextlib.suppress(OSError):
                os.killpg(process.pid, signal.SIGKILL)
        process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(KILL_TIMEOUT)
        if self._exchange_thread is not None:
            self._exchange_thread.join(PIPE_TIMEOUT)
            if self._exchange_thread.is_alive():
                return  # The exchange's thread still waits for a pipe and closes the streams later.
        _close_streams(process)


def _close_streams(process: subprocess.Popen[bytes]) -> None:
    for stream in filter(None, (process.stdin, process.stdout)):
        with contextlib.suppress(OSError):
            stream.close()


def _read_bytes(stream: IO[bytes], size: int) -> bytes:
    """Read `size` bytes; raise EOFError if the stream ends before."""
    data = stream.read(size)
    if len(data) < size:
        raise EOFError
    return data


def unpack_answer(text: bytes, numbers: bytes) -> tuple[dict[str, Any], list[Any]]:
    """Parse an answer: return its JSON object and copies of its arrays. The bytes may be invalid in any way.

    Raises
    ------
    RemoteError
    InvalidAnswer
        The text is not a JSON object, or the arrays do not have the sizes in it.
    """
    try:
        fields = json.loads(text)
        if "error" in fields:
            raise RemoteError(str(fields["error"]), str(fields.get("kind", "")))
        values, start, arrays = np.frombuffer(numbers, float), 0, []
        for size in fields.pop("sizes"):
            if size is not None and not 0 <= size <= len(values) - start:
                raise ValueError(
                    f"the answer announces an array of {size} numbers; {len(values) - start} numbers remain"
                )
            arrays.append(None if size is None else values[start : start + size].copy())
            start += size or 0
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InvalidAnswer(f"{type(error).__name__}: {error}") from None
    return fields, arrays


# -- in the other process -----------------------------------------------------------------------------


def serve_requests(parent: int, memory: int) -> None:
    """Answer requests until the pipe ends: the first names the function, each later one has arguments for it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # The parent handles Ctrl-C.
    if PROCESS_GROUPS:
        threading.Thread(target=_wait_and_kill_group, args=(parent,), daemon=True).start()
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    null = os.open(os.devnull, os.O_RDWR)
    os.dup2(null, 0)  # The function's own input and output are the null device.
    os.dup2(null, 1)
    if memory:
        with contextlib.suppress(ImportError, ValueError, OSError):
            import resource

            resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    function: Callable[..., Answer] | None = None
    while True:
        try:
            (size,) = struct.unpack("<Q", _read_bytes(requests, 8))
            request = _read_bytes(requests, size)
        except EOFError:
            return
        try:
            arguments = pickle.loads(request)  # Unpickling is safe, as only the parent sends requests.
            fields, arrays = ({}, ()) if function is None else function(*arguments)
            function = arguments[0] if function is None else function
            sizes = [None if x is None else int(np.size(x)) for x in arrays]
            numbers = b"".join(np.ascontiguousarray(x, float).tobytes() for x in arrays if x is not None)
            text = json.dumps({**fields, "sizes": sizes}).encode()
        except BaseException as error:  # A panic of Rust code, for example, is not an Exception.
            failure = {"error": str(error)[:MAX_ERROR_LENGTH], "kind": type(error).__name__}
            text, numbers = json.dumps(failure).encode(), b""
        answers.write(struct.pack("<QQ", len(text), len(numbers)) + text + numbers)
        answers.flush()


def _wait_and_kill_group(parent: int) -> None:
    """Wait until the parent process ends, then kill this process and the processes that it started."""
    while os.getppid() == parent:
        time.sleep(PARENT_CHECK_INTERVAL)
    os.killpg(0, signal.SIGKILL)


def limit_cpu_time(extra: float) -> None:
    """Make the system kill this process after `extra` more CPU time [s], in case the parent has ended and cannot."""
    # An infinite limit raises OverflowError: no limit is then set.
    with contextlib.suppress(ImportError, ValueError, OSError, OverflowError):
        import resource

        hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
        resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time() + extra) + 1, hard))
