"""What every adapter shares: one call of a backend, and how its answer becomes a claim."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline
from lavender.base.errors import InputError
from lavender.external.as_qp import QP, target
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import quick
from lavender.judge.solution import Claim, Status, summed
from lavender.problem import Problem
from lavender.solvers.certify import check_infeasible

EPS_MIN = 1e-14  # Smallest tolerance passed to a backend; its own arithmetic stops there.
GAP_MIN = 1e-18
# Of the objective: what the sums of a gap lose to rounding at a large mass ratio; and when asked again.
GAP_RELATIVE, GAP_RELATIVE_MIN = 1e-13, 1e-16
OUT_OF_BUDGET = (Status.MAX_ITERATIONS, Status.TIME_LIMIT, Status.INTERRUPTED)
LEFT = 1e-8  # relative residual that a gap of GAP_RELATIVE_MIN may leave, as its root


@dataclass(frozen=True)
class Limits:
    """What one call may use; tolerances in the units of `QP`, absolute."""

    eps: float  # residual of stationarity and of the constraints
    gap: float  # difference of objectives
    gap_relative: float  # the same, of the objective; either will do
    max_iter: int
    time_limit: float | None  # s
    repeated: bool = False  # the judge did not accept the answer of a call before


@dataclass(frozen=True)
class Answer:
    """What a backend returned; arrays None where it gave none."""

    status: Status
    words: str  # the backend's own
    x: FloatArray | None = None  # (n,)
    zeta: FloatArray | None = None  # (r,) multipliers of the rows
    xi: FloatArray | None = None  # (n,) of the bounds, or (0,) where there are none
    work: Mapping[str, int] = field(default_factory=dict)
    direction: FloatArray | None = None  # of an unbounded x
    contradiction: FloatArray | None = None  # multipliers that prove the rows contradict each other


def at_least(limit: float, least: float) -> float:
    """A tolerance that a backend takes: not below `least`, not above 1e-2."""
    return min(max(limit, least), 1e-2)


def proof(
    qp: QP, x: FloatArray | None, zeta: FloatArray | None
) -> tuple[FloatArray | None, FloatArray | None]:
    """The iterate as a certificate, where it is one: backends without a field for it return it as iterate."""
    y = qp.direction(x, zeta)
    return (x, zeta) if y is not None and check_certificate(qp.problem, y) is None else (None, None)


def set_all(target: Any, settings: Mapping[str, Any], name: str) -> None:
    """Put settings on an object of the backend `name`; InputError for one that it does not have."""
    for key, value in settings.items():
        if not hasattr(target, key):
            known = sorted(k for k in dir(target) if not k.startswith("_"))
            raise InputError(f"{name} has no setting {key!r}; known: {', '.join(known)}")
        setattr(target, key, value)


def certificate(y: Any, size: int) -> FloatArray | None:
    """A proof of infeasibility as the backend gave it, where it is one by its shape."""
    if y is None or np.size(y) != size or not np.isfinite(y).all() or not np.any(y):
        return None
    return np.array(y, float)


Call = Callable[[QP, FloatArray, Limits, dict[str, Any]], Answer]


class Failed(Exception):
    """A backend failed in a process of its own; the text says how."""


def ask(
    qp: QP,
    impulse: FloatArray,
    call: Call,
    max_iter: int,
    tol: float,
    time_limit: float | None,
    settings: Mapping[str, Any],
    noisy: bool,
) -> Claim:
    """Run the backend and write its iterate to `impulse`, or leave the start point and say why.

    A backend that says it is done where the judge does not find `tol` is asked again, 100 times more
    closely, at most three times in all: its tests are not the judge's. The answer with the smallest residual is kept
    with its claim, whatever later calls end with, unless a later one proves that there is no solution. An
    interior-point method leaves sqrt(x w) on a row where impulse and slack both vanish, so its gap falls towards eps^2.
    """
    problem, deadline = qp.problem, Deadline(time_limit)
    start, best = impulse.copy(), None
    work: dict[str, int] = {"backend_calls": 0}
    w, e = np.empty(problem.m), np.empty(problem.m)
    if tol > 0.0 and quick(problem, impulse, w, e)[0] == 0.0:
        return Claim(Status.CONVERGED, 0, work, "the start is a solution", qp.form)
    limits = _levels(problem, tol, max_iter, time_limit)
    while limits:
        last = _once(qp, impulse, call, limits.pop(0), settings, noisy)
        work = summed((work, last.work))
        relative, above = quick(problem, impulse, w, e, floor=True)
        if best is None or relative < best[0]:
            best = (relative, last, impulse.copy(), above)
        left = max_iter - work.get("iterations", 0)
        if (
            last.status is not Status.CONVERGED
            or above <= tol
            or left <= 0
            or deadline.passed()
            or np.any(e[qp.assumed] != 0.0)  # another program is to be solved
        ):
            break
        limits = [
            replace(level, max_iter=left, time_limit=deadline.remaining(), repeated=True) for level in limits
        ]
        if limits:
            impulse[:] = start
    assert best is not None
    # A program keeps the answer that it has: `auto` would call this backend again to check the claim.
    if last is not best[1] and last.status is Status.INFEASIBLE and qp.form != "program":
        infeasible, proved, _ = check_infeasible(problem, last, tol, deadline)
        if proved:
            return replace(infeasible, work=work, iterations=work.get("iterations", 0))
    relative, claim, impulse[:], above = best
    status, words = claim.status, claim.message
    if last is not claim and last.status is not Status.CONVERGED and relative > tol:
        # The best answer and its own claim are kept: a stricter call that fails says nothing about that answer.
        status = last.status if last.status in OUT_OF_BUDGET else Status.STALLED
        words = f"{words}; asked more closely: {last.message}"
    if status is Status.NUMERICAL_ERROR and claim.dual is not None and relative <= tol:
        # It broke down, in its own words, after it had got there.
        status = Status.STALLED
    if tol == 0.0 and status is Status.CONVERGED:
        status, words = Status.STALLED, f"{words}; tol=0: ran at its tightest tolerance"
    elif status is Status.CONVERGED and relative > tol and not above <= tol:
        # Its tests are of other norms: it says nothing false where it could not be asked more closely.
        if limits:
            status = Status.TIME_LIMIT if deadline.passed() else Status.MAX_ITERATIONS
            words = f"{words}; nothing was left to ask more closely"
        elif relative <= LEFT:
            status, words = Status.STALLED, f"{words}; its own tests were met at their tightest"
    done = work.get("iterations", 0)
    if done > max_iter:
        words = f"{words}; {done} iterations, where {max_iter} were asked for at most"
    return replace(claim, status=status, message=words, work=work, iterations=done)


def _levels(problem: Problem, tol: float, max_iter: int, time_limit: float | None) -> list[Limits]:
    """What is asked for first, and then more closely."""
    eps = max(0.5 * target(problem, tol), EPS_MIN)
    # Unknowns are near 1, so objectives lie between 1 and m: a gap below 1e-13 is often lost in its own sums.
    levels = [
        (eps, 1e-2 * eps, GAP_RELATIVE),
        (max(1e-2 * eps, EPS_MIN), max(1e-5 * eps, 1e-13), 1e-2 * GAP_RELATIVE),
        (max(1e-4 * eps, EPS_MIN), max(1e-2 * eps * eps, GAP_MIN), GAP_RELATIVE_MIN),
    ]
    return [Limits(*level, max_iter, time_limit) for level in (levels[-1:] if tol == 0.0 else levels)]


def _once(
    qp: QP, impulse: FloatArray, call: Call, limit: Limits, settings: Mapping[str, Any], noisy: bool
) -> Claim:
    try:
        with quiet(noisy) as said:
            answer = call(qp, impulse, limit, dict(settings))
    except (KeyboardInterrupt, SystemExit, GeneratorExit, InputError):
        raise
    except Failed as failure:
        words = f"{failure}; start point returned"
        return Claim(Status.NUMERICAL_ERROR, 0, {"backend_calls": 1}, words, qp.form)
    except BaseException as error:  # a backend may fail in any way; a panic of Rust is no Exception
        words = f"{type(error).__name__}: {error}; start point returned"
        return Claim(Status.NUMERICAL_ERROR, 0, {"backend_calls": 1}, words, qp.form)
    status, words = answer.status, answer.words or "; ".join(said)
    work = {"backend_calls": 1, **{k: int(v) for k, v in answer.work.items()}}
    certificate = None
    if status is Status.INFEASIBLE:
        certificate = qp.direction(answer.direction, answer.contradiction)
    x, zeta = answer.x, answer.zeta
    unknown = np.full(qp.n, 0.0 if qp.lb is None else np.nan)
    xi = answer.xi if answer.xi is not None and len(answer.xi) == qp.n else unknown
    found = x is not None and len(x) == qp.n and bool(np.isfinite(x).all())
    if qp.form != "impulse":
        found = found and zeta is not None and len(zeta) == len(qp.b) and bool(np.isfinite(zeta).all())
    dual, lam = None, impulse
    if found:
        assert x is not None
        lam = qp.impulse(x, np.zeros(0) if zeta is None else zeta, xi)
        found = bool(np.isfinite(lam).all())
    if found and status is not Status.INFEASIBLE:
        assert x is not None
        impulse[:] = lam
        dual = qp.multiplier(x, xi)
    elif status is not Status.INFEASIBLE:
        if status not in (Status.TIME_LIMIT, Status.INTERRUPTED):
            status = Status.NUMERICAL_ERROR
        words = f"{words}; no iterate, start point returned".removeprefix("; ")
    return Claim(
        status=status,
        iterations=work.get("iterations", 0),
        work=work,
        message=words,
        form=qp.form,
        dual=dual,
        certificate=certificate,
    )


@contextlib.contextmanager
def quiet(noisy: bool) -> Iterator[list[str]]:
    """Collect the warnings of a backend and swallow what it writes to sys.stdout and sys.stderr, in this thread alone.

    With `noisy` also what compiled code prints: that needs the file descriptors of the whole process,
    so only backends known to print pay for it.
    """
    said: list[str] = []
    with _by_thread, _nowhere if noisy else contextlib.nullcontext():
        outer, _here.said, _here.printed = (_here.said, _here.printed), said, io.StringIO()
        try:
            yield said
        finally:
            _here.said, _here.printed = outer


class _Here(threading.local):
    """Where words of this thread go while it runs a backend; None while it runs none."""

    said: list[str] | None = None
    printed: io.StringIO | None = None


_here = _Here()


class _Stream:
    """Stands for sys.stdout or sys.stderr: the stream itself for threads that run no backend."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream if _here.printed is None else _here.printed, name)


class _Shared:
    """A context of the whole process: the first thread enters it, the last one leaves it."""

    def __init__(self, make: Callable[[], contextlib.AbstractContextManager[None]]) -> None:
        self._make, self._lock, self._inside = make, threading.Lock(), 0
        if hasattr(os, "register_at_fork"):  # not on Windows
            os.register_at_fork(
                before=self._lock.acquire, after_in_parent=self._lock.release, after_in_child=self._forked
            )

    def _forked(self) -> None:
        if self._inside and _here.printed is None:  # of threads that the child does not have
            self._inside = 0
            self._context.__exit__(None, None, None)
        self._lock.release()

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._context = self._make()
                self._context.__enter__()
            self._inside += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._context.__exit__(None, None, None)


@contextlib.contextmanager
def _words_by_thread() -> Iterator[None]:
    with (
        warnings.catch_warnings(),
        contextlib.redirect_stdout(_Stream(sys.stdout)),
        contextlib.redirect_stderr(_Stream(sys.stderr)),
    ):
        show = warnings.showwarning

        def hear(message: Warning | str, category: type[Warning], *where: Any) -> None:
            if _here.said is None:
                show(message, category, *where)
            elif not issubclass(category, DeprecationWarning):
                _here.said.append(str(message).strip())

        warnings.showwarning = hear  # type: ignore[assignment]
        warnings.simplefilter("always")
        yield


@contextlib.contextmanager
def _descriptors_to_null() -> Iterator[None]:
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


_by_thread, _nowhere = _Shared(_words_by_thread), _Shared(_descriptors_to_null)
