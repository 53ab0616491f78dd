"""Run backends in other processes, which later calls reuse and which are killed at the time limit.

Backends that have a time limit of their own get it, so that their process survives it, and are killed later. The
standard library's pools are not used: they need `if __name__ == "__main__"` in scripts, and do not kill a task.
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

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.external.backend import Backend
from lavender.external.convex import ScaledProgram
from lavender.external.running import Answer, BackendFailed, Limits
from lavender.judge.solution import Status

START_TIMEOUT = (
    60.0  # [s] On a loaded machine, importing a backend and its modules may take this long.
)
KILL_TIMEOUT = 10.0  # [s] The end of a killed process is awaited for this long.
# A backend with a time limit of its own is killed after this multiple of its limit, and at least this time [s] later:
# some read the clock only every few seconds, and its answer needs time to return.
STOPPABLE_LIMIT_RATIO, MIN_STOPPABLE_TIME = 2.0, 0.1
#: Program of the other process. `python -m` is not used: it searches modules in the current folder first, where the
#: sources of a checkout would hide the installed package.
SERVE_SCRIPT = (
    "import sys; sys.path[:] = filter(None, sys.path); "
    "from lavender.external.isolated import serve_requests; serve_requests()"
)

Start = tuple[FloatArray, FloatArray] | None  # x and multipliers, in scaled units.


class Process:
    """Another process, which the first call starts; it ends after its present call when this process ends."""

    popen: subprocess.Popen[bytes] | None = None

    def call_function(
        self, function: Callable[..., Any], *arguments: Any, timeout: float | None
    ) -> Any:
        """Call a function of a module, and return its result.

        Parameters
        ----------
        timeout : float or None, s
            Time to send the arguments, call the function and receive the result.

        Raises
        ------
        pickle.PicklingError, TypeError, AttributeError
            An argument cannot be pickled; the process runs on.
        InputError, BackendFailed
            The function raised InputError, or another exception; the process runs on. BackendFailed also means that
            the process did not start, or ended before it answered.
        TimeoutError
            The call exceeded `timeout`; the process was killed. Ctrl-C kills it, too.
        """
        request = pickle.dumps((function, arguments), pickle.HIGHEST_PROTOCOL)
        if self.popen is None or self.popen.poll() is not None:
            self._start()
        process = self.popen
        assert process is not None and process.stdin is not None and process.stdout is not None
        limit = threading.TIMEOUT_MAX if timeout is None else min(timeout, threading.TIMEOUT_MAX)
        timer = threading.Timer(limit, process.kill)
        begun = time.monotonic()
        timer.daemon = True
        try:
            if timeout is not None:
                timer.start()
            pickle.dump(request, process.stdin)
            process.stdin.flush()
            error, result = pickle.load(process.stdout)
        except (OSError, EOFError, pickle.UnpicklingError):
            if time.monotonic() - begun >= limit:
                raise TimeoutError from None
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(1.0)
            code = process.returncode
            reason = signal.Signals(-code).name if code and code < 0 else f"exit status {code}"
            raise BackendFailed(f"the process of the backend died ({reason})") from None
        except BaseException:
            self.close()
            raise
        finally:
            timer.cancel()
            if time.monotonic() - begun >= limit or process.poll() is not None:
                self.close()  # The timer may kill it after its answer, too.
        if error is not None:
            raise (
                InputError(result) if error == "InputError" else BackendFailed(f"{error}: {result}")
            )
        return result

    def _start(self) -> None:
        """Start the process."""
        self.close()
        path = os.pathsep.join(p or os.getcwd() for p in sys.path)
        try:
            self.popen = subprocess.Popen(
                [sys.executable, "-c", SERVE_SCRIPT],
                env={**os.environ, "PYTHONPATH": path},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
        except OSError as error:
            raise BackendFailed(f"the process of the backend did not start: {error}") from None

    def close(self) -> None:
        """Kill the process."""
        process = self.popen
        self.popen = None
        if process is not None:
            process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired, OSError):
                process.communicate(timeout=KILL_TIMEOUT)  # It closes the pipes, too.


idle_processes: list[Process] = []  # Processes without a current call.
# A forked process must not use its parent's processes. Windows has no fork.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=idle_processes.clear)


def _call_in_process(function: Callable[..., Any], *arguments: Any, timeout: float | None) -> Any:
    """Call a function in a process without a current call."""
    try:
        process = idle_processes.pop()
    except IndexError:
        process = Process()
    try:
        return process.call_function(function, *arguments, timeout=timeout)
    finally:
        idle_processes.append(process)


def start_process(backend: Backend) -> None:
    """Start a process that has imported the backend's code, before the clock of a time limit starts."""
    with contextlib.suppress(
        TimeoutError, BackendFailed, InputError
    ):  # The later call raises these errors.
        _call_in_process(warm_up, backend, timeout=START_TIMEOUT)


def run_isolated(
    backend: Backend, program: ScaledProgram, start: Start, limit: Limits, settings: dict[str, Any]
) -> Answer:
    """Run the backend in another process, which is killed at the time limit."""
    timeout = limit.time_limit
    if timeout is not None and backend.stoppable:
        timeout = max(STOPPABLE_LIMIT_RATIO * timeout, timeout + MIN_STOPPABLE_TIME)
    try:
        answer: Answer = _call_in_process(
            backend.run, program, start, limit, settings, timeout=timeout
        )
        return answer
    except TimeoutError:
        return Answer(Status.TIME_LIMIT, "ended at the time limit")
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        raise InputError(
            f"settings cannot be sent to the process that runs the backend ({error}); plain numbers and "
            "texts are needed, or isolate=False, which runs the backend in this process"
        ) from None


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
            answer = pickle.dumps((type(error).__name__, str(error)))
        answers.write(answer)
        answers.flush()


_warmed_up: set[str] = set()  # Names of the backends that were warmed up.


def warm_up(backend: Backend) -> None:
    """Solve a tiny program, so that the backend imports all of its code."""
    if backend.name not in _warmed_up:
        _warmed_up.add(backend.name)
        one = np.array([0, 1], np.int32), np.zeros(1, np.int32), np.ones(1)
        tiny = ScaledProgram(
            P=one, q=-np.ones(1), J=one, t=np.zeros(1), free=0, variable=np.zeros(1, np.int32)
        )
        backend.run(tiny, None, Limits(1e-3, 1e-3, 100, None), {})
