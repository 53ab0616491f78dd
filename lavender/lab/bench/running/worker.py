"""A process of its own for code that is not ours: it may hang, eat memory or die, and costs one record.

The parent starts another Python (`serve`), sends a problem once and tasks after it, and gets answers back. What
comes back is data, numbers and words of a stated form and size, never an object that is unpickled; the verdict on it
is computed here, from a problem that the process never held. What a backend prints goes to nowhere. A worker that
does not answer in time is killed with everything that it started, and the next task starts another; when this process
dies, the system ends its workers.
"""

from __future__ import annotations

import math
import time
from dataclasses import fields, replace
from typing import Any

from lavender.base.apart import served
from lavender.base.apart.process import Ended, Process, Raised
from lavender.base.arrays import FloatArray
from lavender.base.errors import LavenderError
from lavender.base.later import load
from lavender.judge.solution import Solution, Status
from lavender.lab.bench.cases import fingerprint
from lavender.lab.bench.machine import memory_share
from lavender.lab.bench.record import CRASHED, ERROR, KILLED, Record, plain, values_in
from lavender.lab.bench.running.timing import Outcome, Task, attempt, judged, solution_of
from lavender.problem import Problem
from lavender.solvers import registry
from lavender.solving.solve import Prepared, seconds_of, solve

_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
ORPHAN = 60.0  # s of CPU, beyond what any task may take
ARRAYS = ("impulse", "certificate")  # of an outcome
DIED = "its code ended the process that it ran in; tell its authors, and leave it out (--solvers)"
GRACE = 2.0  # s, beyond the repeats' own limits, for set-up and judging, before the worker is killed


class Lost(LavenderError):
    """A task brought no solution back; `status` is what its record says, the text why."""

    def __init__(self, status: str, text: str) -> None:
        super().__init__(f"{status}: {text}")
        self.status, self.text = status, text


class Worker:
    """One worker process at a time, started when needed; `close` ends it.

    Parameters
    ----------
    memory : int, optional, bytes
        Limit of the worker's address space, where the system has one; `machine.memory_share()` if None.
    """

    def __init__(self, memory: int | None = None) -> None:
        self.memory = memory_share() if memory is None else memory
        self._process = Process(__name__, self.memory or 0, environment=_ONE_THREAD)
        self._holds = ""

    def measure(self, problem: Problem, task: Task, impulse: Any = None) -> tuple[Record, FloatArray | None]:
        """As `lavender.lab.bench.running.timing.measure`, in the worker."""
        try:
            return judged(problem, task, self._outcome(problem, task, impulse))
        except Lost as lost:
            return task.record(status=lost.status, message=lost.text), None

    def solve(self, problem: Problem, task: Task) -> Solution:
        """The solution of a task, judged here.

        Raises
        ------
        Lost
            The solver raised something, or did not end, or ended the worker.
        """
        found = self._outcome(problem, task, None)
        if isinstance(found, str):
            raise Lost(ERROR, found)
        return solution_of(problem, task, found)

    def _outcome(self, problem: Problem, task: Task, impulse: Any) -> Outcome | str:
        process = self._process
        if not process.alive:
            self._holds = ""
            cause = process.start()
            if cause:
                raise Lost(f"{CRASHED} (did not start)", f"the worker process ended: {cause}")
        # Repeats end once they took the limit together, so at most two can take it; backends look at the clock
        # now and then.
        limit = 3.0 * task.time_limit + GRACE
        begun = time.monotonic()
        messages: list[Any] = [("task", task, impulse)]
        if self._holds != task.sha:
            messages.insert(0, ("problem", problem))
        self._holds = task.sha
        try:
            said, arrays = process.ask(messages, limit, 16 * problem.m)
            return outcome_in(said, arrays, problem.m, time.monotonic() - begun, task.lead)
        except TimeoutError:
            raise Lost(KILLED, f"did not stop; its process was killed after {limit:.3g} s") from None
        except Ended as end:
            raise Lost(f"{CRASHED} ({end})", DIED) from None
        except Raised as error:
            return f"{error.kind}: {error}".removesuffix(": ")
        except ValueError as error:
            process.end()
            text = f"the process of the backend sent what is no answer ({error}); it was killed"
            raise Lost(f"{CRASHED} (no answer)", text) from None

    def close(self) -> None:
        """End the process and what it started."""
        self._process.end()

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def solved(
    worker: Worker,
    problem: Problem,
    name: str,
    *,
    tol: float,
    max_iter: int | None = None,
    time_limit: float | None = None,
    **options: Any,
) -> Solution:
    """As `lv.solve`; a solver that another process finds by its entry point is run by the worker.

    Raises
    ------
    Lost
        It raised something, did not end, or ended the worker.
    """
    spec = registry.get(name)
    if not spec.plugged or max_iter == 0:  # which is none; of a task it is the solver's own
        load(*spec.requires)  # what the time of a first solve would hold besides
        return solve(problem, name, tol=tol, max_iter=max_iter, time_limit=time_limit, **options)
    Prepared(problem, spec, options, begin=False)  # what is refused, is refused here
    task = Task(
        run="",
        case=problem.name,
        sha=fingerprint(problem),
        solver=name,
        mode="tol",
        tol=tol,
        max_iter=max_iter or 0,
        time_limit=seconds_of(time_limit),
        start="warm",
        options=options,
    )
    return worker.solve(problem, task)


def serve(memory: int, lifeline: int) -> None:
    """The other process: answer tasks, until they end; `memory`: bytes of address space, 0 for no limit."""
    served.serve(lifeline, _runner, memory)


def _runner() -> served.Handler:
    problem: Any = None

    def run(message: Any) -> tuple[dict[str, Any], list[Any]] | None:
        nonlocal problem
        if message[0] == "problem":
            problem = message[1]
            return None
        served.limit_cpu(3.0 * message[1].time_limit + ORPHAN)
        found = attempt(problem, message[1], message[2])
        if isinstance(found, str):
            return {"error": found[:500]}, []
        found = replace(found, message=str(found.message)[:500], form=str(found.form)[:500])
        said = {f.name: plain(getattr(found, f.name)) for f in fields(found) if f.name not in ARRAYS}
        return said, [getattr(found, name) for name in ARRAYS]

    return run


def outcome_in(said: dict[str, Any], arrays: list[Any], m: int, took: float, lead: float = 0.0) -> Outcome:
    """What an answer says, every part of it checked.

    `took` [s] is what the whole took here. `lead` [s] passed before, in this process, and is in each time of a line.

    Raises
    ------
    ValueError
        It is none: other words, counts or sizes, times longer than the whole took.
    """
    values = values_in(Outcome, said)
    if values.get("status") not in Status.__members__:
        raise ValueError("no status")
    if len(arrays) != 2 or arrays[0] is None or any(x is not None and len(x) != m for x in arrays):
        raise ValueError("impulses of another length")
    try:
        found = Outcome(*arrays, **values)
    except TypeError as error:
        raise ValueError(str(error)) from None
    parts = (*found.setups, *found.solves)
    if not parts or len(found.setups) != len(found.solves):
        raise ValueError("no times")
    lines = [t - lead for t in found.times]
    known = all(t >= 0.0 for t in (*parts, *lines))
    if not known or not max(math.fsum(parts), math.fsum(lines)) <= took:
        raise ValueError("times that did not pass")
    if not all(t is None or t <= took for t in (found.pace, found.own)):
        raise ValueError("a pace, or a time of its own, that did not pass")
    return found
