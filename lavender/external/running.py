"""Call a backend, with stricter tolerances if needed, and convert its answer to a claim."""

from __future__ import annotations

import contextlib
import io
import itertools
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
from lavender.external.as_qp import QP, compute_backend_tolerance
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import compute_stopping_residual
from lavender.judge.solution import Claim, Status, sum_work_counts
from lavender.problem import Problem
from lavender.solvers.certify import check_infeasibility_claim

# Smallest tolerance passed to a backend; rounding in its arithmetic prevents smaller residuals.
MIN_TOLERANCE = 1e-14
MIN_GAP = 1e-18  # Smallest absolute gap of objectives passed to a backend.
# Gap relative to the objective in the first call: at large mass ratios, rounding of the sums causes about as much.
MAX_RELATIVE_GAP = 1e-13
MIN_RELATIVE_GAP = 1e-16  # Gap relative to the objective in the last, strictest call.
OUT_OF_BUDGET = (Status.MAX_ITERATIONS, Status.TIME_LIMIT, Status.INTERRUPTED)
MAX_LOOSE_RATIO = 100.0  # A claim at the tolerances tol is not called false up to this multiple of tol.
MAX_GAP_RESIDUAL = 1e-8  # Relative residual that a gap of MIN_RELATIVE_GAP can cause: its square root.


@dataclass(frozen=True)
class Limits:
    """Tolerances and limits of one call. Tolerances are absolute, in the units of `QP`.

    Parameters
    ----------
    eps : float
        Residual of stationarity and of the constraints.
    gap : float
        Difference of the primal and dual objectives.
    gap_relative : float
        Difference of the objectives relative to the objective. A backend may stop if either gap is reached.
    max_iter : int
    time_limit : float or None, s
    attempt : int
        Number of earlier calls with answers that the judge did not accept.
    """

    eps: float
    gap: float
    gap_relative: float
    max_iter: int
    time_limit: float | None
    attempt: int = 0


@dataclass(frozen=True)
class Answer:
    """Result of one call of a backend. Arrays that it did not return are None.

    Parameters
    ----------
    status : Status
    message : str
        The backend's own text.
    x : (n,)
    zeta : (r,)
        Multipliers of the rows.
    xi : (n,)
        Multipliers of the bounds; (0,) if there are none.
    work : mapping of str to int
    direction : (n,)
        Direction in which the objective is unbounded.
    contradiction : (r,)
        Multipliers that prove that the rows contradict each other.
    """

    status: Status
    message: str
    x: FloatArray | None = None
    zeta: FloatArray | None = None
    xi: FloatArray | None = None
    work: Mapping[str, int] = field(default_factory=dict)
    direction: FloatArray | None = None
    contradiction: FloatArray | None = None


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


def clamp_tolerance(tolerance: float, minimum: float) -> float:
    """Limit a tolerance to the range from `minimum` to 1e-2."""
    return min(max(tolerance, minimum), 1e-2)


def keep_if_infeasibility_certificate(
    qp: QP, x: FloatArray | None, zeta: FloatArray | None
) -> tuple[FloatArray | None, FloatArray | None]:
    """Return (x, zeta) if the iterate is a certificate of infeasibility, else (None, None).

    Some backends return a certificate as their iterate.
    """
    y = qp.recover_certificate(x, zeta)
    return (x, zeta) if y is not None and check_certificate(qp.problem, y) is None else (None, None)


def set_backend_options(options: Any, settings: Mapping[str, Any], name: str) -> None:
    """Set attributes of the options object of the backend `name`; raise InputError for unknown ones."""
    for key, value in settings.items():
        if not hasattr(options, key):
            known = sorted(k for k in dir(options) if not k.startswith("_"))
            raise InputError(f"{name} has no setting {key!r}; known: {', '.join(known)}")
        setattr(options, key, value)


def copy_usable_certificate(y: Any, size: int) -> FloatArray | None:
    """Copy a backend's certificate of infeasibility; None if it has another size, is zero or is not finite."""
    if y is None or np.size(y) != size or not np.isfinite(y).all() or not np.any(y):
        return None
    return np.array(y, float)


Call = Callable[[QP, FloatArray, Limits, dict[str, Any]], Answer]


class BackendFailed(Exception):
    """A backend failed in another process; the message describes the failure."""


def call_backend_until_accepted(
    qp: QP,
    impulse: FloatArray,
    call: Call,
    max_iter: int,
    tol: float,
    time_limit: float | None,
    settings: Mapping[str, Any],
    noisy: bool,
) -> Claim:
    """Run the backend until the judge accepts its iterate, and write the best iterate to `impulse`.

    The stopping tests of backends differ from the judge's. If a backend claims convergence and the judge's residual is
    above `tol`, the backend is called again with 100 times smaller tolerances, up to three times in all. If it fails,
    it is called once with the tolerances `tol`, as a user would call it, because tolerances near rounding errors let
    some backends fail. The answer with the smallest residual and its claim are returned, unless a later call proves
    that no solution exists. If no call returns an iterate, `impulse` keeps the start point.

    An interior-point method leaves an error sqrt(x w) on a row with vanishing impulse x and slack w, so the tolerance
    of the gap decreases towards eps^2.

    Parameters
    ----------
    qp : QP
    impulse : (m,), N s
        Start point; overwritten.
    call : callable
        Function that runs the backend once.
    max_iter : int
        Limit of the iterations of all calls.
    tol : float, -
        Relative residual; 0 for one call with the smallest tolerances.
    time_limit : float or None, s
    settings : mapping
        Additional options of the backend.
    noisy : bool
        Whether the backend prints by compiled code.
    """
    problem, deadline = qp.problem, Deadline(time_limit)
    start, has_loosened = impulse.copy(), False
    best: tuple[float, Claim, FloatArray, float] | None = None
    work: dict[str, int] = {"backend_calls": 0}
    w, e = np.empty(problem.m), np.empty(problem.m)
    if tol > 0.0 and compute_stopping_residual(problem, impulse, w, e)[0] == 0.0:
        return Claim(Status.CONVERGED, 0, work, "the start is a solution", qp.form)
    levels = _make_levels(qp, tol)
    for attempt in itertools.count():
        remaining = max_iter - work.get("iterations", 0)
        limit = Limits(*levels.pop(0), remaining, deadline.get_remaining_seconds(), attempt)
        last = _call_backend_once(qp, impulse, call, limit, settings, noisy)
        work = sum_work_counts((work, last.work))
        relative, above = compute_stopping_residual(problem, impulse, w, e, floor=True)
        if best is None or relative < best[0]:
            best = (relative, last, impulse.copy(), above)
        if last.status is not Status.CONVERGED:
            has_loosened = attempt == 0 and tol > 0.0 and _has_failed(problem, last)
            levels = [(tol, tol, tol)] if has_loosened else []
        out_of_budget = work.get("iterations", 0) >= max_iter or deadline.has_passed()
        # If a row that was assumed at its bound leaves it, the caller solves a program with all rows.
        if above <= tol or not levels or out_of_budget or np.any(e[qp.assumed] != 0.0):
            break
        impulse[:] = start
    assert best is not None
    # Not in the program form: `check_infeasibility_claim` may run `auto`, which calls this backend again.
    if last is not best[1] and last.status is Status.INFEASIBLE and qp.form != "program":
        infeasible, proved, _ = check_infeasibility_claim(problem, last, tol, deadline)
        if proved:
            return replace(infeasible, work=work, iterations=work.get("iterations", 0))
    relative, claim, impulse[:], above = best
    status, message = claim.status, claim.message
    if status is Status.INFEASIBLE:
        return replace(claim, work=work, iterations=work.get("iterations", 0))
    if last is not claim and last.status is not Status.CONVERGED and relative > tol:
        # Return the best answer with its own claim: the failure of another call does not affect it.
        failed = Status.STALLED if status is Status.CONVERGED else status
        status = last.status if last.status in OUT_OF_BUDGET else failed
        message = f"{message}; with other tolerances: {last.message}"
    if status is Status.NUMERICAL_ERROR and claim.dual is not None and above <= tol:
        # The backend reports a failure, but its iterate is a solution.
        status = Status.STALLED
    if tol == 0.0 and status is Status.CONVERGED:
        status, message = Status.STALLED, f"{message}; tol=0: ran at its smallest tolerance"
    elif status is Status.CONVERGED and relative > tol and not above <= tol:
        # The backend's tests use other norms than the judge, so its claim is not false if no stricter call was
        # possible.
        if levels:
            status = Status.TIME_LIMIT if deadline.has_passed() else Status.MAX_ITERATIONS
            message = f"{message}; no iterations or time remained for stricter tolerances"
        elif relative <= MAX_GAP_RESIDUAL or (has_loosened and relative <= MAX_LOOSE_RATIO * tol):
            status, message = Status.STALLED, f"{message}; its own tests passed at the strictest tolerances"
        elif qp.shift_of_p:
            status = Status.STALLED
    if qp.shift_of_p:
        message = f"{message}; {qp.shift_of_p:g} was added to the diagonal of the singular P"
    iterations = work.get("iterations", 0)
    if iterations > max_iter:
        message = f"{message}; {iterations} iterations, more than the limit of {max_iter}"
    return replace(claim, status=status, message=message, work=work, iterations=iterations)


def _has_failed(problem: Problem, claim: Claim) -> bool:
    """Return whether a backend failed at its tolerances, or claims infeasibility without a valid certificate."""
    if claim.status is Status.INFEASIBLE:
        return claim.certificate is None or check_certificate(problem, claim.certificate) is not None
    return claim.status in (Status.STALLED, Status.NUMERICAL_ERROR)


def _make_levels(qp: QP, tol: float) -> list[tuple[float, float, float]]:
    """Return the tolerances `eps`, `gap` and `gap_relative` of the first call and of the stricter ones."""
    eps = max(0.5 * compute_backend_tolerance(qp, tol), MIN_TOLERANCE)
    # Unknowns are near 1, so objectives are between 1 and m, and rounding of their sums often exceeds a gap of 1e-13:
    # the first call does not require a smaller one.
    levels = [
        (eps, 1e-2 * eps, MAX_RELATIVE_GAP),
        (max(1e-2 * eps, MIN_TOLERANCE), max(1e-5 * eps, 1e-13), 1e-2 * MAX_RELATIVE_GAP),
        (max(1e-4 * eps, MIN_TOLERANCE), max(1e-2 * eps * eps, MIN_GAP), MIN_RELATIVE_GAP),
    ]
    return levels[-1:] if tol == 0.0 else levels


def _call_backend_once(
    qp: QP, impulse: FloatArray, call: Call, limit: Limits, settings: Mapping[str, Any], noisy: bool
) -> Claim:
    """Run the backend once, write its iterate to `impulse` if it is valid, and convert its answer to a claim."""
    try:
        with capture_backend_output(noisy) as warning_texts:
            answer = call(qp, impulse, limit, dict(settings))
    except (KeyboardInterrupt, SystemExit, GeneratorExit, InputError):
        raise
    except BackendFailed as failure:
        message = f"{failure}; start point returned"
        return Claim(Status.NUMERICAL_ERROR, 0, {"backend_calls": 1}, message, qp.form)
    except BaseException as error:  # A backend may raise anything; a panic of Rust is not an Exception.
        message = f"{type(error).__name__}: {error}; start point returned"
        return Claim(Status.NUMERICAL_ERROR, 0, {"backend_calls": 1}, message, qp.form)
    status, message = answer.status, answer.message or "; ".join(warning_texts)
    work = {"backend_calls": 1, **{k: int(v) for k, v in answer.work.items()}}
    certificate = None
    if status is Status.INFEASIBLE:
        certificate = qp.recover_certificate(answer.direction, answer.contradiction)
    x, zeta = answer.x, answer.zeta
    unknown = np.full(qp.n, 0.0 if qp.lb is None else np.nan)
    xi = answer.xi if answer.xi is not None and len(answer.xi) == qp.n else unknown
    is_valid = x is not None and len(x) == qp.n and bool(np.isfinite(x).all())
    if zeta is None or len(zeta) != len(qp.b):
        zeta = np.full(len(qp.b), np.nan)  # In the impulse form, impulses do not depend on multipliers.
    dual, lam = None, impulse
    if is_valid:
        assert x is not None
        lam = qp.recover_impulse(x, zeta, xi)
        is_valid = bool(np.isfinite(lam).all())
    if is_valid and status is not Status.INFEASIBLE:
        assert x is not None
        impulse[:] = lam
        dual = qp.recover_bound_multiplier(x, xi)
    elif status is not Status.INFEASIBLE:
        if status not in (Status.TIME_LIMIT, Status.INTERRUPTED):
            status = Status.NUMERICAL_ERROR
        message = f"{message}; no iterate, start point returned".removeprefix("; ")
    return Claim(
        status=status,
        iterations=work.get("iterations", 0),
        work=work,
        message=message,
        form=qp.form,
        dual=dual,
        certificate=certificate,
    )


@contextlib.contextmanager
def capture_backend_output(noisy: bool) -> Iterator[list[str]]:
    """Collect the warnings of a backend, and discard its output to sys.stdout and sys.stderr, in this thread only.

    `noisy` also discards output of compiled code. This redirects the file descriptors of the whole process, so it is
    only used for backends that are known to print.
    """
    collected: list[str] = []
    with _redirect_streams, _discard_descriptors if noisy else contextlib.nullcontext():
        outer = _thread_output.warnings, _thread_output.text
        _thread_output.warnings, _thread_output.text = collected, io.StringIO()
        try:
            yield collected
        finally:
            _thread_output.warnings, _thread_output.text = outer


class _ThreadOutput(threading.local):
    """Destinations of this thread's warnings and output while it runs a backend, else None."""

    warnings: list[str] | None = None
    text: io.StringIO | None = None


_thread_output = _ThreadOutput()


class _Stream:
    """Replacement of sys.stdout or sys.stderr. Threads that do not run a backend write to the original stream."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream if _thread_output.text is None else _thread_output.text, name)


class _SharedContext:
    """A context manager of the whole process: the first thread that needs it enters it, and the last leaves it."""

    def __init__(self, make_context: Callable[[], contextlib.AbstractContextManager[None]]) -> None:
        self._make_context, self._lock, self._n_threads = make_context, threading.Lock(), 0
        if hasattr(os, "register_at_fork"):  # Windows cannot fork.
            os.register_at_fork(
                before=self._lock.acquire, after_in_parent=self._lock.release, after_in_child=self._reset
            )

    def _reset(self) -> None:
        """Leave the context in a forked process if only threads of the parent were in it."""
        if self._n_threads and _thread_output.text is None:
            self._n_threads = 0
            self._context.__exit__(None, None, None)
        self._lock.release()

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


@contextlib.contextmanager
def _redirect_streams_by_thread() -> Iterator[None]:
    """Redirect warnings, sys.stdout and sys.stderr of threads that run a backend."""
    with (
        warnings.catch_warnings(),
        contextlib.redirect_stdout(_Stream(sys.stdout)),  # pyright: ignore[reportArgumentType]
        contextlib.redirect_stderr(_Stream(sys.stderr)),  # pyright: ignore[reportArgumentType]
    ):
        show = warnings.showwarning

        def collect_warning(message: Warning | str, category: type[Warning], *location: Any) -> None:
            if _thread_output.warnings is None:
                show(message, category, *location)
            elif not issubclass(category, DeprecationWarning):
                _thread_output.warnings.append(str(message).strip())

        warnings.showwarning = collect_warning  # type: ignore[assignment]
        warnings.simplefilter("always")
        yield


@contextlib.contextmanager
def _redirect_descriptors_to_null() -> Iterator[None]:
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


_redirect_streams = _SharedContext(_redirect_streams_by_thread)
_discard_descriptors = _SharedContext(_redirect_descriptors_to_null)
