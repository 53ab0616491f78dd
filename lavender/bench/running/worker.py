"""A process of its own for code that is not ours: it may hang, eat memory or die, and costs one record.

The parent starts another Python (`lavender.bench.running.served`), sends a problem once and tasks after it, and gets
answers back. What comes back is data, numbers and words of a stated form and size, never an object that is
unpickled; the verdict on it is computed here, from a problem that the process never held. What a backend prints
goes to nowhere. A worker that does not answer in time is killed with everything that it started, and the next
task starts another; when this process dies, the system ends its workers.
"""

from __future__ import annotations

import contextlib
import json
import math
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

import numpy as np

from lavender._arrays import FloatArray
from lavender.bench.machine import memory_share
from lavender.bench.record import CRASHED, KILLED, Record
from lavender.bench.running.timing import Outcome, Task, judged
from lavender.problem import Problem
from lavender.solution import Status

__all__ = ["Worker"]

# Not `-m`: that puts the current folder first, and in a checkout its sources would hide the installed package.
_START = (
    "import sys; sys.path[:] = filter(None, sys.path); "
    "from lavender.bench.running import served; served.serve(int(sys.argv[1]), int(sys.argv[2]))"
)

START_TIME = 60.0  # s, to import everything on a loaded machine
GRACE = 2.0  # s, beyond the repeats' own limits, for set-up and judging
WORDS = 2**20  # bytes of the words of one answer: a status, a message, counts and times
PIECE = 2**20  # bytes read at once
GROUPS = os.name == "posix"  # processes can be ended together with what they started
END_TIME = 10.0  # s, for the system to end a killed process; one that waits for a dead disk may take longer


def _read(stream: IO[bytes], size: int) -> bytes:
    """Exactly so many bytes of an unbuffered stream.

    Raises
    ------
    EOFError
        The stream ended before.
    """
    parts = []
    while size:
        part = stream.read(min(size, PIECE))
        if not part:
            raise EOFError
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


class Worker:
    """One worker process at a time, started when needed; `close` ends it.

    Parameters
    ----------
    memory : int, optional, bytes
        Limit of the worker's address space, where the system has one; `machine.memory_share()` if None.
    grace : s, optional
        Beyond the time limits of a task, before the worker is killed.
    """

    def __init__(self, memory: int | None = None, grace: float | None = None) -> None:
        self.memory = memory_share() if memory is None else memory
        self.grace = GRACE if grace is None else grace
        self._process: subprocess.Popen[bytes] | None = None
        self._answers: queue.Queue[Any] = queue.Queue()
        self._holds = ""
        self._lifeline = -1  # the writing end of a pipe that ends when this process does
        self._room = 0  # bytes of arrays that an answer may have

    def measure(self, problem: Problem, task: Task) -> Record:
        """As `lavender.bench.running.timing.measure`, in the worker."""
        return self.measure_impulse(problem, task)[0]

    def measure_impulse(
        self, problem: Problem, task: Task, impulse: Any = None
    ) -> tuple[Record, FloatArray | None]:
        """As `lavender.bench.running.timing.measure_impulse`, in the worker."""
        if self._process is None:
            cause = self._start()
            if cause:
                message = f"the worker process ended: {cause}"
                return task.record(status=f"{CRASHED} (did not start)", message=message), None
        # Repeats end once they took the limit together, so at most two can take it; backends look at the clock
        # now and then.
        limit = 3.0 * task.time_limit + self.grace
        begun = time.monotonic()
        try:
            messages: list[Any] = [("task", task, impulse)]
            if self._holds != task.sha:
                messages.insert(0, ("problem", problem))
            self._holds = task.sha
            self._room = 16 * problem.m  # impulses and a certificate
            self._send(messages, limit)
            answer = self._answers.get(timeout=max(0.0, begun + limit - time.monotonic()))
        except queue.Empty:
            self._end()
            text = f"did not stop; its process was killed after {limit:.3g} s"
            return task.record(status=KILLED, message=text), None
        except KeyboardInterrupt:
            self._end()
            raise
        if answer is None:
            text = "the process of the backend died"
            return task.record(status=f"{CRASHED} ({self._cause()})", message=text), None
        try:
            return judged(problem, task, _outcome(answer, problem.m, time.monotonic() - begun))
        except ValueError as error:
            self._end()
            text = f"the process of the backend sent what is no answer ({error}); it was killed"
            return task.record(status=f"{CRASHED} (no answer)", message=text), None

    def _send(self, messages: list[Any], limit: float) -> None:
        """Write messages; a process that does not read them within the limit is one that does not answer.

        Raises
        ------
        queue.Empty
            It did not read them.
        """
        process = self._process
        assert process is not None and process.stdin is not None
        stream = process.stdin
        frames = [pickle.dumps(m, pickle.HIGHEST_PROTOCOL) for m in messages]
        data = memoryview(b"".join(struct.pack("<Q", len(f)) + f for f in frames))

        def write() -> None:
            done = 0
            with contextlib.suppress(OSError, ValueError):  # it died: the answer is its end
                while done < len(data):
                    done += stream.write(data[done : done + PIECE]) or 0

        if len(data) <= 4096:  # a pipe takes that at once, and it is empty: every task was answered
            write()
            return
        writer = threading.Thread(target=write, daemon=True)
        writer.start()
        writer.join(limit)
        if writer.is_alive():
            raise queue.Empty

    def _start(self) -> str:
        """Start a process and wait until it is ready; why it is not, or nothing."""
        environment = {
            **os.environ,
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
            "MKL_NUM_THREADS": "1",
        }
        environment["PYTHONPATH"] = os.pathsep.join(p or os.getcwd() for p in sys.path)
        more: dict[str, Any] = {}
        alive = -1
        if GROUPS:
            alive, self._lifeline = os.pipe()
            more = {"start_new_session": True, "pass_fds": (alive,)}
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _START, str(self.memory or 0), str(alive)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=environment,
                bufsize=0,
                **more,
            )
        finally:
            if alive >= 0:
                os.close(alive)
        self._holds, self._room = "", 0
        answers: queue.Queue[Any] = queue.Queue()
        self._answers = answers
        stream = self._process.stdout
        assert stream is not None
        # A process of the backend's that left the group may keep the pipe open for ever: this thread then waits
        # alone, and nobody waits for it.
        threading.Thread(target=self._listen, args=(stream, answers), daemon=True).start()
        try:
            ready = answers.get(timeout=START_TIME)
        except queue.Empty:
            ready = None
        except KeyboardInterrupt:
            self._end()
            raise
        return "" if ready is not None else self._cause()

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
        """How the process ended, after it was ended with all that it started."""
        process = self._process
        assert process is not None
        code = _ended(process, 1.0)
        self._end()
        if code is None:
            return "no answer"
        if code < 0:
            with contextlib.suppress(ValueError):
                return signal.Signals(-code).name
        return f"exit status {code}"

    def _end(self) -> None:
        process, self._process = self._process, None
        lifeline, self._lifeline = self._lifeline, -1
        self._holds = ""
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

    def close(self) -> None:
        """End the process and what it started."""
        self._end()

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _ended(process: subprocess.Popen[bytes], limit: float) -> int | None:
    """Exit status of a process, -N for signal N; None where it runs on. It is not reaped: its group may live."""
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
        if time.monotonic() > until:
            return None
        time.sleep(0.01)


def _outcome(answer: tuple[bytes, bytes], m: int, took: float) -> Outcome | str:
    """What an answer says, every part of it checked.

    Raises
    ------
    ValueError
        It is none: other words, counts or sizes, times longer than the whole took.
    """
    try:
        said = json.loads(answer[0])
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(said, dict):
        raise ValueError("not a table")
    if isinstance(said.get("error"), str):
        return str(said["error"])
    numbers = np.frombuffer(answer[1], float) if len(answer[1]) % 8 == 0 else np.empty(0)
    status, work = said.get("status"), said.get("work")
    if not isinstance(status, str) or status not in Status.__members__:
        raise ValueError("no status")
    if len(numbers) != m * (2 if said.get("certificate") is True else 1):
        raise ValueError("impulses of another length")
    if not _is_count(said.get("iterations")) or not isinstance(work, dict):
        raise ValueError("no counts")
    if not all(isinstance(k, str) and _is_count(n) for k, n in work.items()):
        raise ValueError("counts that are none")
    if not all(isinstance(said.get(name), str) for name in ("message", "form")):
        raise ValueError("no message")
    setups, solves = _times(said.get("setups")), _times(said.get("solves"))
    if len(setups) != len(solves) or not math.fsum(setups + solves) <= took:
        raise ValueError("times that did not pass")
    return Outcome(
        impulse=numbers[:m],
        status=Status[status],
        iterations=said["iterations"],
        work=work,
        message=said["message"],
        form=said["form"],
        certificate=numbers[m:] if len(numbers) > m else None,
        setups=setups,
        solves=solves,
    )


def _times(some: Any) -> list[float]:
    if not isinstance(some, list) or not some or not all(isinstance(t, float) and t >= 0.0 for t in some):
        raise ValueError("no times")
    return some


def _is_count(n: Any) -> bool:
    return isinstance(n, int) and not isinstance(n, bool) and 0 <= n < 2**63
