"""`solve` and `prepare`: check the arguments, run the solver in short chunks of iterations, judge the result.

Between two chunks this module reads the clock, records history, calls the callback, and turns Ctrl-C into a result.
A chunk lasts about 10 ms. Chunks do not change the result, because every solver checks convergence at fixed numbers
of iterations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from threading import Lock
from time import perf_counter
from types import MappingProxyType
from typing import Any

import numpy as np

from lavender._arrays import ArrayLike, FloatArray, equal, flag, number, whole_number
from lavender.deadline import CHUNK_TIME, Deadline
from lavender.errors import BREAKDOWN, CapabilityError, InputError, InUse, UnknownName, last_words
from lavender.foreign import Foreign
from lavender.outcome import (
    CONVERGED,
    INFEASIBLE,
    MAX_ITERATIONS,
    NUMERICAL_ERROR,
    STALLED,
    TIME_LIMIT,
    decide_empty_rows,
    finish,
)
from lavender.problem import Problem, check_problem
from lavender.registry import SMALL_ROWS, SolverSpec, State, get
from lavender.residuals import (
    Residual,
    judged,
    reference,
    remember,
    remembered,
    residual,
    told,
    unstretched,
)
from lavender.solution import Claim, History, Solution, SolverRun, Status
from lavender_ext.judge.measure import all_finite

__all__ = ["Prepared", "prepare", "solve"]

FIRST_CHUNK = 256  # iterations: 10 ms at 40 us each, slower than any compiled sweep of few rows
Callback = Callable[[int, FloatArray, Residual], Any]
Record = tuple[int, float, float, float, float]  # iterations, s, relative, energy, velocity
NOTHING_DONE = Claim(Status.MAX_ITERATIONS, 0)
INTERRUPTED = Status.INTERRUPTED
FRONT_DOOR = ("impulse", "tol", "max_iter", "time_limit", "history", "callback")


def solve(
    problem: Problem,
    solver: str = "auto",
    *,
    impulse: ArrayLike | None = None,
    tol: float = 1e-6,
    max_iter: int | None = None,
    time_limit: float | None = None,
    history: bool = False,
    callback: Callback | None = None,
    **options: Any,
) -> Solution:
    """Solve a constraint problem with the named solver; the default `auto` chooses and combines solvers.

    Parameters
    ----------
    problem : Problem
    solver : str
        A registered name; `available(problem)` lists the installed solvers that accept the problem.
    impulse : (m,) N s, optional
        Warm start. Default: `problem.guess`, otherwise zero clipped to the bounds.
    tol : float, default 1e-6
        Relative residual to reach: 0 is a solution, 1 is zero impulses (see `lavender.residuals`). `tol=0` runs exactly
        `max_iter` iterations; `auto` and solvers that factor end earlier where nothing is left to gain.
    max_iter : int, optional
        The most iterations, in the solver's own unit (sweeps, steps, pivots). Default: that of the solver's spec.
    time_limit : float, optional, s
        Limit of the solve time, checked between chunks of iterations. Solvers of other packages run in a separate
        process, which is kept for later solves and killed at the limit (at twice the limit if the package has a time
        limit of its own); `isolate=False` runs them in this process.
    history : bool
        Record iterations, time and residual at fixed numbers of iterations.
    callback : callable (iterations, impulse, residual), optional
        Called whenever history would be recorded; the solve stops if it returns a true value.
    **options
        `order`, `ground`, `seed`, `threads` and the solver's own options, as listed by its spec.

    Returns
    -------
    Solution
        Also if the solver did not converge: then it holds the last iterate. See `Solution.status` and `.success`.

    Raises
    ------
    UnknownName
        No such solver or option.
    SolverUnavailable
        The solver's package is not installed.
    CapabilityError
        The solver does not accept this problem or option; the message says why.
    InputError
        `impulse`, `tol`, `max_iter` or `time_limit` is not valid.
    """
    check_problem(problem)  # first, for those who pass A and b
    spec = get(solver)
    if max_iter is None and time_limit is None and callback is None and history is False and not options:
        made = solve_small(problem, spec, impulse, tol)
        if made is not None:
            return made
    return Prepared(problem, spec, options).solve(
        impulse=impulse, tol=tol, max_iter=max_iter, time_limit=time_limit, history=history, callback=callback
    )


def prepare(problem: Problem, solver: str = "auto", **options: Any) -> Prepared:
    """Do once the part of a solve that many solves can share: factorisation, colouring, allocation.

    Parameters
    ----------
    problem : Problem
    solver : str
        Name, as in `solve`.
    **options
        Options of the solver. `tol`, `max_iter`, `impulse` and `time_limit` are arguments of `Prepared.solve`.

    Returns
    -------
    Prepared
        `prepared.solve(impulse=..., tol=...)` solves this problem; `prepared.solve(problem2, ...)` solves another. If
        that has the same structure (blocks, sparsity pattern of A or J), the preparation is reused. Both may be called
        any number of times. `setup_time` [s] is the time that preparing took.

    Examples
    --------
    Ten steps of one structure, each started from the impulses (m,) [N s] of the step before:

    >>> import numpy as np
    >>> import lavender as lv
    >>> A = np.array([[2.0, 1.0], [1.0, 2.0]])  # 1/kg
    >>> prepared = lv.prepare(lv.Problem.lcp(A, [1.0, 0.5]), "pgs")
    >>> impulse = None
    >>> for step in range(10):
    ...     problem = lv.Problem.lcp(A, [1.0 + 0.01 * step, 0.5])  # m/s
    ...     solution = prepared.solve(problem, impulse=impulse, tol=1e-9)
    ...     impulse = solution.impulse
    >>> solution.success
    True
    """
    return Prepared(problem, get(solver), options)


class Prepared:
    """A solver prepared for a problem; `solve(problem2)` reuses the preparation if the structure is the same.

    It runs one solve at a time: calling `solve` during another `solve`, from another thread or from its callback,
    raises `InUse`. Threads may share a `Problem`, but each needs a `Prepared` of its own.
    """

    def __init__(self, problem: Problem, spec: SolverSpec, options: dict[str, Any]) -> None:
        start = perf_counter()  # a check may form A, which is set-up
        _check_problem(problem, spec)
        for name in options:
            if name not in spec.accepts:
                if name in FRONT_DOOR:
                    raise CapabilityError(
                        f"prepare does not take {name}=: give it to the solve of what it returns"
                    )
                if name in ("order", "ground", "seed", "threads"):
                    raise CapabilityError(
                        f"solver {spec.name!r} does not take {name}=; it takes: "
                        f"{', '.join(sorted(spec.accepts)) or 'no options'}"
                    )
                raise UnknownName(f"option of solver {spec.name!r}", name, {*spec.accepts, *FRONT_DOOR})
        self.spec = spec
        self.options = options
        self._given, self.problem = problem, problem.disk
        self._lock = Lock()
        # `auto` prepares nothing before its compiled call for small problems was made.
        if options or not spec.delegates:
            self._begin()
        self.setup_time = perf_counter() - start

    solver: Any = None  # made when it is first needed
    setup_time = 0.0  # s
    _fresh = True  # nothing was solved with what was set up
    _broken = ""  # why there is no state

    def _begin(self) -> None:
        start = perf_counter()
        self.solver = _make(self.spec, self.options)
        try:
            self._set_up(self.problem, anew=True)
        except BaseException:
            self.solver = None  # the next call begins again
            raise
        self._fresh = True
        self.setup_time += perf_counter() - start

    def _replace(self, problem: Problem) -> None:
        """Another problem in the place of the prepared one; nothing is set up for it yet."""
        self._given, self.problem, self.solver = problem, problem.disk, None

    def solve(
        self,
        problem: Problem | None = None,
        *,
        impulse: ArrayLike | None = None,
        tol: float = 1e-6,
        max_iter: int | None = None,
        time_limit: float | None = None,
        history: bool = False,
        callback: Callback | None = None,
    ) -> Solution:
        """As `lavender.solve`; `problem`, if given, replaces the prepared one.

        Raises
        ------
        InUse
            Another call of this object's `solve` has not returned yet.
        """
        if not self._lock.acquire(False):
            raise InUse(
                f"this prepared {self.spec.name!r} is already solving, and it can run one solve at a time: "
                "make one for each thread (lavender.prepare)"
            )
        try:
            plain = max_iter is None and time_limit is None and callback is None and history is False
            if plain and self.spec.delegates and not self.options:
                made = solve_small(self._given if problem is None else problem, self.spec, impulse, tol)
                if made is not None:
                    if problem is not None and problem is not self._given:
                        self._replace(problem)
                    return made
            tol, max_iter, time_limit = check_budget(self.spec, tol, max_iter, time_limit)
            _check_records(self.spec, history, callback)
            if self.solver is None:
                if problem is not None and problem is not self._given:
                    _check_problem(problem, self.spec)
                    self._replace(problem)
                self._begin()
            self._refresh(problem)
            loop = self._loop(impulse, tol, time_limit, history, callback)
            return self._run(loop, max_iter)
        finally:
            self._lock.release()

    def _loop(
        self, impulse: Any, tol: float, time_limit: float | None, history: bool, callback: Callback | None
    ) -> _Loop:
        problem, given = self.problem, self._given
        if given is not problem and callback is not None:
            callback = _in_rows_of(given, given.cones.stretch, callback)
        if impulse is not None:
            lam = given.on_disk(problem.impulse_array(impulse))
        else:
            lam = problem.start() if problem.guess is None else problem.guess.copy()
        if time_limit is not None and hasattr(self.solver, "ready"):
            start = perf_counter()
            self.solver.ready(self.state, time_limit)
            self.setup_time += perf_counter() - start
        records: list[Record] | None = [] if history else None
        return _Loop(
            problem=problem, solver=self.solver, state=self.state, impulse=lam, tol=tol, time_limit=time_limit,
            callback=callback, records=records,
        )  # fmt: skip

    def _run(self, loop: _Loop, max_iter: int) -> Solution:
        spec, problem = self.spec, self.problem
        setup_time, self.setup_time = self.setup_time, 0.0
        proof = decide_empty_rows(problem, loop.impulse, loop.tol)
        if proof is not None:
            claim = Claim(INFEASIBLE, 0, {}, proof[0], certificate=proof[1])
        elif self._broken:
            claim = Claim(NUMERICAL_ERROR, 0, {}, self._broken)
        else:
            claim = loop.run(max_iter) if spec.resumable else loop.run_once(max_iter)
        solution = finish(
            problem, spec, self.options, loop.impulse, claim, loop.tol, setup_time, loop.time, loop.recorded(),
            float(getattr(self.state, "sweeps_per_decade", math.nan)),
        )  # fmt: skip
        return solution if self._given is problem else solution.unstretched(self._given)

    def _refresh(self, problem: Problem | None) -> None:
        if problem is None or problem is self._given:
            if not self._fresh:
                self._set_up(self.problem, anew=False)
        else:
            start = perf_counter()
            _check_problem(problem, self.spec)
            given, problem = problem, problem.disk
            self._set_up(problem, anew=not same_structure(self.problem, problem))
            self.setup_time = perf_counter() - start
            self._given, self.problem = given, problem  # not before: what cannot be set up is refused again
        self._fresh = False

    def __reduce__(self) -> tuple[Any, ...]:
        """Copied or pickled it is prepared anew: a state is for one solve at a time."""
        return partial(prepare, **self.options), (self._given, self.spec.name)

    def _set_up(self, problem: Problem, anew: bool) -> None:
        """Prepare, or update the state of a problem of the same structure."""
        if problem.metric.start_energy < 0.0:
            reference(problem)  # of the judge, before any solver has the problem in its hands
        anew, self._broken = anew or bool(self._broken), ""
        try:
            if anew:
                self.state = self.solver.prepare(problem)
            else:
                self.state = self.solver.update(self.state, problem)
        except InputError:
            raise  # before the start
        except BREAKDOWN as error:
            self.state, self._broken = None, last_words(error)


def _in_rows_of(given: Problem, stretch: FloatArray, callback: Callback) -> Callback:
    """A callback of a problem with ellipses, for what is solved in its place."""

    def call(done: int, impulse: FloatArray, found: Residual) -> Any:
        return callback(done, stretch * impulse, unstretched(given, found))

    return call


def _make(spec: SolverSpec, options: dict[str, Any]) -> Any:
    factory = spec.load()
    try:
        made = factory(**options)
    except (TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"solver {spec.name!r} cannot take the options {options}: {error}") from error
    if not spec.own:
        return Foreign(spec.name, made)
    if spec.boxes <= spec.laws:
        return made
    from lavender.solvers.polyhedral import (
        ThroughRows,  # with the table of solvers, which is imported by then
    )

    return ThroughRows(made)


def same_structure(p: Problem, q: Problem) -> bool:
    """Same blocks, same kind of operator, same bodies or same pattern of J and M or of A."""
    if not (equal(p.cones.ptr, q.cones.ptr) and equal(p.cones.kind, q.cones.kind)) or p.law != q.law:
        return False
    if p.rows is not None and q.rows is not None:
        return (
            p.rows.n_bodies == q.rows.n_bodies
            and equal(p.rows.joint_body, q.rows.joint_body)
            and equal(p.rows.contact_body, q.rows.contact_body)
        )
    if p.operator != q.operator:
        return False
    if p.generalized is not None and q.generalized is not None:
        return all(
            equal(x, y)
            for of in ("jac", "mass")
            for x, y in zip(
                getattr(p.generalized.operator, of)[:2], getattr(q.generalized.operator, of)[:2], strict=True
            )
        )
    return equal(p.csr.indptr, q.csr.indptr) and equal(p.csr.indices, q.csr.indices)


@dataclass
class _Loop:
    """Chunks, clock, history and Ctrl-C around one solver's `run`."""

    problem: Problem
    solver: Any
    state: Any
    impulse: FloatArray  # (m,) N s, in place
    tol: float
    time_limit: float | None  # s
    callback: Callback | None
    records: list[Record] | None
    time: float = 0.0  # s, of the solver alone
    done: int = 0  # iterations
    work: dict[str, int] = field(default_factory=dict)
    broken: bool = False  # the solver did not return
    next_record: int = 0  # iterations

    def run_once(self, max_iter: int) -> Claim:
        start_point = self.impulse.copy()
        start = perf_counter()
        try:
            try:
                claim = self._call(max_iter, self.time_limit)
            finally:
                self.time = perf_counter() - start
            if not self.broken:
                tell = getattr(self.solver, "tell", None)  # judges, and finds words
                return claim if tell is None else tell(self.state, self.impulse, claim)
        except KeyboardInterrupt:
            claim = Claim(INTERRUPTED, 0, {}, "Ctrl-C")
        if not all_finite(self.impulse) or (self.broken and self._is_worse_than(start_point)):
            self.impulse[:] = start_point
        return claim

    def _is_worse_than(self, impulse: FloatArray) -> bool:
        last, other = (judged(self.problem, x.copy()) for x in (self.impulse, impulse))
        return last.relative > other.relative

    def _call(self, max_iter: int, time_limit: float | None) -> Claim:
        """Run at most so many iterations of the solver; an arithmetic breakdown becomes a claim."""
        try:
            return self.solver.run(self.state, self.impulse, max_iter, self.tol, time_limit)
        except BREAKDOWN as error:
            self.broken = True
            return Claim(NUMERICAL_ERROR, 0, {}, last_words(error))

    def run(self, max_iter: int) -> Claim:
        # About a nanosecond per unit of work: the first guess, then measured. Capped, for solvers in Python.
        chunk = min(FIRST_CHUNK, max(1, int(CHUNK_TIME * 1e9) // max(1, self.problem.metric.work)))
        records = self.records is not None or self.callback is not None
        claim = NOTHING_DONE
        if self.time_limit is not None:
            chunk = 1  # the counted work may be wrong: over J and M some solvers sweep over A
            if hasattr(self.solver, "until"):
                # For work that cannot be cut into chunks: a factorisation that would end too late is not begun.
                self.solver.until(self.state, Deadline(self.time_limit))
        try:
            if records and self._record():
                return self._total(Claim(INTERRUPTED, 0, {}, "stopped by the callback"))
            while self.done < max_iter:
                n = min(chunk, max_iter - self.done)
                if records:
                    n = min(n, self.next_record - self.done)
                start = perf_counter()
                claim = self._call(n, None)
                elapsed = perf_counter() - start
                self.time += elapsed
                self.done += claim.iterations
                for kind, count in claim.work.items():
                    self.work[kind] = self.work.get(kind, 0) + count
                stopped = records and self.done == self.next_record and self._record()
                if claim.status is not MAX_ITERATIONS:
                    break
                if claim.iterations < 1:
                    claim = Claim(STALLED, 0, {}, f"did none of the {n} iterations that it was asked for")
                    break
                if stopped:
                    claim = Claim(INTERRUPTED, 0, {}, "stopped by the callback")
                    break
                if self.time_limit is not None and self.time >= self.time_limit:
                    claim = Claim(TIME_LIMIT, 0, {}, claim.message)
                    break
                if self.done < max_iter:
                    chunk = self._next_chunk(n, elapsed)
        except KeyboardInterrupt:
            claim = Claim(INTERRUPTED, 0, {}, "Ctrl-C")
        self._keep_best()
        return self._total(claim)

    def _next_chunk(self, n: int, elapsed: float) -> int:
        aim = CHUNK_TIME
        if self.time_limit is not None:
            aim = min(aim, max(self.time_limit - self.time, 0.0))
        return max(1, min(8 * n, int(n * aim / max(elapsed, 1e-7))))

    def _keep_best(self) -> None:
        # A solver whose residual may rise keeps its best checked iterate; a budget (tol = 0) means the last one.
        if self.tol == 0.0:
            return
        state: State = self.state
        best = getattr(state, "best", None)
        if best is None or best[1] is None:
            return
        last = remembered(self.problem, self.impulse) or judged(self.problem, self.impulse.copy())
        if last.relative <= best[0]:
            remember(self.problem, last)  # for the result
        else:
            self.impulse[:] = best[1]

    def _record(self) -> bool:
        r = residual(self.problem, self.impulse, "float64")
        if self.records is not None:
            self.records.append((self.done, self.time, r.relative, r.energy, r.velocity))
        self.next_record = self.done + max(1, self.done >> 3)  # 1, 2, ... 16, then an eighth more each time
        return bool(self.callback(self.done, self.impulse.copy(), r)) if self.callback is not None else False

    def _total(self, claim: Claim) -> Claim:
        if claim.iterations == self.done and claim.work == self.work:
            return claim  # of a single chunk
        return replace(claim, iterations=self.done, work=self.work)

    def recorded(self) -> History | None:
        if self.records is None:
            return None
        if not self.records or self.records[-1][0] != self.done:
            self._record()
        columns = list(zip(*self.records, strict=True))
        return History(np.array(columns[0], np.int64), *(np.array(c, float) for c in columns[1:]))


def solve_small(problem: Problem, spec: SolverSpec, impulse: Any, tol: float) -> Solution | None:
    """The solution of a small problem by one compiled call, judged there; None if `Prepared` has to solve it.

    The fields of claim, counts and residual are made when they are first read.
    """
    small = spec.small
    if small is None or not spec.own or type(problem) is not Problem or not isinstance(tol, float):
        return None
    if not 0.0 < tol < math.inf:
        return None
    if problem.cones.has_ellipse or (problem.m > SMALL_ROWS and problem.generalized is None):
        return None  # islands may take long: they are solved where Ctrl-C is heard
    start = perf_counter()
    if impulse is None:
        given = problem.guess
    elif (
        type(impulse) is np.ndarray and impulse.dtype is problem.b.dtype and impulse.shape == problem.b.shape
        and impulse.flags.c_contiguous and all_finite(impulse)
    ):  # fmt: skip
        given = impulse
    else:
        given = problem.impulse_array(impulse)
    found = small.solve(problem, given, tol)
    if found is None:
        return None
    judged, counts = found
    kept = given if given is None or impulse is None else given.copy()  # the caller may write into his own
    judged.impulse.setflags(write=False)
    return Solution.late(
        judged.impulse,
        CONVERGED,
        tol,
        perf_counter() - start,
        (rest_of, (problem, spec, judged, counts, kept)),
    )


def rest_of(
    problem: Problem, spec: SolverSpec, judged: Any, counts: Any, given: FloatArray | None
) -> dict[str, Any]:
    """The fields of a solution of a compiled call that `Solution.late` leaves for later."""
    assert spec.small is not None
    claim = spec.small.claim(problem, counts, given, judged.relative)
    return {
        "residual": told(problem, judged),
        "iterations": claim.iterations,
        "work": MappingProxyType(dict(claim.work)),
        "solver": SolverRun(spec.name, {}, claim.form),
        "message": claim.message,
        "history": None,
        "dual": None,
        "certificate": None,
        "impulse_bound": None,
        "contradicted": "",
        "sweeps_per_decade": math.nan,
        "turns": claim.turns,
    }


def _check_problem(problem: Problem, spec: SolverSpec) -> None:
    check_problem(problem)
    reason = spec.refuses(problem)
    if reason:
        raise CapabilityError(f"solver {spec.name!r} {reason}")


def check_budget(
    spec: SolverSpec, tol: float, max_iter: int | None, time_limit: float | None
) -> tuple[float, int, float | None]:
    """The three as numbers, `max_iter` the spec's where it is None.

    Raises
    ------
    InputError
        A wrong one.
    """
    tol = number("tol", tol, low=0.0)
    max_iter = whole_number("max_iter", spec.max_iter if max_iter is None else max_iter)
    if time_limit is None or (isinstance(time_limit, (float, np.floating)) and time_limit == np.inf):
        return tol, max_iter, None
    return tol, max_iter, number("time_limit", time_limit, above=0.0)


def _check_records(spec: SolverSpec, history: bool, callback: Callback | None) -> None:
    if callback is not None and not callable(callback):
        raise InputError(f"callback is {callback!r}; a function of (iterations, impulse, residual) is needed")
    if (callback is not None and not spec.callback) or (flag("history", history) and not spec.history):
        raise CapabilityError(
            f"solver {spec.name!r} runs in one call; it takes no callback and records no history"
        )
