"""Compare the claims of an engine with the judge's verdicts, over the steps of many worlds.

    comparison = compare_claims(step_kamino("build_boxes_fourbar", worlds=8, steps=50))
    print(comparison.table_of_claims)

An answer is right if no row has a velocity error above a threshold, or if rounding explains its error in the engine's
precision. A claim is right if it states the same. Worlds with numbers that are not finite cannot be judged; they are
counted by the claim that the engine makes for them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_float
from lavender.base.errors import InputError
from lavender.batch.residuals import residual_many
from lavender.io.engine_step import EngineStep
from lavender.io.recorder import Recorder, read_recorded_state
from lavender.io.stored import STATES_FOLDER, write_arrays
from lavender.judge.residuals import AT_FLOOR, DEFAULT_THRESHOLD
from lavender.report.runner import Event
from lavender.report.summary_page import PageSection, SummaryPage
from lavender.report.table import Table
from lavender.report.text import format_count, format_percent, format_size, format_tolerance

#: Outcomes of a world's step.
OUTCOMES = (
    "claimed and right",
    "claimed and wrong",
    "not claimed but right",
    "not claimed and wrong",
    "claimed with numbers that are not finite",
    "not claimed, not finite",
)
RIGHT_OUTCOMES, WRONG_OUTCOMES = (0, 2), (1, 3)
STATES_FILE = "states.npz"
N_KEPT_PROBLEMS = 8  # The problems of this many worst answers are written to files.
# Numbers of contacts and limits differ between steps and are removed from row names.
NUMBER_PATTERN = re.compile(r"\b\d+\b")
CLAIMS_NOTE = (
    "Right: no row has a velocity error above the threshold, or rounding explains it in the engine's precision. A "
    "wrong claim hides an error; a missing claim for a right answer costs iterations, or a needless warning."
)
WORST_ROWS_NOTE = "Rows with the largest error of wrong answers, without the numbers of contacts."
MASS_NOTE = (
    "Effective mass 1 / A_ii [kg] of the row with the largest error: an absolute tolerance on impulses accepts large "
    "velocity errors of light bodies."
)
WORST_FILES_NOTE = (
    "Problems with the engine's impulses and claims, in the folder worst: lavender check reads it. states.npz holds "
    "the states before these steps (--states starts from them again)."
)


@dataclass(eq=False)
class ClaimComparison:
    """Claims and verdicts of all worlds and steps.

    Parameters
    ----------
    engine : str
    threshold : float, m/s
        Velocity error up to which an answer is right.
    outcome : (steps, worlds) int
        Indices in `OUTCOMES`.
    velocity : (steps, worlds) m/s
        Velocity error of the worst row; NaN if the world cannot be judged.
    iterations : (steps, worlds) int
        -1 if the engine does not count them.
    where : dict
        Name of the worst row, with numbers removed -> number of wrong answers with this worst row, and their largest
        error [m/s].
    masses : list of (float, bool)
        Effective mass [kg] of the worst row of each wrong answer, and whether the engine claimed that it had converged.
    stopped : bool
        Ctrl-C ended the run early.
    error_limit : float, m/s, optional
        The summary counts the wrong answers with a larger velocity error.
    """

    engine: str
    threshold: float
    outcome: Any
    velocity: FloatArray
    iterations: Any
    where: dict[str, tuple[int, float]] = field(default_factory=dict)
    masses: list[tuple[float, bool]] = field(default_factory=list)
    stopped: bool = False
    error_limit: float | None = None

    @property
    def counts(self) -> dict[str, int]:
        """Number of answers with each outcome."""
        return {name: int(np.count_nonzero(self.outcome == i)) for i, name in enumerate(OUTCOMES)}

    @property
    def is_any_lost(self) -> bool:
        """Whether a world had numbers that are not finite."""
        return bool(np.any(self.outcome >= len(RIGHT_OUTCOMES) + len(WRONG_OUTCOMES)))

    @property
    def largest(self) -> float:
        """Largest velocity error of a wrong answer [m/s]."""
        return float(np.max(self.velocity[np.isin(self.outcome, WRONG_OUTCOMES)], initial=0.0))

    @property
    def n_above_limit(self) -> int:
        """Number of wrong answers with a velocity error above `error_limit`."""
        limit = np.inf if self.error_limit is None else self.error_limit
        return int(np.count_nonzero(self.velocity[np.isin(self.outcome, WRONG_OUTCOMES)] > limit))

    @property
    def head(self) -> str:
        """Summary in a few sentences."""
        counts, total = self.counts, self.outcome.size
        claimed = counts[OUTCOMES[0]] + counts[OUTCOMES[1]]
        missing = counts[OUTCOMES[2]] + counts[OUTCOMES[3]]
        lost = counts[OUTCOMES[4]] + counts[OUTCOMES[5]]
        text = (
            f"{self.engine}: {format_count(total, 'answer')} of {format_count(self.outcome.shape[1], 'world')}. Of "
            f"{claimed} that the engine calls converged, {counts[OUTCOMES[1]]} are wrong by more than "
            f"{self.threshold:g} m/s; of {missing} that it does not, {counts[OUTCOMES[2]]} are right."
        )
        if self.largest:
            text += f" The largest error is {format_size(self.largest)} m/s."
        if self.error_limit is not None:
            count = self.n_above_limit
            text += (
                f" {format_count(count, 'wrong answer')} {'has' if count == 1 else 'have'} an error above "
                f"{self.error_limit:g} m/s."
            )
        if lost:
            text += (
                f" {format_count(lost, 'answer')} {'is' if lost == 1 else 'are'} not finite; the engine calls "
                f"{counts[OUTCOMES[4]]} of them converged."
            )
        return text

    @property
    def table_of_claims(self) -> Table:
        """Number of answers and worlds with each outcome, and errors."""
        rows = []
        for i, name in enumerate(OUTCOMES):
            here = self.outcome == i
            if here.any():
                errors = self.velocity[here & np.isfinite(self.velocity)]
                sizes = (
                    [format_size(float(q)) for q in np.quantile(errors, (0.5, 1.0))]
                    if len(errors)
                    else ["", ""]
                )
                share = format_percent(int(here.sum()), self.outcome.size, 1)
                rows.append([name, str(here.sum()), share, str(np.count_nonzero(here.any(axis=0))), *sizes])
        heads = ["claim and verdict", "answers", "share", "worlds", "median [m/s]", "worst [m/s]"]
        return Table(heads, rows, words=frozenset({heads[0]}))

    @property
    def table_of_rows(self) -> Table:
        """Worst rows of wrong answers, most frequent first."""
        ranked = sorted(self.where.items(), key=lambda entry: -entry[1][0])
        rows = [[name, str(n), format_size(largest)] for name, (n, largest) in ranked]
        return Table(["worst row", "wrong answers", "worst [m/s]"], rows)

    @property
    def table_of_masses(self) -> Table:
        """Wrong answers by the decade of the worst row's effective mass."""
        decades: dict[int, list[bool]] = {}
        for mass, claimed in self.masses:
            decades.setdefault(int(np.floor(np.log10(mass))), []).append(claimed)
        rows = [
            [
                f"{format_tolerance(10.0**k)} to {format_tolerance(10.0 ** (k + 1))}",
                str(len(claims)),
                str(sum(claims)),
            ]
            for k, claims in sorted(decades.items())
        ]
        return Table(["effective mass [kg]", "wrong answers", "of these claimed"], rows)

    @property
    def summary_page(self) -> SummaryPage:
        """Page with all tables."""
        sections = [
            PageSection("Claims and verdicts", [self.table_of_claims], note=CLAIMS_NOTE, short=len(OUTCOMES)),
            PageSection(
                "Worst rows", [self.table_of_rows], note=f"{WORST_ROWS_NOTE} {WORST_FILES_NOTE}", short=5
            ),
            PageSection("Effective mass", [self.table_of_masses], note=MASS_NOTE),
        ]
        numbers = {"engine": self.engine, "threshold": self.threshold, **self.counts}
        return SummaryPage(f"Claims of {self.engine}", self.head, sections, numbers, stopped=self.stopped)


def compare_claims(
    steps: Iterable[EngineStep],
    *,
    engine: str = "engine",
    threshold: float = DEFAULT_THRESHOLD,
    folder: str | os.PathLike[str] | None = None,
    total: int = 0,
    watch: Callable[[Event], None] | None = None,
) -> ClaimComparison:
    """Judge the steps of an engine and compare its claims with the verdicts.

    Parameters
    ----------
    steps : iterable of EngineStep
        Results of `lavender.io.from_kamino` or `from_genesis`, one for each step, with equal numbers of worlds.
    engine : str
        Name in the tables.
    threshold : float, default 1e-4 m/s
    folder : path, optional
        The worst answers are recorded in its folder `worst` (`lavender.io.Recorder`), and the states before them, if
        the steps have states, in its file `states.npz`.
    total : int, optional
        Number of steps, for the progress.
    watch : callable, optional
        Called with the progress.

    Returns
    -------
    ClaimComparison
        After Ctrl-C, it covers the steps judged so far, and its `stopped` is true.

    Raises
    ------
    InputError
        There are no steps, or steps have different numbers of worlds.
    """
    threshold = check_float("threshold", threshold, low=0.0)
    result = ClaimComparison(
        engine, threshold, np.zeros((0, 0), int), np.zeros((0, 0)), np.zeros((0, 0), int)
    )
    outcomes: list[Any] = []
    velocities: list[Any] = []
    iterations: list[Any] = []
    recorder = None
    if folder is not None:
        recorder = Recorder(
            Path(folder) / "worst",
            keep_worst=N_KEPT_PROBLEMS,
            threshold=threshold,
            solver=engine,
            replace=True,
        )
    if watch is not None:
        watch(Event(0, total, f"compiling {engine}", ""))
    try:
        for step in steps:
            if outcomes and len(step.batch) != len(outcomes[0]):
                raise InputError(
                    f"step {len(outcomes)} has {len(step.batch)} worlds, and the first step "
                    f"{len(outcomes[0])}; all steps need the same number of worlds"
                )
            outcome, velocity = _judge_claims_of_step(step, result)
            outcomes.append(outcome)
            velocities.append(velocity)
            iterations.append(step.claims.iterations)
            if recorder is not None:
                recorder.add(step)
            if watch is not None:
                wrong = sum(int(np.isin(x, WRONG_OUTCOMES).sum()) for x in outcomes)
                watch(Event(len(outcomes), total, f"steps judged, {wrong} wrong answers", ""))
    except KeyboardInterrupt:
        if not outcomes:
            raise
        result.stopped = True
    finally:
        if recorder is not None:
            recorder.close()
            _write_states_before_steps(recorder)
    if not outcomes:
        raise InputError("steps is empty; at least one step is needed")
    result.outcome, result.velocity = np.array(outcomes), np.array(velocities)
    result.iterations = np.array(iterations)
    return result


def _write_states_before_steps(recorder: Recorder) -> None:
    """Write `states.npz` next to the recorder's folder: the states from which the recorded steps can be repeated."""
    labels = [NUMBER_PATTERN.findall(file.replace("_", " ")) for file in recorder.files]
    folder = recorder.folder / STATES_FOLDER
    found = [
        (file, label) for file, label in zip(recorder.files, labels, strict=True) if (folder / file).is_file()
    ]
    states = [read_recorded_state(recorder.folder, file) for file, _ in found]
    arrays = {name: np.array([state[name] for state in states]) for name in (states[0] if states else ())}
    if arrays:
        step, world = np.array([label for _, label in found], int).T
        write_arrays(recorder.folder.parent / STATES_FILE, arrays | {"step": step, "world": world})


def _judge_claims_of_step(step: EngineStep, result: ClaimComparison) -> tuple[Any, FloatArray]:
    """Return outcome and velocity error of each world; add all wrong answers, claimed or not, to the statistics."""
    residuals = residual_many(step.batch, step.impulse, threshold=result.threshold, errors="status")
    velocity, verdicts, claimed = residuals.velocity_error, residuals.verdict, step.claims.converged
    is_right = (velocity <= result.threshold) | (verdicts == AT_FLOOR) | (step.batch.row_counts == 0)
    outcome = np.where(is_right, 0, 1) + np.where(claimed, 0, 2)
    lost = ~np.isfinite(velocity)
    lost[list(residuals.faults)] = True
    outcome[lost] = np.where(claimed[lost], 4, 5)
    velocity = np.where(lost, np.nan, velocity)
    for i in np.flatnonzero(np.isin(outcome, WRONG_OUTCOMES)).tolist():
        residual, problem = residuals[i], step.batch[i]
        name = NUMBER_PATTERN.sub("", residual.worst_name).replace("  ", " ").strip()
        count, largest = result.where.get(name, (0, 0.0))
        result.where[name] = count + 1, max(largest, float(velocity[i]))
        result.masses.append((float(1.0 / problem.d[residual.worst_row]), bool(claimed[i])))
    return outcome, velocity
