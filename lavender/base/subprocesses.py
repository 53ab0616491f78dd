"""Call functions in another Python process, which can be killed.

The standard library's pools are not used: they need `if __name__ == "__main__"` in scripts, and do not kill a task.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

START_TIMEOUT = 60.0  # [s] On a loaded machine, importing a function and its modules may take this long.
KILL_TIMEOUT = 10.0  # [s] The end of a killed process is awaited for this long.
#: Program of the other process. `python -m` is not used: it searches modules in the current folder first, where the
#: sources of a checkout would hide the installed package.
SERVE_SCRIPT = (
    "import sys; sys.path[:] = filter(None, sys.path); "
    "from lavender.base.subprocesses import serve_requests; serve_requests()"
)


class ProcessEnded(Exception):
    """The process did not start, or ended before it answered; the message describes how."""


class RemoteError(Exception):
    """The function raised an exception; `kind` is the name of its type."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind


class ProcessBackend:
    """Calls functions of modules in another process, which the first call starts and later calls reuse.

    When this process ends, the other one ends after its present call.
    """

    popen: subprocess.Popen[bytes] | None = None

    def call_function(
        self, function: Callable[..., Any], *arguments: Any, timeout: float | None = None
    ) -> Any:
        """Call a function, and return its result.

        Parameters
        ----------
        timeout : float, optional, s
            Time to send the arguments, call the function and receive the result.

        Raises
        ------
        pickle.PicklingError, TypeError, AttributeError
            An argument cannot be pickled; the process runs on.
        RemoteError
            The function raised; the process runs on.
        TimeoutError
            The call exceeded `timeout`; the process was killed. Ctrl-C kills it, too.
        ProcessEnded
            The process did not start, or ended before it answered.
        """
        request = pickle.dumps((function, arguments), pickle.HIGHEST_PROTOCOL)
        if self.popen is None or self.popen.poll() is not None:
            self._start()
        process = self.popen
        assert process is not None and process.stdin is not None and process.stdout is not None
        limit = threading.TIMEOUT_MAX if timeout is None else min(timeout, threading.TIMEOUT_MAX)
        timer, begun = threading.Timer(limit, process.kill), time.monotonic()
        timer.daemon = True
        try:
            if timeout is not None:
                timer.start()
            pickle.dump(request, process.stdin)
            process.stdin.flush()
            error, result = pickle.load(process.stdout)
        except (OSError, EOFError, pickle.UnpicklingError):
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(1.0)
            code = process.returncode
            if time.monotonic() - begun >= limit:
                raise TimeoutError from None
            if code is not None and code < 0:
                raise ProcessEnded(signal.Signals(-code).name) from None
            raise ProcessEnded("no answer" if code is None else f"exit status {code}") from None
        except BaseException:
            timer.cancel()
            self.close()
            raise
        finally:
            timer.cancel()
            if time.monotonic() - begun >= limit or process.poll() is not None:
                self.close()  # The timer may kill it after its answer, too.
        if error is not None:
            raise RemoteError(*error)
        return result

    def _start(self) -> None:
        """Start the process."""
        self.close()
        path = os.pathsep.join(p or os.getcwd() for p in sys.path)
        try:
            self.popen = subprocess.Popen(
                [sys.executable, "-c", SERVE_SCRIPT], env={**os.environ, "PYTHONPATH": path},
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        except OSError as error:
            raise ProcessEnded(f"it did not start: {error}") from None

    def close(self) -> None:
        """Kill the process."""
        process, self.popen = self.popen, None
        if process is None:
            return
        process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(KILL_TIMEOUT)
        for stream in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                stream.close()  # type: ignore[union-attr]


# -- in the other process -----------------------------------------------------------------------------


def serve_requests() -> None:
    """Answer requests, each with a function and its arguments, until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # The parent handles Ctrl-C.
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    null = os.open(os.devnull, os.O_RDWR)
    os.dup2(null, 0)  # The function's own input and output are the null device.
    os.dup2(null, 1)
    while True:
        try:
            request = pickle.load(requests)
        except EOFError:
            return
        try:
            function, arguments = pickle.loads(request)
            answer = pickle.dumps((None, function(*arguments)), pickle.HIGHEST_PROTOCOL)
        except BaseException as error:  # A panic of Rust code, for example, is not an Exception.
            answer = pickle.dumps(((type(error).__name__, str(error)), None))
        answers.write(answer)
        answers.flush()
