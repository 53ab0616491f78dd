"""Run backends in other processes, which later calls reuse, also those that go on beyond the time limit of a call.

A call ends at its limit; its process goes on for up to MAX_OVERRUN, is killed then, and is replaced in the
background. A call that finds only such processes begins in another one only if it has START_TIME left. Backends that
have a time limit of their own get it. The standard library's pools are not used: they need
`if __name__ == "__main__"` in scripts, and do not kill a task.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
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
from lavender.judge.solution import Status
from lavender.programs.backend import Backend
from lavender.programs.convex import ScaledProgram
from lavender.programs.running import Answer, BackendFailed, Limits

START_TIMEOUT = (
    60.0  # [s] On a loaded machine, importing a backend and its modules may take this long.
)
START_TIME = 2.0  # [s] With less time left, no process is started within the limit of a call.
KILL_TIMEOUT = 10.0  # [s] The end of a killed process is awaited for this long.
MAX_OVERRUN = 0.5  # [s] A process is killed this long after the limit of its call, as long as its start takes.
WAITING_STEP = 2e-4  # [s] Interval in which a call looks for a process that has ended its call.
# So many processes are kept: the call after one beyond its limit begins at once in another.
KEPT_PROCESSES = 2
MAX_OVERRUNNING = (
    2  # With as many processes beyond the limit of their calls, no other one is started.
)
# A backend with a time limit of its own is waited for up to this multiple of its limit, and at least this time [s]
# longer: some read the clock only every few seconds, and its answer needs time to return.
STOPPABLE_LIMIT_RATIO, MIN_STOPPABLE_TIME = 2.0, 0.1
#: Program of the other process. `python -m` is not used: it searches modules in the current folder first, where the
#: sources of a checkout would hide the installed package.
SERVE_SCRIPT = (
    "import sys; sys.path[:] = filter(None, sys.path); "
    "from lavender.programs.isolated import serve_requests; serve_requests()"
)

Start = tuple[FloatArray, FloatArray] | None  # x and multipliers, in scaled units.


class Process:
    """Another process, which the first call starts; it ends after its present call when this process ends."""

    def __init__(self) -> None:
        self.popen: subprocess.Popen[bytes] | None = None
        self.warm: dict[str, Backend] = {}  # Backends whose code it has imported, by name.
        # Answers that a thread reads; None if the process ended.
        self._answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._n_pending = 0  # Number of requests without an answer that was taken.

    @property
    def is_busy(self) -> bool:
        """Whether the process is still computing the answer of a call that ended at its limit."""
        while self._n_pending and not self._answers.empty():
            if self._answers.get() is None:
                self.close()
            else:
                self._n_pending -= 1
        return self._n_pending > 0

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
            The call exceeded `timeout`; the process is killed if it goes on for MAX_OVERRUN. Ctrl-C kills it, too.
        """
        begun = time.monotonic()
        request = pickle.dumps((function, arguments), pickle.HIGHEST_PROTOCOL)
        if self.popen is None or self.popen.poll() is not None:
            self._start()
        process = self.popen
        assert process is not None and process.stdin is not None
        try:
            self._n_pending += 1
            with contextlib.suppress(OSError):  # The process ended: its answer is None.
                pickle.dump(request, process.stdin)
                process.stdin.flush()
            if timeout is None:
                answer = self._answers.get()
            else:
                left = max(begun + timeout - time.monotonic(), 0.0)
                answer = self._answers.get(timeout=min(left, threading.TIMEOUT_MAX))
        except queue.Empty:
            timer = threading.Timer(MAX_OVERRUN, self._end_overrun, (process,))
            timer.daemon = True
            timer.start()
            raise TimeoutError from None
        except BaseException:
            self.close()
            raise
        self._n_pending -= 1
        if answer is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(1.0)
            code = process.returncode
            reason = signal.Signals(-code).name if code and code < 0 else f"exit status {code}"
            self.close()
            raise BackendFailed(f"the process of the backend died ({reason})")
        error, result = answer
        if error is not None:
            raise (
                InputError(result) if error == "InputError" else BackendFailed(f"{error}: {result}")
            )
        return result

    def _start(self) -> None:
        """Start the process, and the thread that reads its answers."""
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
        arguments = self.popen.stdout, self._answers
        threading.Thread(target=_read_answers, args=arguments, daemon=True).start()

    def _end_overrun(self, process: subprocess.Popen[bytes]) -> None:
        """Kill the process if the call that began in it still runs, and start another one."""
        if not self._is_overrunning(process):
            return
        start_spare(tuple(self.warm.values()))  # It is counted before this process is not.
        with _LOCK:
            is_overrunning = self._is_overrunning(process)
            if is_overrunning:
                idle_processes.remove(self)
        if is_overrunning:
            self.close()

    def _is_overrunning(self, process: subprocess.Popen[bytes]) -> bool:
        """Whether no thread waits for the call that runs in the process."""
        return self in idle_processes and self.popen is process and self.is_busy

    def close(self) -> None:
        """Kill the process."""
        process, self.popen = self.popen, None
        self._answers = queue.SimpleQueue()  # The thread of the former process has its own.
        self._n_pending = 0
        if process is not None:
            process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(KILL_TIMEOUT)
            for pipe in (process.stdin, process.stdout):
                with contextlib.suppress(OSError, AttributeError, ValueError):
                    pipe.close()  # type: ignore[union-attr]


def _read_answers(pipe: Any, answers: queue.SimpleQueue[Any]) -> None:
    """Put the answers of a process into a queue until it ends, and then None."""
    with contextlib.suppress(OSError, EOFError, pickle.UnpicklingError, ValueError):
        while True:
            answers.put(pickle.load(pipe))
    answers.put(None)


# Processes without a current call, some of which may go on beyond the limit of one; _LOCK guards the list.
idle_processes: list[Process] = []
_LOCK = threading.Lock()
_spare_thread: threading.Thread | None = None


def _forget_processes() -> None:
    """Forget the processes of the parent, which a forked process must not use."""
    global _LOCK, _spare_thread
    _LOCK = threading.Lock()
    _spare_thread = None
    idle_processes.clear()


if hasattr(os, "register_at_fork"):  # Windows has no fork.
    os.register_at_fork(after_in_child=_forget_processes)


def is_starting_spare() -> bool:
    """Whether a process is being started in the background."""
    return _spare_thread is not None and _spare_thread.is_alive()


def _take_process(backend: Backend, time_left: float | None) -> Process | None:
    """Return a process without a call, preferably one that has imported the backend's code.

    None if there are only processes that go on beyond the limit of a call, less than START_TIME [s] is left, and none
    ends its call in half of that time.
    """
    begun = time.monotonic()
    while True:
        with _LOCK:
            free = [process for process in idle_processes if not process.is_busy]
            free.sort(key=lambda process: backend.name not in process.warm)
            if free:
                idle_processes.remove(free[0])
                return free[0]
            n_overrunning = len(idle_processes)
            has_others = n_overrunning > 0 or is_starting_spare()
        if not has_others or time_left is None or time_left >= START_TIME:
            return Process()
        if n_overrunning < MAX_OVERRUNNING:
            start_spare((backend,))
        if time.monotonic() - begun > 0.5 * time_left:
            return None
        time.sleep(WAITING_STEP)


def _call_in_process(
    backend: Backend, function: Callable[..., Any], *arguments: Any, timeout: float | None
) -> Any:
    """Call a function in a process without a current call; raise TimeoutError if it cannot begin."""
    begun = time.monotonic()
    process = _take_process(backend, timeout)
    if process is None:
        raise TimeoutError
    try:
        left = None if timeout is None else timeout - (time.monotonic() - begun)
        result = process.call_function(function, *arguments, timeout=left)
        process.warm[backend.name] = backend
        return result
    finally:
        with _LOCK:
            idle_processes.append(process)


def start_process(backend: Backend) -> None:
    """Start a process that has imported the backend's code, before the clock of a time limit starts.

    Others are started in the background: up to KEPT_PROCESSES, and one if all go on beyond the limit of a call.
    """
    with _LOCK:
        is_busy = [process.is_busy for process in idle_processes]
        has_others = len(is_busy) > 0 or is_starting_spare()
    if has_others and all(is_busy):
        start_spare((backend,))
        return
    with contextlib.suppress(
        TimeoutError, BackendFailed, InputError
    ):  # The later call raises these errors.
        _call_in_process(backend, warm_up, backend, timeout=START_TIMEOUT)
    if len(idle_processes) < KEPT_PROCESSES:
        start_spare((backend,))


def start_spare(backends: tuple[Backend, ...]) -> None:
    """Start a process with the code of these backends in a thread, unless another one is being started."""
    global _spare_thread

    def start() -> None:
        process = Process()
        with contextlib.suppress(TimeoutError, BackendFailed, InputError):
            for backend in backends:
                process.call_function(warm_up, backend, timeout=START_TIMEOUT)
                process.warm[backend.name] = backend
            with _LOCK:
                idle_processes.append(process)

    with _LOCK:
        if not is_starting_spare():
            _spare_thread = threading.Thread(target=start, daemon=True)
            _spare_thread.start()


def run_isolated(
    backend: Backend,
    program: ScaledProgram,
    start: Start,
    limit: Limits,
    settings: dict[str, Any],
) -> Answer:
    """Run the backend in another process, and end at the time limit."""
    timeout = limit.time_limit
    if timeout is not None and backend.stoppable:
        timeout = max(STOPPABLE_LIMIT_RATIO * timeout, timeout + MIN_STOPPABLE_TIME)
    try:
        answer: Answer = _call_in_process(
            backend, backend.run, program, start, limit, settings, timeout=timeout
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
