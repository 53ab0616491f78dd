"""Run backends in other processes, which later calls reuse and which are killed at the time limit.

Backends that have a time limit of their own get it, so that their process survives it, and are killed later.
"""

from __future__ import annotations

import atexit
import os
import pickle
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.base.subprocesses import START_TIMEOUT, ProcessBackend, ProcessEnded, RemoteError
from lavender.external.backend import Backend
from lavender.external.convex import ScaledProgram
from lavender.external.running import Answer, BackendFailed, Limits
from lavender.judge.solution import Status

# A backend with a time limit of its own is killed after this multiple of its limit, and at least this time [s] later:
# some read the clock only every few seconds, and its answer needs time to return.
STOPPABLE_LIMIT_RATIO, MIN_STOPPABLE_TIME = 2.0, 0.1

Start = tuple[FloatArray, FloatArray] | None  # x and multipliers, in scaled units.

idle_processes: list[ProcessBackend] = []  # Processes without a current call.


@contextmanager
def _take_process() -> Iterator[ProcessBackend]:
    """Yield a process without a current call."""
    try:
        process = idle_processes.pop()
    except IndexError:
        process = ProcessBackend()
    try:
        yield process
    finally:
        idle_processes.append(process)


def start_process(backend: Backend) -> None:
    """Start a process that has imported the backend's code, before the clock of a time limit starts."""
    # The later call of the backend raises these errors.
    with suppress(TimeoutError, ProcessEnded, RemoteError), _take_process() as process:
        process.call_function(warm_up, backend, timeout=START_TIMEOUT)


def run_isolated(
    backend: Backend, program: ScaledProgram, start: Start, limit: Limits, settings: dict[str, Any]
) -> Answer:
    """Run the backend in another process, which is killed at the time limit."""
    timeout = limit.time_limit
    if timeout is not None and backend.stoppable:
        timeout = max(STOPPABLE_LIMIT_RATIO * timeout, timeout + MIN_STOPPABLE_TIME)
    try:
        with _take_process() as process:
            answer: Answer = process.call_function(
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
    except ProcessEnded as error:
        raise BackendFailed(f"the process of the backend died ({error})") from None
    except RemoteError as error:
        is_input = error.kind == "InputError"
        raise (InputError(str(error)) if is_input else BackendFailed(f"{error.kind}: {error}")) from None


@atexit.register
def _close_idle_processes() -> None:
    while idle_processes:
        idle_processes.pop().close()


# A forked process must not use its parent's processes. Windows has no fork.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=idle_processes.clear)


# -- in the other process -----------------------------------------------------------------------------

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
