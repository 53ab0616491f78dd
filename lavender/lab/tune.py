"""Measure MuJoCo's settings on worlds of one model: time of a step, error, and the `<option>` line to copy.

    found = tune("ant.xml", worlds=16, steps=200)
    found.faster, found.closer; found.summary_page.write("lavender-tune")

Settings are chosen on the worlds with even numbers; those with odd numbers are held back. Each world is cut into
stretches of `horizon` steps of a run with the model's own settings. From the start of each stretch, a setting makes its
own steps, warm-started from its own answers:

    time    of mj_step, mean of all steps [s]; of each step the minimum of several repeats, in which settings alternate
    error   of the engine's answer to the problem of each step, by the judge [m/s]
    motion  largest distance of a body, after `horizon` steps, from its position in the converged run [m]

If fewer than `MIN_CONTACT_SHARE` of the steps have contact, only the model's own setting is measured and no line is
recommended.

A cone, impratio or noslip other than the model's defines another problem: its error is measured on its own problem, its
motion shows how far it deviates, and no line recommends it.
"""

from __future__ import annotations

import contextlib
import copy
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean
from time import perf_counter
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_float, check_int
from lavender.base.deadline import format_seconds
from lavender.base.errors import InputError, reject_former_names
from lavender.batch.residuals import residual_many
from lavender.io.efc import from_mujoco_many
from lavender.io.recording import Control
from lavender.judge.residuals import DEFAULT_THRESHOLD
from lavender.lab.audit import MAX_PROBLEMS_IN_MEMORY
from lavender.lab.bench import machine
from lavender.lab.bench.running.runner import Event
from lavender.lab.report.figures import Curve, Figure
from lavender.lab.report.summary_page import PageSection, SummaryPage
from lavender.lab.report.table import Cell, Table
from lavender.lab.report.text import format_ratio, format_size
from lavender.lab.simulated_worlds import Runs, StepSizes, can_any_geoms_collide, has_diverged, simulate_world
from lavender.problem.derived import cached_property

ERROR_QUANTILE = 0.99  # Settings are compared by this quantile of the error.
TIME_NOISE_FRACTION = (
    0.05  # Times that differ by at most this fraction count as equal: noise is a few per cent.
)
MAX_TIME_RATIO = (
    2.0  # A setting is timed no further if it takes longer than this multiple of the present setting.
)
N_TRIAL_ROUNDS = 2  # Settings near the front are varied after this many rounds.
# Settings of the front are varied if they take at most this multiple of the present setting's time.
MAX_VARIED_TIME_RATIO = 1.5
TOLERANCES = (1e-3, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-15)
ITERATIONS = {"Newton": (1, 2, 3, 5, 10), "CG": (3, 6, 12, 25, 50), "PGS": (3, 6, 12, 25, 50, 100)}
#: Kinds of measurements: the error of a setting, and the times of its steps.
MEASUREMENTS = ("judging", "timing")
EXPECTED_VARIED_SETTINGS = 4  # Expected number of settings with measured variants, for the remaining time.
MERGE_NOTE = (
    "Add the line next to the model's own <option>: MuJoCo merges both. If it replaces the model's own <option>, "
    "its integrator and time step are lost."
)
TUNE_BUSY_CONSEQUENCE = "The times are invalid; measure again on an idle machine."
# Prefixes of MuJoCo's enumerators; the rest of the name is the MJCF keyword.
ENUMS = {
    "solver": "mjSOL_",
    "cone": "mjCONE_",
    "jacobian": "mjJAC_",
}
OPTIONS = ("solver", "iterations", "tolerance", "ls_iterations", "ls_tolerance", "jacobian")
PROBLEM_OPTIONS = ("cone", "impratio", "noslip_iterations")  # Options that change the problem.
CONVERGED_OPTIONS = {
    "solver": "Newton",
    "iterations": 300,
    "tolerance": 0.0,
    "ls_iterations": 100,
    "ls_tolerance": 1e-4,
}


@dataclass(frozen=True)
class Setting:
    """Attributes of `<option>` that differ from the model's."""

    options: tuple[tuple[str, Any], ...] = ()

    @classmethod
    def from_options(cls, mj: Any, model: Any, **options: Any) -> Setting:
        """Create the setting of the options that differ from the model's, in the order of `OPTIONS`."""
        has = {name: _get_option_value(mj, model, name) for name in (*OPTIONS, *PROBLEM_OPTIONS)}
        return cls(tuple((name, options[name]) for name in has if options.get(name, has[name]) != has[name]))

    def apply_to(self, mj: Any, model: Any) -> Any:
        """Return a copy of the model with these options."""
        configured = copy.copy(model)
        for name, x in self.options:
            kind = ENUMS.get(name)
            setattr(configured.opt, name, x if kind is None else _map_keywords_to_values(mj, name)[x])
        return configured

    @property
    def option_line(self) -> str:
        """`<option>` line to copy into the model; empty if no option differs."""
        texts = (f'{name}="{x:g}"' if isinstance(x, float) else f'{name}="{x}"' for name, x in self.options)
        return f"<option {' '.join(texts)}/>" if self.options else ""

    @property
    def name(self) -> str:
        """The line, or "the model's own setting"."""
        return self.option_line or "the model's own setting"

    @property
    def changes_problem(self) -> bool:
        """Whether the setting defines another problem than the model's."""
        return any(name in PROBLEM_OPTIONS for name, _ in self.options)


def _map_keywords_to_values(mj: Any, name: str) -> dict[str, Any]:
    """Return {MJCF keyword: MuJoCo's value} of an enumerated option."""
    members = getattr(mj, f"mjt{name.capitalize()}").__members__
    keywords = {"NEWTON": "Newton", "CG": "CG", "PGS": "PGS"}
    short = ((key.removeprefix(ENUMS[name]), value) for key, value in members.items())
    return {keywords.get(key, key.lower()): value for key, value in short}


def _get_option_value(mj: Any, model: Any, name: str) -> Any:
    """Return the model's value of an option as MJCF writes it."""
    x = getattr(model.opt, name)
    if name not in ENUMS:
        return float(x) if isinstance(x, float) else int(x)
    return next(word for word, value in _map_keywords_to_values(mj, name).items() if int(value) == int(x))


@dataclass(eq=False)
class Measured:
    """Results of one setting on some worlds.

    Parameters
    ----------
    setting : Setting
    solver : str
    error : (steps,) m/s
    motion : (stretches,) m
    times : (steps,) s
        Each the minimum of all repeats, which removes interruptions.
    rows, contacts : (steps,) int
    """

    setting: Setting
    solver: str
    error: FloatArray = field(repr=False)
    motion: FloatArray = field(repr=False)
    times: FloatArray = field(repr=False)
    rows: Any = field(default=(), repr=False)
    contacts: Any = field(default=(), repr=False)

    @property
    def mean_step_time(self) -> float:
        """Mean time of a step [s]; infinite if it was not timed."""
        return float(self.times.mean())

    @property
    def worst_error(self) -> float:
        """Error that one step in a hundred exceeds [m/s]."""
        return float(np.quantile(self.error, ERROR_QUANTILE, method="higher"))

    @property
    def worst_motion(self) -> float:
        """Distance that one stretch in a hundred exceeds [m]."""
        return float(np.quantile(self.motion, ERROR_QUANTILE, method="higher"))


class Schedule:
    """Measurements that are done and expected, for the progress and the remaining time.

    Parameters
    ----------
    watch : callable, optional
        Called with an `Event` at the begin of each measurement.
    """

    def __init__(self, watch: Callable[[Event], None] | None) -> None:
        self.watch = watch
        self.done = 0
        self.loads: list[float | None] = []  # number of runnable processes at each timing
        self._expected = dict.fromkeys(MEASUREMENTS, 0)
        self._reserved = dict.fromkeys(MEASUREMENTS, 0)
        self._durations: dict[str, list[float]] = {kind: [] for kind in MEASUREMENTS}

    def reserve(self, kind: str, count: int) -> None:
        """Set the estimate of later measurements that are not announced yet."""
        self._reserved[kind] = count

    def expect(self, kind: str, count: int) -> None:
        """Announce measurements; they replace reserved ones."""
        self._expected[kind] += count
        self._reserved[kind] = max(0, self._reserved[kind] - count)

    def skip(self, kind: str) -> None:
        """Count an announced measurement as unnecessary."""
        self._expected[kind] -= 1

    @property
    def remaining(self) -> float | None:
        """Estimate of the remaining time [s]: the mean durations so far; None at the beginning."""
        total = 0.0
        every = [t for durations in self._durations.values() for t in durations]
        for kind in MEASUREMENTS:
            mean = fmean(self._durations[kind] or every or [0.0])
            total += mean * (self._expected[kind] + self._reserved[kind])
        return total if every else None

    @contextlib.contextmanager
    def measure(self, kind: str, text: str) -> Iterator[None]:
        """Show the progress, then run and time the block, which is one measurement."""
        if self.watch is not None:
            count = sum(self._expected.values()) + sum(self._reserved.values())
            self.watch(Event(self.done, self.done + count, f"{kind}: {text}", "", remaining=self.remaining))
        if kind == "timing":
            self.loads.append(machine.count_runnable_processes())
        begin = perf_counter()
        yield
        self._durations[kind].append(perf_counter() - begin)
        self._expected[kind] -= 1
        self.done += 1


@dataclass(eq=False)
class Stage:
    """Worlds on which settings are measured.

    Parameters
    ----------
    mj, model
        The module mujoco and the model with its own setting.
    starts : (n, size)
        State at the start of each stretch.
    controls : (n, horizon, nu)
    ends : (n, bodies, 3) m
        Positions of the bodies after each stretch of the converged run.
    """

    mj: Any
    model: Any
    starts: FloatArray
    controls: FloatArray
    ends: FloatArray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def from_runs(cls, mj: Any, model: Any, runs: Runs, worlds: Iterable[int], horizon: int) -> Stage:
        """Cut worlds that run with the model's own setting into stretches."""
        starts, controls = [], []
        for world in worlds:
            drive = runs.make_controller(model, world)
            world_controls = np.array([drive(None, step) for step in range(runs.steps)])
            ctrl = world_controls.reshape(runs.steps // horizon, horizon, model.nu)
            starts.append(simulate_world(mj, model, runs, world)[0][::horizon])
            controls.append(ctrl)
        configured = cls(mj, model, np.concatenate(starts), np.concatenate(controls))
        try:
            configured.ends = configured.run_stretches(
                Setting.from_options(mj, model, **CONVERGED_OPTIONS).apply_to(mj, model)
            )[1]
        except mj.FatalError as error:
            raise InputError(f"{runs.model}: MuJoCo ends in an error, {error}") from None
        return configured

    def run_stretches(self, model: Any, states: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Run all stretches.

        Returns (seconds of each step, positions of bodies after each stretch (n, bodies, 3) [m]), and stores the state
        before each step in `states`.
        """
        mj, kind = self.mj, self.mj.mjtState.mjSTATE_INTEGRATION
        data = mj.MjData(model)
        n, horizon, _ = self.controls.shape
        step_times = np.empty(n * horizon)
        ends = np.empty((n, model.nbody, 3))
        for i in range(n):
            mj.mj_setState(model, data, self.starts[i], kind)
            for k in range(horizon):
                data.ctrl[:] = self.controls[i, k]
                if states is not None:
                    mj.mj_getState(model, data, states[horizon * i + k], kind)
                begin = perf_counter()
                mj.mj_step(model, data)
                step_times[horizon * i + k] = perf_counter() - begin
            mj.mj_kinematics(model, data)
            ends[i] = np.nan if has_diverged(mj, data) else data.xpos
        return step_times, ends

    def judge_setting(self, setting: Setting) -> Measured:
        """Judge a setting without timing it; its errors are infinite if a world diverges."""
        mj, model = self.mj, setting.apply_to(self.mj, self.model)
        never = np.full(1, np.inf)
        result = Measured(setting, str(_get_option_value(mj, model, "solver")), never, never, never)
        states = np.empty((self.controls.shape[0] * self.controls.shape[1], self.starts.shape[1]))
        judge = copy.copy(model)
        judge.opt.noslip_iterations = 0
        errors: list[FloatArray] = []
        rows: list[Any] = []
        contacts: list[Any] = []
        try:
            ends = self.run_stretches(model, states)[1]
            for i in range(0, len(states), MAX_PROBLEMS_IN_MEMORY):
                batch, impulse = from_mujoco_many(
                    judge, states[i : i + MAX_PROBLEMS_IN_MEMORY], errors="status"
                )
                errors.append(residual_many(batch, impulse, errors="status").velocity_error)
                rows.append(batch.row_counts)
                contacts.append(batch.contact_counts)
        except (mj.FatalError, InputError):  # A step or a forward pass failed.
            return result
        distance = np.linalg.norm(ends - self.ends, axis=2).max(axis=1)
        if np.isnan(distance).any():
            return result
        sizes: dict[str, Any] = {"rows": np.concatenate(rows), "contacts": np.concatenate(contacts)}
        return replace(
            result, error=np.nan_to_num(np.concatenate(errors), nan=np.inf), motion=distance, **sizes
        )

    def time_settings(self, settings: list[Measured], repeats: int, schedule: Schedule) -> None:
        """Time the steps of several rounds in which all settings alternate; the first is the model's own.

        A setting with which a world diverges is not timed.
        """
        settings = [m for m in settings if np.isfinite(m.error).all()]
        models = [m.setting.apply_to(self.mj, self.model) for m in settings]
        schedule.expect("timing", len(settings) * repeats)
        for round_index in range(repeats):
            for m, model in zip(settings, models, strict=True):
                # Medians: a step that is interrupted in the first round does not exclude a setting.
                if round_index and np.median(m.times) > MAX_TIME_RATIO * np.median(settings[0].times):
                    schedule.skip("timing")
                    continue
                with schedule.measure("timing", f"round {round_index + 1} of {repeats}, {m.setting.name}"):
                    m.times = np.minimum(m.times, self.run_stretches(model)[0])


@dataclass(frozen=True, eq=False)
class Tuning:
    """Result of `tune`; the first of `measured` and of `held` is the model's own setting.

    Parameters
    ----------
    runs : Runs
    horizon : int
        Number of steps of a stretch.
    measured : list of Measured
        Results on the worlds with even numbers.
    held : list of Measured
        Results of the model's own setting and those chosen on the worlds with odd numbers; empty if Ctrl-C came before.
    threshold : float, m/s, m
        Smaller errors and distances count as accurate enough.
    stopped : bool
        The measurement was stopped by Ctrl-C.
    sizes : StepSizes, optional
        Rows and contacts of the steps of all worlds with the model's own setting.
    busy : str
        A warning if other processes used the processors during the timing; else empty.
    """

    runs: Runs
    horizon: int
    measured: list[Measured]
    held: list[Measured]
    threshold: float
    stopped: bool = False
    sizes: StepSizes | None = None
    busy: str = ""

    @property
    def present_result(self) -> Measured:
        """Result of the model's own setting."""
        return self.measured[0]

    @property
    def _same_problem(self) -> list[Measured]:
        """Timed settings that do not change the problem."""
        return [m for m in self.measured if not m.setting.changes_problem and np.isfinite(m.mean_step_time)]

    def _is_accurate_enough(self, m: Measured) -> bool:
        """Whether worst error and motion are at most the present setting's, or within the threshold."""
        now, threshold = self.present_result, self.threshold
        pairs = ((m.error.max(), now.error.max()), (m.worst_motion, now.worst_motion))
        return all(x <= max(own, threshold) for x, own in pairs)

    @cached_property
    def faster(self) -> Measured | None:
        """Fastest setting that is at least as accurate as the present one, or within the threshold; None if none is."""
        now = self.present_result
        good = [
            m
            for m in self._same_problem
            if m.worst_error <= max(now.worst_error, self.threshold) and self._is_accurate_enough(m)
        ]
        best = min(good, key=lambda m: m.mean_step_time)
        return best if best.mean_step_time < (1.0 - TIME_NOISE_FRACTION) * now.mean_step_time else None

    @cached_property
    def closer(self) -> Measured | None:
        """Most accurate setting that is as fast as the present one; None if that is within the threshold."""
        now = self.present_result
        good = [
            m
            for m in self._same_problem
            if m.mean_step_time <= (1.0 + TIME_NOISE_FRACTION) * now.mean_step_time
            and self._is_accurate_enough(m)
        ]
        best = min(good, key=lambda m: m.worst_error)
        return best if best.worst_error < now.worst_error > self.threshold else None

    @property
    def pareto_front(self) -> list[Measured]:
        """Settings that no other setting beats in both time and error, fastest first."""
        front: list[Measured] = []
        for m in sorted(self._same_problem, key=lambda m: (m.mean_step_time, m.worst_error)):
            if not front or m.worst_error < front[-1].worst_error:
                front.append(m)
        return front

    @property
    def reason_without_line(self) -> str:
        """Reason why no line is recommended; empty if enough of the steps have contact."""
        if self.sizes is None or self.sizes.has_enough_contact:
            return ""
        if not self.sizes.can_touch:
            return (
                f"No setting is recommended: {self.sizes.contact_phrase}, and settings do not matter without."
            )
        return (
            f"No setting is recommended: {self.sizes.contact_phrase}. A setting that is fast and accurate without "
            "contact may be neither with it. Start from states with contact (--states FILE), or take more --steps."
        )

    @property
    def lines(self) -> list[str]:
        """Lines to copy, and their results on the worlds held back; none if too few steps have contact."""
        if self.reason_without_line:
            return []
        none = f"none of {len(self._same_problem)} settings"
        enough = (
            f"not needed, {format_size(self.present_result.worst_error)} m/s is within {self.threshold:g}"
        )
        closer = enough if self.present_result.worst_error <= self.threshold else none
        lines = []
        for description, m, reason, gains, max_ratio in (
            ("as accurate as now, faster", self.faster, none, "mean_step_time", 1.0 - TIME_NOISE_FRACTION),
            ("as fast as now, more accurate", self.closer, closer, "worst_error", 1.0),
        ):
            if m is None:
                lines.append(f"{description}: {reason}")
                continue
            held = next((h for h in self.held[1:] if h.setting == m.setting), None)
            if held is not None and getattr(held, gains) >= max_ratio * getattr(self.held[0], gains):
                description += ": not on the worlds held back"
            lines += [
                f"{m.setting.option_line}  <!-- {description} -->",
                f"    chosen on: {_compare(m, self.present_result)}",
                f"    held back: {'not measured' if held is None else _compare(held, self.held[0])}",
            ]  # fmt: skip
        return lines

    def _table(self, settings: Iterable[Measured]) -> Table:
        """Build the table of some settings."""
        rows: list[list[str | Cell]] = [
            [
                m.setting.option_line or "as it is", Cell.time(m.mean_step_time),
                f"{m.mean_step_time / self.present_result.mean_step_time:.2f}", Cell.size(m.worst_error),
                Cell.size(float(m.error.max())), Cell.size(m.worst_motion),
            ]
            for m in settings
        ]  # fmt: skip
        heads = [
            "setting",
            "a step",
            "of now",
            "error 99 % [m/s]",
            "worst",
            f"motion after {self.horizon} [m]",
        ]
        return Table(heads, rows, words=frozenset({"setting"}))

    @property
    def figure(self) -> Figure:
        """Error over time: every setting, the front, and the model's own setting."""

        def curve(name: str, settings: list[Measured], **more: Any) -> Curve:
            notes = tuple(m.setting.option_line for m in settings)
            return replace(
                Curve.from_points(
                    name, name, [(m.mean_step_time, m.worst_error) for m in settings], notes=notes
                ),
                **more,
            )

        by = {s: [m for m in self._same_problem if m.solver == s] for s in ITERATIONS}
        parts = [curve(s, settings, points=True) for s, settings in by.items() if settings]
        parts += [curve("front", self.pareto_front), curve("as it is", [self.present_result], points=True)]
        return Figure("time-and-error", Path(self.runs.model).name, "time of a step [s]",
                      "error that 1 % of the steps exceed [m/s]", tuple(parts), x_log=True)  # fmt: skip

    @property
    def summary_page(self) -> SummaryPage:
        """Page with the result in a sentence, figures and tables, as `lavender tune` writes it."""
        now = self.present_result
        head = (
            f"{Path(self.runs.model).name}: a step takes {format_seconds(now.mean_step_time)}, and 1 % of the steps "
            f"have errors above {format_size(now.worst_error)} m/s."
        )
        if self.closer is not None:
            gain = (
                format_ratio(now.worst_error / self.closer.worst_error)
                if self.closer.worst_error
                else "exact:"
            )
            head += f" In the same time the error can be {gain} less."
        if self.reason_without_line:
            head += f" {self.reason_without_line}"
        merge_note = f" {MERGE_NOTE}" if self.faster or self.closer else ""
        other = [m for m in self.measured if m.setting.changes_problem]
        shown = [now, *(m for m in self.pareto_front if m is not now)]
        every = sorted(self.measured, key=lambda m: m.mean_step_time)
        sizes = [] if self.sizes is None else [self.sizes.size_table]
        figures = [] if self.reason_without_line else [self.figure]
        return SummaryPage(
            "lavender tune", head,
            [
                PageSection("Lines to copy", code=self.lines,
                     note="None, for the reason above." if self.reason_without_line
                     else "Chosen on the worlds with even numbers, tested on the others." + merge_note),
                PageSection("Rows and contacts", sizes, short=2, note="Of the steps with the model's own setting."),
                PageSection("The front of time and error", [self._table(shown)], figures, short=5),
                PageSection("Other problems", [self._table(other)], short=2,
                     note="A cone, impratio or noslip other than the model's: the error is that of its own problem."),
                PageSection("Every setting", [self._table(every)], note="Without those with which a world diverges."),
            ],
            {"model": self.runs.model, "lines": self.lines, "why_no_line": self.reason_without_line, "busy": self.busy,
             **({} if self.sizes is None else self.sizes.as_dict), "stopped": self.stopped,
             "measured": [_to_dict(m) for m in self.measured], "held": [_to_dict(m) for m in self.held]},
            stopped=self.stopped,
            warning=self.busy,
        )  # fmt: skip


def _compare(m: Measured, now: Measured) -> str:
    """Compare time and error of a setting with the present ones."""
    return (
        f"{m.mean_step_time / now.mean_step_time:.2f} of the time, error {format_size(m.worst_error)} m/s "
        f"instead of {format_size(now.worst_error)}"
    )


def _to_dict(m: Measured) -> dict[str, Any]:
    """Convert a result to a dict for JSON."""
    return {"options": dict(m.setting.options), "seconds": m.mean_step_time, "error": m.worst_error,
            "worst": float(m.error.max()), "motion": m.worst_motion}  # fmt: skip


def list_first_settings(mj: Any, model: Any) -> list[Setting]:
    """List the first settings: each solver with each tolerance and number of iterations; then other problems."""
    enough = max(100, int(model.opt.iterations))
    tried: list[dict[str, Any]] = [{}]
    for solver, budgets in ITERATIONS.items():
        tried += [{"solver": solver, "iterations": enough, "tolerance": t} for t in TOLERANCES]
        tried += [{"solver": solver, "iterations": n} for n in budgets]
    tried += [{"cone": "pyramidal"}, {"cone": "elliptic"}, {"impratio": 1.0}, {"impratio": 10.0}]
    tried += [{"noslip_iterations": n} for n in (0, 3, 10)]
    return list(dict.fromkeys(Setting.from_options(mj, model, **x) for x in tried))


def list_variants(mj: Any, model: Any, setting: Setting) -> list[Setting]:
    """List variants of a setting: other line searches, and dense instead of sparse J or the reverse."""
    options = dict(setting.options)
    stored = "dense" if mj.mj_isSparse(model) else "sparse"
    tried: list[dict[str, Any]] = [{"jacobian": stored}]
    if options.get("solver", _get_option_value(mj, model, "solver")) != "PGS":
        tried += [{"ls_tolerance": x} for x in (0.1, 1e-3)] + [{"ls_iterations": n} for n in (5, 15, 50)]
        tried += [{"jacobian": stored, "ls_tolerance": x} for x in (0.1, 1e-3)]
    return [Setting.from_options(mj, model, **options | x) for x in tried]


@reject_former_names(ahead="horizon", rounds="repeats")
def tune(
    model: str | os.PathLike[str],
    *,
    worlds: int = 16,
    steps: int = 200,
    control: Control = "random",
    seed: int = 0,
    spread: float = 0.1,
    states: Any = None,
    horizon: int = 10,
    repeats: int = 5,
    threshold: float = DEFAULT_THRESHOLD,
    watch: Callable[[Event], None] | None = None,
) -> Tuning:
    """Measure MuJoCo's settings on worlds of a model.

    Parameters
    ----------
    model : path (MJCF)
    worlds, steps, control, seed, spread
        See `Runs`. Half of the worlds are held back; `steps` is a multiple of `horizon`.
    states : path of an .npz, "keyframes", or arrays, optional
        See `audit`.
    horizon : int
        Number of steps of a stretch.
    repeats : int
        Repetitions of the timing, in which settings alternate.
    threshold : float, m/s, m
        Smaller errors and distances count as accurate enough.
    watch : callable, optional
        Called with the progress.

    Returns
    -------
    Tuning
        After Ctrl-C, the result so far, with `stopped`.

    Raises
    ------
    InputError
        The model cannot be read, there are fewer than two worlds, or `horizon` does not divide `steps`.
    CapabilityError
        The problem of the model's integrator is not one of M.
    """
    own: dict[str, Any] = {"worlds": check_int("worlds", worlds, 2, None), "steps": steps}
    runs = Runs(os.fspath(model), **own, control=control, seed=seed, spread=spread).with_start_states(states)
    horizon, repeats = check_int("horizon", horizon, 1, None), check_int("repeats", repeats, 1, None)
    threshold = check_float("threshold", threshold, low=0.0)
    if steps % horizon:
        raise InputError(f"steps is {steps} and horizon {horizon}; a multiple of it is needed")
    mj, configured = runs.load_model()
    # An unsupported model raises here, once.
    from_mujoco_many(configured, np.zeros((0, configured.nq + configured.nv)))
    schedule = Schedule(watch)
    measured: list[Measured] = []
    held: list[Measured] = []
    sizes: StepSizes | None = None

    def make_result(stopped: bool) -> Tuning:
        """Build the result so far."""
        timed = [m for m in measured if np.isfinite(m.mean_step_time)]
        busy = machine.describe_busy(schedule.loads, os.cpu_count() or 1, TUNE_BUSY_CONSEQUENCE)
        return Tuning(
            runs, horizon, timed, held, threshold=threshold, stopped=stopped, sizes=sizes, busy=busy
        )

    def judge(stage: Stage, settings: list[Setting]) -> list[Measured]:
        """Judge settings."""
        results = []
        schedule.expect("judging", len(settings))
        for setting in settings:
            with schedule.measure("judging", setting.name):
                results.append(stage.judge_setting(setting))
        return results

    first_settings = list_first_settings(mj, configured)
    n_variants = len(list_variants(mj, configured, Setting())) * EXPECTED_VARIED_SETTINGS
    n_first, n_trial = len(first_settings), min(N_TRIAL_ROUNDS, repeats)
    schedule.reserve("judging", n_first + 3 + n_variants)  # 3: the worlds held back
    schedule.reserve("timing", n_first * n_trial + (n_first + n_variants) * repeats + 3 * 2 * repeats)

    try:
        stage, held_back = (
            Stage.from_runs(mj, configured, runs, range(i, worlds, 2), horizon) for i in (0, 1)
        )
        measured += judge(stage, [Setting()])
        if not np.isfinite(measured[0].error).all():
            raise InputError(f"{runs.model}: these worlds diverge with the model's own setting")
        last = judge(held_back, [Setting()])
        both = [*measured, *last]
        rows, contacts = (np.concatenate([getattr(m, name) for m in both]) for name in ("rows", "contacts"))
        sizes = StepSizes(rows, contacts, can_any_geoms_collide(mj, configured))
        if not sizes.has_enough_contact:
            schedule.reserve("judging", 0)
            schedule.reserve("timing", 0)
            stage.time_settings(measured, repeats, schedule)
            return make_result(False)
        measured += judge(stage, first_settings[1:])
        stage.time_settings(measured, n_trial, schedule)
        near = [
            m.setting
            for m in make_result(False).pareto_front
            if m.mean_step_time <= MAX_VARIED_TIME_RATIO * measured[0].mean_step_time
        ]
        known = {m.setting for m in measured}
        more = dict.fromkeys(
            x for s in [Setting(), *near] for x in list_variants(mj, configured, s) if x not in known
        )
        schedule.reserve("judging", len(more) + 2)
        schedule.reserve("timing", (len(measured) + len(more)) * repeats + 3 * 2 * repeats)
        measured += judge(stage, list(more))
        stage.time_settings(measured, repeats, schedule)
        chosen = make_result(False)
        other = dict.fromkeys(m.setting for m in (chosen.faster, chosen.closer) if m is not None)
        last += judge(held_back, list(other))
        schedule.reserve("judging", 0)
        schedule.reserve("timing", 0)
        held_back.time_settings(last, 2 * repeats, schedule)
        held += last if np.isfinite(last[0].mean_step_time) else []
    except KeyboardInterrupt:
        if not measured or not np.isfinite(measured[0].mean_step_time):
            raise
        return make_result(True)
    return make_result(False)
