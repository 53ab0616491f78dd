"""Residuals of many worlds in one call, bit-identical to single calls of `residual`, in arrays.

One compiled loop processes the worlds of a `Batch`, or problems in generalised coordinates; threads share the worlds by
an atomic counter. A single call handles every other problem. `lavender/batch/solve.py`
solves with the same loop.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from lavender.base.arrays import (
    FloatArray,
    as_array,
    number,
    one_of,
    places,
    read_only,
    several,
    whole_number,
)
from lavender.base.errors import InputError, LavenderError
from lavender.base.threads import run_on_threads
from lavender.batch.data import ERRORS, Batch
from lavender.judge.residuals import AT_REST, ENOUGH, TOL, VERDICTS, Residual, residual, verdict_of
from lavender.problem import PRECISIONS, Problem, check_problem
from lavender.problem.derived import cached_property
from lavender_ext.batch.many import CODE, NUMBER, PLACE, Hand, Worlds, data_of

DONE_ALL = -1  # of `Hand`: there are no more worlds


class Many:
    """n worlds, and what the judge found of them; all arrays are read-only."""

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
        self._data, self._sizes = data_of(given, Problem)
        place = np.zeros((len(given), len(PLACE)), np.int64)
        self._first = np.cumsum(self._sizes) - self._sizes
        place[:, PLACE["rows"]], place[:, PLACE["row"]] = self._sizes, self._first
        self._impulse, self._velocity = np.zeros(int(self._sizes.sum())), None
        self._worlds = Worlds(place, self._impulse, np.zeros(0), cold)
        self._worlds.of_objects(given, self._data, starts)

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
    def roundoff_floor(self) -> FloatArray:
        """(n,) relative residual that rounding alone costs."""
        return self._numbers("roundoff_floor")

    @property
    def worst_row(self) -> np.ndarray:
        """(n,) row of the largest velocity error, counted in its world; -1 where there is none."""
        self._read()
        return read_only(self._worlds.worst[:-1])

    def _numbers(self, which: str) -> FloatArray:
        self._read()
        return read_only(self._worlds.numbers[NUMBER[which], :-1])

    def _read(self) -> None:
        """Judge what is not yet."""

    def _rows(self, i: int) -> slice:
        return slice(int(self._first[i]), int(self._first[i] + self._sizes[i]))

    def _keep(self, i: int, found: Residual) -> None:
        """What the judge found of a world that the loop left."""
        known = {
            "relative": found.relative, "energy": found.energy, "speed": found.velocity,
            "roundoff_floor": found.roundoff_floor,
            "reference_energy": found.energy_at_zero, "reference_speed": found.velocity_at_zero,
            "above_floor": found.above_floor,
            "push": abs(found.error[found.worst_row]) if found.worst_row >= 0 else 0.0,
        }  # fmt: skip
        for name, x in known.items():
            self._worlds.numbers[NUMBER[name], i] = x
        self._worlds.worst[i] = found.worst_row

    def __getstate__(self) -> dict[str, Any]:
        """What came of the worlds, without the loop that has ended."""
        loop = self._worlds
        found = SimpleNamespace(numbers=loop.numbers, worst=loop.worst, counts=loop.counts, code=loop.code)
        return vars(self) | {"_worlds": found, "_data": None}

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

        def single(i: int, stop: bytearray) -> None:
            try:
                alone(i)
            except LavenderError as error:
                self.faults[i] = self._fault(i, error)
                stop[0] |= errors == "raise"

        def work(stop: bytearray) -> None:
            hand = Hand(self._worlds, stop)
            while (i := turn(hand)) != DONE_ALL:
                if i >= 0:
                    single(i, stop)

        run_on_threads(work, min(threads, len(self)))
        for i in np.flatnonzero(self._worlds.code[:-1] == CODE["bad"]).tolist():
            single(i, bytearray(1))  # which finds the words
        if self.faults and errors == "raise":
            raise self.faults[min(self.faults)]
        self.faults.update(self._unusable)
        for i in self.faults:
            self._worlds.numbers[:, i] = np.nan

    def _fault(self, i: int, error: LavenderError) -> LavenderError:
        if isinstance(self.problems, Batch) and isinstance(error, InputError):
            return InputError(f"world {i}: {error}")
        return error


class Residuals(Many):
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
        """(n,) as `Residual.verdict`; "" of a bad world."""
        nothing = (self._numbers("relative_at_zero") < 0.5) | (self._numbers("reference_speed") < AT_REST)
        for i, known in self._nothing.items():
            nothing[i] = known
        names = "relative", "roundoff_floor", "above_floor", "energy", "speed", "rhs_energy"
        each = zip(
            *(self._numbers(name).tolist() for name in names), nothing.tolist(), self.precision, strict=True
        )
        words = [verdict_of(*x, self.threshold) for x in each]  # type: ignore[call-arg]
        for i in self.faults:
            words[i] = ""
        return read_only(np.array(words, f"U{max(map(len, VERDICTS))}"))

    @property
    def excess(self) -> FloatArray:
        """(n,) relative residual over its floor."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.relative == 0.0, 0.0, self.relative / self.roundoff_floor)

    def keep(self, i: int, found: Residual) -> None:
        """The residual of a world that the loop left."""
        self._keep(i, found)
        self._nothing[i] = found.nothing_to_do
        self._worlds.numbers[NUMBER["rhs_energy"], i] = found.energy_rhs

    def _one(self, i: int) -> Residual:
        return residual(self.problems[i], self._impulse[self._rows(i)], self.precision[i], self.threshold)

    def __repr__(self) -> str:
        words, counts = np.unique(self.verdict, return_counts=True)
        told = ", ".join(f"{n} {word or 'bad'}" for word, n in zip(words, counts, strict=True))
        return f"<Residuals of {len(self)} worlds: {told}>"


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
    (['at its floor', 'stopped before convergence', 'wrong'], [0.0, 0.1, 1.0])
    """
    given = given_problems(problems, errors)
    if precision is not None:
        precision = one_of("precision", precision, PRECISIONS)
    threshold = number("threshold", threshold, low=0.0)
    threads = whole_number("threads", threads, 1, None)
    if isinstance(given, Batch):
        starts: Any = given.impulses("impulses", impulses)
        words = len(given) * [given.precision if precision is None else precision]
    else:
        starts = of_each(given, impulses)
        for i, start in enumerate(starts):
            if start is None:
                raise InputError(
                    f"impulses of world {i} is None, and the problem has no guess; (m,) is needed"
                )
        words = [p.precision if precision is None else precision for p in given]
    made = Residuals(given, starts, words, threshold)
    single = isinstance(given, Batch) and "float32" in words

    def alone(i: int) -> None:
        made.keep(i, residual(given[i], made._impulse[made._rows(i)], words[i], threshold))

    made._run(lambda hand: int(hand.judge(TOL, single)), alone, threads, errors)
    for i, word in enumerate(words):  # The compiled loop judges the problems of a list for float64.
        if word == "float32" and not single and i not in made.faults:
            alone(i)
    return made


def given_problems(problems: Any, errors: str) -> Any:
    """A batch, or a list of problems."""
    one_of("errors", errors, ERRORS)
    if isinstance(problems, Problem):
        raise InputError("problems is one Problem; a list of them is needed, or `solve`")
    if isinstance(problems, Batch):
        return problems
    given = several("problems", problems, "Problems, or a Batch,")
    for problem in given:
        if type(problem) is not Problem:
            check_problem(problem)
    return given


def of_each(given: Any, impulses: Any) -> list[Any]:
    """Impulses (m,) [N s] of each problem, its guess where there are none."""
    impulses = several("impulses", impulses, "(m,), one for each problem,")
    if len(impulses) != len(given):
        raise InputError(f"{len(impulses)} impulses for {len(given)} problems; one for each is needed")
    return [
        p.guess if x is None else as_array(f"impulses of world {i}", x, (p.m,), finite=False, unit="N s")
        for i, (p, x) in enumerate(zip(given, impulses, strict=True))
    ]
