"""Call a backend on a scaled program, at most twice, and keep the best point."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline
from lavender.base.errors import InputError
from lavender.judge.solution import Status, sum_work_counts
from lavender.programs.convex import ConvexProgram, ScaledProgram

FIRST_TOLERANCE, SECOND_TOLERANCE = (
    1e-3,
    1e-5,
)  # [-] Tolerances of the two calls, as multiples of tol.
MIN_TOLERANCES = (
    1e-11,
    1e-12,
)  # Smallest tolerances of the two calls: rounding prevents smaller residuals.
# Gap of the second call: an interior-point method leaves an error of the square root of the gap on a row on which
# multiplier and slack vanish together.
SECOND_GAP = 1e-16
# Most iterations of an interior-point method in the first call, and by how many the second call may exceed the first.
MAX_INTERIOR_ITERATIONS, MORE_INTERIOR_ITERATIONS = 100, 15
OUT_OF_BUDGET = (Status.MAX_ITERATIONS, Status.TIME_LIMIT, Status.INTERRUPTED)
# No second call follows, except after a claim of infeasibility that its multipliers contradict.
FINAL = (Status.TIME_LIMIT, Status.INTERRUPTED, Status.INFEASIBLE)


@dataclass(frozen=True)
class Limits:
    """Tolerance and limits of one call."""

    eps: float  # Residual of stationarity and of the constraints, in scaled units.
    gap: float  # Gap of the primal and dual objectives, absolute and relative.
    max_iter: int
    time_limit: float | None  # [s]
    attempt: int = 0  # 0 in the first call, 1 in the second.


@dataclass(frozen=True)
class Answer:
    """Result of one call of a backend, in the units of the scaled program."""

    status: Status
    message: str  # The backend's own text.
    # (n,), (m,) or None: point and multipliers of the rows. With INFEASIBLE, they may be a direction in which the
    # objective is unbounded, or multipliers that prove that the rows contradict each other.
    x: FloatArray | None = None
    lam: FloatArray | None = None
    work: Mapping[str, int] = field(default_factory=dict)  # mapping of str to int


@dataclass
class BackendResult:
    """Result of all calls: the claim of the call with the best point, and the work of all."""

    status: Status
    message: str
    work: dict[str, int]
    point: tuple[FloatArray, FloatArray] | None = (
        None  # x and multipliers; with INFEASIBLE, perhaps proofs.
    )
    shift: float = 0.0  # Number that was added to the diagonal of the scaled P.

    @property
    def iterations(self) -> int:
        """Number of iterations of all calls; 0 if the backend does not report it."""
        return self.work.get("iterations", 0)


class PointJudge(Protocol):
    """Measures points of a program and keeps the best."""

    def accepts(self, x: FloatArray, lam: FloatArray, is_last: bool) -> bool:
        """Measure a point; return whether the best point so far meets tol. A call follows unless `is_last`."""
        ...


Call = Callable[
    [ScaledProgram, "tuple[FloatArray, FloatArray] | None", Limits, "dict[str, Any]"], Answer
]


class BackendFailed(Exception):
    """A backend failed in another process; the message describes the failure."""


def call_backend_until_accepted(
    program: ConvexProgram,
    judge: PointJudge,
    call: Call,
    *,
    max_iter: int,
    tol: float,
    deadline: Deadline,
    settings: Mapping[str, Any],
    call_iterations: int = 2**31,
    first_tolerance: float = FIRST_TOLERANCE,
    start: tuple[FloatArray, FloatArray] | None = None,
    needs_definite: bool = False,
    interior: bool = False,
) -> BackendResult:
    """Call the backend, and once more with a smaller tolerance and all rows unless the judge accepts its point.

    The second call has the size of the first call's x as unit. `max_iter` limits the iterations of both calls,
    `call_iterations` the iterations of the first one; `first_tolerance` is the tolerance of the first call as a
    multiple of tol; `interior` states that the backend is an interior-point method, whose iterations hardly depend on
    the program and the tolerance; `settings` are additional options of the backend; `start` is (x, lam);
    `needs_definite` states that the backend needs a positive definite P.
    """
    best: BackendResult | None = None
    work: dict[str, int] = {"backend_calls": 0}
    if max_iter == 0:  # Some backends return a point that they never wrote.
        return BackendResult(Status.MAX_ITERATIONS, "the backend was not called", work)
    for attempt, min_eps in enumerate(MIN_TOLERANCES):
        if best is not None and best.point is not None:
            program = program.resize(best.point[0])
        scaled = program.scaled if attempt else program.scaled.without_far_rows()
        if needs_definite:
            scaled = scaled.make_definite(attempt)
        if not scaled.is_representable:
            message = "the scaled program has numbers that overflow; the backend was not called"
            return best or BackendResult(Status.NUMERICAL_ERROR, message, work)
        eps = min(max((SECOND_TOLERANCE if attempt else first_tolerance) * tol, min_eps), 1e-2)
        gap = SECOND_GAP if attempt else eps
        left = max_iter - work.get("iterations", 0)
        if not attempt:
            left = min(
                left, call_iterations, MAX_INTERIOR_ITERATIONS if interior else call_iterations
            )
        elif interior:
            left = min(left, work.get("iterations", left) + MORE_INTERIOR_ITERATIONS)
        limits = Limits(eps, gap, left, deadline.get_remaining_seconds(1e-6), attempt)
        begin = None if start is None else program.scale_point(*start)
        answer = _call_backend_once(scaled, begin, call, limits, dict(settings))
        work = sum_work_counts((work, {"backend_calls": 1}, answer.work))
        message = answer.message
        if scaled.shift:
            message += (
                f"; {scaled.shift:.1g} was added to the diagonal of the singular P, in scaled units"
            )
        result = BackendResult(answer.status, message, work, shift=scaled.shift)
        accepted = is_unfounded = False
        if answer.status is Status.INFEASIBLE:
            is_unfounded = not attempt and not scaled.is_nearly_proven_unsolvable(
                answer.x, answer.lam
            )
        if answer.x is not None and answer.lam is not None:
            point = program.restore_point(answer.x, answer.lam)
            result.point = point
            accepted = not is_unfounded and judge.accepts(*point, attempt > 0)
        is_better = (
            best is None or accepted or best.status in (Status.NUMERICAL_ERROR, Status.TIME_LIMIT)
        )
        if is_better or answer.status in OUT_OF_BUDGET:
            best = result
        assert best is not None
        best.work = work
        used = work.get("iterations", 0)
        is_last = (
            used >= max_iter
            or deadline.has_passed()
            or (answer.status in FINAL and not is_unfounded)
        )
        # A limit of iterations in `settings` ends both calls.
        if accepted or is_last or (answer.status is Status.MAX_ITERATIONS and used < left):
            break
    assert best is not None
    if best.iterations > max_iter:
        best.message = (
            f"{best.message}; {best.iterations} iterations, more than the limit of {max_iter}"
        )
    return best


def _call_backend_once(
    scaled: ScaledProgram,
    start: tuple[FloatArray, FloatArray] | None,
    call: Call,
    limits: Limits,
    settings: dict[str, Any],
) -> Answer:
    """Run the backend once; return a failure as an answer of status NUMERICAL_ERROR, and an invalid point as None."""
    try:
        answer = call(scaled, start, limits, settings)
    except (KeyboardInterrupt, SystemExit, GeneratorExit, InputError):
        raise
    except BackendFailed as failure:
        return Answer(Status.NUMERICAL_ERROR, str(failure))
    except (
        BaseException
    ) as error:  # A backend may raise anything; a panic of Rust is not an Exception.
        return Answer(Status.NUMERICAL_ERROR, f"{type(error).__name__}: {error}")
    x, lam = answer.x, answer.lam
    is_valid = x is not None and len(x) == scaled.n and bool(np.isfinite(x).all())
    if is_valid and lam is not None and len(lam) == len(scaled.t):
        return answer
    status = answer.status
    message = f"{answer.message}; no iterate".removeprefix("; ")
    if status not in (Status.INFEASIBLE, Status.TIME_LIMIT, Status.INTERRUPTED):
        status = Status.NUMERICAL_ERROR
    return Answer(status, message, work=answer.work)


def classify_status(text: str) -> Status:
    """Return the status that a backend's text for it means."""
    text = text.lower().replace("_", " ")
    if text in ("solved", "optimal"):
        return Status.CONVERGED
    for status, words in (
        (Status.INTERRUPTED, ("interrupted",)),
        (Status.TIME_LIMIT, ("time",)),
        (Status.MAX_ITERATIONS, ("iter",)),
        (Status.STALLED, ("almost", "inaccurate", "insufficient", "unknown")),
        (Status.INFEASIBLE, ("infeas", "unbounded")),
    ):
        if any(word in text for word in words):
            return status
    return Status.NUMERICAL_ERROR


class _SharedContext:
    """A context manager of the whole process: the first thread that needs it enters it, and the last leaves it."""

    def __init__(self, make_context: Callable[[], contextlib.AbstractContextManager[Any]]) -> None:
        self._make_context = make_context
        self._lock = threading.Lock()
        self._n_threads = 0

    def __enter__(self) -> None:
        with self._lock:
            if self._n_threads == 0:
                self._context = self._make_context()
                self._context.__enter__()
            self._n_threads += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._n_threads -= 1
            if self._n_threads == 0:
                self._context.__exit__(None, None, None)


class _IgnoredWarnings(warnings.catch_warnings):
    """A context in which warnings are ignored."""

    def __enter__(self) -> None:
        super().__enter__()
        warnings.simplefilter("ignore")


@contextlib.contextmanager
def _discard_output() -> Iterator[None]:
    """Redirect the file descriptors of standard output and error to the null device."""
    for stream in (sys.__stdout__, sys.__stderr__):
        if stream is not None:
            stream.flush()
    saved = [(fd, os.dup(fd)) for fd in (1, 2)]
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        for fd, _ in saved:
            os.dup2(null, fd)
        yield
    finally:
        for fd, copy in saved:
            os.dup2(copy, fd)
            os.close(copy)
        os.close(null)


_without_warnings, _without_output = (
    _SharedContext(_IgnoredWarnings),
    _SharedContext(_discard_output),
)


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    with _without_warnings, _without_output:
        yield


def quiet(noisy: bool) -> contextlib.AbstractContextManager[None]:
    """Ignore the warnings of a backend and, if it is `noisy`, discard all output of the process while it runs."""
    return _silence() if noisy else _without_warnings
