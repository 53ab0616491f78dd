"""`prepare` and the one sequence of a solve: set a solver up, run it (`solvers/loop.py`), and judge the result."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from threading import Lock
from time import perf_counter
from typing import TYPE_CHECKING, Any, NoReturn, cast

import numpy as np

from lavender.base.arrays import ArrayLike, FloatArray, are_equal
from lavender.base.deadline import NEVER, Deadline, Stopwatch
from lavender.base.errors import BREAKDOWN, CapabilityError, InputError, InUse, UnknownName, format_error
from lavender.base.lazy_import import import_numerical_modules
from lavender.external.foreign import ForeignSolver
from lavender.judge.certificates import prove_infeasibility
from lavender.judge.residuals import (
    Residual,
    combine_best_islands,
    convert_residual_from_disk,
    find_relative_at_zero,
    get_zero_impulse_reference,
    replace_stale_start,
    residual,
)
from lavender.judge.solution import (
    CONVERGED,
    INFEASIBLE,
    NUMERICAL_ERROR,
    ROUNDOFF_LIMIT,
    TIME_LIMIT,
    Claim,
    Solution,
    sum_work_counts,
)
from lavender.problem import Problem, check_problem
from lavender.solvers.certify import check_infeasibility_claim
from lavender.solvers.costs import (
    SCIPY_MODULES,
    estimate_import_cost,
    estimate_judge_setup_cost,
    estimate_pass_cost,
    estimate_result_cost,
)
from lavender.solvers.islands import find_islands
from lavender.solvers.loop import MIN_TIME_LIMIT, Callback, Loop, Record
from lavender.solvers.registry import SMALL_ROWS, Solver, SolverSpec, get
from lavender.solving.compiled_call import solve_small
from lavender.solving.limits import (
    check_accepted,
    check_budget,
    check_records,
    check_time_limit,
    is_tight,
    is_too_late,
    make_deadline,
)
from lavender.solving.outcome import create_unjudged, decide_empty_rows, finish, name_lost_row
from lavender.solving.velocity import accept_velocity, relative_tolerance
from lavender_ext.judge.measure import residuals_by_island
from lavender_ext.judge.stopping_test import StoppingTest

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from lavender.solvers.registry import SolverOptions

# [passes of the judge] Cost of judging `auto`'s last iterate and of selecting the best iterate of each island.
SELECTION_PASSES = 3
SETUP_LATE_MESSAGE = "what has to be set up first takes longer than the time limit"
JUDGE_LATE_MESSAGE = "what the judge reads takes longer than the time limit: the start, unjudged"
WITHOUT_SCIPY_MESSAGE = (
    "without SciPy, which this process has not loaded: import scipy.linalg.lapack, scipy.sparse before"
)
SOLVE_ARGUMENTS = ("impulse", "tol", "velocity_tol", "max_iter", "time_limit", "history", "callback")


def prepare(problem: Problem, solver: str = "auto", **options: Unpack[SolverOptions]) -> Prepared:
    """Prepare a solver once for many solves: factorisation, colouring, allocation.

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
        `prepared.solve(impulse=..., tol=...)` solves this problem. `prepared.solve(problem2, ...)` solves another
        problem and keeps it: the next `prepared.solve()` solves `problem2`. The preparation is reused if `problem2`
        has the same structure (blocks, sparsity pattern of A or J). `setup_time` [s] is the time of the preparation.

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
    raises `InUse`. Threads may share a `Problem`, but each needs its own `Prepared`.
    """

    def __init__(
        self,
        problem: Problem,
        spec: SolverSpec,
        options: dict[str, Any],
        begin: bool = True,
        deadline: Deadline = NEVER,
    ) -> None:
        # The time of checks counts as set-up: they may form A and convert ellipses to disks.
        watch = Stopwatch()
        late = check_accepted(problem, spec, deadline)
        for name in options:
            if name not in spec.accepts:
                if name in SOLVE_ARGUMENTS:
                    raise CapabilityError(
                        f"prepare does not take {name}=; give it to the method solve of the returned "
                        f"object: prepare(...).solve({name}=...)"
                    )
                if name in ("order", "ground", "seed"):
                    raise CapabilityError(
                        f"solver {spec.name!r} does not take {name}=; it takes: "
                        f"{', '.join(sorted(spec.accepts)) or 'no options'}"
                    )
                valid = {*spec.accepts, *SOLVE_ARGUMENTS, "solver"}
                kind = f"option of solver {spec.name!r}"
                raise UnknownName(kind, name, valid)
        self.spec = spec
        self.options = options
        self._original, self.problem = problem, problem if late else problem.disk
        self._lock = Lock()
        # `auto` has nothing to prepare before its compiled call for small problems.
        if begin and (options or not spec.delegates):
            self._prepare_solver(NEVER)
        self.setup_time = watch.elapsed_seconds

    def __repr__(self) -> str:
        return f"<Prepared {self.spec.name} for {self._original!r}>"

    solver: Any = None  # Created when it is first needed.
    setup_time = 0.0  # [s] Time of the preparation.
    _is_fresh = True  # Whether no solve has used the state yet.
    _failure = ""  # Reason why no state exists, or empty.
    _is_late = False  # Whether no state exists because building it would have exceeded the time limit.

    def _prepare_solver(self, deadline: Deadline) -> None:
        """Create the solver and its state."""
        watch = Stopwatch()
        self.problem = self._original.disk
        self.solver = _make_solver(self.spec, self.options)
        try:
            self._set_up(self.problem, True, deadline)
        except BaseException:
            self.solver = None  # Makes the next call try again.
            raise
        self._is_fresh = True
        self.setup_time += watch.elapsed_seconds

    def _replace_problem(self, problem: Problem | None, deadline: Deadline = NEVER) -> None:
        """Replace the prepared problem by another one, if one is given, without a set-up."""
        if problem is not None and problem is not self._original:
            late = check_accepted(problem, self.spec, deadline)
            self._original, self.problem, self.solver = problem, problem if late else problem.disk, None

    def solve(
        self,
        problem: Problem | None = None,
        *,
        impulse: ArrayLike | None = None,
        tol: float = 1e-6,
        velocity_tol: float | None = None,
        max_iter: int | None = None,
        time_limit: float | None = None,
        history: bool = False,
        callback: Callback | None = None,
        **unknown: NoReturn,
    ) -> Solution:
        """Solve as `lavender.solve`; `problem`, if given, replaces the prepared one unless an error is raised.

        Raises
        ------
        InUse
            Another call of this object's `solve` has not returned yet.
        UnknownName
            An argument does not exist.
        """
        for name in unknown:
            raise UnknownName("argument of Prepared.solve", name, SOLVE_ARGUMENTS)
        begun = 0.0 if time_limit is None else perf_counter()
        limit = math.inf if time_limit is None else check_time_limit(time_limit)
        original = self._original if problem is None else problem
        if velocity_tol is not None:
            check_problem(original)
            tol = relative_tolerance(original, velocity_tol)
        if not self._lock.acquire(False):
            raise InUse(
                f"this prepared {self.spec.name!r} is already solving, and it can run one solve at a time: "
                "make one for each thread (lavender.prepare)"
            )
        try:
            solution: Solution | None = None
            failed_call: tuple[int, ...] | None = None
            is_default = max_iter is None and callback is None and history is False
            if is_default and self.spec.delegates and not self.options:
                solution, failed_call = solve_small(original, self.spec, impulse, tol, limit)
            if solution is not None:
                self._replace_problem(problem)
            else:
                deadline = make_deadline(self.spec, limit, begun)
                solution = self._solve(
                    problem, impulse, tol, max_iter, deadline, history, callback, failed_call
                )
        finally:
            self._lock.release()
        return solution if velocity_tol is None else accept_velocity(solution, velocity_tol)

    def _solve(
        self,
        problem: Problem | None,
        impulse: ArrayLike | None,
        tol: float,
        max_iter: int | None,
        deadline: Deadline,
        history: bool = False,
        callback: Callback | None = None,
        failed_call: tuple[int, ...] | None = None,
    ) -> Solution:
        """Solve as `solve`, without the compiled call; `failed_call` holds its counts if it has been made."""
        try:
            original = self._original if problem is None else problem
            tol, max_iter = check_budget(self.spec, tol, max_iter)
            check_records(self.spec, history, callback)
            check_problem(original)
            tight = is_tight(original, deadline)
            if tight and is_too_late(original, self.spec, deadline):
                self._replace_problem(problem, deadline)
                return create_unjudged(original, self.spec, self.options, impulse, tol, JUDGE_LATE_MESSAGE)
            disk = original.disk
            start = None if impulse is None else original.on_disk(disk.impulse_array(impulse))
            if tight:
                # The judge makes one pass for the result, and one for a start that is not zero.
                passes = 2 if start is not None or disk.guess is not None else 1
                judge_time = 1e-9 * passes * estimate_result_cost(disk)
                setup_time = 1e-9 * estimate_judge_setup_cost(disk)
                if deadline.has_passed(setup_time + judge_time) and not self.spec.external:
                    self._replace_problem(problem)
                    return create_unjudged(
                        original, self.spec, self.options, impulse, tol, JUDGE_LATE_MESSAGE
                    )
                deadline.reserve_seconds(judge_time)
                selection_time = 1e-9 * SELECTION_PASSES * estimate_pass_cost(disk)
                if self.spec.delegates and not deadline.has_passed(4.0 * selection_time):
                    deadline.reserve_seconds(selection_time)
            if self.solver is None:
                self._replace_problem(problem)
                self._prepare_solver(deadline)
            self._refresh(problem, deadline)
            loop = self._loop(start, tol, deadline, history, callback)
            if self.spec.delegates and self.state is not None:
                self.state.failed_call, self.state.loop = failed_call, loop if history else None
            return self._run(loop, max_iter)
        finally:
            if self._is_late:
                self.solver, self._is_late = None, False  # Makes the next call try again.

    def _loop(
        self,
        lam: FloatArray | None,
        tol: float,
        deadline: Deadline,
        history: bool,
        callback: Callback | None,
    ) -> Loop:
        """Build the loop of a solve, and start the worker processes of the solver."""
        problem, original = self.problem, self._original
        if original is not problem and callback is not None:
            callback = _make_callback_in_original_tangents(original, original.cones.stretch, callback)
        if lam is None:
            lam = problem.start() if problem.guess is None else problem.guess.copy()
        left = deadline.get_remaining_seconds()
        has_workers = self.spec.external or not self.spec.builtin or problem.has_singular_program
        if left is not None and has_workers and not self._is_late and not self._failure:
            watch = Stopwatch()
            self.solver.start_workers(self.state, left)
            deadline.reserve_seconds(-watch.elapsed_seconds)
            self.setup_time += watch.elapsed_seconds
        records: list[Record] | None = [] if history else None
        return Loop(
            problem=problem, solver=self.solver, state=self.state, impulse=lam, tol=tol, deadline=deadline,
            callback=callback, records=records,
        )  # fmt: skip

    def _run(self, loop: Loop, max_iter: int) -> Solution:
        """Run the solver unless the problem is decided without it, and build the solution."""
        spec, problem = self.spec, self.problem
        setup_time, self.setup_time = self.setup_time, 0.0
        given, refutation = loop.impulse.copy(), ""
        proof = decide_empty_rows(problem, loop.impulse, loop.tol)
        if proof is not None:
            message, certificate, impossible = proof
            claim = Claim(INFEASIBLE, 0, {}, message, certificate=certificate)
            claim = self._solve_with_zero_b(loop, claim, impossible, max_iter)
        elif self._failure:
            claim = Claim(NUMERICAL_ERROR, 0, {}, self._failure)
        elif self._is_late or (loop.deadline.has_passed() and not spec.external):
            # If the start is the zero impulse, no better impulse can be selected, and judging is postponed.
            at_zero = find_relative_at_zero(problem, loop.impulse)
            if (
                at_zero is not None
                and at_zero > loop.tol
                and loop.records is None
                and loop.deadline.has_passed()
            ):
                start = loop.impulse
                if self._original is not problem:
                    start = self._original.cones.stretch * loop.impulse
                message = f"{SETUP_LATE_MESSAGE}: the start, unjudged"
                return create_unjudged(
                    self._original, spec, self.options, start, loop.tol, message, setup_time
                )
            claim = Claim(TIME_LIMIT, 0, {}, SETUP_LATE_MESSAGE)
            loop.replace_by_best_impulse(loop.impulse)
        else:
            has_checks = isinstance(getattr(self.state, "watch", None), StoppingTest)
            if loop.tol > 0.0 and not has_checks and not spec.delegates and not problem.has_singular_program:
                # Judge the start as given, as compiled calls do: without its empty rows it may be worse than zero.
                kept = given.copy()
                replace_stale_start(problem, kept)
                is_stale = kept != given
                loop.impulse[is_stale] = kept[is_stale]
            start = loop.impulse.copy()
            claim = loop.run(max_iter) if spec.resumable else loop.run_in_one_call(max_iter)
            # Own solvers claim only what the judge confirms.
            is_own = spec.builtin and not spec.external
            if loop.tol > 0.0 and not (is_own and claim.status in (CONVERGED, ROUNDOFF_LIMIT)):
                claim = name_lost_row(problem, loop.impulse, claim)
                # `auto` and the checks of sweeps have stored the best impulse of each island, including the start.
                keeps_best = spec.delegates and not problem.has_singular_program
                if not keeps_best and (claim.status is TIME_LIMIT or not has_checks):
                    claimed = loop.impulse.copy()
                    loop.replace_by_best_impulse(start, or_zero=claim.status is TIME_LIMIT)
                    if claim.status is CONVERGED and not np.array_equal(claimed, loop.impulse):
                        relative = residual(problem, claimed).relative
                        if relative > loop.tol:
                            refutation = f"its own impulse has a relative residual of {relative:.2e}"
            if (
                claim.status is TIME_LIMIT
                and spec.delegates
                and problem.m > SMALL_ROWS
                and estimate_import_cost(*SCIPY_MODULES)
            ):
                claim = replace(claim, message=f"{claim.message}; {WITHOUT_SCIPY_MESSAGE}")
        if claim.status is INFEASIBLE and (spec.external or not spec.builtin):
            claim, _, refutation = check_infeasibility_claim(problem, claim, loop.tol, loop.deadline)
        if claim.status is INFEASIBLE and claim.certificate is not None and loop.tol > 0.0 and proof is None:
            claim = self._without_infeasible_islands(loop, claim, max_iter)
        claim = replace(claim, judged=loop.judged)
        solution = finish(
            problem, spec, self.options, loop.impulse, claim, loop.tol, setup_time, loop.time, loop.get_history(),
            float(getattr(self.state, "sweeps_per_decade", math.nan)), refutation,
        )  # fmt: skip
        return solution if self._original is problem else solution.convert_from_disk(self._original)

    def _without_infeasible_islands(self, loop: Loop, claim: Claim, max_iter: int) -> Claim:
        """Solve the islands that the certificate of an INFEASIBLE claim does not concern, unless they meet tol."""
        assert claim.certificate is not None
        count, label = find_islands(self.problem)
        if count < 2:
            return claim
        proof = prove_infeasibility(self.problem, claim.certificate, loop.tol)
        if proof.reason:
            return claim
        _, table = residuals_by_island(self.problem.metric, loop.impulse)
        row_label = np.repeat(label, np.diff(self.problem.cones.ptr))
        infeasible = np.bincount(row_label, proof.y != 0.0, minlength=count) > 0
        if np.all(infeasible | (table[:, 0] <= loop.tol)):
            return claim
        return self._solve_with_zero_b(loop, claim, infeasible[row_label], max_iter)

    def _solve_with_zero_b(self, loop: Loop, claim: Claim, rows: Any, max_iter: int) -> Claim:
        """Solve with b = 0 on rows that cannot be met, so that other islands get an impulse; return the same claim."""
        if loop.tol == 0.0 or loop.deadline.has_passed():
            return claim
        b, start = self.problem.b.copy(), loop.impulse.copy()
        b[rows] = start[rows] = 0.0
        try:
            others = Prepared(self.problem.updated(b=b), self.spec, self.options)
        except InputError:  # The remaining entries of b are below the accepted range.
            return claim
        solution = others.solve(
            impulse=start,
            tol=loop.tol,
            max_iter=max_iter,
            time_limit=loop.deadline.get_remaining_seconds(MIN_TIME_LIMIT),
        )
        loop.impulse[:] = combine_best_islands(
            self.problem, (loop.impulse,), (solution.impulse,), loop.tol, by_residual=True
        )
        loop.time += solution.setup_time + solution.solve_time
        work = sum_work_counts((claim.work, solution.work))
        return replace(claim, iterations=claim.iterations + solution.iterations, work=work)

    def _refresh(self, problem: Problem | None, deadline: Deadline) -> None:
        """Update the state for another problem, or for another solve of the same problem."""
        if problem is None or problem is self._original:
            if not self._is_fresh:
                self._set_up(self.problem, False, deadline)
        else:
            watch = Stopwatch()
            check_accepted(problem, self.spec)
            original, problem = problem, problem.disk
            self._set_up(problem, not same_structure(self.problem, problem), deadline)
            self.setup_time = watch.elapsed_seconds
            # Assign the problem last, so that it does not replace the old problem if its set-up raises an error.
            self._original, self.problem = original, problem
        self._is_fresh = False

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy or pickle the arguments only; the copy prepares the solver again, as two solves cannot share a state."""
        return partial(prepare, **self.options), (self._original, self.spec.name)

    def _set_up(self, problem: Problem, is_new: bool, deadline: Deadline) -> None:
        """Build the state, or update it for a problem of the same structure, if its estimated time fits.

        Otherwise, and after a breakdown, the state is None; after a breakdown, the next call builds it anew.
        """
        if problem.metric.reference_energy < 0.0:
            get_zero_impulse_reference(
                problem
            )  # Compute the judge's reference before a solver gets the problem.
        is_new, self._failure = is_new or bool(self._failure), ""
        if deadline.is_set and not self.spec.delegates:  # `auto` prepares nothing.
            self._is_late = deadline.has_passed(1e-9 * self.solver.cost(problem).setup)
            if self._is_late and self.solver.needs_scipy and estimate_import_cost(*SCIPY_MODULES):
                # Import SciPy without counting the time, like the start of processes; otherwise no call with this
                # limit could ever import it.
                watch = Stopwatch()
                import_numerical_modules()
                deadline.reserve_seconds(-watch.elapsed_seconds)
                self._is_late = deadline.has_passed(1e-9 * self.solver.cost(problem).setup)
            if self._is_late:
                self.state = None
                return
        try:
            if is_new:
                self.state = self.solver.prepare(problem)
            else:
                self.state = self.solver.update(self.state, problem)
        except InputError:
            raise  # The solver does not accept the problem.
        except BREAKDOWN as error:
            self.state, self._failure = None, format_error(error)


def _make_callback_in_original_tangents(
    problem: Problem, stretch: FloatArray, callback: Callback
) -> Callback:
    """Return a callback for `problem.disk` that calls `callback` with impulse and residual of `problem`."""

    def call(done: int, impulse: FloatArray, judged: Residual) -> Any:
        return callback(done, stretch * impulse, convert_residual_from_disk(problem, judged))

    return call


def _make_solver(spec: SolverSpec, options: dict[str, Any]) -> Solver:
    """Create the solver; wrap external ones (`ForeignSolver`) and own ones of bounded rows (`BoundedRowSolver`)."""
    factory = spec.load()
    try:
        solver = factory(**options)
    except (TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"solver {spec.name!r} cannot take the options {options}: {error}") from error
    if not spec.builtin:
        return ForeignSolver(spec.name, solver)
    if spec.box_friction_laws <= spec.laws:
        return solver
    # Import this module here, because it imports the table of solvers.
    from lavender.solvers.polyhedral import BoundedRowSolver

    return BoundedRowSolver(solver)


def same_structure(p: Problem, q: Problem) -> bool:
    """Return whether two problems have the same blocks, form of A, and bodies or sparsity pattern."""
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
            for name in ("jac", "mass")
            for x, y in zip(
                getattr(p.generalized.operator, name)[:2],
                getattr(q.generalized.operator, name)[:2],
                strict=True,
            )
        )
    return are_equal(p.csr.indptr, q.csr.indptr) and are_equal(p.csr.indices, q.csr.indices)
