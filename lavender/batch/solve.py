"""Many problems in one call: the results of `solve` on each, with the same bits, in arrays.

The compiled loop of `lavender/batch/residuals.py` solves what it can; a single `solve` handles every other problem. A
`Solution` is built at its first access.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from time import perf_counter
from typing import Any, overload

import numpy as np

from lavender.base.arrays import FloatArray, read_only, whole_number
from lavender.base.deadline import NEVER, Deadline
from lavender.base.errors import InputError, LavenderError
from lavender.batch.data import Batch
from lavender.batch.residuals import Many, given_problems, of_each
from lavender.judge.residuals import judged, reading_time
from lavender.judge.solution import CONTRADICTED, Solution, Status, uninterrupted
from lavender.problem import Problem
from lavender.problem.derived import cached_property
from lavender.solvers.loop import LEAST
from lavender.solvers.registry import SolverSpec, get
from lavender.solving.solve import (
    COUNTED,
    NO_TURN,
    check_budget,
    check_taken,
    rest_of,
    seconds_of,
    solve,
    unjudged,
)
from lavender_ext.batch.many import CODE, NUMBER, PLACE, Hand
from lavender_ext.judge.measure import all_finite

__all__ = ["Solutions", "solve_many"]

LATE, ENTRY = (
    4e-6,
    5e-9,
)  # s, of the judge on a world of J and M whose turn comes too late, and for each multiply-add
UNREAD = 4e-5  # s, of one that he reads later
STATUS = np.array(list(Status), object)
NUMBER_OF = {status: i for i, status in enumerate(Status)}


class Solutions(Many, Sequence[Solution]):
    """Results of `solve_many`, in read-only arrays; `many[i]` is the `Solution` of world i.

    `many[many.success]`, `many[2:5]` and `many[[0, 7]]` are lists of solutions. Access to a world whose status is
    INVALID_PROBLEM raises its error.

    Parameters
    ----------
    impulse : N s
        Of a stacked batch (n, m), 0 beyond the rows of a world that has fewer; else of all rows, where `ptr` says which
        world they are of. NaN of a world that is INVALID_PROBLEM, like all its numbers; its counts are 0.
    status : (n,) of Status
        INVALID_PROBLEM where the data of a world are no problem's.
    relative, energy, velocity_error, impulse_error, floor : (n,)
        Of the judge: -, sqrt J, m/s and N s of the worst row, -.
    worst_row, iterations : (n,) int
    tol : float, -
    faults : dict
        What is wrong with the worlds that are INVALID_PROBLEM, by their numbers.
    """

    def __init__(
        self,
        given: Any,
        starts: Any,
        cold: bool,
        tol: float,
        spec: SolverSpec,
        options: dict[str, Any],
        errors: str,
    ) -> None:
        super().__init__(given, starts, cold)
        self.tol, self._spec, self._starts, self._cold = tol, spec, starts, cold
        self._options, self._errors = options, errors
        self._kept: dict[int, Solution] = {}
        self._unread: list[int] = []  # worlds whose turn came too late: their starts, not judged yet
        self._seconds = 0.0  # share of each
        # Of a batch the loop writes over the starts.
        self._given = None if cold or not isinstance(given, Batch) else starts.copy()

    def __getstate__(self) -> dict[str, Any]:
        return super().__getstate__() | {"_spec": self._spec.name}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _spec=get(state["_spec"]))

    @property
    def impulse(self) -> FloatArray:
        """See the class."""
        shape = self.problems.shape if isinstance(self.problems, Batch) else self._impulse.shape
        return read_only(self._impulse.reshape(shape))

    @cached_property
    def velocity(self) -> FloatArray:
        """v+ [m/s, rad/s]: of a stacked batch (n, nv); else of all worlds one after the other, none of a matrix."""
        if isinstance(self.problems, Batch):
            self._read()
            return read_only(self._velocity.reshape(self.problems.velocity_shape))  # type: ignore[union-attr]
        found = [np.zeros(0)]
        for i, p in enumerate(self.problems):
            if p.matrix is None:
                own = p.velocity(p._start if i in self.faults else self._impulse[self._rows(i)]).ravel()
                found.append(np.full_like(own, np.nan) if i in self.faults else own)
        return read_only(np.concatenate(found))

    @cached_property
    def status(self) -> np.ndarray:
        """See the class."""
        code = self._worlds.code[:-1]
        out = np.where(code == CODE["late"], NUMBER_OF[Status.TIME_LIMIT], NUMBER_OF[Status.CONVERGED])
        for i, solution in self._kept.items():
            out[i] = NUMBER_OF[solution.status]
        for i in self.faults:
            out[i] = NUMBER_OF[Status.INVALID_PROBLEM]
        return read_only(STATUS[out])

    @property
    def iterations(self) -> np.ndarray:
        """(n,) in the solver's own unit."""
        return read_only(self._worlds.counts[:-1, 0])

    @property
    def success(self) -> np.ndarray:
        """(n,) bool: the judge's relative residual is at most `tol`."""
        return self.relative <= self.tol

    @property
    def ptr(self) -> np.ndarray:
        """(n + 1,) first row of each world where `impulse` is flat, then the number of rows."""
        return np.append(self._first, self._impulse.size)

    @property
    def placed(self) -> tuple[FloatArray, np.ndarray, np.ndarray]:
        """All impulses [N s], flat; where each world's begin, and how many rows it has."""
        return read_only(self._impulse.view()), self._first, self._sizes

    def start(self, i: int) -> Any:
        """The start (m,) [N s] of world i, None of one without."""
        if isinstance(self.problems, Batch):
            return None if self._given is None else self._given[self._rows(i)]
        return self._starts[i]

    def late(self, i: int, found: Solution) -> None:
        """The start of a world whose turn came too late, judged when its numbers are read."""
        self._kept[i] = found
        self._impulse[self._rows(i)] = found.impulse
        self._unread.append(i)

    def mark_late(self, i: int) -> None:
        """Keep the start of a late world of a batch, whose problem is made when its numbers are read."""
        if self._cold:
            self._impulse[self._rows(i)] = self.problems.start(i)  # type: ignore[attr-defined]
        self._worlds.code[i] = CODE["late"]
        self._unread.append(i)

    def _read(self) -> None:
        # A thread that comes meanwhile works out the same numbers.
        for i in self._unread:
            try:
                self.keep(i, self._one(i))
            except LavenderError as error:
                if self._errors == "raise":
                    raise
                self.faults[i], self._worlds.numbers[:, i] = error, np.nan
                self.empty_refused()
        self._unread = []

    def keep(self, i: int, found: Solution) -> None:
        """The solution of a world that the loop left."""
        self._kept[i] = found
        self._impulse[self._rows(i)] = found.impulse
        self._keep(i, found.residual)
        self._worlds.counts[i, 0] = found.iterations
        problem = found.residual._problem
        if self._velocity is not None and self._velocity.size and problem.matrix is None:
            v = problem.velocity(found.impulse).ravel()
            first = int(self.problems.at[i, PLACE["velocity"]])  # type: ignore[attr-defined]
            self._velocity[first : first + len(v)] = v

    def _reading(self) -> float:
        """What the results take [s] where nobody has his turn."""
        if isinstance(self.problems, Batch):
            rows, columns = (self.problems.at[:, PLACE[of]].astype(float) for of in ("rows", "velocities"))
            entries = np.where(columns > 0.0, columns, rows)  # of a row; A has its own
            return LATE * len(rows) + ENTRY * float(np.sum(rows * (2.0 * entries + 4.0)))
        both = zip(self.problems, self._data, strict=True)
        return sum(LATE + reading_time(p) if data and p.generalized else UNREAD for p, data in both)

    def empty_refused(self) -> None:
        """What stands in the arrays for worlds that are INVALID_PROBLEM is no answer."""
        for i in self.faults:
            self._impulse[self._rows(i)] = np.nan
            self._worlds.counts[i], self._worlds.worst[i] = 0, -1
            if isinstance(self.problems, Batch) and self._velocity is not None and self._velocity.size:
                first, n = (int(self.problems.at[i, PLACE[name]]) for name in ("velocity", "velocities"))
                self._velocity[first : first + n] = np.nan

    @overload
    def __getitem__(self, i: int) -> Solution: ...
    @overload
    def __getitem__(self, i: Any) -> list[Solution]: ...
    def __getitem__(self, i: Any) -> Any:
        return super().__getitem__(i)

    def _one(self, i: int) -> Solution:
        if i not in self._kept:
            self._kept[i] = self._make_late_solution(i) if i in self._unread else self._solution(i)
        return self._kept[i]

    def _make_late_solution(self, i: int) -> Solution:
        """Of a world of a batch of which nothing was read before the deadline."""
        try:
            problem = self.problems[i]
        except LavenderError as error:
            raise self._fault(i, error) from None
        start = self._impulse[self._rows(i)]
        return unjudged(problem, self._spec, self._options, start, self.tol, f"{NO_TURN}, unjudged")

    def _solution(self, i: int) -> Solution:
        """Of a world that the loop ended."""
        if not self._sizes[i]:
            return solve(self.problems[i], self._spec.name, tol=self.tol)
        impulse, late = self._impulse[self._rows(i)].copy(), self._worlds.code[i] == CODE["late"]
        impulse.setflags(write=False)
        status = Status.TIME_LIMIT if late else Status.CONVERGED
        return Solution.late(impulse, status, self.tol, self._seconds, (self._rest, (i, impulse, status)))

    def _rest(self, i: int, impulse: FloatArray, status: Status) -> dict[str, Any]:
        problem = self.problems[i]
        found = judged(problem, impulse).refine(self.tol)
        started = self._worlds.code[i] in (CODE["late"], CODE["started"])
        counts = None if started else self._counts(problem, i)
        rest = rest_of(problem, self._spec, found, counts, self.start(i), status)
        then = float(self._worlds.numbers[NUMBER["relative"], i])
        if status is Status.CONVERGED and found.relative != then:  # the same data have the same bits
            rest["claim_check"] = CONTRADICTED
            rest["status_conflict"] = (
                f"says {status.name} of other data, with relative residual {then:.2e} (now {found.relative:.2e}): "
                f"the arrays of world {i} were written over after the solve"
            )
        return rest

    def _counts(self, problem: Problem, i: int) -> tuple[int, ...]:
        """What the loop did for world i."""
        counts = tuple(self._worlds.counts[i].tolist())
        return counts if problem.generalized is None else counts[:4]

    def __repr__(self) -> str:
        return f"<Solutions of {len(self)} worlds by {self._spec.name}, {int(self.success.sum())} to {self.tol:g}>"


def solve_many(
    problems: Batch | Iterable[Problem],
    solver: str = "auto",
    *,
    impulse: Any = None,
    impulses: Sequence[Any] | None = None,
    threads: int = 1,
    tol: float = 1e-6,
    max_iter: int | None = None,
    time_limit: float | None = None,
    errors: str = "raise",
    **options: Any,
) -> Solutions:
    """Solve many problems, with the bits of `solve` on each for any number of threads.

    Parameters
    ----------
    problems : Batch, or iterable of Problem
    solver : str
    impulse : N s, optional
        Of a batch, in the shape of its impulses: warm starts. Default: from doing nothing.
    impulses : sequence of (m,) N s, optional
        Of problems: warm start of each, None for one without; default: as `solve`.
    threads : int
        Worlds solved at the same time; each thread takes the next one that nobody has.
    tol, max_iter, **options
        As `solve`.
    time_limit : float, optional, s
        Limit of the whole call on the wall clock. Worlds take their turns in order, each with all of the time left;
        those whose turn comes too late keep their start, with status TIME_LIMIT; the data of such a world of a batch
        may be checked only when its numbers are read.
    errors : {"raise", "status"}
        Of a world whose data or start are refused (NaN, an M that is not definite, a negative mu): raise what is wrong
        with the first, or go on and give it the status INVALID_PROBLEM; `Solutions.faults` has the words.

    Returns
    -------
    Solutions
        In the order of the worlds: arrays, and `many[i]` a `Solution`.

    Raises
    ------
    InputError
        `threads` is not a whole number from 1, starts do not fit the problems, or as `solve`.
    UnknownName, CapabilityError, SolverUnavailable
        As `solve`, for the first world that is refused.
    KeyboardInterrupt
        Ctrl-C; a thread ends the world that it has in hand.
    """
    given = given_problems(problems, errors)
    threads = whole_number("threads", threads, 1, None)
    spec, limit = get(solver), seconds_of(time_limit)
    deadline = NEVER if limit == np.inf else Deadline(limit)
    check_budget(spec, tol, max_iter)
    starts, unusable = _starts(given, impulse, impulses, errors)
    made = Solutions(given, starts, starts is None, tol, spec, options, errors)
    made._unusable = unusable
    # What the results of those to come take is kept free.
    if deadline.is_set:
        deadline.reserve(made._reading())
    more = {"tol": tol, "max_iter": max_iter, **options}
    # What `solve` would ask of one compiled call.
    together = (
        spec.builtin and not options and max_iter is None and isinstance(tol, float) and 0.0 < tol < np.inf
    )
    small = spec.small if together else None
    asked = (small.limits, small.rules) if small is not None else (None, None)

    def turn(hand: Hand) -> int:
        if not deadline.is_set:
            return int(hand.solve(tol, *asked))
        if deadline.passed(0.0):
            return int(hand.judge(tol, False, True))
        return int(hand.solve(tol, *asked, COUNTED * (deadline.remaining(LEAST) or LEAST)))

    def alone(i: int) -> None:
        # The first late world of a batch is made, so that a solver that refuses its kind says so; the others are not.
        is_another = isinstance(given, Batch) and made._unread and made._worlds.code[i] != CODE["bad"]
        if is_another and deadline.passed():
            made.mark_late(i)
            return
        problem, start = given[i], made.start(i)
        if small is not None and made._worlds.code[i] == CODE["tried"] and not deadline.is_set:
            small.in_vain(problem, start, tol, made._counts(problem, i))
        if deadline.is_set:
            if not isinstance(given, Batch):
                deadline.reserve(-UNREAD)
            if deadline.passed():
                check_taken(problem, spec, deadline)
                made.late(i, unjudged(problem, spec, options, start, tol, f"{NO_TURN}, unjudged"))
                return
        found = solve(problem, solver, impulse=start, time_limit=deadline.remaining(LEAST), **more)
        is_judged = found.status is not Status.TIME_LIMIT or "residual" in vars(found)
        keep = made.keep if is_judged else made.late
        keep(i, found if "callback" in options else uninterrupted(found))

    begin = perf_counter()
    made._run(turn, alone, threads, errors)
    made.empty_refused()
    made._seconds = (perf_counter() - begin) / max(1, len(given))
    if not isinstance(given, Batch):
        made._worlds.remember(made._data)
    return made


def _starts(given: Any, impulse: Any, impulses: Any, errors: str) -> tuple[Any, dict[int, LavenderError]]:
    """Flat impulses of a batch, or of each problem (m,) or None; None: doing nothing everywhere.

    Beside what is wrong with those that are not finite, in whose place stands doing nothing.
    """
    unusable = dict[int, LavenderError]()

    def is_usable(i: int, start: FloatArray) -> bool:
        if all_finite(start):
            return True
        bad = np.flatnonzero(~np.isfinite(start))[0]
        unusable[i] = InputError(
            f"world {i}: impulse [N s] is {start[bad]} at row {bad}; a finite start is needed"
        )
        if errors == "raise":
            raise unusable[i]
        return False

    if isinstance(given, Batch):
        if impulses is not None:
            raise InputError(
                "impulses are of a list of problems; give impulse=, one array of the whole batch"
            )
        if impulse is None:
            return None, unusable
        flat = given.impulses("impulse", impulse)
        if not all_finite(flat):
            for i in range(len(given)):
                rows = given.rows_of(i)
                if not is_usable(i, flat[rows]):
                    flat[rows] = 0.0
        return flat, unusable
    if impulse is not None:
        raise InputError("impulse is of one problem; give impulses=, one for each (None where there is none)")
    starts = [p.guess for p in given] if impulses is None else of_each(given, impulses)
    return [x if x is None or is_usable(i, x) else None for i, x in enumerate(starts)], unusable
