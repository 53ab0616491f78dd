"""A process of its own for code that is not ours: it may hang, eat memory or die, and costs one record.

The parent starts another Python (`served.py`), sends a problem once and tasks after it, and gets answers back. What
comes back is data, numbers and words of a stated form and size, never an object that is unpickled; the verdict on it
is computed here, from a problem that the process never held. What a backend prints goes to nowhere. A worker that
does not answer in time is killed with everything that it started, and the next task starts another; when this process
dies, the system ends its workers.
"""

from __future__ import annotations

import json
import math
import time
from typing import Any

import numpy as np

from lavender.base.apart.process import Ended, Process
from lavender.base.arrays import FloatArray
from lavender.judge.solution import Status
from lavender.lab.bench.machine import memory_share
from lavender.lab.bench.record import CRASHED, KILLED, Record, values_in
from lavender.lab.bench.running.timing import Outcome, Task, judged
from lavender.problem import Problem

_SERVED = "lavender.lab.bench.running.served"
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
GRACE = 2.0  # s, beyond the repeats' own limits, for set-up and judging


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
        self._process = Process(_SERVED, self.memory or 0, environment=_ONE_THREAD)
        self._holds = ""

    def measure(self, problem: Problem, task: Task, impulse: Any = None) -> tuple[Record, FloatArray | None]:
        """As `lavender.lab.bench.running.timing.measure`, in the worker."""
        process = self._process
        if not process.alive:
            self._holds = ""
            cause = process.start()
            if cause:
                message = f"the worker process ended: {cause}"
                return task.record(status=f"{CRASHED} (did not start)", message=message), None
        # Repeats end once they took the limit together, so at most two can take it; backends look at the clock
        # now and then.
        limit = 3.0 * task.time_limit + self.grace
        begun = time.monotonic()
        messages: list[Any] = [("task", task, impulse)]
        if self._holds != task.sha:
            messages.insert(0, ("problem", problem))
        self._holds = task.sha
        try:
            answer = process.ask(messages, limit, 16 * problem.m)  # impulses and a certificate
        except TimeoutError:
            text = f"did not stop; its process was killed after {limit:.3g} s"
            return task.record(status=KILLED, message=text), None
        except Ended as end:
            return task.record(status=f"{CRASHED} ({end})", message="the process of the backend died"), None
        try:
            return judged(problem, task, outcome_in(answer, problem.m, time.monotonic() - begun))
        except ValueError as error:
            process.end()
            text = f"the process of the backend sent what is no answer ({error}); it was killed"
            return task.record(status=f"{CRASHED} (no answer)", message=text), None

    def close(self) -> None:
        """End the process and what it started."""
        self._process.end()

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def outcome_in(answer: tuple[bytes, bytes], m: int, took: float) -> Outcome | str:
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
    values = values_in(Outcome, said)
    if values.get("status") not in Status.__members__:
        raise ValueError("no status")
    numbers = np.frombuffer(answer[1], float) if len(answer[1]) % 8 == 0 else np.empty(0)
    if len(numbers) != m * (2 if said.get("certificate") is True else 1):
        raise ValueError("impulses of another length")
    try:
        found = Outcome(numbers[:m], numbers[m:] if len(numbers) > m else None, **values)
    except TypeError as error:
        raise ValueError(str(error)) from None
    parts = (*found.setups, *found.solves)
    if not parts or len(found.setups) != len(found.solves):
        raise ValueError("no times")
    known = all(t >= 0.0 for t in (*parts, *found.times))
    if not known or not max(math.fsum(parts), math.fsum(found.times)) <= took:
        raise ValueError("times that did not pass")
    if not all(t is None or t <= took for t in (found.pace, found.own)):
        raise ValueError("a pace, or a time of its own, that did not pass")
    return found
