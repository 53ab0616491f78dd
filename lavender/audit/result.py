"""Hold the result of an audit: errors and verdicts of every step, sentences, tables, files and the page."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from lavender.audit.simulated_worlds import Divergence, Runs
from lavender.audit.step_sizes import StepSizes, describe_exceedance
from lavender.base.arrays import FloatArray, check_choice
from lavender.io.npz import write_npz
from lavender.io.stored import lock_step_folder, write_arrays
from lavender.judge.residuals import AT_FLOOR, CLOSE, DEFAULT_THRESHOLD, UNCONVERGED, VERDICTS, WRONG
from lavender.problem import Problem
from lavender.report.figures import Curve, Figure
from lavender.report.summary_page import PageSection, SummaryPage
from lavender.report.table import Cell, Table
from lavender.report.text import format_count, format_percent, format_size

UNCONVERGED_OR_WRONG = f"{UNCONVERGED} or wrong"
AUDIT_VERDICTS = (*VERDICTS, "not judged")
NOT_JUDGED = len(VERDICTS)
VELOCITY_UNIT = "m/s, rad/s"  # Linear rows have the first unit, angular rows the second.
WORST_ROW_ERRORS = ("velocity", "impulse", "relative", "floor")  # Errors of the worst row [m/s, N s, -, -].
QUANTILES = (0.5, 0.9, 0.99, 0.999, 1.0)
N_SHOWN_WORLDS = 5  # Up to this many numbers of worlds are written in a sentence.
SAVED_KINDS = ("worst", "contact")
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
ENGINE_ADVICE = "To find out whether the engine is the cause, audit again with --engine mujoco."
OUTSIDE_SOLVER = "outside the constraint solver (time step, integrator, actuators or the model itself)"
DIVERGENCE_ADVICE = (
    'To find out whether the solver is the cause, audit again with <option solver="Newton" iterations="100" '
    'tolerance="1e-12"/>: if worlds diverge again after exact solves, the cause is the model.'
)


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
                PageSection("The worst worlds", [self.table_of_worst], short=len(self.worst), note=FILES_NOTE),
            ],
            self.totals,
            stopped=self.stopped,
            warning=" ".join(filter(None, (self.start_warning, self.notes, self.busy))),
        )  # fmt: skip


def _join_numbers(numbers: list[int]) -> str:
    """Return "world 3", "worlds 3 and 5", or "worlds 1, 2, 3 and 40 more"."""
    shown = [str(number) for number in sorted(numbers)[:N_SHOWN_WORLDS]]
    more = len(numbers) - len(shown)
    last = f"{more} more" if more else shown.pop()
    return f"world{'s' * (len(numbers) > 1)} {' and '.join(filter(None, (', '.join(shown), last)))}"


def _select_worst(candidates: list[Worst], keep: int | None) -> list[Worst]:
    """Select the `keep` worst steps, or the worst step of each of `N_WORST_WORLDS` worlds."""
    ranked = sorted(candidates, key=lambda w: (-w.velocity, w.world, w.step))
    if keep is not None:
        return ranked[:keep]
    worst: dict[int, Worst] = {}
    for w in ranked:
        worst.setdefault(w.world, w)
    return list(worst.values())[:N_WORST_WORLDS]
