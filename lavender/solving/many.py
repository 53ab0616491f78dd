"""Many problems in one call: the results of `solve` on each, with the same bits, in arrays.

One compiled loop takes one world after the other, by an atomic counter, from the arrays of a `Batch` or from problems
in generalised coordinates. What it does not solve, and every other problem, is handed back to the thread that took it
and goes the way of a single solve. A `Solution` is made when it is first asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from time import perf_counter
from typing import Any, overload

import numpy as np

from lavender.base.arrays import FloatArray, as_array, number, places, whole_number
from lavender.base.deadline import NEVER, Deadline
from lavender.base.errors import InputError, LavenderError
from lavender.judge.residuals import AT_REST, ENOUGH, Residual, judged, reading_time, residual, verdict_of
from lavender.judge.solution import Solution, Status, uninterrupted
from lavender.problem import PRECISIONS, Problem, check_problem
from lavender.problem.batch import Batch, check_errors
from lavender.problem.derived import cached_property
from lavender.solvers.registry import SolverSpec, get
from lavender.solving.loop import LEAST
from lavender.solving.solve import COUNTED, check_budget, check_taken, rest_of, seconds_of, solve, unjudged
from lavender_ext.judge.measure import all_finite
from lavender_ext.small.many import CODE, NUMBER, PLACE, Hand, Worlds

__all__ = ["Residuals", "Solutions", "residual_many", "solve_many"]

DONE_ALL = -1  # of `Hand`: there are no more worlds
LATE, ENTRY = (
    4e-6,
    5e-9,
)  # s, of the judge on a world of J and M whose turn comes too late, and for each multiply-add
UNREAD = 4e-5  # s, of one that he reads later
NO_TURN = "the time limit was over before its turn: the start, unjudged"
STATUS = np.array(list(Status), object)
NUMBER_OF = {status: i for i, status in enumerate(Status)}


class _Many:
    """n worlds, and what the judge found of them."""

    def __init__(self, given: Any, starts: Any, cold: bool) -> None:
        """Of a batch, or of problems; starts: flat impulses [N s] of the batch, or (m,) or None of each problem."""
        self.problems: Sequence[Problem] = given
        self.faults: dict[int, LavenderError] = {}
        self._unusable: dict[int, LavenderError] = {}  # starts, which go on as doing nothing
        if isinstance(given, Batch):
            place, self._sizes, self._first = given.at, given.at[:, PLACE["rows"]], given.at[:, PLACE["row"]]
            self._impulse = np.zeros(int(np.prod(given.shape))) if cold else starts
            self._velocity: FloatArray | None = np.zeros(int(np.prod(given.velocity_shape)))
            self._worlds: Worlds = given.worlds(self._impulse, self._velocity, cold)
            return
        self._sizes = np.array([p.m for p in given], np.int64)
        place = np.zeros((len(given), len(PLACE)), np.int64)
        place[:, PLACE["rows"]], self._first = self._sizes, np.cumsum(self._sizes) - self._sizes
        place[:, PLACE["row"]] = self._first
        self._impulse, self._velocity = np.zeros(int(self._sizes.sum())), None
        self._worlds = Worlds(place, self._impulse, np.zeros(0), cold)
        together = (
            type(p) is Problem and p.generalized is not None and not p.cones.has_ellipse for p in given
        )
        self._data = [p.derived.view if ours else None for p, ours in zip(given, together, strict=True)]
        self._worlds.of_objects(self._data, starts)

    @property
    def relative(self) -> FloatArray:
        """(n,) relative residual, NaN of a world that is bad."""
        return self._numbers("relative")

    @property
    def energy(self) -> FloatArray:
        """(n,) sqrt J, of the error."""
        return self._numbers("energy")

    @property
    def velocity_error(self) -> FloatArray:
        """(n,) m/s, of the worst row."""
        return self._numbers("speed")

    @property
    def impulse_error(self) -> FloatArray:
        """(n,) N s, of that row."""
        return self._numbers("push")

    @property
    def floor(self) -> FloatArray:
        """(n,) relative residual that rounding alone costs."""
        return self._numbers("floor")

    @property
    def worst_row(self) -> np.ndarray:
        """(n,) row of the largest velocity error, counted in its world; -1 where there is none."""
        self._read()
        worst: np.ndarray = self._worlds.worst[:-1]
        return worst

    def _numbers(self, which: str) -> FloatArray:
        self._read()
        found: FloatArray = self._worlds.numbers[NUMBER[which], :-1]
        return found

    def _read(self) -> None:
        """Judge what is not yet."""

    def _late(self) -> float:
        """What the results take [s] where nobody has his turn."""
        if isinstance(self.problems, Batch):
            rows, columns = (self.problems.at[:, PLACE[of]].astype(float) for of in ("rows", "velocities"))
            return LATE * len(rows) + ENTRY * float(np.sum(rows * (2.0 * columns + 4.0)))
        both = zip(self.problems, self._data, strict=True)
        return sum(LATE + reading_time(p) if data else UNREAD for p, data in both)

    def _rows(self, i: int) -> slice:
        return slice(int(self._first[i]), int(self._first[i] + self._sizes[i]))

    def _keep(self, i: int, found: Residual) -> None:
        """What the judge found of a world that the loop left."""
        known = {
            "relative": found.relative, "energy": found.energy, "speed": found.velocity, "floor": found.floor,
            "start_energy": found.energy_start, "start_speed": found.velocity_start,
            "push": abs(found.error[found.worst_row]) if found.worst_row >= 0 else 0.0,
        }  # fmt: skip
        for name, x in known.items():
            self._worlds.numbers[NUMBER[name], i] = x
        self._worlds.worst[i] = found.worst_row

    def __len__(self) -> int:
        return len(self.problems)

    def __getitem__(self, i: Any) -> Any:
        """Of world i, or a list of several."""
        i = places(i, len(self))
        if isinstance(i, list):
            return [self[j] for j in i]
        if i in self.faults:
            raise self.faults[i]
        return self._one(i)

    def _one(self, i: int) -> Any:
        """Of a world whose data are a problem's."""
        raise NotImplementedError

    def _run(
        self, turn: Callable[[Hand], int], alone: Callable[[int], None], threads: int, errors: str
    ) -> None:
        """All worlds by `turn`; those that it leaves by `alone`; what is bad by its number in `faults`."""
        stop = bytearray(1)  # not 0: nothing more is begun

        def single(i: int) -> None:
            try:
                alone(i)
            except LavenderError as error:
                self.faults[i] = self._fault(i, error)
                stop[0] |= errors == "raise"

        def work(_: int) -> None:
            hand = Hand(self._worlds, stop)
            while (i := turn(hand)) != DONE_ALL:
                if i >= 0:
                    single(i)

        threads = min(threads, len(self))
        if threads < 2:
            work(0)
        else:
            with ThreadPoolExecutor(threads) as pool:
                try:
                    list(pool.map(work, range(threads)))
                finally:
                    stop[0] = 1  # of Ctrl-C the other threads hear nothing
        stop[0] = 0
        for i in np.flatnonzero(self._worlds.code[:-1] == CODE["bad"]).tolist():
            single(i)  # which finds the words
        if self.faults and errors == "raise":
            raise self.faults[min(self.faults)]
        self.faults.update(self._unusable)
        for i in self.faults:
            self._worlds.numbers[:, i] = np.nan

    def _fault(self, i: int, error: LavenderError) -> LavenderError:
        if isinstance(self.problems, Batch) and isinstance(error, InputError):
            return InputError(f"world {i}: {error}")
        return error


class Solutions(_Many, Sequence[Solution]):
    """Results of `solve_many`, in arrays; `many[i]` is the `Solution` of world i.

    `many[many.success]`, `many[2:5]` and `many[[0, 7]]` are lists of them; faults of those that are REFUSED are raised.

    Parameters
    ----------
    impulse : N s
        Of a stacked batch (n, m), 0 beyond the rows of a world that has fewer; else of all rows, where `ptr` says which
        world they are of. NaN of a world that is REFUSED, like all its numbers; its counts are 0.
    status : (n,) of Status
        REFUSED where the data of a world are no problem's.
    relative, energy, velocity_error, impulse_error, floor : (n,)
        Of the judge: -, sqrt J, m/s and N s of the worst row, -.
    worst_row, iterations : (n,) int
    tol : float, -
    faults : dict
        What is wrong with the worlds that are REFUSED, by their numbers.
    """

    def __init__(self, given: Any, starts: Any, cold: bool, tol: float, spec: SolverSpec) -> None:
        super().__init__(given, starts, cold)
        self.tol, self._spec, self._starts, self._cold = tol, spec, starts, cold
        self._kept: dict[int, Solution] = {}
        self._unread: list[int] = []  # worlds whose turn came too late: their starts, unjudged
        self._seconds = 0.0  # share of each
        # Of a batch the loop writes over the starts.
        self._given = None if cold or not isinstance(given, Batch) else starts.copy()

    @property
    def impulse(self) -> FloatArray:
        """See the class."""
        return (
            self._impulse.reshape(self.problems.shape) if isinstance(self.problems, Batch) else self._impulse
        )

    @cached_property
    def velocity(self) -> FloatArray:
        """v+ [m/s, rad/s]: of a stacked batch (n, nv); else of all worlds one after the other, none of a matrix."""
        if isinstance(self.problems, Batch):
            return self._velocity.reshape(self.problems.velocity_shape)  # type: ignore[union-attr]
        found = [np.zeros(0)]
        for i, p in enumerate(self.problems):
            if p.matrix is None:
                own = p.velocity(p._start if i in self.faults else self._impulse[self._rows(i)]).ravel()
                found.append(np.full_like(own, np.nan) if i in self.faults else own)
        return np.concatenate(found)

    @cached_property
    def status(self) -> np.ndarray:
        """See the class."""
        code = self._worlds.code[:-1]
        out = np.where(code == CODE["late"], NUMBER_OF[Status.TIME_LIMIT], NUMBER_OF[Status.CONVERGED])
        for i, solution in self._kept.items():
            out[i] = NUMBER_OF[solution.status]
        for i in self.faults:
            out[i] = NUMBER_OF[Status.REFUSED]
        return STATUS[out]

    @property
    def iterations(self) -> np.ndarray:
        """(n,) in the solver's own unit."""
        counts: np.ndarray = self._worlds.counts[:-1, 0]
        return counts

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
        return self._impulse, self._first, self._sizes

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

    def _read(self) -> None:
        while self._unread:
            i = self._unread.pop()
            self.keep(i, self._kept[i])

    def keep(self, i: int, found: Solution) -> None:
        """The solution of a world that the loop left."""
        self._kept[i] = found
        self._impulse[self._rows(i)] = found.impulse
        _Many._keep(self, i, found.residual)
        self._worlds.counts[i, 0] = found.iterations
        problem = found.residual._problem
        if self._velocity is not None and self._velocity.size and problem.matrix is None:
            v = problem.velocity(found.impulse).ravel()
            first = int(self.problems.at[i, PLACE["velocity"]])  # type: ignore[attr-defined]
            self._velocity[first : first + len(v)] = v

    def empty_refused(self) -> None:
        """What stands in the arrays for worlds that are REFUSED is no answer."""
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
            self._kept[i] = self._solution(i)
        return self._kept[i]

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
        found = judged(problem, impulse)
        counts = None if status is Status.TIME_LIMIT else tuple(self._worlds.counts[i].tolist())
        return rest_of(problem, self._spec, found, counts, self.start(i), status)

    def __repr__(self) -> str:
        return f"<Solutions of {len(self)} worlds by {self._spec.name}, {int(self.success.sum())} to {self.tol:g}>"


class Residuals(_Many):
    """Verdicts of `residual_many`, in arrays; `errors[i]` is the `Residual` of world i.

    Parameters
    ----------
    relative, energy, velocity_error, impulse_error, floor : (n,)
        As of `Solutions`; the floor is that of `precision`.
    worst_row : (n,) int
    precision : {"float64", "float32"} or sequence of them
    threshold : float, m/s
    faults : dict
        What is wrong with the worlds whose data are no problem's, by their numbers.
    """

    def __init__(self, given: Any, starts: Any, precision: Sequence[str], threshold: float) -> None:
        super().__init__(given, starts, False)
        self.precision, self.threshold = precision, threshold
        if not isinstance(given, Batch):
            self._impulse[:] = np.concatenate([np.zeros(0), *starts])
        self._nothing: dict[int, bool] = {}  # of worlds that the loop left

    @cached_property
    def verdict(self) -> np.ndarray:
        """(n,) as `Residual.verdict`: "at its floor", "close enough", "stopped early", "wrong"; "" of a bad world."""
        nothing = (self._numbers("start_relative") < 0.5) | (self._numbers("start_speed") < AT_REST)
        for i, known in self._nothing.items():
            nothing[i] = known
        names = "relative", "floor", "energy", "speed", "rhs_energy"
        each = zip(
            *(self._numbers(name).tolist() for name in names), nothing.tolist(), self.precision, strict=True
        )
        words = [verdict_of(*x, self.threshold) for x in each]  # type: ignore[call-arg]
        for i in self.faults:
            words[i] = ""
        return np.array(words, "U13")

    @property
    def excess(self) -> FloatArray:
        """(n,) relative residual over its floor."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.relative == 0.0, 0.0, self.relative / self.floor)

    def keep(self, i: int, found: Residual) -> None:
        """The residual of a world that the loop left."""
        _Many._keep(self, i, found)
        self._nothing[i] = found.nothing_to_do
        self._worlds.numbers[NUMBER["rhs_energy"], i] = found.energy_rhs

    def _one(self, i: int) -> Residual:
        return residual(self.problems[i], self._impulse[self._rows(i)], self.precision[i], self.threshold)

    def __repr__(self) -> str:
        words, counts = np.unique(self.verdict, return_counts=True)
        told = ", ".join(f"{n} {word or 'bad'}" for word, n in zip(words, counts, strict=True))
        return f"<Residuals of {len(self)} worlds: {told}>"


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
        those whose turn comes too late keep their start, with status TIME_LIMIT.
    errors : {"raise", "status"}
        Of a world whose data or start are refused (NaN, an M that is not definite, a negative mu): raise what is wrong
        with the first, or go on and give it the status REFUSED; `Solutions.faults` has the words.

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
    given = _given(problems, errors)
    threads = whole_number("threads", threads, 1, None)
    spec, limit = get(solver), seconds_of(time_limit)
    deadline = NEVER if limit == np.inf else Deadline(limit)
    check_budget(spec, tol, max_iter)
    starts, unusable = _starts(given, impulse, impulses, errors)
    made = Solutions(given, starts, starts is None, tol, spec)
    made._unusable = unusable
    # What the results of those to come take is kept free.
    if deadline.is_set:
        deadline.keep(made._late())
    more = {"tol": tol, "max_iter": max_iter, **options}
    # What `solve` would ask of one compiled call.
    together = spec.own and not options and max_iter is None and isinstance(tol, float) and 0.0 < tol < np.inf
    small = spec.small if together else None
    limits = small.limits if small is not None else None

    def turn(hand: Hand) -> int:
        if not deadline.is_set:
            return int(hand.solve(tol, limits))
        if deadline.passed(0.0):
            return int(hand.judge(False, True))
        return int(hand.solve(tol, limits, COUNTED * (deadline.left(LEAST) or LEAST)))

    def alone(i: int) -> None:
        problem, start = given[i], made.start(i)
        if small is not None and made._worlds.code[i] == CODE["tried"] and not deadline.is_set:
            small.in_vain(problem, start, tol, tuple(made._worlds.counts[i].tolist()))
        if deadline.is_set and not isinstance(given, Batch):
            deadline.keep(-UNREAD)
            if deadline.passed():
                check_taken(problem, spec)
                made.late(i, unjudged(problem, spec, options, start, tol, NO_TURN))
                return
        found = solve(problem, solver, impulse=start, time_limit=deadline.left(LEAST), **more)
        made.keep(i, found if "callback" in options else uninterrupted(found))

    begin = perf_counter()
    made._run(turn, alone, threads, errors)
    made.empty_refused()
    made._seconds = (perf_counter() - begin) / max(1, len(given))
    if not isinstance(given, Batch):
        made._worlds.remember(made._data)
    return made


def residual_many(
    problems: Batch | Iterable[Problem],
    impulses: Any,
    *,
    precision: str | None = None,
    threshold: float = ENOUGH,
    threads: int = 1,
    errors: str = "raise",
) -> Residuals:
    """The judge alone, on impulses from anywhere: an error and a verdict for each world.

    Parameters
    ----------
    problems : Batch, or iterable of Problem
    impulses : N s
        In the shape of the batch's impulses; of problems a sequence of (m,). Entries may be infinite or NaN.
    precision : {"float64", "float32"}, optional
        In which the impulses were computed; default: that of each problem.
    threshold : float, m/s
        As `residual`.
    threads : int
    errors : {"raise", "status"}
        As `solve_many`; the verdict of a bad world is empty.

    Returns
    -------
    Residuals
        With the numbers of `residual` on each, to the bit.

    Raises
    ------
    InputError
        Shapes that do not fit, an unknown precision, a negative threshold, or a world that is bad.

    Examples
    --------
    >>> import numpy as np
    >>> import lavender as lv
    >>> J, M, v_free = np.ones((3, 1, 1)), np.ones((3, 1, 1)), -np.ones((3, 1))  # 1 kg falls by 1 m/s
    >>> batch = lv.Batch(J, M, v_free, cones=lv.Cones.contacts(0.0, tangents=0))
    >>> found = lv.residual_many(batch, [[1.0], [0.9], [0.0]])  # N s
    >>> found.verdict.tolist(), found.velocity_error.round(6).tolist()
    (['at its floor', 'stopped early', 'wrong'], [0.0, 0.1, 1.0])
    """
    given = _given(problems, errors)
    if precision not in (None, *PRECISIONS):
        raise InputError(f"precision is {precision!r}; {' or '.join(map(repr, PRECISIONS))} is needed")
    threshold = number("threshold", threshold, low=0.0)
    threads = whole_number("threads", threads, 1, None)
    if isinstance(given, Batch):
        starts: Any = given.impulses("impulses", impulses)
        words = len(given) * [given.precision if precision is None else precision]
    else:
        starts = _of_each(given, impulses)
        words = [p.precision if precision is None else precision for p in given]
    made = Residuals(given, starts, words, threshold)
    single = isinstance(given, Batch) and "float32" in words

    def alone(i: int) -> None:
        made.keep(i, residual(given[i], made._impulse[made._rows(i)], words[i], threshold))

    made._run(lambda hand: int(hand.judge(single)), alone, threads, errors)
    return made


def _given(problems: Any, errors: str) -> Any:
    """A batch, or a list of problems."""
    check_errors(errors)
    if isinstance(problems, Problem):
        raise InputError("problems is one Problem; a list of them is needed, or `solve`")
    if isinstance(problems, Batch):
        return problems
    given = list(problems)
    for problem in given:
        check_problem(problem)
    return given


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
    starts = [p.guess for p in given] if impulses is None else _of_each(given, impulses)
    return [x if x is None or is_usable(i, x) else None for i, x in enumerate(starts)], unusable


def _of_each(given: Any, impulses: Any) -> list[Any]:
    """Impulses (m,) [N s] of each problem, its guess where there are none."""
    if len(impulses) != len(given):
        raise InputError(f"{len(impulses)} impulses for {len(given)} problems; one for each is needed")
    return [
        p.guess if x is None else as_array(f"impulses of world {i}", x, (p.m,), finite=False, unit="N s")
        for i, (p, x) in enumerate(zip(given, impulses, strict=True))
    ]
