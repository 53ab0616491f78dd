"""Run backends with a time limit in other processes, which later calls reuse.

A process that does not answer in time is killed, and the next call starts another. Backends that accept a time limit
are killed after twice that limit, because some of them read the clock only every few seconds.
"""

from __future__ import annotations

import atexit
import os
import pickle
from contextlib import suppress
from typing import Any

import numpy as np

from lavender.base import subprocesses
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.base.subprocesses import InvalidAnswer, ProcessBackend, ProcessEnded, RemoteError
from lavender.external.backend import Backend
from lavender.external.convex import ScaledProgram
from lavender.external.running import Answer, BackendFailed, Limits
from lavender.judge.solution import Status

#: Fields of `running.Answer`, in the order in which they are sent.
ANSWER_ARRAYS = ("x", "lam")
MAX_BACKEND_MESSAGE_LENGTH = 500  # [characters] Longer messages of backends are cut.
STOPPABLE_LIMIT_RATIO = 2.0  # A backend that accepts a time limit is killed after this multiple of its limit.
CPU_TIME_MARGIN = (
    60.0  # [s] CPU time after the limit of a call, at which the system kills a process without parent.
)

Start = tuple[FloatArray, FloatArray] | None  # x and multipliers, in scaled units.

#: Running processes without a current call. A thread removes a process from the list before it uses it.
idle_processes: list[ProcessBackend] = []


def start_process(backend: Backend) -> None:
    """Start a process that has imported the backend's code, before the clock of a time limit starts."""
    process = _take_idle_process() or ProcessBackend(run_backend)
    with suppress(ProcessEnded):  # If the system starts no process, the backend runs in this one.
        process.start()
        # The later call of the backend raises these errors.
        with suppress(TimeoutError, InvalidAnswer, RemoteError):
            process.call_function(backend, timeout=subprocesses.START_TIMEOUT, max_bytes=0)
        idle_processes.append(process)


class IsolatedBackend:
    """Runs a backend under a time limit in another process, or in this one if the system starts none."""

    def __init__(self, backend: Backend) -> None:
        self.backend = backend
        self.manner = "to its end"

    def __call__(
        self, program: ScaledProgram, start: Start, limit: Limits, settings: dict[str, Any]
    ) -> Answer:
        answer = call_backend(self.backend, program, start, limit, settings)
        if answer is None:
            return self.backend.run(program, start, limit, settings)
        self.manner = "in a separate process"
        return answer


def call_backend(
    backend: Backend, program: ScaledProgram, start: Start, limit: Limits, settings: dict[str, Any]
) -> Answer | None:
    """Run the backend in another process, which is killed at the time limit; None if no process is ready.

    Raises
    ------
    InputError
        The backend has no such setting, or a setting cannot be pickled.
    BackendFailed
        The backend raised an exception, or its process died.
    """
    assert limit.time_limit is not None
    process = _take_idle_process()
    if process is None:
        return None
    try:
        fields, arrays = process.call_function(
            backend,
            program,
            start,
            limit,
            settings,
            timeout=limit.time_limit * (STOPPABLE_LIMIT_RATIO if backend.stoppable else 1.0),
            max_bytes=8 * (program.n + len(program.t)),
        )
    except TimeoutError:
        return Answer(Status.TIME_LIMIT, "ended at the time limit")
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        idle_processes.append(process)
        raise InputError(
            f"settings cannot be sent to the process that runs the backend ({error}); plain numbers and "
            "texts are needed, or isolate=False, which runs the backend in this process"
        ) from None
    except ProcessEnded as error:
        raise BackendFailed(f"the process of the backend died ({error})") from None
    except InvalidAnswer as error:
        raise BackendFailed(f"the process of the backend sent an invalid answer ({error})") from None
    except RemoteError as error:
        idle_processes.append(process)
        is_input = error.kind == "InputError"
        raise (InputError(str(error)) if is_input else BackendFailed(f"{error.kind}: {error}")) from None
    idle_processes.append(process)
    try:  # The answer may be invalid, since the backend's code can write to the process's output.
        work = {str(kind): int(count) for kind, count in fields["work"].items()}
        by_name = dict(zip(ANSWER_ARRAYS, arrays, strict=True))
        return Answer(status=Status[fields["status"]], message=str(fields["message"]), work=work, **by_name)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise BackendFailed(f"the process of the backend sent an invalid answer ({error})") from None


def _take_idle_process() -> ProcessBackend | None:
    """Return a running process without a call, or None."""
    while True:
        try:
            process = idle_processes.pop()
        except IndexError:
            return None
        if process.is_alive:
            return process
        process.close()


@atexit.register
def _close_idle_processes() -> None:
    while idle_processes:
        idle_processes.pop().close()


# A forked process must not use its parent's processes. Windows has no fork.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=idle_processes.clear)


# -- in the other process -----------------------------------------------------------------------------

_warmed_up: set[str] = set()  # Names of the backends that were warmed up.


def run_backend(
    backend: Backend,
    program: ScaledProgram | None = None,
    start: Start = None,
    limit: Limits | None = None,
    settings: dict[str, Any] | None = None,
) -> subprocesses.Answer:
    """Run a backend. Without a program, solve a tiny one, so that the backend imports all of its code."""
    if program is None or limit is None or settings is None:
        if backend.name not in _warmed_up:
            _warmed_up.add(backend.name)
            with suppress(Exception):
                one = np.array([0, 1], np.int32), np.zeros(1, np.int32), np.ones(1)
                tiny = ScaledProgram(
                    P=one, q=-np.ones(1), J=one, t=np.zeros(1), free=0, variable=np.zeros(1, np.int32)
                )
                backend.run(tiny, None, Limits(1e-3, 1e-3, 100, None), {})
        return {}, ()
    cores = os.cpu_count() or 1  # Some backends compute on all cores.
    subprocesses.limit_cpu_time(cores * STOPPABLE_LIMIT_RATIO * (limit.time_limit or 0.0) + CPU_TIME_MARGIN)
    answer = backend.run(program, start, limit, settings)
    work = {str(kind): int(count) for kind, count in answer.work.items()}
    fields = {
        "status": answer.status.name,
        "message": answer.message[:MAX_BACKEND_MESSAGE_LENGTH],
        "work": work,
    }
    return fields, [getattr(answer, name) for name in ANSWER_ARRAYS]
