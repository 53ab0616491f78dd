"""`prepare` and the one sequence of every solve: check the arguments, set the solver up, run it, finish.

`lavender.solve`, `Prepared.solve`, `solve_many`, `solve_qp` and the engine's `solver=` start a solve here. The steps
are in `solving/loop.py`, the end is in `finish.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from threading import Lock
from time import perf_counter
from typing import TYPE_CHECKING, Any, NoReturn, cast

import numpy as np

from lavender.base.arrays import (
    ArrayLike,
    FloatArray,
    are_equal,
    as_array,
    check_bool,
    check_float,
    check_int,
    mark_read_only,
)
from lavender.base.deadline import (
    NEVER,
    UNLIMITED,
    Deadline,
    TooLate,
    limit_forming,
    stop_clock,
)
from lavender.base.errors import (
    BREAKDOWN,
    CapabilityError,
    InputError,
    InUse,
    UnknownName,
    format_error,
)
from lavender.base.lazy_import import import_numerical_modules
from lavender.judge.certificates import prove_infeasibility
from lavender.judge.residuals import (
    Residual,
    choose_start,
    combine_best_islands,
    get_zero_impulse_reference,
    measure_residual,
    reuse_or_judge_impulse,
)
from lavender.judge.solution import (
    CONVERGED,
    INFEASIBLE,
    NUMERICAL_ERROR,
    ROUNDOFF_LIMIT,
    TIME_LIMIT,
    Claim,
    Solution,
    name_start,
    sum_work_counts,
)
from lavender.problem import Problem, check_problem
from lavender.solvers.decisions import SMALL_ROWS
from lavender.solvers.islands import find_islands
from lavender.solvers.registry import Solver, SolverSpec, get
from lavender.solving.compiled_call import solve_small
from lavender.solving.finish import FinishedRun, decide_empty_rows, finish, name_lost_row
from lavender.solving.limits import import_before_limit, reserve_time_of_judge, start_limit
from lavender.solving.loop import MIN_TIME_LIMIT, Callback, Loop, get_stopping_test
from lavender.solving.velocity import accept_velocity, relative_tolerance
from lavender_ext.judge.measure import residuals_by_island

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from lavender.solvers.registry import SolverOptions

SOLVE_ARGUMENTS = (
    "impulse",
    "tol",
    "velocity_tol",
    "max_iter",
    "time_limit",
    "history",
    "callback",
)


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
    spec = get(solver)
    prepared = Prepared(problem, spec, cast("dict[str, Any]", options))
    begin = perf_counter()
    setup = prepared._setup
    # Form and factor all matrices that do not depend on b.
    if not problem.has_singular_program:
        if spec.builtin and not spec.external and problem.m > SMALL_ROWS:
            import_numerical_modules(*spec.lazy_modules)
        with suppress(*BREAKDOWN):  # A solve repeats it and reports the error.
            get_zero_impulse_reference(problem.disk)
            if setup.solver is not None:
                setup.solver.complete(setup.state)
    prepared.setup_time += perf_counter() - begin
    return prepared


class SetUp:
    """State of `Prepared`: a solver that is set up for its problem, or None, so that the next solve sets it up."""

    __slots__ = ("failure", "is_used", "solver", "state")

    def __init__(self, solver: Any = None, state: Any = None) -> None:
        self.solver = solver
        self.state = state  # Result of the solver's `prepare` or `update`.
        self.is_used = (
            False  # Whether a solve has used the state, so that the next solve has to update it.
        )
        self.failure = ""  # Arithmetic error that ended the set-up; empty if there was none.

    @property
    def checks_start(self) -> bool:
        """Whether the solver's stopping test judges the start, too, and keeps the best impulse of each island."""
        return get_stopping_test(self.state) is not None and bool(self.solver.checks_start)


class Prepared:
    """A solver prepared for a problem; `solve(problem2)` reuses the preparation if the structure is the same.

    It runs one solve at a time: calling `solve` during another `solve`, from another thread or from its callback,
    raises `InUse`. Threads may share a `Problem`, but each needs its own `Prepared`.
    """

    def __init__(
        self, problem: Problem, spec: SolverSpec, options: dict[str, Any], begin: bool = True
    ) -> None:
        # The time of checks counts as set-up: they may form A and convert ellipses to disks.
        start = perf_counter()
        check_accepted(problem, spec)
        for name in options:
            if name in SOLVE_ARGUMENTS and name not in spec.accepts:
                raise CapabilityError(
                    f"prepare does not take {name}=: give it to prepare(...).solve"
                )
        check_options(spec, options)
        self.spec = spec
        self.options = options
        self.problem = problem
        self._target: tuple[Problem, FloatArray] | None = (
            None  # [m/s] A problem and its targets b + J v*.
        )
        self._lock = Lock()
        self._setup = SetUp()
        self.setup_time = 0.0  # [s] Time of the preparation since the last solve.
        # `auto` has nothing to prepare before its compiled call for small problems.
        if begin and (options or not spec.delegates):
            self._set_up(problem)
        self.setup_time = perf_counter() - start

    def __repr__(self) -> str:
        return f"<Prepared {self.spec.name} for {self.problem!r}>"

    @property
    def is_foreign(self) -> bool:
        """Whether the solver is a backend or a plug-in, whose claims are checked."""
        return self.spec.external or not self.spec.builtin

    @property
    def solver(self) -> Any:
        """The solver; None if it is not set up."""
        return self._setup.solver

    @property
    def state(self) -> Any:
        """State that the solver has prepared; None if it is not set up."""
        return self._setup.state

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy or pickle the arguments only; the copy prepares the solver again, as two solves cannot share a state."""
        return partial(prepare, **self.options), (self.problem, self.spec.name)

    def solve(
        self,
        problem: Problem | None = None,
        *,
        b: ArrayLike | None = None,
        v_free: ArrayLike | None = None,
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

        Parameters
        ----------
        problem : Problem, optional
        b : (m,) m/s, optional
            New right-hand side of the prepared problem, in place of `problem`.
        v_free : (nv,) m/s, rad/s, optional
            New v* of a prepared problem in generalised coordinates, in place of `problem`. Unless b is given, the
            targets b + J v* of the rows stay.

        Raises
        ------
        InputError
            `problem` is given together with `b` or `v_free`, or one of these is not valid.
        InUse
            Another call of this object's `solve` has not returned yet.
        UnknownName
            An argument does not exist.
        """
        for name in unknown:
            raise UnknownName("argument of Prepared.solve", name, SOLVE_ARGUMENTS)
        deadline = start_limit(time_limit)
        original = self.problem if problem is None else problem
        if b is not None or v_free is not None:
            original = self._update_problem(problem, b, v_free)
        if type(original) is not Problem:
            check_problem(original)
        if velocity_tol is not None:
            tol = relative_tolerance(original, velocity_tol, tol)
        if not self._lock.acquire(False):
            raise InUse(
                f"this prepared {self.spec.name!r} is already solving: make one for each thread"
            )
        try:
            solution: Solution | None = None
            failed_call: tuple[int, ...] | None = None
            is_default = max_iter is None and callback is None and history is False
            if is_default and self.spec.delegates and not self.options:
                solution, failed_call = solve_small(original, self.spec, impulse, tol, deadline)
            if solution is not None:
                if original is not self.problem:
                    if not original.has_operator_of(self.problem):
                        check_accepted(original, self.spec)
                    self.problem = original
                    self._setup = SetUp()
            else:
                import_before_limit(self.spec, deadline)
                tol, max_iter = check_arguments(self.spec, tol, max_iter, history, callback)
                solution = self._solve(
                    original, impulse, tol, max_iter, deadline, history, callback, failed_call
                )
        finally:
            self._lock.release()
        return solution if velocity_tol is None else accept_velocity(solution, velocity_tol)

    def _update_problem(self, problem: Problem | None, b: Any, v_free: Any) -> Problem:
        """Return the prepared problem with a new right-hand side b or a new v*, see `solve`."""
        original = self.problem
        if problem is not None:
            raise InputError("problem is given with b or v_free: give problem.updated(b=...) alone")
        general = original.generalized
        if original.has_singular_program or (v_free is not None and general is None):
            return original.updated(b=b, v_free=v_free)
        target = None
        moved = general
        known = self._target
        if b is not None:
            b = as_array("b", b, (original.m,), unit="m/s")
        if v_free is not None:
            assert general is not None
            moved = general.with_jacobian(None, v_free)
            if b is None:
                is_known = known is not None and known[0] is original
                target = (
                    known[1] if known and is_known else original.b + general.multiply_by_v_free()
                )
                b = mark_read_only(target - moved.multiply_by_v_free())
        updated: Problem = original._with_rhs(b, moved, None)
        if target is not None:
            self._target = updated, target
        return updated

    def _solve(
        self,
        original: Problem,
        impulse: Any,
        tol: float,
        max_iter: int,
        deadline: Deadline = NEVER,
        history: bool = False,
        callback: Callback | None = None,
        failed_call: tuple[int, ...] | None = None,
    ) -> Solution:
        """Prepare, step and finish, without the compiled call for small problems; solvers get `original.disk`.

        The arguments are checked, `failed_call` has the work counts of a compiled call that has failed.
        """
        start = None if impulse is None else original.make_start(impulse)
        setup = self._setup
        if setup.solver is None or setup.is_used or original is not self.problem:
            setup = self._set_up(original, deadline)
        problem = original.disk
        has_default_start = start is None and original.guess is None
        if start is None:
            start = original._start.copy() if original.guess is None else original.guess.copy()
        if problem is not original:
            start = original.on_disk(start)
            callback = (
                None
                if callback is None
                else partial(_call_in_original_tangents, original, callback)
            )
        loop = Loop(
            problem=problem,
            solver=None,
            state=None,
            impulse=start,
            tol=tol,
            deadline=deadline,
            callback=callback,
            records=[] if history else None,
        )
        if setup.solver is not None:
            setup.is_used = True
            loop.solver, loop.state = setup.solver, setup.state
            if deadline.is_set:
                self._start_workers(setup, deadline)
                if self.spec.builtin and not self.spec.external:
                    reserve_time_of_judge(problem, deadline)
            if self.spec.delegates:
                setup.state.failed_call = failed_call
                setup.state.has_given_start = not has_default_start
                setup.state.loop = loop if history else None
        solution = self._run(loop, setup, max_iter, has_default_start)
        if problem is not original:
            result = mark_read_only(original.cones.stretch * solution.impulse)
            proof = solution.certificate
            # The impulse is judged again, because multiplying it by the scale of the ellipses rounds it.
            judged = measure_residual(original, result, "float64", tol=tol)
            proof = None if proof is None else mark_read_only(original.cones.stretch * proof)
            solution = replace(solution, impulse=result, residual=judged, certificate=proof)
        name = name_start(original.guess, impulse)
        return solution.with_fields(start=name) if name else solution

    # -- set-up ----------------------------------------------------------------------------------

    def _set_up(self, original: Problem, deadline: Deadline = NEVER) -> SetUp:
        """Set the solver up for a problem, unless the deadline has passed; reuse its state for the same structure.

        The problem replaces the old one unless an error is raised.
        """
        begin = perf_counter()
        spec = self.spec
        last = self._setup
        problem = original.disk
        is_other = original is not self.problem
        if is_other:
            if not original.has_operator_of(self.problem):
                check_accepted(original, spec)
            self.setup_time = 0.0
        if problem.metric.reference_energy < 0.0:
            # Compute the judge's reference before a solver gets the problem.
            get_zero_impulse_reference(problem)
        solver = last.solver
        setup = SetUp()
        if solver is None:
            solver = _make_solver(spec, self.options)
        if not deadline.has_passed():
            try:
                with limit_forming(deadline) if deadline.is_set else UNLIMITED:
                    if last.solver is not None and (
                        not is_other or same_structure(self.problem.disk, problem)
                    ):
                        state = solver.update(last.state, problem)
                    else:
                        state = solver.prepare(problem)
                setup = SetUp(solver, state)
            except InputError:
                raise  # The solver does not accept the problem.
            except TooLate:
                pass  # The solve returns TIME_LIMIT.
            except BREAKDOWN as error:
                setup.failure = format_error(error)
        self.problem, self._setup = original, setup
        self.setup_time += perf_counter() - begin
        return setup

    def _start_workers(self, setup: SetUp, deadline: Deadline) -> None:
        """Start the worker processes of a solver, without counting their start as time of the solve."""
        if self.spec.external or not self.spec.builtin or self.problem.has_singular_program:
            with stop_clock(deadline) as spent:
                setup.solver.start_workers(setup.state, deadline.get_remaining_seconds() or 0.0)
            self.setup_time += spent[0]

    # -- the run ---------------------------------------------------------------------------------

    def _run(self, loop: Loop, setup: SetUp, max_iter: int, has_default_start: bool) -> Solution:
        """Decide without the solver, or choose the start, run, select and solve feasible islands; then finish."""
        setup_time = self.setup_time
        self.setup_time = 0.0
        start = loop.impulse.copy()
        claim = self._decide_without_solver(loop, setup, max_iter)
        if claim is None:
            self._choose_start(loop, setup, start, has_default_start)
            claim = loop.run(max_iter) if self.spec.resumable else loop.run_in_one_call(max_iter)
            claim = self._select(loop, setup, claim, start)
            if claim.status is CONVERGED and not (claim.iterations or any(claim.work.values())):
                self._restore_solved_start(loop, start)
            if claim.certificate is not None and claim.status is INFEASIBLE and loop.tol > 0.0:
                claim = self._solve_feasible_islands(loop, claim, max_iter)
        return self._finish(loop, claim, start, setup_time)

    def _decide_without_solver(self, loop: Loop, setup: SetUp, max_iter: int) -> Claim | None:
        """Return the claim of a problem that no solver can or may solve; else None."""
        problem = loop.problem
        if len(problem.metric.empty):
            proof = decide_empty_rows(problem, loop.impulse, loop.tol)
            if proof is not None:
                message, certificate, impossible = proof
                claim = Claim(INFEASIBLE, 0, {}, message, certificate=certificate)
                return self._solve_with_zero_b(loop, claim, impossible, max_iter)
        if setup.failure:
            return Claim(NUMERICAL_ERROR, 0, {}, setup.failure)
        if setup.solver is None or (loop.deadline.has_passed() and not self.spec.external):
            loop.keep_start()
            return Claim(TIME_LIMIT, 0)
        return None

    def _choose_start(
        self, loop: Loop, setup: SetUp, start: FloatArray, has_default_start: bool
    ) -> None:
        """Let the zero impulse replace a given start where it is better, unless the solver does this itself."""
        problem = loop.problem
        is_given = not (has_default_start or problem.has_singular_program)
        if loop.tol > 0.0 and is_given and not (setup.checks_start or self.spec.delegates):
            # The start is judged as given, as in compiled calls, but empty rows keep their bounds.
            begin = choose_start(problem, start, loop.tol)
            changed = (begin != start) & (loop.impulse == start)
            loop.impulse[changed] = begin[changed]

    def _select(self, loop: Loop, setup: SetUp, claim: Claim, start: FloatArray) -> Claim:
        """Select the best of result and start in each island, unless an own solver claims what the judge confirms.

        `auto` and the checks of sweeps have stored the best impulse of each island, including the start.
        """
        is_confirmed = not self.is_foreign and claim.status in (CONVERGED, ROUNDOFF_LIMIT)
        if loop.tol == 0.0 or is_confirmed:
            return claim
        problem = loop.problem
        claim = name_lost_row(problem, loop.impulse, claim)
        has_checks = setup.checks_start
        keeps_best = self.spec.delegates and not problem.has_singular_program
        checked = has_checks and loop.state.watch.has_best
        if keeps_best or checked or (has_checks and claim.status is not TIME_LIMIT):
            return claim
        claimed = loop.impulse.copy()
        loop.replace_by_best_impulse(start, claim)
        if claim.status is CONVERGED and not np.array_equal(claimed, loop.impulse):
            relative = measure_residual(problem, claimed).relative
            if relative > loop.tol:
                found = f"its own impulse has a relative residual of {relative:.2e}"
                claim = replace(claim, refutation=found)
        return claim

    def _restore_solved_start(self, loop: Loop, start: FloatArray) -> None:
        """Return a start (m,) that is a solution bit for bit: a solver without work may have scaled or clipped it."""
        if self.is_foreign or np.array_equal(loop.impulse, start):
            return
        judged = reuse_or_judge_impulse(loop.problem, start)
        if judged.relative <= loop.tol:
            loop.impulse[:] = start
            loop.judged = judged

    def _finish(self, loop: Loop, claim: Claim, start: FloatArray, setup_time: float) -> Solution:
        """Build the solution: the judge's residual, the status, the message."""
        if claim.judged is not loop.judged:
            claim = replace(claim, judged=loop.judged)
        return finish(
            FinishedRun(
                loop.problem,
                self.spec,
                self.options,
                loop.impulse,
                claim,
                tol=loop.tol,
                start=start,
                setup_time=setup_time,
                solve_time=loop.time,
                history=None if loop.records is None else loop.get_history(),
                sweeps_per_decade=float(getattr(loop.state, "sweeps_per_decade", math.nan)),
                deadline=loop.deadline,
            )
        )

    def _solve_feasible_islands(self, loop: Loop, claim: Claim, max_iter: int) -> Claim:
        """Solve the islands that the certificate of an INFEASIBLE claim does not concern, unless they meet tol."""
        assert claim.certificate is not None
        problem = loop.problem
        count, label = find_islands(problem)
        if count < 2:
            return claim
        proof = prove_infeasibility(problem, claim.certificate, loop.tol)
        if proof.reason:
            return claim
        _, table = residuals_by_island(problem.metric, loop.impulse)
        row_label = np.repeat(label, np.diff(problem.cones.ptr))
        infeasible = np.bincount(row_label, proof.y != 0.0, minlength=count) > 0
        if np.all(infeasible | (table[:, 0] <= loop.tol)):
            return claim
        return self._solve_with_zero_b(loop, claim, infeasible[row_label], max_iter)

    def _solve_with_zero_b(self, loop: Loop, claim: Claim, rows: Any, max_iter: int) -> Claim:
        """Solve with b = 0 on rows that cannot be met, so that other islands get an impulse; return the same claim."""
        max_iter -= claim.iterations
        if loop.tol == 0.0 or max_iter < 0 or loop.deadline.has_passed():
            return claim
        problem = loop.problem
        start = loop.impulse.copy()
        b = problem.b.copy()
        b[rows] = start[rows] = 0.0
        try:
            others = Prepared(problem.updated(b=b), self.spec, self.options)
        except InputError:  # The remaining entries of b are below the accepted range.
            return claim
        left = loop.deadline.get_remaining_seconds(MIN_TIME_LIMIT)
        solution = others.solve(impulse=start, tol=loop.tol, max_iter=max_iter, time_limit=left)
        impulses = (solution.impulse,)
        loop.impulse[:] = combine_best_islands(
            problem, loop.impulse, impulses, loop.tol, by_energy=True
        )
        loop.time += solution.setup_time + solution.solve_time
        work = sum_work_counts((claim.work, solution.work))
        return replace(claim, iterations=claim.iterations + solution.iterations, work=work)


def check_options(
    spec: SolverSpec, options: Iterable[str], arguments: Iterable[str] = SOLVE_ARGUMENTS
) -> None:
    """Raise an error for the first option that the solver does not take; `arguments` are those of the caller."""
    for name in options:
        if name in spec.accepts:
            continue
        if name in ("order", "ground", "seed"):
            accepted = ", ".join(sorted(spec.accepts)) or "no options"
            raise CapabilityError(
                f"solver {spec.name!r} does not take {name}=; it takes: {accepted}"
            )
        known = {*spec.accepts, *arguments, "solver"}
        raise UnknownName(f"option of solver {spec.name!r}", name, known)


def check_accepted(problem: Problem, spec: SolverSpec) -> None:
    """Raise an error if the argument is not a problem or the solver refuses it."""
    reason = spec.refuses(problem)
    if reason:
        raise CapabilityError(f"solver {spec.name!r} {reason}")


def check_arguments(
    spec: SolverSpec, tol: float, max_iter: int | None, history: Any = False, callback: Any = None
) -> tuple[float, int]:
    """Check arguments of a solve; return tol and max_iter, which is the default of the spec if it is None."""
    if type(tol) is not float or not 0.0 <= tol <= 1.0:
        tol = check_float("tol", tol, low=0.0)
    if max_iter is None:
        max_iter = spec.max_iter
    elif type(max_iter) is not int or not 0 <= max_iter < 2**31:
        max_iter = check_int("max_iter", max_iter)
    if callback is not None:
        if not callable(callback):
            raise InputError(
                f"callback is {callback!r}; a function (iterations, impulse, residual) is needed"
            )
        if not spec.callback:
            raise CapabilityError(
                f"solver {spec.name!r} runs in one call; a solver of lavender.available(callback=True) is needed"
            )
    if history is not False and check_bool("history", history) and not spec.history:
        raise CapabilityError(
            f"solver {spec.name!r} runs in one call; a solver of lavender.available(history=True) is needed"
        )
    return tol, max_iter


def _call_in_original_tangents(
    original: Problem, callback: Callback, done: int, impulse: FloatArray, _: Residual
) -> Any:
    """Call the callback of a problem with ellipses with an impulse (m,) [N s] of its `disk`."""
    impulse = original.cones.stretch * impulse
    return callback(done, impulse, measure_residual(original, impulse, "float64"))


def _make_solver(spec: SolverSpec, options: dict[str, Any]) -> Solver:
    """Create the solver; wrap external ones (`ForeignSolver`) and own ones of bounded rows (`BoundedRowSolver`)."""
    factory = spec.load()
    try:
        solver = factory(**options)
    except (TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"solver {spec.name!r} cannot take the options {options}: {error}"
        ) from error
    if spec.external or not spec.builtin:
        # Import the adapters of other packages only here, because they take a quarter of the time of `import lavender`.
        from lavender.solvers.foreign import ForeignSolver

        return ForeignSolver(spec, solver)
    if spec.box_friction_laws <= spec.laws:
        return solver
    # Import this module here, because it imports the table of solvers.
    from lavender.solvers.polyhedral import BoundedRowSolver

    return BoundedRowSolver(solver)


def same_structure(p: Problem, q: Problem) -> bool:
    """Return whether two problems have the same blocks, form of A, and bodies or sparsity pattern."""
    if p.has_operator_of(q):
        return True
    if (
        not (are_equal(p.cones.ptr, q.cones.ptr) and are_equal(p.cones.kind, q.cones.kind))
        or p.law != q.law
    ):
        return False
    if p.rows is not None and q.rows is not None:
        pairs = (p.rows.joint_body, q.rows.joint_body), (p.rows.contact_body, q.rows.contact_body)
        return p.rows.n_bodies == q.rows.n_bodies and all(are_equal(*pair) for pair in pairs)
    if p.operator != q.operator:
        return False
    if p.generalized is not None and q.generalized is not None:
        patterns = (
            (*g.operator.jac[:2], *g.operator.mass[:2]) for g in (p.generalized, q.generalized)
        )
        return all(map(are_equal, *patterns))
    return all(map(are_equal, p._compressed[:2], q._compressed[:2]))
