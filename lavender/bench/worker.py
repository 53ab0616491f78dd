"""A process of its own for code that is not ours: it may hang, eat memory or die, and costs one record.

The parent starts another Python, sends a problem once and tasks after it, and gets
records back: pickles with a length in front, over the standard streams. What a backend prints goes to
nowhere. A worker that does not answer in time is killed; the next task starts another.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import signal
import struct
import subprocess
import sys
import threading
import time
from typing import IO, Any

from lavender._arrays import FloatArray
from lavender.bench.record import CRASHED, KILLED, Record
from lavender.bench.timing import Task
from lavender.problem import Problem

__all__ = ["Worker"]

# Not `-m`: that puts the current folder first, and in a checkout its sources would hide the installed package.
_START = (
    "import sys; sys.path[:] = filter(None, sys.path); "
    "from lavender.bench import worker; worker._serve(int(sys.argv[1]))"
)

START_TIME = 60.0  # s, to import everything on a loaded machine
ORPHAN = 60.0  # s of CPU, beyond what any task may take
GRACE = 2.0  # s, beyond the repeats' own limits, for set-up and judging


def _send(stream: IO[bytes], message: Any) -> None:
    data = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
    stream.write(struct.pack("<Q", len(data)) + data)
    stream.flush()


def _receive(stream: IO[bytes]) -> Any:
    head = stream.read(8)
    if len(head) < 8:
        raise EOFError
    (size,) = struct.unpack("<Q", head)
    data = stream.read(size)
    if len(data) < size:
        raise EOFError
    return pickle.loads(data)


class Worker:
    """One worker process at a time, started when needed; `close` ends it.

    Parameters
    ----------
    memory : int, optional, bytes
        Limit of the worker's address space, where the system has one.
    grace : s, optional
        Beyond the time limits of a task, before the worker is killed.
    """

    def __init__(self, memory: int | None = None, grace: float | None = None) -> None:
        self.memory = memory
        self.grace = GRACE if grace is None else grace
        self._process: subprocess.Popen[bytes] | None = None
        self._answers: queue.Queue[Any] = queue.Queue()
        self._holds = ""

    def measure(self, problem: Problem, task: Task) -> Record:
        """As `lavender.bench.timing.measure`, in the worker."""
        return self.measure_impulse(problem, task)[0]

    def measure_impulse(
        self, problem: Problem, task: Task, impulse: Any = None
    ) -> tuple[Record, FloatArray | None]:
        """As `lavender.bench.timing.measure_impulse`, in the worker."""
        if self._process is None:
            cause = self._start()
            if cause:
                message = f"the worker process ended: {cause}"
                return task.record(status=f"{CRASHED} (did not start)", message=message), None
        # Repeats end once they took the limit together, so at most two can take it; backends look at the clock
        # now and then.
        limit = 3.0 * task.time_limit + self.grace
        try:
            assert self._process is not None and self._process.stdin is not None
            if self._holds != task.sha:
                _send(self._process.stdin, ("problem", problem))
                self._holds = task.sha
            _send(self._process.stdin, ("task", task, impulse))
            answer = self._answers.get(timeout=limit)
        except queue.Empty:
            self._end()
            message = f"did not stop; its process was killed after {limit:.3g} s"
            return task.record(status=KILLED, message=message), None
        except (BrokenPipeError, OSError):
            answer = None
        except KeyboardInterrupt:
            self._end()
            raise
        if answer is None:
            message = "the process of the backend died"
            return task.record(status=f"{CRASHED} ({self._cause()})", message=message), None
        return answer

    def _start(self) -> str:
        """Start a process and wait until it is ready; why it is not, or nothing."""
        environment = {
            **os.environ,
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
            "MKL_NUM_THREADS": "1",
        }
        environment["PYTHONPATH"] = os.pathsep.join(p or os.getcwd() for p in sys.path)
        self._process = subprocess.Popen(
            [sys.executable, "-c", _START, str(self.memory or 0)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
        )
        self._holds = ""
        answers: queue.Queue[Any] = queue.Queue()
        self._answers = answers
        stream = self._process.stdout

        def listen() -> None:
            assert stream is not None
            with contextlib.suppress(Exception):
                while True:
                    answers.put(_receive(stream))
            answers.put(None)  # the end, however it came

        threading.Thread(target=listen, daemon=True).start()
        try:
            ready = answers.get(timeout=START_TIME)
        except queue.Empty:
            ready = None
        return "" if ready == "ready" else self._cause()

    def _cause(self) -> str:
        process = self._process
        assert process is not None
        try:
            code = process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            code = None
        self._end()
        if code is None:
            return "no answer"
        if code < 0:
            with contextlib.suppress(ValueError):
                return signal.Signals(-code).name
        return f"exit status {code}"

    def _end(self) -> None:
        process, self._process = self._process, None
        self._holds = ""
        if process is None:
            return
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()

    def close(self) -> None:
        """End the process."""
        self._end()

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _limit_cpu(more: float) -> None:
    """The system ends this process after so much more CPU time, should nobody be left who could."""
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
        resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time() + more) + 1, hard))


def _serve(memory: int) -> None:
    # Ctrl-C goes to the whole group: the parent decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if memory:
        with contextlib.suppress(ImportError, ValueError, OSError):
            import resource

            resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, 0)
    os.dup2(nowhere, 1)
    from lavender.bench.timing import measure_impulse

    _send(answers, "ready")
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
            _send(answers, measure_impulse(problem, message[1], message[2]))
