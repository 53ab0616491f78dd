"""Solve many problems in one call, with results that are bit-identical to `solve`, in arrays.

The compiled loop of `lavender/batch/residuals.py` solves the problems that it supports; every other problem is solved
by a single `solve`. A `Solution` is built at its first access.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from time import perf_counter
from typing import TYPE_CHECKING, Any, cast, overload

import numpy as np

from lavender.base.arrays import FloatArray, check_int, format_html_table, mark_read_only
from lavender.base.deadline import Deadline
from lavender.base.errors import InputError, LavenderError, require_packages
from lavender.batch.data import Batch
from lavender.batch.residuals import (
    WorldResults,
    check_problems,
    convert_impulses_or_guesses,
    residual_many,
)
from lavender.judge.residuals import Residual, judge_impulse, make_residual, residual
from lavender.judge.solution import CONTRADICTED, Solution, Status, name_start, raise_if_interrupted
from lavender.problem import Problem
from lavender.problem.derived import cached_property
from lavender.solvers.registry import SolverSpec, get
from lavender.solving.compiled_call import compute_postponed_fields
from lavender.solving.limits import start_limit
from lavender.solving.loop import MIN_TIME_LIMIT
from lavender.solving.prepared import SOLVE_ARGUMENTS, Prepared, check_arguments, check_options
from lavender.solving.solve import solve
from lavender.solving.velocity import (
    MAX_VELOCITY_TOLERANCE,
    accept_velocity,
    check_velocity_tolerance,
)
from lavender_ext.batch.many import CODE, NUMBER, Worker
from lavender_ext.judge.measure import all_finite

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from lavender.solvers.registry import SolverOptions
    from lavender.solving.loop import Callback

    class ManyOptions(SolverOptions, total=False):
        """Options of `solve` that `solve_many` passes on."""

        history: bool
        callback: Callback | None


STATUS_OF_INDEX = np.array(list(Status), object)
MANY_ARGUMENTS = (*SOLVE_ARGUMENTS, "impulses", "threads", "errors", "like")
INDEX_OF_STATUS = {status: i for i, status in enumerate(Status)}


class Solutions(WorldResults, Sequence[Solution]):
    """Results of `solve_many`, in arrays; `many[i]` is the `Solution` of world i, in NumPy arrays.

    Arrays are read-only NumPy arrays, or copies in the library of `like`, except `status` and `ptr`.

    `many[many.success]`, `many[2:5]` and `many[[0, 7]]` are lists of solutions. Access to a world with the status
    INVALID_PROBLEM raises its error.

    Parameters
    ----------
    impulse : N s
        (n, m) for a stacked batch, with 0 in padding rows; else a flat array of all rows, see `ptr`. For a world with
        the status INVALID_PROBLEM all numbers are NaN and all counts are 0.
    status : (n,) of Status
        INVALID_PROBLEM for a world with invalid data.
    relative, energy, velocity_error, impulse_error, roundoff_floor : (n,)
        Numbers of the judge [-, sqrt J, m/s, N s, -]; the errors are errors of the worst row.
    worst_row, iterations : (n,) int
    tol : float, -
    velocity_tol : float or None, m/s
        Requested velocity error, if the worlds were to be solved to one.
    faults : dict of int to LavenderError
        Errors of worlds with the status INVALID_PROBLEM, by their indices.
    """

    velocity_tol: float | None = None

    def __init__(
        self, problems: Any, starts: Any, tol: float, spec: SolverSpec, like: Any = None
    ) -> None:
        # Keep a copy of the starts of a batch, because the loop overwrites them.
        self._starts = starts.copy() if isinstance(starts, np.ndarray) else starts
        super().__init__(problems, starts, starts is None, like)
        self.tol, self._spec = tol, spec
        self._solutions: dict[int, Solution] = {}
        self._time_per_world = 0.0  # [s] Mean time of the worlds so far.

    def __getstate__(self) -> dict[str, Any]:
        return super().__getstate__() | {"_spec": self._spec.name}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _spec=get(state["_spec"]))

    @property
    def impulse(self) -> FloatArray:
        """Impulses [N s], see the class."""
        shape = self.problems.shape if type(self.problems) is Batch else self._impulse.shape
        return self._export(self._impulse.reshape(shape))

    @property
    def velocity(self) -> FloatArray:
        """v+ [m/s, rad/s]: (n, nv) for a stacked batch, else concatenated; problems given as a matrix have none."""
        return self._export(self._velocities)

    @cached_property
    def _velocities(self) -> FloatArray:
        if type(self.problems) is Batch:
            return mark_read_only(self._velocity.reshape(self.problems.velocity_shape))  # type: ignore[union-attr]
        velocities = [np.zeros(0)]
        for i, p in enumerate(self.problems):
            if p.matrix is None:
                v = p.velocity(
                    p._start if i in self.faults else self._impulse[self._get_rows(i)]
                ).ravel()
                velocities.append(np.full_like(v, np.nan) if i in self.faults else v)
        return mark_read_only(np.concatenate(velocities))

    @cached_property
    def status(self) -> np.ndarray:
        """Status of each world (n,), see the class."""
        code = self._worlds.code[:-1]
        out = np.where(
            code == CODE["late"],
            INDEX_OF_STATUS[Status.TIME_LIMIT],
            INDEX_OF_STATUS[Status.CONVERGED],
        )
        for i, solution in self._solutions.items():
            out[i] = INDEX_OF_STATUS[solution.status]
        for i in self.faults:
            out[i] = INDEX_OF_STATUS[Status.INVALID_PROBLEM]
        return mark_read_only(STATUS_OF_INDEX[out])

    @property
    def iterations(self) -> np.ndarray:
        """Iterations (n,) in the solver's own unit."""
        return self._export(self._worlds.counts[:-1, 0])

    @property
    def success(self) -> np.ndarray:
        """Whether each world (n,) has a relative residual up to `tol`, or a velocity error up to `velocity_tol`."""
        return self._export(self._is_solved)

    @property
    def _is_solved(self) -> np.ndarray:
        if self.velocity_tol is not None:
            return self._get_column("speed") <= self.velocity_tol
        floor = self._get_column("roundoff_floor") if self.tol > 0.0 else 0.0
        return np.maximum(self._get_column("relative"), floor) <= self.tol

    @property
    def ptr(self) -> np.ndarray:
        """First row of each world in a flat `impulse`, followed by the number of rows (n + 1,)."""
        return np.append(self._first, self._impulse.size)

    @property
    def flat_impulses(self) -> tuple[FloatArray, np.ndarray, np.ndarray]:
        """Flat array of all impulses [N s], and offset and number of rows of each world (n,)."""
        return mark_read_only(self._impulse.view()), self._first, self._sizes

    def get_start(self, i: int) -> Any:
        """Return the start (m,) [N s] of world i, or None if none was given."""
        if type(self.problems) is Batch:
            return None if self._starts is None else self._starts[self._get_rows(i)]
        return self._starts[i]

    def store_solution(self, i: int, solution: Solution) -> None:
        """Store the solution of a world that a single call solved."""
        if self.velocity_tol is not None:
            solution = accept_velocity(solution, self.velocity_tol)
        self._solutions[i] = solution
        self._impulse[self._get_rows(i)] = solution.impulse
        self._store_residual(i, solution.residual)
        self._worlds.counts[i, 0] = solution.iterations
        problem = solution.residual._problem
        if self._velocity is not None and self._velocity.size and problem.matrix is None:
            v = problem.velocity(solution.impulse).ravel()
            first = self.problems.at[i]["velocity"]  # type: ignore[attr-defined]
            self._velocity[first : first + len(v)] = v

    def clear_invalid(self) -> None:
        """Set the numbers of worlds with the status INVALID_PROBLEM to NaN and their counts to 0."""
        for i in self.faults:
            self._impulse[self._get_rows(i)] = np.nan
            self._worlds.counts[i], self._worlds.worst[i] = 0, -1
            if type(self.problems) is Batch and self._velocity is not None and self._velocity.size:
                world = self.problems.at[i]
                self._velocity[world["velocity"] : world["velocity"] + world["velocities"]] = np.nan

    @overload
    def __getitem__(self, i: int) -> Solution: ...
    @overload
    def __getitem__(self, i: Any) -> list[Solution]: ...
    def __getitem__(self, i: Any) -> Any:
        return super().__getitem__(i)

    def _get_result(self, i: int) -> Solution:
        if i not in self._solutions:
            self._solutions[i] = self._make_solution(i)
        if self.velocity_tol is not None and self._solutions[i].velocity_tol is None:
            self._solutions[i] = accept_velocity(self._solutions[i], self.velocity_tol)
        return self._solutions[i]

    def _make_solution(self, i: int) -> Solution:
        """Build the solution of a world that the compiled loop processed."""
        if not self._sizes[i]:
            return solve(self.problems[i], self._spec.name, tol=self.tol)
        impulse = self._impulse[self._get_rows(i)].copy()
        late = self._worlds.code[i] == CODE["late"]
        impulse.setflags(write=False)
        status = Status.TIME_LIMIT if late else Status.CONVERGED
        guess = None if type(self.problems) is Batch else self.problems[i].guess

        def judge_world(i: int) -> Residual:
            problem = self.problems[i]
            return make_residual(problem, judge_impulse(problem, impulse).refine(self.tol))

        return Solution.from_fields(
            {
                "impulse": impulse,
                "status": status,
                "tol": self.tol,
                "setup_time": 0.0,
                "solve_time": self._time_per_world,
                "residual": self._make_residual(i, judge_world),
                "start": name_start(guess, self.get_start(i)),
                "_rest": (self._make_postponed_fields, (i, impulse, status)),
            }
        )

    def _make_postponed_fields(self, i: int, impulse: FloatArray, status: Status) -> dict[str, Any]:
        """Compute the fields of a solution that are computed only at its first access."""
        problem = self.problems[i]
        judgement = judge_impulse(problem, impulse).refine(self.tol)
        is_start = self._worlds.code[i] in (CODE["late"], CODE["started"])
        counts = None if is_start else tuple(self._worlds.counts[i].tolist())
        fields = compute_postponed_fields(
            problem, self._spec, judgement, counts, self.get_start(i), status
        )
        solved_relative = float(self._worlds.numbers[NUMBER["relative"], i])
        # If the data have not changed since the solve, both residuals are bit-identical.
        if status is Status.CONVERGED and judgement.relative != solved_relative:
            fields["claim_check"] = CONTRADICTED
            fields["status_conflict"] = (
                f"says {status.name} of other data, with relative residual {solved_relative:.2e} (now "
                f"{judgement.relative:.2e}): the arrays of world {i} were written over after the solve"
            )
        return fields

    def to_pandas(self) -> Any:
        """Return a pandas DataFrame with a row for each world: its status, success and the numbers of the judge.

        The columns are `status`, `success`, `iterations`, `relative` [-], `energy` [sqrt J], `velocity_error` [m/s or
        rad/s], `impulse_error` [N s], `roundoff_floor` [-] and `worst_row`, its name or "" without one.
        """
        require_packages("Solutions.to_pandas", "pandas")
        import pandas as pd

        worst = np.asarray(self._worlds.worst[:-1]) if len(self) else np.zeros(0, int)
        names = [
            "" if i in self.faults or row < 0 else self.problems[i].row_name(int(row))
            for i, row in enumerate(worst)
        ]
        columns: dict[str, Any] = {
            "status": [status.name for status in self.status],
            "success": self._is_solved,
            "iterations": self._worlds.counts[:-1, 0],
            "relative": self._get_column("relative"),
            "energy": self._get_column("energy"),
            "velocity_error": self._get_column("speed"),
            "impulse_error": self._get_column("push"),
            "roundoff_floor": self._get_column("roundoff_floor"),
            "worst_row": names,
        }
        return pd.DataFrame(columns)

    def _repr_html_(self) -> str:
        """Return a small HTML table for notebooks: counts of statuses, and the worst world."""
        counts = Counter(status.name for status in self.status)
        relative = np.where(
            np.isnan(self._get_column("relative")), -1.0, self._get_column("relative")
        )
        facts = {
            "worlds": len(self),
            "solved": f"{int(self._is_solved.sum())} to {self.tol:g}",
            "statuses": ", ".join(f"{name} {n}" for name, n in counts.most_common()),
        }
        if len(self) and relative.max() >= 0.0:
            i = int(relative.argmax())
            facts |= {"worst world": f"{i}, relative residual {relative[i]:.2e}"}
        return format_html_table(facts, self._spec.name)

    def __repr__(self) -> str:
        return f"<Solutions of {len(self)} worlds by {self._spec.name}, {int(self._is_solved.sum())} to {self.tol:g}>"


def solve_many(
    problems: Batch | Iterable[Problem],
    solver: str = "auto",
    *,
    impulse: Any = None,
    impulses: Sequence[Any] | None = None,
    threads: int = 1,
    tol: float = 1e-6,
    velocity_tol: float | None = None,
    max_iter: int | None = None,
    time_limit: float | None = None,
    errors: str = "raise",
    like: Any = None,
    **options: Unpack[ManyOptions],
) -> Solutions:
    """Solve many problems, with results that are bit-identical to `solve` for any number of threads.

    Parameters
    ----------
    problems : Batch, or iterable of Problem
    solver : str
    impulse : N s, optional
        For a batch: warm starts, an array of the batch's shape of impulses; or the `Solutions` of another step, or
        (Batch, impulse), whose impulses are assigned world by world (`Batch.make_start`). Default: the zero impulse.
    impulses : sequence of (m,) N s, optional
        For problems: warm start of each, or None. Default: as for `solve`.
    threads : int
        Number of worlds that are solved at the same time. Each thread starts the next world that no thread has started.
    tol, max_iter, **options
        As for `solve`.
    velocity_tol : float, optional, m/s
        Velocity error to reach on every row, in place of `tol`. All worlds are solved to the relative residual that
        guarantees it in the world with the largest velocity error of the zero impulse.
    time_limit : float, optional, s
        Limit of the wall-clock time of the whole call. Worlds are solved in order, each with all of the remaining
        time. Worlds that are not started in time keep their start, which is judged, and have the status TIME_LIMIT.
    errors : {"raise", "status"}
        For worlds with invalid data or an invalid start (NaN, an M that is not definite, a negative mu): raise the
        error of the first one, or give them the status INVALID_PROBLEM and store the errors in `Solutions.faults`.
    like : array, optional
        An array of PyTorch, JAX, CuPy, Warp or another library with DLPack. Arrays of the result are copies in its
        library and on its device; floats have its floating dtype. Default: NumPy.

    Returns
    -------
    Solutions
        Arrays in the order of the worlds; `many[i]` is a `Solution`.

    Raises
    ------
    InputError
        `threads` is not an integer of at least 1, starts do not fit the problems, or `like` is not an array of a
        supported library. The errors of `solve` are raised, too.
    UnknownName, CapabilityError, SolverUnavailable
        As for `solve`, for the first world that is not accepted.
    KeyboardInterrupt
        Ctrl-C was pressed; each thread completes its current world.
    """
    worlds = check_problems(problems, errors)
    if type(threads) is not int or threads < 1:
        threads = check_int("threads", threads, 1, None)
    spec = get(solver)
    check_options(spec, options.keys() - SOLVE_ARGUMENTS, MANY_ARGUMENTS)
    deadline = start_limit(time_limit)
    if velocity_tol is not None:
        velocity_tol = check_velocity_tolerance(velocity_tol, tol)
        tol = _compute_tolerance_for_velocity_error(worlds, velocity_tol)
    check_arguments(spec, tol, max_iter)
    starts, invalid_starts = _convert_starts(worlds, impulse, impulses, errors)
    named = cast("dict[str, Any]", options)
    solutions = Solutions(worlds, starts, tol, spec, like)
    solutions._invalid_starts, solutions.velocity_tol = invalid_starts, velocity_tol
    more: dict[str, Any] = {"tol": tol, "max_iter": max_iter, **named}
    # The compiled loop is used under the conditions under which `solve` makes a single compiled call.
    uses_loop = (
        spec.builtin
        and not options
        and max_iter is None
        and isinstance(tol, float)
        and 0.0 < tol < np.inf
    )
    small = spec.small if uses_loop else None
    call = None if small is None else small.call

    def process_until_deferred(hand: Worker) -> int:
        return int(hand.process_worlds(tol, call, deadline))

    def solve_single(i: int) -> None:
        problem = worlds[i]
        start = solutions.get_start(i)
        if solutions._worlds.code[i] == CODE["tried"]:
            own = Deadline(deadline.get_remaining_seconds(MIN_TIME_LIMIT))
            counts = tuple(solutions._worlds.counts[i].tolist())
            prepared = Prepared(problem, spec, named, False)
            checked = check_arguments(spec, tol, max_iter)
            solution = prepared._solve(problem, start, *checked, own, failed_call=counts)
        else:
            left = deadline.get_remaining_seconds(MIN_TIME_LIMIT)
            solution = solve(problem, solver, impulse=start, time_limit=left, **more)
        solutions.store_solution(
            i, solution if "callback" in options else raise_if_interrupted(solution)
        )

    begin = perf_counter()
    solutions._process_worlds(process_until_deferred, solve_single, threads, errors)
    solutions.clear_invalid()
    solutions._time_per_world = (perf_counter() - begin) / max(1, len(worlds))
    if type(worlds) is not Batch:
        solutions._worlds.store_zero_residuals(solutions._data)
    return solutions


def _compute_tolerance_for_velocity_error(worlds: Any, velocity_tol: float) -> float:
    """Return the relative residual that guarantees a velocity error [m/s] in every valid world."""
    if type(worlds) is Batch:
        # The velocity error of the zero impulse does not depend on the impulse that is judged.
        references = residual_many(worlds, np.zeros(worlds.shape), errors="status").velocity_at_zero
    else:
        references = np.array(
            [residual(p, p.start()).velocity_at_zero for p in worlds if p.m], float
        )
    largest = float(np.max(references[np.isfinite(references)], initial=0.0))
    return (
        min(velocity_tol / largest, MAX_VELOCITY_TOLERANCE)
        if largest > 0.0
        else MAX_VELOCITY_TOLERANCE
    )


def _convert_starts(
    worlds: Any, impulse: Any, impulses: Any, errors: str
) -> tuple[Any, dict[int, LavenderError]]:
    """Convert the starts of all worlds.

    Returns
    -------
    starts : array, list or None
        Flat impulses [N s] of a batch; (m,) or None for each problem of a list. None: all start from the zero impulse.
    invalid : dict of int to LavenderError
        Errors of starts that are not finite, which are replaced by the zero impulse.
    """
    starts: Any
    parts: Iterable[tuple[int, Any]] = ()
    if type(worlds) is Batch:
        if impulses is not None:
            raise InputError(
                "impulses= needs a list of problems; a batch takes impulse=, one for all worlds"
            )
        if isinstance(impulse, tuple | WorldResults):
            impulse = worlds.make_start(impulse)
        starts = None if impulse is None else worlds.flatten_impulses("impulse", impulse)
        if starts is not None and not all_finite(starts):
            parts = ((i, starts[worlds.rows_of(i)]) for i in range(len(worlds)))
    else:
        if impulse is not None:
            raise InputError(
                "impulse= needs a batch; a list of problems takes impulses=, one for each"
            )
        starts = (
            [p.guess for p in worlds]
            if impulses is None
            else convert_impulses_or_guesses(worlds, impulses)
        )
        parts = [(i, start) for i, start in enumerate(starts) if start is not None]
    invalid = dict[int, LavenderError]()
    for i, start in parts:
        if not all_finite(start):
            bad = np.flatnonzero(~np.isfinite(start))[0]
            message = (
                f"world {i}: impulse [N s] is {start[bad]} at row {bad}; a finite start is needed"
            )
            invalid[i] = InputError(message)
            if errors == "raise":
                raise invalid[i]
            if type(worlds) is Batch:
                start[:] = 0.0
            else:
                starts[i] = None
    return starts, invalid
