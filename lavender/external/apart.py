"""Backends under a time limit, in processes of their own that are kept from call to call.

A process that has not answered when the time is up is ended, and the next call finds another. Backends that take a
limit are told it and have as long again to answer with what they have; some look at the clock seconds apart. Answers
are data (`lavender.base.apart`): nothing that a backend sends is unpickled here.
"""

from __future__ import annotations

import atexit
import os
import pickle
from contextlib import suppress
from threading import Lock
from typing import Any

from lavender.base.apart.process import START_TIME, Ended, NoAnswer, Process, Raised
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.external.as_qp import QP
from lavender.external.backend import Backend
from lavender.external.running import Answer, Failed, Limits
from lavender.judge.solution import Status

SERVED = "lavender.external.backends"  # the other side: its `serve`
ARRAYS = ("x", "zeta", "xi", "direction", "contradiction")  # of an answer, in the order they are sent
WORDS = 500  # characters of what a backend said
GRACE = 2.0  # limits after which a backend that was told its own is ended
ENTRY = 12.0  # bytes of an entry of a program
HAND_OVER = 3e8  # bytes in a second that go to another process: pickled, through a pipe, and back into arrays

_lock = Lock()
idle: list[Process] = []  # started, and not asked anything
_owner = 0  # id of the process that started them: a fork's copies are not its own


def ready(name: str) -> None:
    """Have a process ready that solved by the backend of that name before, outside the clock.

    Where the system starts none, the backend runs here.
    """
    process = _take() or Process(SERVED)
    if not process.start():
        with suppress(TimeoutError, Ended, NoAnswer, Raised):  # the call itself will tell
            process.ask([name], START_TIME, 0)
        _keep(process)


class Elsewhere:
    """Runs a backend within a limit in a process of its own, or here where the system starts none."""

    def __init__(self, backend: Backend) -> None:
        self.backend = backend
        self.where = "to its end"

    def __call__(self, qp: QP, impulse: FloatArray, limit: Limits, settings: dict[str, Any]) -> Answer:
        backend = self.backend
        found = call(backend.name, GRACE if backend.stoppable else 1.0, qp, impulse, limit, settings)
        if found is None:
            return backend.run(qp, impulse, limit, settings)
        self.where = "in a process of its own"
        return found


def call(
    name: str, patience: float, qp: QP, impulse: FloatArray, limit: Limits, settings: dict[str, Any]
) -> Answer | None:
    """One run of the backend of that name, ended after `patience` times `limit.time_limit`; None without a process.

    Raises
    ------
    InputError
        Settings that the backend does not know, or that cannot be sent.
    Failed
        The backend raised something, or its process died.
    """
    assert limit.time_limit is not None
    if qp.nbytes > HAND_OVER * limit.time_limit:
        return Answer(
            Status.TIME_LIMIT, "ended at the time limit: to hand the program over would take longer"
        )
    process = _take()
    if process is None:
        return None
    try:
        found = process.ask(
            [(name, qp, impulse, limit, settings)],
            patience * limit.time_limit,
            8 * (4 * qp.n + 2 * len(qp.b)),
        )
    except TimeoutError:
        return Answer(Status.TIME_LIMIT, "ended at the time limit")
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        _keep(process)
        raise InputError(
            f"settings cannot be sent to another process ({error}); isolate=False runs the backend in this one"
        ) from None
    except Ended as end:
        raise Failed(f"the process of the backend died ({end})") from None
    except NoAnswer as error:
        raise Failed(f"the process of the backend sent what is no answer ({error})") from None
    except Raised as error:
        _keep(process)
        raise (
            InputError(str(error)) if error.kind == "InputError" else Failed(f"{error.kind}: {error}")
        ) from None
    _keep(process)
    return _answer(*found)


def _answer(said: dict[str, Any], arrays: list[Any]) -> Answer:
    # Every part is checked: a backend may have written anything.
    try:
        work = {str(kind): int(count) for kind, count in said["work"].items()}
        found = dict(zip(ARRAYS, arrays, strict=True))
        return Answer(status=Status[said["status"]], words=str(said["words"]), work=work, **found)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise Failed(f"the process of the backend sent what is no answer ({error})") from None


def _take() -> Process | None:
    global _owner
    with _lock:
        if _owner != os.getpid():
            idle.clear()
            _owner = os.getpid()
        while idle:
            process = idle.pop()
            if process.alive:
                return process
            process.end()
    return None


def _keep(process: Process) -> None:
    with _lock:
        idle.append(process)


@atexit.register
def _end() -> None:
    if _owner == os.getpid():
        while idle:
            idle.pop().end()
