"""Residuals of many worlds in one call, as arrays, bit-identical to single calls of `residual`.

One compiled loop processes the worlds of a `Batch`, or problems in generalised coordinates. Each thread takes the next
world from an atomic counter. Every other problem is judged by a call of `residual`. `lavender/batch/solve.py` solves
with this loop, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from math import prod
from types import SimpleNamespace
from typing import Any

import numpy as np

from lavender.base.array_libraries import find_converter
from lavender.base.arrays import (
    BoolArray,
    FloatArray,
    check_choice,
    check_float,
    check_int,
    check_sequence,
    mark_read_only,
    resolve_index,
)
from lavender.base.errors import InputError, LavenderError
from lavender.base.threads import run_on_threads
from lavender.batch.data import ERRORS, Batch
from lavender.judge.residuals import (
    DEFAULT_THRESHOLD,
    EXACT_TOL,
    MAX_EXCUSED_RESIDUAL,
    MAX_REST_VELOCITY,
    MAX_STIFF_RATIO,
    TOL,
    VERDICTS,
    Residual,
    compute_verdict,
    residual,
)
from lavender.problem import PRECISIONS, Problem, check_problem
from lavender.problem.derived import cached_property
from lavender.solvers.small import AUTO
from lavender_ext.batch.many import (
    CODE,
    NUMBER,
    PLACE,
    Worker,
    Worlds,
    judge_motions,
    list_problem_data,
)
from lavender_ext.core.checks import make_instance

# Row of `Worlds.numbers` of each field of a residual.
NUMBER_OF_FIELD = {
    "relative": NUMBER["relative"],
    "energy": NUMBER["energy"],
    "velocity": NUMBER["speed"],
    "roundoff_floor": NUMBER["roundoff_floor"],
    "above_floor": NUMBER["above_floor"],
    "energy_at_zero": NUMBER["reference_energy"],
    "velocity_at_zero": NUMBER["reference_speed"],
}
NO_VELOCITY = np.zeros(0)
# The exact impulses of this number of worlds take less time than one motion that is judged by a single call.
WORLDS_PER_SINGLE = 16
NO_MORE_WORLDS = -1  # The methods of `Worker` return this after the last world.


class _Column:
    """Property of `WorldResults`: a number of the judge for each world."""

    def __init__(self, name: str, doc: str) -> None:
        self.name, self.__doc__ = name, doc

    def __get__(self, results: Any, owner: type) -> FloatArray:
        return self if results is None else results._export(results._get_column(self.name))  # type: ignore[return-value]


class WorldResults:
    """Judged residuals of n worlds: base class of `Residuals` and `Solutions`.

    All arrays are read-only, or copies in the library of `like`.

    Parameters
    ----------
    problems : Batch, or list of Problem
    starts : array or list
        Flat impulses [N s] of the batch, or (m,) or None for each problem.
    cold : bool
        Whether all worlds start from the zero impulse.
    like : array, optional
        An array of the library of the results.
    """

    def __init__(self, problems: Any, starts: Any, cold: bool, like: Any = None) -> None:
        self._convert = find_converter(like)
        self.problems: Sequence[Problem] = problems
        self.faults: dict[int, LavenderError] = {}
        # Worlds with an invalid start begin at the zero impulse.
        self._invalid_starts: dict[int, LavenderError] = {}
        if type(problems) is Batch:
            at = problems.at
            self._sizes, self._first = at["rows"], at["row"]
            self._impulse = np.zeros(prod(problems.shape)) if cold else starts
            self._velocity: FloatArray | None = np.zeros(prod(problems.velocity_shape))
            self._worlds: Worlds = problems.make_kernel_worlds(self._impulse, self._velocity, cold)
            return
        self._data, at, m = list_problem_data(problems, Problem)
        self._sizes, self._first = at[:, PLACE["rows"]], at[:, PLACE["row"]]
        self._impulse = np.zeros(m)
        self._velocity = None
        self._worlds = Worlds(at, self._impulse, NO_VELOCITY, cold)
        self._worlds.set_from_problems(problems, self._data, starts)

    relative = _Column("relative", "Relative residual (n,) [-]; NaN for an invalid world.")
    energy = _Column("energy", "Energy norm of the error (n,) [sqrt J].")
    velocity_error = _Column("speed", "Velocity error of the worst row (n,) [m/s].")
    velocity_at_zero = _Column(
        "reference_speed",
        "Velocity error of the zero impulse (n,) [m/s], the reference of `relative`.",
    )
    impulse_error = _Column("push", "Impulse error of the worst row (n,) [N s].")
    roundoff_floor = _Column(
        "roundoff_floor", "Relative residual that rounding alone can cause (n,) [-]."
    )

    @property
    def worst_row(self) -> np.ndarray:
        """Row of the largest velocity error (n,), as an index in its world; -1 for a world without rows."""
        return self._export(self._worlds.worst[:-1])

    def _export(self, array: np.ndarray) -> Any:
        """Return an array as callers receive it: read-only, or a copy in the library of `like`."""
        return mark_read_only(array) if self._convert is None else self._convert(array)

    def _get_column(self, which: str) -> FloatArray:
        return mark_read_only(self._worlds.numbers[NUMBER[which], :-1])

    def _get_rows(self, i: int) -> slice:
        return slice(int(self._first[i]), int(self._first[i] + self._sizes[i]))

    def _store_residual(self, i: int, residual: Residual) -> None:
        """Store the judged numbers of a world that the loop did not process."""
        numbers = self._worlds.numbers
        for name, row in NUMBER_OF_FIELD.items():
            numbers[row, i] = getattr(residual, name)
        push = abs(residual.error[residual.worst_row]) if residual.worst_row >= 0 else 0.0
        numbers[NUMBER["push"], i] = push
        self._worlds.worst[i] = residual.worst_row

    def _make_residual(self, i: int, judge: Callable[[int], Residual], **fields: Any) -> Residual:
        """Return the residual of world i by the stored numbers; `judge` computes its other fields when one is read."""
        numbers = self._worlds.numbers[:, i].tolist()
        fields |= {name: numbers[row] for name, row in NUMBER_OF_FIELD.items()}
        fields |= {
            "worst_row": int(self._worlds.worst[i]),
            "_rest": (lambda: judge(i).__getstate__(), ()),
        }
        found: Residual = make_instance(Residual, fields)
        return found

    def __getstate__(self) -> dict[str, Any]:
        """Return the results, in NumPy arrays, without the data of the compiled loop."""
        loop = self._worlds
        results = SimpleNamespace(
            numbers=loop.numbers, worst=loop.worst, counts=loop.counts, code=loop.code
        )
        return vars(self) | {"_worlds": results, "_data": None, "_convert": None}

    def __len__(self) -> int:
        return len(self.problems)

    def __getitem__(self, i: Any) -> Any:
        """Return the result of world i, or a list of results; raise the error of an invalid world."""
        i = resolve_index(i, len(self))
        if isinstance(i, list):
            return [self[j] for j in i]
        if i in self.faults:
            raise self.faults[i]
        return self._get_result(i)

    def _get_result(self, i: int) -> Any:
        """Return the result of a valid world."""
        raise NotImplementedError

    def _process_worlds(
        self,
        process_until_deferred: Callable[[Worker], int],
        process_single: Callable[[int], None],
        threads: int,
        errors: str,
    ) -> None:
        """Process all worlds, and store the errors of invalid ones in `faults`.

        `process_until_deferred` processes the next world in the compiled loop, or returns its index if a single call
        (`process_single`) must process it.
        """

        def try_single(i: int, stop: bytearray) -> None:
            try:
                process_single(i)
            except LavenderError as error:
                is_input = type(self.problems) is Batch and isinstance(error, InputError)
                self.faults[i] = InputError(f"world {i}: {error}") if is_input else error
                stop[0] |= errors == "raise"

        def work(stop: bytearray) -> None:
            hand = Worker(self._worlds, stop)
            while (i := process_until_deferred(hand)) != NO_MORE_WORLDS:
                if i >= 0:
                    try_single(i, stop)

        run_on_threads(work, min(threads, len(self)))
        code = self._worlds.code
        # Bytes are searched in a tenth of the time of an array of booleans.
        for i in (
            (code == CODE["bad"]).nonzero()[0].tolist() if CODE["bad"] in code.tobytes() else ()
        ):
            # Repeat the invalid world by a single call, which raises the complete error.
            try_single(i, bytearray(1))
        if self.faults and errors == "raise":
            raise self.faults[min(self.faults)]
        self.faults.update(self._invalid_starts)
        for i in self.faults:
            self._worlds.numbers[:, i] = np.nan


class Residuals(WorldResults):
    """Verdicts of `residual_many`, in arrays; `errors[i]` is the `Residual` of world i.

    Parameters
    ----------
    relative, energy, velocity_error, impulse_error, roundoff_floor : (n,)
        As for `Solutions`; the floor depends on `precision`.
    worst_row : (n,) int
    precision : {"float64", "float32"} or sequence of them
    threshold : float, m/s
    faults : dict of int to LavenderError
        Errors of invalid worlds, by their indices.
    """

    def __init__(
        self,
        problems: Any,
        starts: Any,
        precision: Sequence[str],
        threshold: float,
        like: Any = None,
    ) -> None:
        super().__init__(problems, starts, False, like)
        self.precision, self.threshold = precision, threshold
        if type(problems) is not Batch:
            self._impulse[:] = np.concatenate([np.zeros(0), *starts])
        # `Residual.nothing_to_do` of the worlds that single calls processed.
        self._nothing_to_do: dict[int, bool] = {}
        # Worlds that were judged by the acceleration that moved their bodies.
        self.moved: set[int] = set()
        # Residuals of the worlds with forces of an engine that have lost digits.
        self.without_digits: dict[int, Residual] = {}

    @cached_property
    def verdict(self) -> np.ndarray:
        """Verdict of each world (n,), as `Residual.verdict`; "" for an invalid world."""
        nothing_to_do = (self._get_column("relative_at_zero") < 0.5) | (
            self._get_column("reference_speed") < MAX_REST_VELOCITY
        )
        for i, value in self._nothing_to_do.items():
            nothing_to_do[i] = value
        names = "relative", "roundoff_floor", "above_floor", "energy", "speed", "rhs_energy"
        arguments = zip(
            *(self._get_column(name).tolist() for name in names),
            nothing_to_do.tolist(),
            self.precision,
            strict=True,
        )
        verdicts = [compute_verdict(*x, self.threshold) for x in arguments]  # type: ignore[call-arg]
        for i in self.faults:
            verdicts[i] = ""
        return mark_read_only(np.array(verdicts, f"U{max(map(len, VERDICTS))}"))

    @property
    def excess(self) -> FloatArray:
        """Relative residual divided by its floor (n,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            relative, floor = self._get_column("relative"), self._get_column("roundoff_floor")
            return self._export(np.where(relative == 0.0, 0.0, relative / floor))

    def store_residual(self, i: int, residual: Residual) -> None:
        """Store the residual of a world that a single call processed."""
        self._store_residual(i, residual)
        self._nothing_to_do[i] = residual.nothing_to_do
        if residual.lost_digits:
            self.without_digits[i] = residual
        self._worlds.numbers[NUMBER["rhs_energy"], i] = residual.energy_rhs

    def _judge_world(self, i: int) -> Residual:
        return residual(
            self.problems[i], self._impulse[self._get_rows(i)], self.precision[i], self.threshold
        )

    def _get_result(self, i: int) -> Residual:
        if i in self._nothing_to_do or not self._sizes[i]:
            return self._judge_world(i)
        return self._make_residual(
            i,
            self._judge_world,
            precision=self.precision[i],
            threshold=self.threshold,
            moved_by="acceleration" if i in self.moved else "impulse",
        )

    def __repr__(self) -> str:
        verdicts, counts = np.unique(self.verdict, return_counts=True)
        summary = ", ".join(
            f"{n} {verdict or 'bad'}" for verdict, n in zip(verdicts, counts, strict=True)
        )
        return f"<Residuals of {len(self)} worlds: {summary}>"


def residual_many(
    problems: Batch | Iterable[Problem],
    impulses: Any,
    *,
    precision: str | None = None,
    threshold: float = DEFAULT_THRESHOLD,
    threads: int = 1,
    errors: str = "raise",
    like: Any = None,
) -> Residuals:
    """Judge impulses of many worlds: compute an error and a verdict for each.

    Parameters
    ----------
    problems : Batch, or iterable of Problem
    impulses : N s
        An array of the batch's shape of impulses, or a sequence of (m,) for problems. Entries may be infinite or NaN.
    precision : {"float64", "float32"}, optional
        Precision in which the impulses were computed. Default: the precision of each problem.
    threshold : float, m/s
        As for `residual`.
    threads : int
    errors : {"raise", "status"}
        As for `solve_many`; the verdict of an invalid world is empty.
    like : array, optional
        As for `solve_many`.

    Returns
    -------
    Residuals
        Results that are bit-identical to `residual` for each world.

    Raises
    ------
    InputError
        The shapes disagree, the precision is unknown, the threshold is negative, or a world is invalid.

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
    worlds = check_problems(problems, errors)
    if precision is not None:
        precision = check_choice("precision", precision, PRECISIONS)
    threshold = check_float("threshold", threshold, low=0.0)
    threads = check_int("threads", threads, 1, None)
    if type(worlds) is Batch:
        starts: Any = worlds.flatten_impulses("impulses", impulses)
        precisions = len(worlds) * [worlds.precision if precision is None else precision]
    else:
        starts = convert_impulses_or_guesses(worlds, impulses)
        for i, start in enumerate(starts):
            if start is None:
                raise InputError(
                    f"impulses[{i}] is None, and problem {i} has no guess that could be judged instead; an "
                    f"array ({worlds[i].m},) [N s] is needed"
                )
        precisions = [p.precision if precision is None else precision for p in worlds]
    residuals = Residuals(worlds, starts, precisions, threshold, like)
    is_single_precision = type(worlds) is Batch and "float32" in precisions

    def judge_single(i: int) -> None:
        impulse = residuals._impulse[residuals._get_rows(i)]
        # The numbers do not depend on the names of blocks, which take as long to write as a solve.
        problem = worlds.get_world(i, named=False) if type(worlds) is Batch else worlds[i]
        residuals.store_residual(i, residual(problem, impulse, precisions[i], threshold))

    residuals._process_worlds(
        lambda hand: int(hand.process_worlds(TOL, judges=True, narrow=is_single_precision)),
        judge_single,
        threads,
        errors,
    )
    # For a list of problems, the compiled loop assumes float64.
    is_left = (
        np.array(precisions) == "float32"
        if not is_single_precision
        else np.zeros(len(worlds), bool)
    )
    if type(worlds) is not Batch:
        is_engine = np.array([p.engine_motion is not None for p in worlds], bool)
    elif worlds.engine_motions:
        is_engine = worlds.engine_motions.has_motion.copy()
    else:
        is_engine = np.zeros(len(worlds), bool)
    is_engine &= residuals._get_column("above_floor") != 0.0
    is_engine[list(residuals.faults)] = is_left[list(residuals.faults)] = False
    if type(worlds) is Batch and is_engine.any() and "float32" not in precisions:
        is_engine &= ~_judge_motions(worlds, residuals, is_engine)
    for i in np.flatnonzero(is_left | is_engine).tolist():
        judge_single(i)
    return residuals


def _judge_motions(batch: Batch, residuals: Residuals, moved: BoolArray) -> BoolArray:
    """Judge the accelerations that moved the bodies of some worlds (n,); return the worlds that were judged.

    The exact impulses are the solutions from the engine's impulses, as in `EngineMotion.judge`: these themselves if
    they are solutions.
    """
    motions = batch.engine_motions
    own = moved & motions.find_worlds_moved_by_acceleration(residuals._impulse)
    judged = np.zeros(len(batch), bool)
    if WORLDS_PER_SINGLE * int(np.count_nonzero(own)) < len(batch):
        return judged
    engine = residuals._impulse, motions.change, motions.compliance
    limits = EXACT_TOL, MAX_STIFF_RATIO, MAX_EXCUSED_RESIDUAL
    numbers, worst = residuals._worlds.numbers, residuals._worlds.worst
    is_exact = own & (residuals._get_column("relative") <= EXACT_TOL)
    for worlds, which in ((residuals._worlds, is_exact), (None, own & ~is_exact)):
        if not which.any():
            continue
        if worlds is None:
            velocity = np.zeros(prod(batch.velocity_shape))
            worlds = batch.make_kernel_worlds(residuals._impulse.copy(), velocity, False)
            hand = Worker(worlds, bytearray(1))
            while hand.process_worlds(EXACT_TOL, AUTO.call) != NO_MORE_WORLDS:
                pass  # A single call judges a world that the loop leaves.
            which &= worlds.code[:-1] == CODE["ready"]
        indices = np.flatnonzero(which)
        refused = judge_motions(worlds, *limits, engine, indices.tolist(), numbers, worst)
        judged[indices] = True
        judged[refused] = False
    residuals.moved = set(np.flatnonzero(judged).tolist())
    return judged


def check_problems(problems: Any, errors: str) -> Any:
    """Return a batch, or a list of problems; raise InputError for other arguments or an unknown `errors`."""
    check_choice("errors", errors, ERRORS)
    if isinstance(problems, Problem):
        raise InputError(
            "problems is one Problem; a list of problems is needed: use [problem], or `lavender.solve` and "
            "`lavender.residual`, which take one problem"
        )
    if type(problems) is Batch:
        return problems
    is_list = type(problems) is list
    problems = (
        list(problems) if is_list else check_sequence("problems", problems, "Problems, or a Batch,")
    )
    for problem in problems:
        if type(problem) is not Problem:
            check_problem(problem)
    return problems


def convert_impulses_or_guesses(problems: Any, impulses: Any) -> list[Any]:
    """Convert the impulses (m,) [N s] of each problem; its guess replaces None."""
    impulses = check_sequence("impulses", impulses, "(m,), one for each problem,")
    if len(impulses) != len(problems):
        raise InputError(
            f"impulses has {len(impulses)} entries for {len(problems)} problems; one array for each problem is needed"
        )
    return [
        p.guess if x is None else p.make_start(x, f"impulses of world {i}", finite=False)
        for i, (p, x) in enumerate(zip(problems, impulses, strict=True))
    ]
