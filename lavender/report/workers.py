"""Run tasks in other processes: with joblib on this machine or a dask cluster, or isolated from the judge.

A third-party solver runs in an isolated process, so that code that hangs, exhausts memory or dies costs one record. The
process gets a problem once and tasks after it. The verdict on an answer is computed in the calling process, from a
problem that the isolated process never held.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from multiprocessing import resource_tracker
from typing import Any

from lavender.base import subprocesses
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError, LavenderError, require_packages
from lavender.base.lazy_import import import_numerical_modules
from lavender.base.subprocesses import ProcessBackend, ProcessEnded, RemoteError
from lavender.judge.solution import Solution, Status
from lavender.problem import Problem
from lavender.report.cases import hash_problem
from lavender.report.machine import get_memory_per_process
from lavender.report.store import CRASHED, ERROR, KILLED, Row, to_jsonable
from lavender.report.timing import Task, judge_outcome, make_solution, run_task_or_return_error
from lavender.solvers import registry
from lavender.solving.limits import check_time_limit
from lavender.solving.prepared import Prepared
from lavender.solving.solve import solve

MAX_WORKERS = 4096  # [processes] More than any machine has cores.
CONNECT_TIMEOUT = 10.0  # [s] Time for a scheduler to answer.
PARENT_CHECK_INTERVAL = 0.5  # [s] Time between two checks of a worker that its parent still runs.
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
ORPHAN_CPU_TIME = 60.0  # [s] A worker without a parent is killed this CPU time after its task's limit.
OUTCOME_ARRAYS = ("impulse", "certificate")  # Arrays of an outcome, in the order in which they are sent.
DIED_MESSAGE = "its code ended its process; report this to its authors, and use another solver"
GRACE_TIME = 2.0  # [s] Time for set-up and judging beyond the repetitions' limits, before a worker is killed.


def check_workers(workers: Any) -> None:
    """Raise InputError unless the number of workers is -1 or 1 to MAX_WORKERS."""
    if type(workers) is not int or not (workers == -1 or 1 <= workers <= MAX_WORKERS):
        need = f"-1 (one for each core) or a whole number from 1 to {MAX_WORKERS} is needed"
        raise InputError(f"workers is {workers!r}; {need}")


def map_unordered(
    function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], workers: int, backend: str
) -> Iterator[Any]:
    """Call `function` with each tuple of `arguments` on workers, and yield each result as soon as it is available.

    `backend` is a name that `connect_backend` returned. The iteration ends early, without an exception, if workers
    were lost.
    """
    require_packages("a measurement by worker processes", "joblib")
    import joblib

    lost: tuple[type[BaseException], ...] = (BrokenPipeError, ConnectionError)
    with contextlib.suppress(ImportError):
        from joblib.externals.loky.process_executor import BrokenProcessPool

        lost = (*lost, BrokenProcessPool)
    with contextlib.suppress(ImportError):
        from distributed.client import FutureCancelledError
        from distributed.scheduler import KilledWorker

        lost = (*lost, KilledWorker, FutureCancelledError)
    parent = os.getpid() if backend == "loky" else 0  # 0 if workers belong to a cluster.
    with joblib.parallel_config(backend=backend, n_jobs=workers):
        calls = (joblib.delayed(_call_in_worker)(parent, function, each) for each in arguments)
        try:
            with _ignore_sigint() if hasattr(signal, "pthread_sigmask") else contextlib.nullcontext():
                results = joblib.Parallel(return_as="generator_unordered", batch_size=1)(calls)
            try:
                for result in results:  # noqa: UP028 - `yield from` would close `results` without the filter below
                    yield result
            except GeneratorExit:
                with warnings.catch_warnings():  # joblib warns about the calls that it cancels.
                    warnings.simplefilter("ignore", UserWarning)
                    results.close()
                raise
        except lost:
            return


def _call_in_worker(parent: int, function: Callable[..., Any], call_arguments: tuple[Any, ...]) -> Any:
    """Call the function in a worker, which ends when its parent does."""
    if parent and parent != os.getpid():
        _end_this_process_with_parent(parent)
        warnings.filterwarnings("ignore", "solver plug-in")  # The parent has reported it.
    return function(*call_arguments)


@cache
def _end_this_process_with_parent(parent: int) -> None:
    """Start a thread that ends this process soon after its parent was killed."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_CHECK_INTERVAL)
        os._exit(1)

    if hasattr(os, "getppid"):
        threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _ignore_sigint() -> Iterator[None]:
    """Ignore SIGINT in processes started in this context. A terminal sends it to all; only this process handles it."""
    from joblib.externals.loky.backend import resource_tracker as loky_tracker

    # Start both resource trackers first: starting one unblocks SIGINT in this process.
    resource_tracker.ensure_running()
    loky_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def connect_backend(spec: str) -> tuple[str, contextlib.AbstractContextManager[Any]]:
    """Return joblib's name of a backend, and a context manager that holds the connection to its cluster.

    Raises
    ------
    InputError
        A package is missing, no scheduler answers, or joblib does not have the backend.
    """
    from joblib.parallel import BACKENDS

    name, _, address = spec.partition("=")
    if name not in (*BACKENDS, "dask") or (address and name != "dask") or name == "ray":
        known = "'loky' runs processes on this machine, 'dask' or 'dask=ADDRESS' a cluster"
        raise InputError(f"joblib has no backend {spec!r}: {known}")
    if name != "dask":
        return name, contextlib.nullcontext()
    try:
        import dask
        import distributed
    except ImportError:
        raise InputError(
            "backend 'dask' needs distributed: pip install 'lavender-contact[cluster]'"
        ) from None
    address = address or dask.config.get("scheduler-address", "")
    try:
        if address:
            client = distributed.Client(address, timeout=CONNECT_TIMEOUT)  # type: ignore[no-untyped-call]
            return name, client
        distributed.get_client()
    except (OSError, ValueError) as error:
        advice = "use dask=tcp://HOST:8786, set DASK_SCHEDULER_ADDRESS, or make a distributed.Client first"
        raise InputError(
            f"no dask scheduler answers at {address!r} ({error}); start one there"
            if address
            else f"backend 'dask' needs a scheduler: {advice}"
        ) from None
    return name, contextlib.nullcontext()  # The current client is used.


# -- the isolated process ----------------------------------------------------------------------------------


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
    ) -> tuple[Row, FloatArray | None]:
        """Make one measurement in the worker; equivalent to `lavender.report.timing.measure_task`."""
        try:
            return judge_outcome(problem, task, self._run_task(problem, task, impulse))
        except TaskFailed as failure:
            return task.make_row(status=failure.status, message=failure.text), None

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

    def _run_task(self, problem: Problem, task: Task, impulse: Any) -> Row | str:
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
            return parse_outcome(answer, arrays, problem.m, elapsed)
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
    worker: Worker, problem: Problem, name: str, *, tol: float, max_iter: int | None = None,
    time_limit: float | None = None, **options: Any,
) -> Solution:  # fmt: skip
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
    for name in ("message", "form"):
        outcome[name] = str(outcome[name])[: subprocesses.MAX_ERROR_LENGTH]
    arrays = [outcome.pop(name) for name in OUTCOME_ARRAYS]
    return to_jsonable(outcome), arrays


def _is_count(value: Any) -> bool:
    """Return whether a value is a 64-bit integer that is not negative."""
    return type(value) is int and 0 <= value < 2**63


#: Test of each entry of an outcome but its arrays, as another process sends it; times are tested later.
OUTCOME_TESTS: dict[str, Callable[[Any], bool]] = {
    "status": lambda v: isinstance(v, str) and v in Status.__members__,
    "iterations": _is_count,
    "work": lambda v: isinstance(v, dict) and all(map(_is_count, v.values())),
    **dict.fromkeys(("message", "form", "status_conflict"), lambda v: isinstance(v, str)),
    **dict.fromkeys(("setup_time", "solve_time", "calibration_time"), lambda v: isinstance(v, (int, float))),
    "times": lambda v: isinstance(v, list) and bool(v) and all(isinstance(t, (int, float)) for t in v),
}


def parse_outcome(answer: Row, arrays: list[Any], m: int, elapsed: float) -> Row:
    """Check every part of an answer and return its outcome.

    `elapsed` [s] is the time that the call took, measured here.

    Raises
    ------
    ValueError
        The answer has other fields, counts or sizes, or times longer than `elapsed`.
    """
    for name, is_valid in OUTCOME_TESTS.items():
        if not is_valid(answer.get(name)):
            raise ValueError(f"{name} is {answer.get(name)!r:.60}")
    if len(arrays) != 2 or arrays[0] is None or any(x is not None and len(x) != m for x in arrays):
        sizes = ", ".join("none" if x is None else str(len(x)) for x in arrays)
        raise ValueError(f"arrays of {sizes} numbers; {m} impulses, and {m} impulses or none are needed")
    times = [answer["setup_time"], answer["solve_time"], *answer["times"]]
    if (
        not all(0.0 <= t <= elapsed for t in (*times, answer["calibration_time"]))
        or math.fsum(answer["times"]) > elapsed
    ):
        raise ValueError(f"negative times, or times that add up to more than the call of {elapsed:.3g} s")
    return {name: answer[name] for name in OUTCOME_TESTS} | dict(zip(OUTCOME_ARRAYS, arrays, strict=True))
