"""`solve` and `prepare`: check the arguments, set up the solver, run it (`solvers/loop.py`), judge the result."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from threading import Lock
from time import perf_counter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from lavender.base.arrays import (
    ArrayLike,
    FloatArray,
    are_equal,
    check_bool,
    check_float,
    check_int,
    read_only,
)
from lavender.base.deadline import NEVER, Deadline, Stopwatch
from lavender.base.errors import BREAKDOWN, CapabilityError, InputError, InUse, UnknownName, format_error
from lavender.base.lazy_import import import_numerics
from lavender.external.foreign import Foreign
from lavender.judge.certificates import prove
from lavender.judge.residuals import (
    Residual,
    best_of_islands,
    convert_from_disk,
    find_known_relative,
    get_reference,
    judging_time,
    make_residual,
    residual,
    setup_time,
)
from lavender.judge.solution import (
    CONFIRMED,
    CONVERGED,
    INFEASIBLE,
    NUMERICAL_ERROR,
    ROUNDOFF_LIMIT,
    TIME_LIMIT,
    Claim,
    Solution,
    SolverRun,
    Status,
    summed,
)
from lavender.problem import Problem, check_problem
from lavender.solvers.certify import check_infeasible
from lavender.solvers.islands import islands
from lavender.solvers.loop import LEAST, Callback, Loop, Record, best_of
from lavender.solvers.registry import SMALL_ROWS, Solver, SolverSpec, get
from lavender.solvers.setup_times import SCIPY, estimate_disk_time, estimate_refusal_time, loading
from lavender.solving.outcome import decide_empty_rows, finish, name_lost_row
from lavender_ext.judge.measure import all_finite, by_island
from lavender_ext.judge.watch import Watch

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from lavender.solvers.registry import SolverOptions

LATER = ("iterations", "work", "solver", "message", "history", "dual", "certificate", "impulse_bound",
         "claim_check", "status_conflict", "sweeps_per_decade", "stages")  # fmt: skip
COUNTED = 0.9e9  # ns that a small call may be counted for, for each second of its limit
SET_UP_LATE = "what has to be set up first takes longer than the time limit"
NO_TURN = "the time limit was over before its turn: the start"
JUDGE_LATE = "what the judge reads takes longer than the time limit: the start, unjudged"
WITHOUT_SCIPY = (
    "without SciPy, which this process has not loaded: import scipy.linalg.lapack, scipy.sparse before"
)
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
    **options: Unpack[SolverOptions],
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
        Relative residual to reach: 0 is a solution, 1 is zero impulses (see `judge.residuals`). `tol=0` runs exactly
        `max_iter` iterations; `auto` and solvers that factor end earlier where nothing is left to gain.
    max_iter : int, optional
        The most iterations, in the solver's own unit (sweeps, steps, pivots). Default: that of the solver's spec.
    time_limit : float, optional, s
        Limit of the whole call on the wall clock: set-up, iterations and the judge. What cannot be stopped, such as a
        set-up or a factorisation, is begun only if its counted time fits in what is left. The result is no worse than
        the start. Solvers of other packages, and plug-ins, are imported before the clock of the first limit. The
        former run in a separate process, which is kept for later solves and killed at the limit (at twice the limit if
        the package has a time limit of its own); `isolate=False` runs them in this process.
    history : bool
        Record iterations, time and residual at fixed numbers of iterations.
    callback : callable (iterations, impulse, residual), optional
        Called whenever history would be recorded; the solve stops if it returns a true value.
    **options
        `order`, `ground`, `seed` and the solver's own options, as listed by its spec.

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
    begun = 0.0 if time_limit is None else perf_counter()
    check_problem(problem)  # first, for those who pass A and b
    spec = get(solver)
    limit = math.inf if time_limit is None else seconds_of(time_limit)
    if max_iter is None and callback is None and history is False and not options:
        made = solve_small(problem, spec, impulse, tol, limit)
        if made is not None:
            return made
    deadline = _deadline(spec, limit, begun)
    return Prepared(problem, spec, cast("dict[str, Any]", options), False, deadline)._solve(
        None, impulse, tol, max_iter, deadline, history, callback
    )


def prepare(problem: Problem, solver: str = "auto", **options: Unpack[SolverOptions]) -> Prepared:
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
        `prepared.solve(impulse=..., tol=...)` solves this problem. `prepared.solve(problem2, ...)` solves another,
        which takes its place: the next `prepared.solve()` solves `problem2`. If that has the same structure (blocks,
        sparsity pattern of A or J), the preparation is reused. Both may be called any number of times. `setup_time`
        [s] is the time that preparing took.

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
    return Prepared(problem, get(solver), cast("dict[str, Any]", options))


class Prepared:
    """A solver prepared for a problem; `solve(problem2)` reuses the preparation if the structure is the same.

    It runs one solve at a time: calling `solve` during another `solve`, from another thread or from its callback,
    raises `InUse`. Threads may share a `Problem`, but each needs a `Prepared` of its own.
    """

    def __init__(
        self,
        problem: Problem,
        spec: SolverSpec,
        options: dict[str, Any],
        begin: bool = True,
        deadline: Deadline = NEVER,
    ) -> None:
        watch = Stopwatch()  # a check may form A, and ellipses become disks: both are set-up
        late = check_taken(problem, spec, deadline)
        for name in options:
            if name not in spec.accepts:
                if name in FRONT_DOOR:
                    raise CapabilityError(
                        f"prepare does not take {name}=: give it to the solve of what it returns"
                    )
                if name in ("order", "ground", "seed"):
                    raise CapabilityError(
                        f"solver {spec.name!r} does not take {name}=; it takes: "
                        f"{', '.join(sorted(spec.accepts)) or 'no options'}"
                    )
                raise UnknownName(f"option of solver {spec.name!r}", name, {*spec.accepts, *FRONT_DOOR})
        self.spec = spec
        self.options = options
        self._given, self.problem = problem, problem if late else problem.disk
        self._lock = Lock()
        # `auto` prepares nothing before its compiled call for small problems was made.
        if begin and (options or not spec.delegates):
            self._begin(NEVER)
        self.setup_time = watch.seconds

    solver: Any = None  # made when it is first needed
    setup_time = 0.0  # s
    _fresh = True  # nothing was solved with what was set up
    _broken = ""  # why there is no state
    _late = False  # there is none, as it would have taken longer than the time limit

    def _begin(self, deadline: Deadline) -> None:
        watch = Stopwatch()
        self.problem = self._given.disk
        self.solver = _make(self.spec, self.options)
        try:
            self._set_up(self.problem, True, deadline)
        except BaseException:
            self.solver = None  # the next call begins again
            raise
        self._fresh = True
        self.setup_time += watch.seconds

    def _take(self, problem: Problem | None, deadline: Deadline = NEVER) -> None:
        """Another problem, if one is given, in the place of the prepared one; nothing is set up for it yet."""
        if problem is not None and problem is not self._given:
            late = check_taken(problem, self.spec, deadline)
            self._given, self.problem, self.solver = problem, problem if late else problem.disk, None

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
        """As `lavender.solve`; `problem`, if given, replaces the prepared one unless an error is raised.

        Raises
        ------
        InUse
            Another call of this object's `solve` has not returned yet.
        """
        deadline = _deadline(self.spec, seconds_of(time_limit))
        return self._solve(problem, impulse, tol, max_iter, deadline, history, callback)

    def _solve(
        self,
        problem: Problem | None,
        impulse: ArrayLike | None,
        tol: float,
        max_iter: int | None,
        deadline: Deadline,
        history: bool,
        callback: Callback | None,
    ) -> Solution:
        if not self._lock.acquire(False):
            raise InUse(
                f"this prepared {self.spec.name!r} is already solving, and it can run one solve at a time: "
                "make one for each thread (lavender.prepare)"
            )
        try:
            given = self._given if problem is None else problem
            plain = max_iter is None and callback is None and history is False
            if plain and self.spec.delegates and not self.options:
                made = solve_small(given, self.spec, impulse, tol, deadline.remaining(LEAST) or math.inf)
                if made is not None:
                    self._take(problem)
                    return made
            tol, max_iter = check_budget(self.spec, tol, max_iter)
            _check_records(self.spec, history, callback)
            check_problem(given)
            if comes_too_late(given, self.spec, deadline):
                self._take(problem, deadline)
                return unjudged(given, self.spec, self.options, impulse, tol, JUDGE_LATE)
            asked = given.disk
            start = None if impulse is None else given.on_disk(asked.impulse_array(impulse))
            if deadline.is_set:
                # Of what was found, and of where it began.
                passes = 2 if start is not None or asked.guess is not None else 1
                last = passes * judging_time(asked)
                if deadline.passed(setup_time(asked) + last) and not self.spec.external:
                    self._take(problem)
                    return unjudged(given, self.spec, self.options, impulse, tol, JUDGE_LATE)
                deadline.reserve(last)
            if self.solver is None:
                self._take(problem)
                self._begin(deadline)
            self._refresh(problem, deadline)
            loop = self._loop(start, tol, deadline, history, callback)
            return self._run(loop, max_iter)
        finally:
            if self._late:
                self.solver, self._late = None, False  # the next call begins again
            self._lock.release()

    def _loop(
        self,
        lam: FloatArray | None,
        tol: float,
        deadline: Deadline,
        history: bool,
        callback: Callback | None,
    ) -> Loop:
        problem, given = self.problem, self._given
        if given is not problem and callback is not None:
            callback = _in_rows_of(given, given.cones.stretch, callback)
        if lam is None:
            lam = problem.start() if problem.guess is None else problem.guess.copy()
        left = deadline.remaining()
        if left is not None and not self._late and not self._broken:
            watch = Stopwatch()
            self.solver.start_workers(self.state, left)
            deadline.reserve(-watch.seconds)
            self.setup_time += watch.seconds
        records: list[Record] | None = [] if history else None
        return Loop(
            problem=problem, solver=self.solver, state=self.state, impulse=lam, tol=tol, deadline=deadline,
            callback=callback, records=records,
        )  # fmt: skip

    def _run(self, loop: Loop, max_iter: int) -> Solution:
        spec, problem = self.spec, self.problem
        setup_time, self.setup_time = self.setup_time, 0.0
        proof = decide_empty_rows(problem, loop.impulse, loop.tol)
        if proof is not None:
            message, certificate, impossible = proof
            claim = Claim(INFEASIBLE, 0, {}, message, certificate=certificate)
            claim = self._solve_with_zero_b(loop, claim, impossible, max_iter)
        elif self._broken:
            claim = Claim(NUMERICAL_ERROR, 0, {}, self._broken)
        elif self._late or (loop.deadline.passed() and not spec.external):
            # A start that does nothing is not weighed beside another, and the judge is for who asks.
            nothing = find_known_relative(problem, loop.impulse)
            if nothing is not None and nothing > loop.tol and loop.records is None and loop.deadline.passed():
                start = loop.impulse if self._given is problem else self._given.cones.stretch * loop.impulse
                words = f"{SET_UP_LATE}: the start, unjudged"
                return unjudged(self._given, spec, self.options, start, loop.tol, words, setup_time)
            claim = Claim(TIME_LIMIT, 0, {}, SET_UP_LATE)
            loop.not_worse(loop.impulse)
        else:
            start = loop.impulse.copy()
            claim = loop.run(max_iter) if spec.resumable else loop.run_once(max_iter)
            if loop.tol > 0.0 and claim.status not in (CONVERGED, ROUNDOFF_LIMIT):
                claim = name_lost_row(problem, loop.impulse, claim)
                # The checks of sweeps keep the best of each island, from the start on.
                if claim.status is TIME_LIMIT or not isinstance(getattr(self.state, "watch", None), Watch):
                    loop.not_worse(start, or_zero=claim.status is TIME_LIMIT)
            if claim.status is TIME_LIMIT and spec.delegates and problem.m > SMALL_ROWS and loading(*SCIPY):
                claim = replace(claim, message=f"{claim.message}; {WITHOUT_SCIPY}")
        refutation = ""
        if claim.status is INFEASIBLE and (spec.external or not spec.builtin):
            claim, _, refutation = check_infeasible(problem, claim, loop.tol, loop.deadline)
        if claim.status is INFEASIBLE and claim.certificate is not None and loop.tol > 0.0 and proof is None:
            claim = self._without_infeasible_islands(loop, claim, max_iter)
        solution = finish(
            problem, spec, self.options, loop.impulse, claim, loop.tol, setup_time, loop.time, loop.recorded(),
            float(getattr(self.state, "sweeps_per_decade", math.nan)), refutation,
        )  # fmt: skip
        return solution if self._given is problem else solution.unstretched(self._given)

    def _without_infeasible_islands(self, loop: Loop, claim: Claim, max_iter: int) -> Claim:
        """Solve the islands that an INFEASIBLE claim's certificate says nothing about, unless they meet tol."""
        assert claim.certificate is not None
        count, label = islands(self.problem)
        if count < 2:
            return claim
        proof = prove(self.problem, claim.certificate, loop.tol)
        if proof.reason:
            return claim
        _, table = by_island(self.problem.metric, loop.impulse)
        row_label = np.repeat(label, np.diff(self.problem.cones.ptr))
        infeasible = np.bincount(row_label, proof.y != 0.0, minlength=count) > 0
        if np.all(infeasible | (table[:, 0] <= loop.tol)):
            return claim
        return self._solve_with_zero_b(loop, claim, infeasible[row_label], max_iter)

    def _solve_with_zero_b(self, loop: Loop, claim: Claim, rows: Any, max_iter: int) -> Claim:
        """Solve with b = 0 on rows that nothing can meet, so that other islands keep an impulse; the same claim."""
        if loop.tol == 0.0 or loop.deadline.passed():
            return claim
        b, start = self.problem.b.copy(), loop.impulse.copy()
        b[rows] = start[rows] = 0.0
        try:
            others = Prepared(self.problem.updated(b=b), self.spec, self.options)
        except InputError:  # All other numbers of b are below the smallest that a problem may have.
            return claim
        found = others.solve(
            impulse=start, tol=loop.tol, max_iter=max_iter, time_limit=loop.deadline.remaining(LEAST)
        )
        loop.impulse[:] = best_of_islands(self.problem, (loop.impulse,), (found.impulse,), loop.tol)
        loop.time += found.setup_time + found.solve_time
        return replace(
            claim, iterations=claim.iterations + found.iterations, work=summed((claim.work, found.work))
        )

    def _refresh(self, problem: Problem | None, deadline: Deadline) -> None:
        if problem is None or problem is self._given:
            if not self._fresh:
                self._set_up(self.problem, False, deadline)
        else:
            watch = Stopwatch()
            check_taken(problem, self.spec)
            given, problem = problem, problem.disk
            self._set_up(problem, not same_structure(self.problem, problem), deadline)
            self.setup_time = watch.seconds
            self._given, self.problem = given, problem  # not before: what cannot be set up is refused again
        self._fresh = False

    def __reduce__(self) -> tuple[Any, ...]:
        """Copied or pickled it is prepared anew: a state is for one solve at a time."""
        return partial(prepare, **self.options), (self._given, self.spec.name)

    def _set_up(self, problem: Problem, anew: bool, deadline: Deadline) -> None:
        """Prepare, or update the state of a problem of the same structure, if that is counted to end in time."""
        if problem.metric.reference_energy < 0.0:
            get_reference(problem)  # of the judge, before any solver has the problem in its hands
        anew, self._broken = anew or bool(self._broken), ""
        if deadline.is_set:
            self._late = deadline.passed(self.solver.setup_time(problem))
            if self._late and self.solver.needs_scipy and loading(*SCIPY):
                # As processes are started: else no call within the limit would ever have what it needs.
                watch = Stopwatch()
                import_numerics()
                deadline.reserve(-watch.seconds)
                self._late = deadline.passed(self.solver.setup_time(problem))
            if self._late:
                self.state = None
                return
        try:
            if anew:
                self.state = self.solver.prepare(problem)
            else:
                self.state = self.solver.update(self.state, problem)
        except InputError:
            raise  # before the start
        except BREAKDOWN as error:
            self.state, self._broken = None, format_error(error)


def unjudged(
    given: Problem,
    spec: SolverSpec,
    options: dict[str, Any],
    impulse: Any,
    tol: float,
    words: str,
    setup_time: float = 0.0,
) -> Solution:
    """The start as it is, if even the judge would be late: it measures the start when a field is first read."""
    start = given._start if given.guess is None else given.guess
    start = start.copy() if impulse is None else given.impulse_array(impulse)
    late = judged_later, (given, spec, options, start, Claim(TIME_LIMIT, 0, {}, words), tol)
    return Solution.late(read_only(start), TIME_LIMIT, tol, 0.0, late, setup_time)


def _in_rows_of(given: Problem, stretch: FloatArray, callback: Callback) -> Callback:
    """A callback of a problem with ellipses, for what is solved in its place."""

    def call(done: int, impulse: FloatArray, found: Residual) -> Any:
        return callback(done, stretch * impulse, convert_from_disk(given, found))

    return call


def _make(spec: SolverSpec, options: dict[str, Any]) -> Solver:
    factory = spec.load()
    try:
        made = factory(**options)
    except (TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"solver {spec.name!r} cannot take the options {options}: {error}") from error
    if not spec.builtin:
        return Foreign(spec.name, made)
    if spec.box_friction_laws <= spec.laws:
        return made
    from lavender.solvers.polyhedral import (
        ThroughRows,  # with the table of solvers, which is imported by then
    )

    return ThroughRows(made)


def same_structure(p: Problem, q: Problem) -> bool:
    """Same blocks, same kind of operator, same bodies or same pattern of J and M or of A."""
    if not (are_equal(p.cones.ptr, q.cones.ptr) and are_equal(p.cones.kind, q.cones.kind)) or p.law != q.law:
        return False
    if p.rows is not None and q.rows is not None:
        return (
            p.rows.n_bodies == q.rows.n_bodies
            and are_equal(p.rows.joint_body, q.rows.joint_body)
            and are_equal(p.rows.contact_body, q.rows.contact_body)
        )
    if p.operator != q.operator:
        return False
    if p.generalized is not None and q.generalized is not None:
        return all(
            are_equal(x, y)
            for of in ("jac", "mass")
            for x, y in zip(
                getattr(p.generalized.operator, of)[:2], getattr(q.generalized.operator, of)[:2], strict=True
            )
        )
    return are_equal(p.csr.indptr, q.csr.indptr) and are_equal(p.csr.indices, q.csr.indices)


def judged_later(
    given: Problem, spec: SolverSpec, options: dict[str, Any], impulse: FloatArray, claim: Claim, tol: float
) -> dict[str, Any]:
    """The fields that `unjudged` leaves for later; impulse (m,) [N s] in the rows of `given`, read-only."""
    disk = given.disk
    made = finish(disk, spec, options, given.on_disk(impulse), claim, tol, 0.0, 0.0, None)
    if given is not disk:
        made = replace(made.unstretched(given), residual=residual(given, impulse, "float64"))
    return {name: getattr(made, name) for name in ("residual", *LATER)}


def solve_small(
    problem: Problem,
    spec: SolverSpec,
    impulse: Any,
    tol: float,
    limit: float = math.inf,
) -> Solution | None:
    """The solution of a small problem by one compiled call, judged there; None if `Prepared` has to solve it.

    If its counted cost is more than the limit [s], the result is the best of what was found by then and of the start.
    The fields of claim, counts and residual are made when they are first read.
    """
    small = spec.small
    if small is None or not spec.builtin or type(problem) is not Problem or not isinstance(tol, float):
        return None
    if not 0.0 < tol < math.inf or problem.has_singular_program:
        return None
    if problem.cones._blocks.has_ellipse or (
        len(problem.b) > SMALL_ROWS and (problem.generalized is None or limit < math.inf)
    ):
        return None  # islands may take long: they are solved where Ctrl-C and the clock are heard
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
    judged, counts = small.attempt(problem, given, tol, COUNTED * limit)
    if judged is None:
        return None
    status = CONVERGED
    if judged.relative > tol:
        if limit == math.inf or judged.relative == judged.roundoff_floor:
            return None  # not the limit: beside such impulses rounding hides b
        status, judged = TIME_LIMIT, best_of(problem, judged, given, tol)
    kept = given if given is None or impulse is None else given.copy()  # the caller may write into his own
    judged.impulse.setflags(write=False)
    return Solution.late(
        judged.impulse,
        status,
        tol,
        perf_counter() - start,
        (rest_of, (problem, spec, judged, counts, kept, status)),
    )


def rest_of(
    problem: Problem,
    spec: SolverSpec,
    judged: Any,
    counts: Any,
    given: FloatArray | None,
    status: Status = CONVERGED,
) -> dict[str, Any]:
    """The fields of a solution of a compiled call that `Solution.late` leaves for later."""
    if spec.small is None:  # of a world of `solve_many`
        claim = Claim(status, 0, {}, NO_TURN)
    else:
        claim = spec.small.claim(problem, counts, given, judged.relative, status)
    return {
        "residual": make_residual(problem, judged),
        "iterations": claim.iterations,
        "work": MappingProxyType(dict(claim.work)),
        "solver": SolverRun(spec.name, {}, claim.form),
        "message": claim.message,
        "history": None,
        "dual": None,
        "certificate": None,
        "impulse_bound": None,
        "claim_check": CONFIRMED,
        "status_conflict": "",
        "sweeps_per_decade": math.nan,
        "stages": claim.stages,
    }


def check_taken(problem: Problem, spec: SolverSpec, deadline: Deadline = NEVER) -> bool:
    """Raise if it is not a problem, or if the solver refuses it; return `comes_too_late`.

    If that is so, only the kind of the problem is checked: whatever is checked beyond it takes longer than is left.
    """
    check_problem(problem)
    late = comes_too_late(problem, spec, deadline)
    reason = spec.refuses(problem, late)
    if reason:
        raise CapabilityError(f"solver {spec.name!r} {reason}")
    return late


def comes_too_late(problem: Problem, spec: SolverSpec, deadline: Deadline) -> bool:
    """Whether the forms of a problem that are read before any solver has it would be made after the deadline.

    These are `problem.disk`, and A where a package of others refuses by its entries. Such a call returns its start.
    """
    if not deadline.is_set:
        return False
    if problem.rows is not None and problem.cones.has_ellipse and deadline.passed(setup_time(problem)):
        return True  # the numbers of bodies alone, from which the entries of A are counted
    needed = estimate_disk_time(problem) + estimate_refusal_time(problem, spec)
    if needed > 0.0 and problem.generalized is None and deadline.passed(needed) and loading("scipy.sparse"):
        watch = Stopwatch()
        import_numerics()
        deadline.reserve(
            -watch.seconds
        )  # as processes are started: else no call within the limit would ever have it
        needed = estimate_disk_time(problem) + estimate_refusal_time(problem, spec)
    return needed > 0.0 and deadline.passed(needed)


def seconds_of(time_limit: Any) -> float:
    """A time limit as a number, inf where it is None.

    Raises
    ------
    InputError
        No positive number.
    """
    if type(time_limit) is float and time_limit > 0.0:
        return time_limit
    if time_limit is None or (isinstance(time_limit, np.floating) and time_limit == np.inf):
        return math.inf
    return check_float("time_limit", time_limit, above=0.0)


def _deadline(spec: SolverSpec, limit: float, begun: float | None = None) -> Deadline:
    """Of a call with that limit [s]; code of others, and what it needs of SciPy, is imported before its clock."""
    if limit == math.inf:
        return NEVER
    if spec.external or not spec.builtin:
        spec.load()
        import_numerics(*(() if spec.external else spec.requires))
        begun = None
    return Deadline(limit, begun)


def check_budget(spec: SolverSpec, tol: float, max_iter: int | None) -> tuple[float, int]:
    """Both as numbers, `max_iter` the spec's where it is None.

    Raises
    ------
    InputError
        A wrong one.
    """
    tol = check_float("tol", tol, low=0.0)
    return tol, check_int("max_iter", spec.max_iter if max_iter is None else max_iter)


def _check_records(spec: SolverSpec, history: bool, callback: Callback | None) -> None:
    if callback is not None and not callable(callback):
        raise InputError(f"callback is {callback!r}; a function of (iterations, impulse, residual) is needed")
    if (callback is not None and not spec.callback) or (check_bool("history", history) and not spec.history):
        raise CapabilityError(
            f"solver {spec.name!r} runs in one call; it takes no callback and records no history"
        )
