"""Run tasks of third-party solvers in another process: code that hangs, exhausts memory or dies costs one record.

The process gets a problem once and tasks after it. The verdict on an answer is computed here, from a problem that the
process never held.
"""

from __future__ import annotations

import math
import time
from dataclasses import fields, replace
from typing import Any

from lavender.base import subprocesses
from lavender.base.arrays import FloatArray
from lavender.base.errors import LavenderError
from lavender.base.lazy_import import import_numerical_modules
from lavender.base.subprocesses import ProcessBackend, ProcessEnded, RemoteError
from lavender.judge.solution import Solution, Status
from lavender.problem import Problem
from lavender.report.cases import hash_problem
from lavender.report.machine import get_memory_per_process
from lavender.report.records import CRASHED, ERROR, KILLED, Record, parse_fields, to_jsonable
from lavender.report.timing import Outcome, Task, judge_outcome, make_solution, run_task_or_return_error
from lavender.solvers import registry
from lavender.solving.limits import check_time_limit
from lavender.solving.prepared import Prepared
from lavender.solving.solve import solve

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
ORPHAN_CPU_TIME = 60.0  # [s] A worker without a parent is killed this CPU time after its task's limit.
OUTCOME_ARRAYS = ("impulse", "certificate")  # Fields of `Outcome`, in the order in which they are sent.
DIED_MESSAGE = "its code ended its process; report this to its authors, and use another solver"
GRACE_TIME = 2.0  # [s] Time for set-up and judging beyond the repetitions' limits, before a worker is killed.


class TaskFailed(LavenderError):
    """A task returned no solution. `status` is the status of its record; the message gives the reason."""

    def __init__(self, status: str, text: str) -> None:
        super().__init__(f"{status}: {text}")
        self.status, self.text = status, text


class Worker:
    """One worker process at a time, started when it is needed; `close` kills it.

    Parameters
    ----------
    memory : int, optional, bytes
        Limit of the worker's address space if the system has one; `machine.get_memory_per_process()` if None.
    """

    def __init__(self, memory: int | None = None) -> None:
        self.memory = get_memory_per_process() if memory is None else memory
        self._process = ProcessBackend(run_task, memory=self.memory or 0, environment=ONE_THREAD)
        self._problem_hash = ""  # Hash of the problem that the process holds.

    def measure_task(
        self, problem: Problem, task: Task, impulse: Any = None
    ) -> tuple[Record, FloatArray | None]:
        """Make one measurement in the worker; equivalent to `lavender.report.timing.measure_task`."""
        try:
            return judge_outcome(problem, task, self._run_task(problem, task, impulse))
        except TaskFailed as failure:
            return task.make_record(status=failure.status, message=failure.text), None

    def solve(self, problem: Problem, task: Task) -> Solution:
        """Return the solution of a task, judged in this process.

        Raises
        ------
        TaskFailed
            The solver raised an exception, did not end, or ended the worker.
        """
        outcome = self._run_task(problem, task, None)
        if isinstance(outcome, str):
            raise TaskFailed(ERROR, outcome)
        return make_solution(problem, task, outcome)

    def _run_task(self, problem: Problem, task: Task, impulse: Any) -> Outcome | str:
        """Return the outcome of a task, or the text of the exception that the solver raised."""
        process = self._process
        if not process.is_alive:
            self._problem_hash = ""
            try:
                process.start()
            except ProcessEnded as error:
                cause = f"the worker process ended: {error}"
                raise TaskFailed(f"{CRASHED} (did not start)", cause) from None
        # The first call takes at most the limit, and the last repeat, which has none, may start just before it: three
        # limits. Some backends read the clock only every few seconds: add GRACE_TIME.
        limit = 3.0 * task.time_limit + GRACE_TIME
        start_time = time.monotonic()
        new_problem = None if self._problem_hash == task.sha else problem
        self._problem_hash = ""
        try:
            answer, arrays = process.call_function(
                new_problem, task, impulse, timeout=limit, max_bytes=16 * problem.m
            )
            elapsed = time.monotonic() - start_time
            self._problem_hash = task.sha
            return parse_outcome(answer, arrays, problem.m, elapsed, task.lead)
        except TimeoutError:
            raise TaskFailed(KILLED, f"did not stop; its process was killed after {limit:.3g} s") from None
        except ProcessEnded as error:
            raise TaskFailed(f"{CRASHED} ({error})", DIED_MESSAGE) from None
        except RemoteError as error:
            return ": ".join(filter(None, (error.kind, str(error))))
        except ValueError as error:
            process.close()
            text = f"the process of the backend sent an invalid answer ({error}); it was killed"
            raise TaskFailed(f"{CRASHED} (no answer)", text) from None

    def close(self) -> None:
        """Kill the process and the processes that it started."""
        self._process.close()

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def solve_isolated(
    worker: Worker,
    problem: Problem,
    name: str,
    *,
    tol: float,
    max_iter: int | None = None,
    time_limit: float | None = None,
    **options: Any,
) -> Solution:
    """Solve as `lv.solve` does. A solver that another process can import by its entry point runs in the worker.

    Raises
    ------
    TaskFailed
        The solver raised an exception, did not end, or ended the worker.
    """
    spec = registry.get(name)
    if not spec.distribution or max_iter == 0:  # In a task, 0 means the solver's own max_iter.
        import_numerical_modules(*spec.requires)  # The first solve's time does not include the import.
        return solve(problem, name, tol=tol, max_iter=max_iter, time_limit=time_limit, **options)
    # Raises an error if the solver rejects the problem or an option.
    Prepared(problem, spec, options, begin=False)
    task = Task(
        run="", case=problem.name, sha=hash_problem(problem), solver=name, mode="tol", tol=tol, max_iter=max_iter or 0,
        time_limit=check_time_limit(time_limit), start="warm", options=options,
    )  # fmt: skip
    return worker.solve(problem, task)


_problem: Problem | None = None  # Problem of the last task; used only in the worker process.


def run_task(problem: Problem | None, task: Task, impulse: Any) -> subprocesses.Answer:
    """Run a task, in the worker process, on `problem` or, if it is None, on the problem of the last task."""
    global _problem
    _problem = _problem if problem is None else problem
    assert _problem is not None
    subprocesses.limit_cpu_time(3.0 * task.time_limit + ORPHAN_CPU_TIME)
    outcome = run_task_or_return_error(_problem, task, impulse)
    if isinstance(outcome, str):
        return {"error": outcome[: subprocesses.MAX_ERROR_LENGTH]}, ()
    message, form = (str(x)[: subprocesses.MAX_ERROR_LENGTH] for x in (outcome.message, outcome.form))
    outcome = replace(outcome, message=message, form=form)
    answer = {
        f.name: to_jsonable(getattr(outcome, f.name)) for f in fields(outcome) if f.name not in OUTCOME_ARRAYS
    }
    return answer, [getattr(outcome, name) for name in OUTCOME_ARRAYS]


def parse_outcome(
    answer: dict[str, Any], arrays: list[Any], m: int, elapsed: float, lead: float = 0.0
) -> Outcome:
    """Check every part of an answer and return its outcome.

    Parameters
    ----------
    elapsed : float, s
        Time that the call took, measured here.
    lead : float, s
        `Task.lead`: time that is included in each of `Outcome.times` but passed in this process before the call.

    Raises
    ------
    ValueError
        The answer has other fields, counts or sizes, or times longer than `elapsed`.
    """
    values = parse_fields(Outcome, answer)
    if values.get("status") not in Status.__members__:
        raise ValueError(
            f"the status is {values.get('status')!r:.60}; one of {', '.join(Status.__members__)} is needed"
        )
    if len(arrays) != 2 or arrays[0] is None or any(x is not None and len(x) != m for x in arrays):
        sizes = ["none" if x is None else str(len(x)) for x in arrays]
        raise ValueError(
            f"the worker returned {len(arrays)} arrays with numbers of entries {', '.join(sizes)}; two arrays are "
            f"needed: {m} impulses, and {m} impulses or none"
        )
    try:
        outcome = Outcome(*arrays, **values)
    except TypeError as error:
        raise ValueError(str(error)) from None
    times = [outcome.setup_time, outcome.solve_time, *(t - lead for t in outcome.times)]
    if not outcome.times or not all(0.0 <= t <= elapsed for t in times):
        raise ValueError(
            f"the worker returned no times, negative times, or times longer than the call of {elapsed:.3g} s"
        )
    if math.fsum(times[2:]) > elapsed or (outcome.calibration_time or 0.0) > elapsed:
        raise ValueError(f"the worker returned times that add up to more than the call of {elapsed:.3g} s")
    return outcome
