"""Judge every step of many worlds: which solves stopped before convergence, their errors, and the worst states.

    result = audit("ant.xml")          # as many worlds as take about a minute; or worlds=64
    result.table_of_errors; result.worst[0].problem
    result.write("lavender-audit"); result.summary_page.write("lavender-audit")

An answer with an error that rounding explains, in the precision of the engine, is at its floor and did not stop before
convergence (`Residual.verdict`). MuJoCo's problems are built by `lavender.io.from_mujoco_many` again from the
state before each step with its warm start and controls: the engine's answer is reproduced to the bit.
`noslip_iterations` are applied after the problem is solved; the answer before them is judged. An answer consists of
forces: MuJoCo's Newton and CG move bodies by accelerations that they compute separately, which are more accurate after
a stop before convergence (docs/mujoco.md).

A step is judged if its error is finite. When a world diverges, its later steps cannot be judged, and the step in which
it diverged is judged only if the engine's answer is finite.
"""

from __future__ import annotations

import copy
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from lavender.audit.simulated_worlds import (
    ENGINES,
    N_TRIAL_WORLDS,
    Divergence,
    Runs,
    StepSizes,
    can_any_geoms_collide,
    count_engine_warnings,
    describe_exceedance,
    iterate_frames,
    simulate_world,
    split_state_vector,
)
from lavender.base.arrays import FloatArray, check_choice, check_float, check_int
from lavender.base.errors import InputError, check_name
from lavender.batch.data import Batch
from lavender.batch.residuals import residual_many
from lavender.io.efc import from_mujoco_many
from lavender.io.npz import write_npz
from lavender.io.start_states import VECTOR, Control
from lavender.io.stored import lock_step_folder, write_arrays
from lavender.judge.residuals import AT_FLOOR, CLOSE, DEFAULT_THRESHOLD, UNCONVERGED, VERDICTS, WRONG
from lavender.problem import PRECISIONS, Problem
from lavender.report import machine
from lavender.report.figures import Curve, Figure
from lavender.report.runner import Event
from lavender.report.summary_page import PageSection, SummaryPage
from lavender.report.table import Cell, Table
from lavender.report.text import format_count, format_percent, format_size
from lavender.report.workers import check_workers, connect_backend, map_unordered

UNCONVERGED_OR_WRONG = f"{UNCONVERGED} or wrong"
AUDIT_VERDICTS = (*VERDICTS, "not judged")
NOT_JUDGED = len(VERDICTS)
VELOCITY_UNIT = "m/s, rad/s"  # Linear rows have the first unit, angular rows the second.
WORST_ROW_ERRORS = ("velocity", "impulse", "relative", "floor")  # Errors of the worst row [m/s, N s, -, -].
QUANTILES = (0.5, 0.9, 0.99, 0.999, 1.0)
MAX_PROBLEMS_IN_MEMORY = 512  # Problems are built and judged in batches of this many.
STEPS_PER_TASK = 4096  # A worker returns its results after this many steps or fewer.
MIN_TASKS_PER_WORKER = 10  # With fewer tasks, the progress and the remaining time would be coarse.
DEFAULT_DURATION = 60.0  # [s] Without a number of worlds, the audit takes about this time.
MIN_PROGRESS_TIME = 1.0  # [s] The remaining time is estimated only after results have arrived for this long.
# If `worlds` is None, at most this many are simulated; more would hardly change the quantiles.
MAX_DEFAULT_WORLDS = 4096
# World 0 is first judged in this process for these numbers of steps, so that Ctrl-C soon after the start has a result.
FIRST_STEPS = (1, 20)
N_SHOWN_WORLDS = 5  # Up to this many numbers of worlds are written in a sentence.
SAVED_KINDS = ("worst", "contact")
MAX_CONTACT_STATES = 1000  # Up to about this many states before steps with contact are kept.
N_WORST_WORLDS = 3  # Number of worlds for which the worst step is written to a file.
MAX_CURVE_POINTS = 60  # Largest number of points of a curve over time.
ERRORS_NOTE = (
    "Errors of the worst row of each judged step. At its floor: rounding explains the error, in the engine's "
    "precision. Close enough: no row has a larger error than the threshold. Stopped before convergence, or wrong: all "
    "others. Not judged: the engine's answer is not finite, or the world diverged before. The errors are of the "
    "engine's forces: the accelerations by which MuJoCo's Newton and CG move bodies are usually more accurate."
)
SIZES_NOTE = "Rows and contacts of the steps judged."
FILES_NOTE = (
    "Problems with the engine's impulses, in the folder worst; states.npz holds the states before these steps "
    "(--states starts from them again)."
)
DIVERGED_NOTE = (
    "The step in which each world diverged, the quantity that was not finite or above 1e10, and whether every solve of "
    "the world until then was exact. If so, the cause lies outside the constraint solver."
)
AUDIT_BUSY_CONSEQUENCE = (
    "The audit took longer than on an idle machine; its errors do not depend on the load."
)
ENGINE_ADVICE = "To find out whether the engine is the cause, audit again with --engine mujoco."
OUTSIDE_SOLVER = "outside the constraint solver (time step, integrator, actuators or the model itself)"
DIVERGENCE_ADVICE = (
    'To find out whether the solver is the cause, audit again with <option solver="Newton" iterations="100" '
    'tolerance="1e-12"/>: if worlds diverge again after exact solves, the cause is the model.'
)
# Matches "contact 12 " at the start of a row's name. The number differs between steps and is removed from names.
CONTACT_NUMBER = re.compile(r"^contact \d+ ")


@dataclass(frozen=True)
class Worst:
    """The worst step of a world.

    Parameters
    ----------
    velocity : float, m/s
        Largest velocity error of a row.
    world, step : int
    where : str
        Name of the row with this error.
    problem : Problem
    impulse : (m,) N s
        The engine's answer.
    state : dict
        State before the step, by the names of MjData.
    """

    velocity: float
    world: int
    step: int
    where: str
    problem: Problem = field(repr=False)
    impulse: FloatArray = field(repr=False)
    state: dict[str, FloatArray] = field(repr=False)


class StepState(NamedTuple):
    """The state before a step.

    Parameters
    ----------
    world, step : int
    state : dict
        By the names of MjData.
    """

    world: int
    step: int
    state: dict[str, FloatArray]


class Judging(NamedTuple):
    """How steps are judged and which are kept.

    Parameters
    ----------
    precision : {"float64", "float32"}
    threshold : float, m/s
    keep : int or None
        Number of worst steps to keep; None: the worst step of each of `N_WORST_WORLDS` worlds.
    contact_share : float
        Up to this fraction of the steps have contact and their state before the step kept.
    """

    precision: str
    threshold: float
    keep: int | None = None
    contact_share: float = 0.0


class Piece(NamedTuple):
    """Results of k judged steps.

    Parameters
    ----------
    world, step : (k,) int
        World and number of each step.
    numbers : (len(WORST_ROW_ERRORS), k)
        Errors of the worst row of each step, one row for each name in `WORST_ROW_ERRORS`.
    verdict : (k,) int
        Indices in AUDIT_VERDICTS.
    rows, contacts : (k,) int
    where : list of (int, str)
        Index of a step that stopped before convergence, and the name of its worst row.
    worst : list of Worst
    divergences : sequence of Divergence
    engine_warnings : dict
        MuJoCo's own warnings, and how often each occurred.
    contact_states : sequence of StepState
    """

    world: Any
    step: Any
    numbers: FloatArray
    verdict: Any
    rows: Any
    contacts: Any
    where: list[tuple[int, str]]
    worst: list[Worst]
    divergences: Sequence[Divergence] = ()
    engine_warnings: Mapping[str, int] = MappingProxyType({})
    contact_states: Sequence[StepState] = ()


@dataclass(frozen=True, eq=False)
class Audit:
    """Result of `audit`.

    Parameters
    ----------
    runs : Runs
    engine : str
    numbers : (4, worlds, steps)
        Errors of the worst row [m/s, N s], relative residual and its floor; NaN if the step was not judged.
    verdict : (worlds, steps) int
        Indices in `AUDIT_VERDICTS`; -1 if the audit was stopped before the step.
    rows, contacts : (worlds, steps) int
        Rows, and contacts that have rows; 0 if the step was not judged.
    can_touch : bool
        Whether the model has geoms that can collide.
    where : dict
        Row name (without the contact's number) -> number of steps that stopped before convergence with this worst row,
        and its largest error [m/s].
    worst : list of Worst
    divergences : list of Divergence
    stopped : bool
        The audit was stopped by Ctrl-C, or workers were lost.
    busy : str
        A warning if other processes used the processors; else empty.
    error_limit : float, m/s, optional
        The summary counts the steps with a larger velocity error that rounding does not explain.
    engine_warnings : Counter
        MuJoCo's own warnings, and how often each occurred.
    notes : str
        Sentences about the differences from a simulation of the model as it is: no sleep, a smaller spread.
    n_quiet : (int, int)
        Number of worlds that diverged and were simulated again without noise, and how many of these then survived.
    contact_states : list of StepState
        States before steps with contact, if the audit keeps them; in the order of worlds and steps.
    """

    runs: Runs
    engine: str
    numbers: FloatArray
    verdict: Any
    rows: Any
    contacts: Any
    can_touch: bool
    where: dict[str, tuple[int, float]]
    worst: list[Worst]
    divergences: list[Divergence]
    stopped: bool = False
    busy: str = ""
    error_limit: float | None = None
    engine_warnings: Counter[str] = field(default_factory=Counter)
    notes: str = ""
    n_quiet: tuple[int, int] = (0, 0)
    contact_states: list[StepState] = field(default_factory=list)

    def add_piece(self, piece: Piece, keep: int | None) -> None:
        """Add the results of judged steps, and keep the worst (`Judging.keep`)."""
        self.numbers[:, piece.world, piece.step] = piece.numbers
        self.verdict[piece.world, piece.step] = piece.verdict
        self.rows[piece.world, piece.step] = piece.rows
        self.contacts[piece.world, piece.step] = piece.contacts
        for i, name in piece.where:
            count, largest = self.where.get(name, (0, 0.0))
            self.where[name] = count + 1, max(largest, float(piece.numbers[0, i]))
        self.worst[:] = _select_worst([*self.worst, *piece.worst], keep)
        self.contact_states.extend(piece.contact_states)
        self.engine_warnings.update(piece.engine_warnings)
        self.divergences[:] = sorted([*self.divergences, *piece.divergences])

    @property
    def is_judged(self) -> Any:
        """(worlds, steps) bool: whether the error is finite."""
        return (self.verdict >= 0) & (self.verdict < NOT_JUDGED)

    @property
    def is_unconverged(self) -> Any:
        """(worlds, steps) bool: whether the solve stopped before convergence, or the answer is wrong."""
        return (self.verdict == AUDIT_VERDICTS.index(UNCONVERGED)) | (
            self.verdict == AUDIT_VERDICTS.index(WRONG)
        )

    @property
    def n_judged(self) -> int:
        """Number of steps judged."""
        return int(np.count_nonzero(self.is_judged))

    @property
    def n_unjudged(self) -> int:
        """Number of steps that were requested and not judged."""
        return self.verdict.size - self.n_judged

    @property
    def n_processed(self) -> int:
        """Number of steps that the audit processed."""
        return int(np.count_nonzero(self.verdict >= 0))

    @property
    def n_diverged(self) -> int:
        """Number of steps in which a world diverged: one for each world that diverged."""
        return len(self.divergences)

    @property
    def max_velocity_error(self) -> float:
        """Largest velocity error that rounding does not explain, of the steps judged [m/s]."""
        return float(np.max(self._errors_above_floor, initial=0.0))

    @property
    def _errors_above_floor(self) -> FloatArray:
        """Velocity errors of the steps judged that are not at their floor [m/s]."""
        measured = self.is_judged & (self.verdict > AUDIT_VERDICTS.index(AT_FLOOR))
        return self.numbers[0][measured]

    @property
    def n_above_limit(self) -> int:
        """Number of steps with a velocity error above `error_limit` that rounding does not explain."""
        limit = np.inf if self.error_limit is None else self.error_limit
        return int(np.count_nonzero(self._errors_above_floor > limit))

    @property
    def judged_sizes(self) -> StepSizes:
        """Rows and contacts of the steps judged."""
        return StepSizes(self.rows[self.is_judged], self.contacts[self.is_judged], self.can_touch)

    def has_exact_solves(self, divergence: Divergence) -> bool:
        """Return whether every step of a world that diverged was solved, so that its solver is not the cause.

        A step is solved if its error is at the round-off floor or below `DEFAULT_THRESHOLD` [m/s]. The last step does
        not count if its state or unconstrained acceleration was too large before it was solved.
        """
        selection = divergence.world, slice(0, divergence.step + (not divergence.is_outside))
        verdict = self.verdict[selection]
        close = (verdict == AUDIT_VERDICTS.index(CLOSE)) & (self.numbers[0][selection] <= DEFAULT_THRESHOLD)
        return bool(np.all(close | (verdict == AUDIT_VERDICTS.index(AT_FLOOR))))

    @property
    def start_warning(self) -> str:
        """Warning if the start states lack a warm start or controls; else empty."""
        missing = self.runs.starts.missing if self.runs.starts is not None else ()
        if not missing:
            return ""
        consequences = {
            "warm start": "the first solve of each world starts cold",
            "controls": "the first step uses the controls of --controls",
        }
        return (
            f"The start states have no {' and no '.join(missing)}: "
            f"{' and '.join(consequences[name] for name in missing)}. The first step therefore has "
            "other errors than in the original simulation. Only the array `state` (mjSTATE_INTEGRATION) contains both."
        )

    @property
    def summary_text(self) -> str:
        """Summary in a few sentences."""
        unconverged, judged = self.is_unconverged, self.n_judged
        worlds = format_count(int(np.count_nonzero(self.is_judged.any(axis=1))), "world")
        wrong = int((self.verdict == AUDIT_VERDICTS.index(WRONG)).sum())
        n = int(unconverged.sum()) - wrong
        text = (
            f"{Path(self.runs.model).name}, {self.engine}: {n or 'none'} of {format_count(judged, 'step')} judged in "
            f"{worlds} stopped before convergence"
        )
        if n:
            text += f" ({format_percent(n, judged, 1)})"
        if wrong:
            answers = f"{wrong} {'is' if wrong == 1 else 'are'} wrong"
            text += f", and {answers} ({format_percent(wrong, judged, 1)}): no better than zero forces"
        if n or wrong:
            text += (
                f", in {format_count(int(unconverged.any(axis=1).sum()), 'world')}; "
                f"the worst error is {format_size(self.max_velocity_error)} m/s (rad/s if its row is angular)"
            )
            if self.worst and self.worst[0].velocity == self.max_velocity_error:
                text += f", in {self.worst[0].where}"
        warning = "" if self.judged_sizes.has_enough_contact else (
            f"Only {self.judged_sizes.contact_phrase}: this is too little to rate the solver. "
            "Start from other states with --states."
        )  # fmt: skip
        engine_warnings = "; ".join(
            f"{text} ({format_count(n, 'time')})" for text, n in self.engine_warnings.most_common()
        )
        if engine_warnings:
            engine_warnings = f"MuJoCo's own warnings: {engine_warnings}."
        more = [self._describe_limit(), self._describe_divergences(), engine_warnings, warning]
        return " ".join([f"{text}.", *filter(None, more)])

    def _describe_limit(self) -> str:
        """Return a sentence with the number of steps above `error_limit`; empty without a limit."""
        if self.error_limit is None:
            return ""
        count, judged = self.n_above_limit, self.n_judged
        share = f" ({format_percent(count, judged, 1)})" if count else ""
        has = "has" if count == 1 else "have"
        return (
            f"{count or 'None'} of {format_count(judged, 'step')} judged{share} {has} an error above "
            f"{self.error_limit:g} m/s."
        )

    def _describe_divergences(self) -> str:
        """Return a sentence about steps that were not judged and worlds that diverged; empty if there are none."""
        lost = self.verdict == NOT_JUDGED
        unjudged = format_count(int(lost.sum()), "step")
        were = "was" if lost.sum() == 1 else "were"
        if not self.divergences:
            return f"{unjudged} {were} not judged: the answer is not finite." if lost.any() else ""
        first = min(d.step for d in self.divergences)
        text = f"{format_count(self.n_diverged, 'world')} diverged, in step {first} at the earliest"
        if lost.any():
            text += f"; {unjudged} {were} not judged, because numbers are not finite or above 1e10"
        noisy = [d.world for d in self.divergences if d.world >= self.runs.n_exact_worlds]
        if noisy and self.runs.spread and len(noisy) == self.n_diverged:
            return f"{text}. {self._describe_noise(noisy)}"
        text += "."
        exact = sum(map(self.has_exact_solves, self.divergences))
        if exact == self.n_diverged:
            return f"{text} Every solve until then was exact: the cause lies {OUTSIDE_SOLVER}."
        if exact:
            text += f" In {exact} of these every solve until then was exact: the cause lies {OUTSIDE_SOLVER}."
        return f"{text} {DIVERGENCE_ADVICE if self.engine == 'mujoco' else ENGINE_ADVICE}"

    def _describe_noise(self, worlds: list[int]) -> str:
        """Return sentences about worlds that diverged, all of which started with random velocities."""
        exact, (checked, quiet) = self.runs.n_exact_worlds, self.n_quiet
        names = "World 0, which starts" if exact == 1 else f"The first {exact} worlds, which start"
        text = (
            f"{names} without random velocities, did not diverge; the others start with {self.runs.spread:g} m/s or "
            f"rad/s (--spread), and {_join_numbers(worlds)} diverged."
        )
        remedy = "Audit again with --spread 0, or from states of your own (--states)."
        if checked and quiet == checked:
            again = "It was" if len(worlds) == 1 else f"{checked} of these {len(worlds)} were"
            return (
                f"{text} {again} simulated again with the same controls and without random velocities, and did not "
                f"diverge: the random velocities are the cause, not the model or its solver. {remedy}"
            )
        if checked:
            cause = f"{text} Without random velocities {checked - quiet} of {checked} of them diverge, too."
            return f"{cause} {DIVERGENCE_ADVICE}"
        return f"{text} {remedy}"

    @property
    def table_of_errors(self) -> Table:
        """Quantiles of the errors over all steps judged, and over unconverged and wrong ones."""
        heads = ["error", *(f"{100.0 * q:g} %" for q in QUANTILES[:-1]), "worst"]
        rows: list[list[str | Cell]] = []
        for of, selected in (
            ("all steps judged", self.is_judged),
            (UNCONVERGED_OR_WRONG, self.is_unconverged),
        ):
            for name, unit, x in (
                ("velocity", VELOCITY_UNIT, self.numbers[0]),
                ("impulse", "N s", self.numbers[1]),
            ):
                known = x[selected & np.isfinite(x)]
                if len(known):
                    quantiles = np.quantile(known, QUANTILES, method="higher")
                    rows.append([f"{name} [{unit}], {of}", *map(Cell.size, quantiles.tolist())])
        return Table(heads, rows, words=frozenset({"error"}))

    @property
    def table_of_verdicts(self) -> Table:
        """Number of steps and of worlds with each verdict."""
        rows = []
        for i, word in enumerate(AUDIT_VERDICTS):
            here = self.verdict == i
            if here.any():
                worlds = str(np.count_nonzero(here.any(axis=1)))
                rows.append(
                    [word, str(here.sum()), format_percent(int(here.sum()), self.n_processed, 2), worlds]
                )
        return Table(["verdict", "steps", "share", "worlds"], rows, words=frozenset({"verdict"}))

    @property
    def table_of_rows(self) -> Table:
        """The worst rows of steps that stopped before convergence or are wrong, most frequent first."""
        ranked = sorted(self.where.items(), key=lambda entry: -entry[1][0])
        rows: list[list[str | Cell]] = [[name, str(n), Cell.size(largest)] for name, (n, largest) in ranked]
        return Table(["worst row", UNCONVERGED_OR_WRONG, f"at most [{VELOCITY_UNIT}]"], rows)

    @property
    def table_of_diverged(self) -> Table:
        """The step in which each world diverged."""
        rows: list[list[str | Cell]] = []
        for d in self.divergences:
            error = self.numbers[0, d.world, d.step]
            known = Cell.size(float(error))
            exact = "exact" if self.has_exact_solves(d) else "not exact"
            rows.append([d.cause, str(d.world), str(d.step), known, exact])
        heads = ["too large", "world", "step", f"error [{VELOCITY_UNIT}]", "solves until then"]
        return Table(heads, rows, words=frozenset({"too large", "solves until then"}))

    @property
    def table_of_worst(self) -> Table:
        """The worlds of the worst steps, which are written to files."""
        rows: list[list[str | Cell]] = [
            [f"worst_{i}.npz", str(w.world), str(w.step), Cell.size(w.velocity), w.where]
            for i, w in enumerate(self.worst, 1)
        ]
        return Table(
            ["file", "world", "step", VELOCITY_UNIT, "worst row"],
            rows,
            words=frozenset({"file", "worst row"}),
        )

    @property
    def figure(self) -> Figure:
        """Errors over time."""
        width = -(-self.runs.steps // MAX_CURVE_POINTS)
        parts = [self.numbers[0][:, k : k + width] for k in range(0, self.runs.steps, width)]
        known = [(k * width, p[np.isfinite(p)]) for k, p in enumerate(parts) if np.isfinite(p).any()]
        curves = tuple(
            Curve.from_points(name, name, [(k, float(np.quantile(p, q, method="higher")) or np.nan) for k, p in known])
            for name, q in (("median", 0.5), ("99 %", 0.99), ("worst", 1.0)) if known
        )  # fmt: skip
        return Figure(
            "over-time", "Errors of all worlds", "step", "velocity error [m/s]", curves, x_log=False
        )

    def write(self, folder: str | os.PathLike[str]) -> None:
        """Write `records.npz`, the worst steps as `worst/worst_1.npz` etc., and `states.npz`.

        `summary_page.write` writes the page.

        `records.npz` holds `velocity` [m/s], `impulse` [N s], `relative`, `floor`, `verdict`, `rows`, `contacts` (each
        (worlds, steps)), `verdicts` and `diverged`, rows of (world, step). `states.npz` holds qpos, qvel, act, ctrl
        and qacc_warmstart of the worst worlds before their step, one row each, and for MuJoCo `state`, their
        mjSTATE_INTEGRATION.
        """
        folder = Path(folder)
        with lock_step_folder(folder / "worst", replace=True) as worst:
            for i, w in enumerate(self.worst, 1):
                write_npz(w.problem, worst / f"worst_{i}.npz", impulse=w.impulse)
        self.save_states("worst", folder / "states.npz")
        records = dict(zip(WORST_ROW_ERRORS, self.numbers, strict=True))
        records |= {"verdict": self.verdict, "verdicts": np.array(AUDIT_VERDICTS)}
        records |= {"rows": self.rows, "contacts": self.contacts}
        records["diverged"] = np.array([(d.world, d.step) for d in self.divergences], int).reshape(-1, 2)
        write_arrays(folder / "records.npz", records)

    def save_states(self, kind: str, path: str | os.PathLike[str]) -> int:
        """Write states before steps to a file that `--states` reads, and return their number.

        Parameters
        ----------
        kind : {"worst", "contact"}
            Steps with the largest errors (`worst`), or with contact (`contact_states`).
        path : path of an .npz
        """
        check_choice("kind", kind, SAVED_KINDS)
        kept: Sequence[Worst | StepState] = self.worst if kind == "worst" else self.contact_states
        names = kept[0].state if kept else ()
        arrays = {name: np.array([entry.state[name] for entry in kept]) for name in names}
        labels = {name: np.array([getattr(entry, name) for entry in kept], int) for name in ("world", "step")}
        write_arrays(Path(path), arrays | labels)
        return len(kept)

    @property
    def totals(self) -> dict[str, Any]:
        """Totals, as `numbers.json` holds them."""
        runs, unconverged = self.runs, self.is_unconverged
        divergences = [d._asdict() | {"exact": self.has_exact_solves(d)} for d in self.divergences]
        return {
            "head": self.summary_text, "engine": self.engine, "model": runs.model, "worlds": runs.worlds,
            "steps": runs.steps,
            "seed": runs.seed, "judged": self.n_judged, "unjudged": self.n_unjudged, "diverged": self.n_diverged,
            "unconverged": int(unconverged.sum()), "wrong": int((self.verdict == AUDIT_VERDICTS.index(WRONG)).sum()),
            "worlds_unconverged": int(unconverged.any(axis=1).sum()),
            "largest": self.max_velocity_error, "error_limit": self.error_limit, "above_limit": self.n_above_limit,
            "divergences": divergences, **self.judged_sizes.as_dict,
            "engine_warnings": dict(self.engine_warnings), "busy": self.busy, "start_warning": self.start_warning,
            "spread": runs.spread, "notes": self.notes,
            "stopped": self.stopped,
        }  # fmt: skip

    @property
    def summary_page(self) -> SummaryPage:
        """Page with the result in a sentence, figures and tables, as `lavender audit` writes it."""
        n_worlds = int(np.count_nonzero(self.is_judged.any(axis=1)))
        return SummaryPage(
            "lavender audit", self.summary_text,
            [
                PageSection("Errors", [self.table_of_errors, self.table_of_verdicts], [self.figure], short=4,
                     note=f"{ERRORS_NOTE} {describe_exceedance(n_worlds)}".strip()),
                PageSection("Rows and contacts", [self.judged_sizes.size_table], short=2, note=SIZES_NOTE),
                PageSection("Worlds that diverged", [self.table_of_diverged], short=2, note=DIVERGED_NOTE),
                PageSection("Worst rows", [self.table_of_rows], short=3,
                        note="Rows that were the worst of a step that stopped before convergence or is wrong."),
                PageSection("The worst worlds", [self.table_of_worst], short=N_WORST_WORLDS, note=FILES_NOTE),
            ],
            self.totals,
            stopped=self.stopped,
            warning=" ".join(filter(None, (self.start_warning, self.notes, self.busy))),
        )  # fmt: skip


def audit(
    model: str | os.PathLike[str],
    *,
    worlds: int | None = None,
    steps: int = 200,
    engine: str = "mujoco",
    control: Control = "random",
    seed: int = 0,
    spread: float | None = None,
    states: Any = None,
    keep: int | None = None,
    keep_contact_states: bool = False,
    precision: str | None = None,
    threshold: float = DEFAULT_THRESHOLD,
    max_velocity_error: float | None = None,
    workers: int = -1,
    backend: str = "loky",
    watch: Callable[[Event], None] | None = None,
) -> Audit:
    """Simulate worlds of a model and judge the engine's answer to every step.

    Parameters
    ----------
    model : path (MJCF)
    worlds : int, optional
        Default: as many as take about a minute (`DEFAULT_DURATION`), at most 4096.
    steps, control, seed, spread
        See `Runs`. Default spread: the largest of 0.1, 0.01, 0.001 and 0 m/s with which trial worlds do not diverge.
    engine : {"mujoco", "mjx", "mujoco_warp"}
    states : path of an .npz, "keyframes", or arrays, optional
        States in which the worlds start: see `lavender.io.start_states`. Default: the model's own.
    keep : int, optional
        Number of worst steps that are kept as problems and states. Default: the worst step of each of three worlds.
    keep_contact_states : bool
        Keep the states before up to 1000 evenly spaced steps with contact (`Audit.save_states`).
    precision : {"float64", "float32"}, optional
        Precision in which MuJoCo computes; default float64. The other engines determine it themselves.
    threshold : float, m/s
        A smaller velocity error is close enough.
    max_velocity_error : float, m/s, optional
        The summary counts the steps with a larger velocity error.
    workers : int
        Processes for MuJoCo; -1: one for each core.
    backend : str
        Name of a joblib backend, as for a campaign.
    watch : callable, optional
        Called with the progress.

    Returns
    -------
    Audit
        After Ctrl-C, the result of the steps so far, with `stopped`: before the first results of the workers, some
        steps of world 0.

    Raises
    ------
    InputError
        The model cannot be read, the engine is not installed, or a number is out of range.
    CapabilityError
        MuJoCo does not store the matrix of the integrator "discrete"; see `lavender.io.from_mujoco`.
    UnknownName
        The engine is unknown.
    """
    check_name("engine", engine, ENGINES)
    if precision not in (None, *PRECISIONS) or (precision and engine != "mujoco"):
        raise InputError(
            f"precision is {precision!r} and engine is {engine!r}; None is needed, or with engine 'mujoco' "
            f"{' or '.join(PRECISIONS)}"
        )
    check_workers(workers)
    if max_velocity_error is not None:
        max_velocity_error = check_float("max_velocity_error", max_velocity_error, low=0.0)
    judging = Judging(
        precision or "float64",
        check_float("threshold", threshold, low=0.0),
        None if keep is None else check_int("keep", keep, 1),
    )
    expected_time = DEFAULT_DURATION if worlds is None else None
    one = Runs(
        os.fspath(model), 1 if worlds is None else worlds, steps, control=control, seed=seed
    ).with_start_states(states)
    early = result = _make_empty_audit(one, engine, max_velocity_error)
    loads: list[float | None] = []
    processes = count_processes(workers) if engine == "mujoco" else 1
    n_quiet = (0, 0)
    try:
        if worlds is None or engine == "mujoco":
            _reject_unsupported_model(one)
            for n_steps in (*FIRST_STEPS, steps) if worlds is None else FIRST_STEPS:
                begin = perf_counter()
                judged = _judge_first_steps(result, judging, n_steps, watch)
                duration = perf_counter() - begin
                early = judged if engine == "mujoco" else early
        if worlds is None:
            worlds = choose_world_count(duration, processes)
        runs = Runs(os.fspath(model), worlds, steps, control=control, seed=seed).with_start_states(states)
        if watch is not None and spread is None:
            watch(Event(0, 0, "simulating trial worlds to choose the spread", ""))
        runs, spread_note = runs.choose_spread() if spread is None else (replace(runs, spread=spread), "")
        if keep_contact_states:
            judging = judging._replace(contact_share=min(1.0, MAX_CONTACT_STATES / (worlds * steps)))
        result = _make_empty_audit(runs, engine, max_velocity_error, spread_note)
        if engine == "mujoco":
            pieces = _audit_mujoco(runs, judging, workers, backend)
        else:
            pieces = _audit_jointly_stepped_worlds(engine, runs, judging)
        if watch is not None:
            text = f"{format_count(worlds, 'world')} of {format_count(steps, 'step')}"
            if engine == "mujoco":
                watch(Event(0, worlds * steps, text, "", remaining=expected_time))
            else:
                watch(Event(0, worlds * steps, f"compiling {engine}, then {text}", ""))
        begin = perf_counter()
        first: tuple[int, float] | None = None  # Number of steps and time [s] of the first results.
        for piece in pieces:
            result.add_piece(piece, judging.keep)
            loads.append(machine.count_runnable_processes())
            if watch is not None:
                # The time before the first results contains the start of the workers.
                first = first or (result.n_processed, perf_counter())
                elapsed, since = perf_counter() - first[1], result.n_processed - first[0]
                remaining = (
                    None if expected_time is None else max(0.0, expected_time + begin - perf_counter())
                )
                if since and elapsed >= MIN_PROGRESS_TIME:
                    remaining = elapsed * (worlds * steps - result.n_processed) / since
                text = f"steps, {int(result.is_unconverged.sum())} unconverged"
                watch(Event(result.n_processed, worlds * steps, text, "", remaining=remaining))
        if engine == "mujoco":
            n_quiet = _repeat_without_noise(runs, result.divergences)
    except KeyboardInterrupt:
        if not result.n_processed:
            if not early.n_processed:
                raise
            return early
    if not result.n_processed:
        raise InputError(
            "no step was judged, because workers were lost; give fewer workers (--workers), which need less memory"
        )
    own = processes + (engine == "mujoco")  # This process waits for the workers.
    busy = machine.make_busy_warning(loads, os.cpu_count() or 1, AUDIT_BUSY_CONSEQUENCE, own=own)
    result.contact_states.sort(key=lambda entry: entry[:2])
    return replace(result, stopped=result.n_processed < result.verdict.size, busy=busy, n_quiet=n_quiet)


def _make_empty_audit(runs: Runs, engine: str, error_limit: float | None, note: str = "") -> Audit:
    """Make the result of an audit before its first step; `note` is a sentence about the spread."""
    shape = runs.worlds, runs.steps
    rows, contacts = np.zeros((2, *shape), int)
    return Audit(
        runs, engine, np.full((len(WORST_ROW_ERRORS), *shape), np.nan), np.full(shape, -1, np.int8),
        rows=rows, contacts=contacts, can_touch=can_any_geoms_collide(*runs.load_model()), where={},
        worst=[], divergences=[], error_limit=error_limit,
        notes=" ".join(filter(None, (runs.sleep_note, note))),
    )  # fmt: skip


def _judge_first_steps(
    empty: Audit, judging: Judging, n_steps: int, watch: Callable[[Event], None] | None
) -> Audit:
    """Judge up to the first `n_steps` steps of world 0 in this process, as the result of an audit that was stopped.

    World 0 starts without noise, so that its steps do not depend on the spread.
    """
    runs = replace(empty.runs, steps=min(n_steps, empty.runs.steps))
    if watch is not None:
        watch(Event(0, 0, f"judging one world: {format_count(runs.steps, 'step')}", ""))
    judged = _make_empty_audit(empty.runs, empty.engine, empty.error_limit)
    for piece in audit_worlds(runs, judging, range(1)):
        judged.add_piece(piece, judging.keep)
    return replace(judged, stopped=True)


def _repeat_without_noise(runs: Runs, divergences: list[Divergence]) -> tuple[int, int]:
    """Simulate the first worlds that diverged again, without their random velocities and with the same controls.

    Returns the number of worlds and how many of them did not diverge.
    """
    worlds = [d.world for d in divergences if d.world >= runs.n_exact_worlds][:N_TRIAL_WORLDS]
    mj, model = runs.load_model()
    with count_engine_warnings(mj):
        repeated = [simulate_world(mj, model, replace(runs, spread=0.0), world)[1] for world in worlds]
    return len(worlds), repeated.count(None)


def _join_numbers(numbers: list[int]) -> str:
    """Return "world 3", "worlds 3 and 5", or "worlds 1, 2, 3 and 40 more"."""
    shown = [str(number) for number in sorted(numbers)[:N_SHOWN_WORLDS]]
    more = len(numbers) - len(shown)
    last = f"{more} more" if more else shown.pop()
    return f"world{'s' * (len(numbers) > 1)} {' and '.join(filter(None, (', '.join(shown), last)))}"


def count_processes(workers: int) -> int:
    """Return the number of processes of `workers` (-1: one for each core)."""
    return workers if workers > 0 else max(1, (os.cpu_count() or 1) + 1 + workers)


def choose_world_count(duration: float, processes: int) -> int:
    """Return the number of worlds that take about `DEFAULT_DURATION` in `processes` processes.

    `duration` [s] is the time in which one world was simulated and judged.
    """
    return max(1, min(MAX_DEFAULT_WORLDS, int(DEFAULT_DURATION * processes / max(duration, 1e-6))))


def _select_worst(candidates: list[Worst], keep: int | None) -> list[Worst]:
    """Select the `keep` worst steps, or the worst step of each of `N_WORST_WORLDS` worlds."""
    ranked = sorted(candidates, key=lambda w: (-w.velocity, w.world, w.step))
    if keep is not None:
        return ranked[:keep]
    worst: dict[int, Worst] = {}
    for w in ranked:
        worst.setdefault(w.world, w)
    return list(worst.values())[:N_WORST_WORLDS]


def _audit_mujoco(runs: Runs, judging: Judging, workers: int, backend: str) -> Iterator[Piece]:
    """Simulate and judge MuJoCo's steps in worker processes."""
    share = -(-runs.worlds // (MIN_TASKS_PER_WORKER * count_processes(workers)))
    worlds_per_task = max(1, min(STEPS_PER_TASK // runs.steps, share))
    parts = (
        (runs, judging, range(first, min(first + worlds_per_task, runs.worlds)))
        for first in range(0, runs.worlds, worlds_per_task)
    )
    name, cluster = connect_backend(backend)
    with cluster:
        for pieces in map_unordered(audit_worlds, parts, workers, name):
            yield from pieces


def _reject_unsupported_model(runs: Runs) -> None:
    """Raise an error if the model's constraint problems cannot be built, once and before any worker starts."""
    _, model = runs.load_model()
    from_mujoco_many(model, np.concatenate([model.qpos0, np.zeros(model.nv)])[None])


def audit_worlds(runs: Runs, judging: Judging, worlds: range) -> list[Piece]:
    """Simulate and judge MuJoCo's steps of some worlds, in a worker."""
    mj, model = runs.load_model()
    with count_engine_warnings(mj) as engine_warnings:
        pieces = _audit_worlds(mj, model, runs, judging, worlds)
    return [*pieces[:-1], pieces[-1]._replace(engine_warnings=engine_warnings)]


def _audit_worlds(mj: Any, model: Any, runs: Runs, judging: Judging, worlds: range) -> list[Piece]:
    """Simulate and judge MuJoCo's steps of some worlds."""
    simulations = [simulate_world(mj, model, runs, world) for world in worlds]
    states = np.concatenate([states for states, _ in simulations])
    divergences = [divergence for _, divergence in simulations if divergence is not None]
    judge = copy.copy(model)
    judge.opt.noslip_iterations = 0
    world, step = np.repeat(worlds, runs.steps), np.tile(np.arange(runs.steps), len(worlds))
    out = []
    for i in range(0, len(states), MAX_PROBLEMS_IN_MEMORY):
        selection = slice(i, i + MAX_PROBLEMS_IN_MEMORY)
        batch, impulse = from_mujoco_many(judge, states[selection], errors="status")
        assert impulse is not None

        def state_of(k: int, selection: FloatArray = states[selection]) -> dict[str, FloatArray]:
            return split_state_vector(mj, model, selection[k]) | {VECTOR: selection[k].copy()}

        sizes = batch.row_counts, batch.contact_counts
        out.append(_judge_steps(batch, impulse, judging, world[selection], step[selection], state_of, sizes))
    return [*out[:-1], out[-1]._replace(divergences=divergences)]


def _audit_jointly_stepped_worlds(engine: str, runs: Runs, judging: Judging) -> Iterator[Piece]:
    """Judge the steps of an engine that steps all worlds at once."""
    world, diverged = np.arange(runs.worlds), np.zeros(runs.worlds, bool)
    for step, frame in enumerate(iterate_frames(engine, runs)):

        def state_of(k: int, frame: Any = frame) -> dict[str, FloatArray]:
            return {name: x[k] for name, x in frame.state.items()}

        judging = judging._replace(precision=frame.batch.precision)
        sizes, at = (frame.rows, frame.contacts), np.full(runs.worlds, step)
        piece = _judge_steps(frame.batch, frame.impulse, judging, world, at, state_of, sizes)
        lost = (piece.verdict == NOT_JUDGED) & ~diverged
        finite = [all(np.isfinite(x[k]).all() for x in frame.state.values()) for k in world]
        divergences = [
            Divergence(
                k, step, "forces or acceleration" if finite[k] else "state before the step", not finite[k]
            )
            for k in np.flatnonzero(lost).tolist()
        ]
        diverged |= lost
        yield piece._replace(divergences=divergences)


def _judge_steps(
    batch: Batch,
    impulse: FloatArray,
    judging: Judging,
    world: Any,
    step: Any,
    state_of: Callable[[int], Any],
    sizes: tuple[Any, Any],
) -> Piece:
    """Judge the answers `impulse` [N s] to the problems of `batch`, one for each step.

    `world` and `step` are the numbers of the steps, `state_of(i)` returns the state before step i, and `sizes` holds
    the numbers of rows and of contacts.
    """
    residuals = residual_many(
        batch, impulse, precision=judging.precision, threshold=judging.threshold, errors="status"
    )
    numbers = np.array(
        [residuals.velocity_error, residuals.impulse_error, residuals.relative, residuals.roundoff_floor]
    )
    verdicts = residuals.verdict
    verdict = np.full(len(verdicts), NOT_JUDGED, np.int8)
    measured = np.isfinite(numbers[0])
    for i, word in enumerate(VERDICTS):
        verdict[measured & (verdicts == word)] = i
    numbers[:, verdict == NOT_JUDGED] = np.nan
    rows, contacts = (np.where(verdict == NOT_JUDGED, 0, x) for x in sizes)
    unconverged = np.flatnonzero(
        (verdict == VERDICTS.index(UNCONVERGED)) | (verdict == VERDICTS.index(WRONG))
    )
    names = {int(i): residuals[int(i)].worst_name for i in unconverged}
    order = unconverged[np.argsort(-numbers[0, unconverged], kind="stable")]
    if judging.keep is None:
        order = order[np.sort(np.unique(world[order], return_index=True)[1])]
    flat, worst = impulse.reshape(-1), []
    for i in order[: N_WORST_WORLDS if judging.keep is None else judging.keep].tolist():
        impulse_of_step = flat[batch.rows_of(i)].copy()
        world_and_step = int(world[i]), int(step[i])
        fields = {"where": names[i], "problem": batch[i], "impulse": impulse_of_step, "state": state_of(i)}
        worst.append(Worst(float(numbers[0, i]), *world_and_step, **fields))
    where = [(i, CONTACT_NUMBER.sub("contact ", name)) for i, name in names.items()]
    with_contact = np.flatnonzero(contacts > 0)
    n = min(len(with_contact), int(np.ceil(judging.contact_share * len(world))))
    chosen = with_contact[np.arange(n) * len(with_contact) // max(n, 1)]
    return Piece(
        world, step, numbers, verdict=verdict, rows=rows, contacts=contacts, where=where, worst=worst,
        contact_states=[StepState(int(world[i]), int(step[i]), state_of(i)) for i in chosen.tolist()],
    )  # fmt: skip
