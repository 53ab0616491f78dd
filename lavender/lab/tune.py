"""MuJoCo's settings on worlds of one model: time of a step beside error, and the `<option>` line to copy.

    found = tune("ant.xml", worlds=16, steps=200)
    found.faster, found.closer; found.summary_page.write("lavender-tune")

Even worlds are chosen on, odd ones held back. Each world is cut into stretches of `horizon` steps of a run with the
settings that the model has. From the start of each, a setting makes its own steps, warm from its own answers:

    time    of mj_step, the mean of all steps [s], of each the least of several repetitions, in which settings alternate
    error   of the engine's answer to the problem of each step, by the judge [m/s]
    motion  how far the body that is furthest off is, after `horizon` steps, from where the converged run has it [m]

If fewer than `MIN_CONTACT_SHARE` of the steps have contact, only the model's own setting is measured and no line is
recommended.

A cone, impratio or noslip other than the model's is another problem: its error is that of its own, its motion says how
far it leads away, and no line names it.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_float, check_int
from lavender.base.deadline import seconds
from lavender.base.errors import InputError, reject_former_names
from lavender.batch.residuals import residual_many
from lavender.io.efc import from_mujoco_many
from lavender.io.recording import Control
from lavender.judge.residuals import DEFAULT_THRESHOLD
from lavender.lab.audit import AT_ONCE
from lavender.lab.bench.running.runner import Event
from lavender.lab.report.figures import Curve, Figure
from lavender.lab.report.summary_page import PageSection, SummaryPage
from lavender.lab.report.table import Table
from lavender.lab.report.text import format_ratio, format_size
from lavender.lab.simulated_worlds import Runs, StepSizes, can_touch, has_diverged, simulate_world
from lavender.problem.derived import cached_property

WORST = 0.99  # quantile of the error by which settings are compared
EQUAL = 0.05  # share of a time by which two may differ and be called equal: noise is a few per cent
SLOW = 2.0  # times the time now, above which a setting is timed no more
TRIAL = 2  # repetitions after which settings near the front are varied
NEAR = 1.5  # times the time now, up to which settings of the front are varied
TOLERANCES = (1e-3, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-15)
ITERATIONS = {"Newton": (1, 2, 3, 5, 10), "CG": (3, 6, 12, 25, 50), "PGS": (3, 6, 12, 25, 50, 100)}
ENUMS = {
    "solver": "mjSOL_",
    "cone": "mjCONE_",
    "jacobian": "mjJAC_",
}  # what words of MJCF begin with in MuJoCo
OPTIONS = ("solver", "iterations", "tolerance", "ls_iterations", "ls_tolerance", "jacobian")
OTHER = ("cone", "impratio", "noslip_iterations")  # of another problem
CONVERGED = {
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
    def of(cls, mj: Any, model: Any, **options: Any) -> Setting:
        """Those that differ, in the order of `OPTIONS`."""
        has = {name: _word(mj, model, name) for name in (*OPTIONS, *OTHER)}
        return cls(tuple((name, options[name]) for name in has if options.get(name, has[name]) != has[name]))

    def on(self, mj: Any, model: Any) -> Any:
        """A copy of the model with these."""
        made = copy.copy(model)
        for name, x in self.options:
            kind = ENUMS.get(name)
            setattr(made.opt, name, x if kind is None else _values(mj, name)[x])
        return made

    @property
    def line(self) -> str:
        """To copy into the model; empty where nothing differs."""
        said = (f'{name}="{x:g}"' if isinstance(x, float) else f'{name}="{x}"' for name, x in self.options)
        return f"<option {' '.join(said)}/>" if self.options else ""

    @property
    def is_other(self) -> bool:
        """Another problem than the model's."""
        return any(name in OTHER for name, _ in self.options)


def _values(mj: Any, name: str) -> dict[str, Any]:
    members = getattr(mj, f"mjt{name.capitalize()}").__members__
    words = {"NEWTON": "Newton", "CG": "CG", "PGS": "PGS"}
    short = ((key.removeprefix(ENUMS[name]), value) for key, value in members.items())
    return {words.get(key, key.lower()): value for key, value in short}


def _word(mj: Any, model: Any, name: str) -> Any:
    x = getattr(model.opt, name)
    if name not in ENUMS:
        return float(x) if isinstance(x, float) else int(x)
    return next(word for word, value in _values(mj, name).items() if int(value) == int(x))


@dataclass(eq=False)
class Measured:
    """One setting on some worlds."""

    setting: Setting
    solver: str
    error: FloatArray = field(repr=False)  # (steps,) m/s
    motion: FloatArray = field(repr=False)  # (stretches,) m
    # (steps,) s, each the least of all repetitions: what interrupts one is no part of it
    times: FloatArray = field(repr=False)
    rows: Any = field(default=(), repr=False)  # (steps,) int
    contacts: Any = field(default=(), repr=False)

    @property
    def time(self) -> float:
        """Of a step [s]; infinite where it was not timed."""
        return float(self.times.mean())

    @property
    def worst(self) -> float:
        """Error that one step of a hundred exceeds [m/s]."""
        return float(np.quantile(self.error, WORST, method="higher"))

    @property
    def worst_motion(self) -> float:
        """Distance that one stretch of a hundred exceeds [m]."""
        return float(np.quantile(self.motion, WORST, method="higher"))


@dataclass(eq=False)
class Stage:
    """Worlds on which settings are measured: starts (n, size), controls (n, horizon, nu), where bodies converge to."""

    mj: Any
    model: Any
    starts: FloatArray
    controls: FloatArray
    ends: FloatArray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, mj: Any, model: Any, runs: Runs, worlds: Iterable[int], horizon: int) -> Stage:
        """Stretches of worlds that run with the model's own setting."""
        starts, controls = [], []
        for world in worlds:
            drive = runs.drive(model, world)
            each = np.array([drive(None, step) for step in range(runs.steps)])
            ctrl = each.reshape(runs.steps // horizon, horizon, model.nu)
            starts.append(simulate_world(mj, model, runs, world)[0][::horizon])
            controls.append(ctrl)
        made = cls(mj, model, np.concatenate(starts), np.concatenate(controls))
        try:
            made.ends = made.run(Setting.of(mj, model, **CONVERGED).on(mj, model))[1]
        except mj.FatalError as error:
            raise InputError(f"{runs.model}: MuJoCo ends in an error, {error}") from None
        return made

    def run(self, model: Any, states: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Seconds of each step, and places of bodies after each stretch (n, bodies, 3) [m]; states before each step."""
        mj, kind = self.mj, self.mj.mjtState.mjSTATE_INTEGRATION
        data = mj.MjData(model)
        n, horizon, _ = self.controls.shape
        spent = np.empty(n * horizon)
        ends = np.empty((n, model.nbody, 3))
        for i in range(n):
            mj.mj_setState(model, data, self.starts[i], kind)
            for k in range(horizon):
                data.ctrl[:] = self.controls[i, k]
                if states is not None:
                    mj.mj_getState(model, data, states[horizon * i + k], kind)
                begin = perf_counter()
                mj.mj_step(model, data)
                spent[horizon * i + k] = perf_counter() - begin
            mj.mj_kinematics(model, data)
            ends[i] = np.nan if has_diverged(mj, data) else data.xpos
        return spent, ends

    def measured(self, setting: Setting) -> Measured:
        """Judge a setting without timing it; its errors are infinite if a world diverges."""
        mj, model = self.mj, setting.on(self.mj, self.model)
        never = np.full(1, np.inf)
        apart = Measured(setting, str(_word(mj, model, "solver")), never, never, never)
        states = np.empty((self.controls.shape[0] * self.controls.shape[1], self.starts.shape[1]))
        judge = copy.copy(model)
        judge.opt.noslip_iterations = 0
        errors: list[FloatArray] = []
        rows: list[Any] = []
        contacts: list[Any] = []
        try:
            ends = self.run(model, states)[1]
            for i in range(0, len(states), AT_ONCE):
                batch, impulse = from_mujoco_many(judge, states[i : i + AT_ONCE], errors="status")
                errors.append(residual_many(batch, impulse, errors="status").velocity_error)
                rows.append(batch.row_counts)
                contacts.append(batch.contact_counts)
        except (mj.FatalError, InputError):  # of a step, of its forward pass
            return apart
        off = np.linalg.norm(ends - self.ends, axis=2).max(axis=1)
        if np.isnan(off).any():
            return apart
        sizes: dict[str, Any] = {"rows": np.concatenate(rows), "contacts": np.concatenate(contacts)}
        return replace(apart, error=np.nan_to_num(np.concatenate(errors), nan=np.inf), motion=off, **sizes)

    def time(self, some: list[Measured], repeats: int, tell: Callable[[str], None]) -> None:
        """Time the steps of several repetitions in which all alternate, the first of them the model's own setting.

        A setting with which a world diverges is not timed.
        """
        some = [m for m in some if np.isfinite(m.error).all()]
        models = [m.setting.on(self.mj, self.model) for m in some]
        for turn in range(repeats):
            for m, model in zip(some, models, strict=True):
                # Medians: one step that was interrupted in the first round says nothing of a setting.
                if turn == 0 or np.median(m.times) <= SLOW * np.median(some[0].times):
                    m.times = np.minimum(m.times, self.run(model)[0])
                    tell("timed")


@dataclass(frozen=True, eq=False)
class Tuning:
    """What `tune` found; the first of `measured` and of `held` is the model's own setting.

    Parameters
    ----------
    runs : Runs
    horizon : int
        Steps of a stretch.
    measured : list of Measured
        On the even worlds.
    held : list of Measured
        The own setting and those chosen, on the odd worlds; empty where Ctrl-C came before.
    threshold : float, m/s, m
        Error, and distance, below which nobody asks for less.
    stopped : bool
    sizes : StepSizes, optional
        Rows and contacts of the steps of all worlds with the model's own setting.
    """

    runs: Runs
    horizon: int
    measured: list[Measured]
    held: list[Measured]
    threshold: float
    stopped: bool = False
    sizes: StepSizes | None = None

    @property
    def now(self) -> Measured:
        """The model's own setting."""
        return self.measured[0]

    @property
    def _own(self) -> list[Measured]:
        return [m for m in self.measured if not m.setting.is_other and np.isfinite(m.time)]

    def _holds(self, m: Measured) -> bool:
        """No further off than now in its worst steps and in motion, or within the threshold."""
        now, most = self.now, self.threshold
        pairs = ((m.error.max(), now.error.max()), (m.worst_motion, now.worst_motion))
        return all(x <= max(own, most) for x, own in pairs)

    @cached_property
    def faster(self) -> Measured | None:
        """As accurate as now, or within the threshold, and fastest."""
        now = self.now
        good = [m for m in self._own if m.worst <= max(now.worst, self.threshold) and self._holds(m)]
        best = min(good, key=lambda m: m.time)
        return best if best.time < (1.0 - EQUAL) * now.time else None

    @cached_property
    def closer(self) -> Measured | None:
        """As fast as now, and most accurate; None where now is within the threshold."""
        now = self.now
        good = [m for m in self._own if m.time <= (1.0 + EQUAL) * now.time and self._holds(m)]
        best = min(good, key=lambda m: m.worst)
        return best if best.worst < now.worst > self.threshold else None

    @property
    def front(self) -> list[Measured]:
        """Settings that no other beats in both, the fastest first."""
        kept: list[Measured] = []
        for m in sorted(self._own, key=lambda m: (m.time, m.worst)):
            if not kept or m.worst < kept[-1].worst:
                kept.append(m)
        return kept

    @property
    def why_no_line(self) -> str:
        """Why no line is recommended; empty if enough of the steps have contact."""
        if self.sizes is None or self.sizes.is_enough:
            return ""
        if not self.sizes.can_touch:
            return f"No setting is recommended: {self.sizes.sentence}, and settings do not matter without."
        return (
            f"No setting is recommended: {self.sizes.sentence}. A setting that is fast and accurate without contact "
            "may be neither with it. Start from states with contact (--states FILE), or take more --steps."
        )

    @property
    def lines(self) -> list[str]:
        """Lines to copy, and their results on the worlds held back; none if too few steps have contact."""
        if self.why_no_line:
            return []
        none = f"none of {len(self._own)} settings"
        enough = f"not needed, {format_size(self.now.worst)} m/s is within {self.threshold:g}"
        closer = enough if self.now.worst <= self.threshold else none
        said = []
        for word, m, why, gains, most in (
            ("as accurate as now, faster", self.faster, none, "time", 1.0 - EQUAL),
            ("as fast as now, more accurate", self.closer, closer, "worst", 1.0),
        ):
            if m is None:
                said.append(f"{word}: {why}")
                continue
            held = next((h for h in self.held[1:] if h.setting == m.setting), None)
            if held is not None and getattr(held, gains) >= most * getattr(self.held[0], gains):
                word += ": not on the worlds held back"
            said += [
                f"{m.setting.line}  <!-- {word} -->", f"    chosen on: {_beside(m, self.now)}",
                f"    held back: {'not measured' if held is None else _beside(held, self.held[0])}",
            ]  # fmt: skip
        return said

    def _table(self, some: Iterable[Measured]) -> Table:
        rows = [
            [
                m.setting.line or "as it is", seconds(m.time), f"{m.time / self.now.time:.2f}", format_size(m.worst),
                format_size(float(m.error.max())), format_size(m.worst_motion),
            ]
            for m in some
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
        """Error against time: every setting, the front, and what the model has."""

        def curve(name: str, some: list[Measured], **more: Any) -> Curve:
            notes = tuple(m.setting.line for m in some)
            return replace(Curve.of(name, name, [(m.time, m.worst) for m in some], notes=notes), **more)

        by = {s: [m for m in self._own if m.solver == s] for s in ITERATIONS}
        parts = [curve(s, some, points=True) for s, some in by.items() if some]
        parts += [curve("front", self.front), curve("as it is", [self.now], points=True)]
        return Figure("time-and-error", Path(self.runs.model).name, "time of a step [s]",
                      "error that 1 % of the steps exceed [m/s]", tuple(parts), x_log=True)  # fmt: skip

    @property
    def summary_page(self) -> SummaryPage:
        """The page."""
        now = self.now
        head = (
            f"{Path(self.runs.model).name}: a step takes {seconds(now.time)}, and 1 % of the steps are more than "
            f"{format_size(now.worst)} m/s off."
        )
        if self.closer is not None:
            gain = format_ratio(now.worst / self.closer.worst) if self.closer.worst else "exact:"
            head += f" In the same time it can be {gain} less."
        if self.why_no_line:
            head += f" {self.why_no_line}"
        other = [m for m in self.measured if m.setting.is_other]
        shown = [now, *(m for m in self.front if m is not now)]
        every = sorted(self.measured, key=lambda m: m.time)
        sizes = [] if self.sizes is None else [self.sizes.table]
        figures = [] if self.why_no_line else [self.figure]
        return SummaryPage(
            "lavender tune", head,
            [
                PageSection("Lines to copy", code=self.lines,
                     note="None, for the reason above." if self.why_no_line
                     else "Chosen on the even worlds, tried on the odd ones."),
                PageSection("Rows and contacts", sizes, short=2, note="Of the steps with the model's own setting."),
                PageSection("The front of time and error", [self._table(shown)], figures, short=5),
                PageSection("Other problems", [self._table(other)], short=2,
                     note="A cone, impratio or noslip other than the model's: the error is that of its own problem."),
                PageSection("Every setting", [self._table(every)], note="Without those with which a world diverges."),
            ],
            {"model": self.runs.model, "lines": self.lines, "why_no_line": self.why_no_line,
             **({} if self.sizes is None else self.sizes.numbers), "stopped": self.stopped,
             "measured": [_told(m) for m in self.measured], "held": [_told(m) for m in self.held]},
            self.stopped,
        )  # fmt: skip


def _beside(m: Measured, now: Measured) -> str:
    return f"{m.time / now.time:.2f} of the time, error {format_size(m.worst)} m/s beside {format_size(now.worst)}"


def _told(m: Measured) -> dict[str, Any]:
    return {"options": dict(m.setting.options), "seconds": m.time, "error": m.worst,
            "worst": float(m.error.max()), "motion": m.worst_motion}  # fmt: skip


def grid(mj: Any, model: Any) -> list[Setting]:
    """What is tried first: each solver to each tolerance and for each number of iterations; then other problems."""
    enough = max(100, int(model.opt.iterations))
    tried: list[dict[str, Any]] = [{}]
    for solver, budgets in ITERATIONS.items():
        tried += [{"solver": solver, "iterations": enough, "tolerance": t} for t in TOLERANCES]
        tried += [{"solver": solver, "iterations": n} for n in budgets]
    tried += [{"cone": "pyramidal"}, {"cone": "elliptic"}, {"impratio": 1.0}, {"impratio": 10.0}]
    tried += [{"noslip_iterations": n} for n in (0, 3, 10)]
    return list(dict.fromkeys(Setting.of(mj, model, **x) for x in tried))


def around(mj: Any, model: Any, setting: Setting) -> list[Setting]:
    """A setting with another line search, and with J stored the other way."""
    whole = dict(setting.options)
    stored = "dense" if mj.mj_isSparse(model) else "sparse"
    tried: list[dict[str, Any]] = [{"jacobian": stored}]
    if whole.get("solver", _word(mj, model, "solver")) != "PGS":
        tried += [{"ls_tolerance": x} for x in (0.1, 1e-3)] + [{"ls_iterations": n} for n in (5, 15, 50)]
        tried += [{"jacobian": stored, "ls_tolerance": x} for x in (0.1, 1e-3)]
    return [Setting.of(mj, model, **whole | x) for x in tried]


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
    worlds, steps, control, seed, spread : as `Runs`
        Half of the worlds are held back; `steps` is a multiple of `horizon`.
    states : path of an .npz, "keyframes", or arrays, optional
        As of `audit`.
    horizon : int
        Steps of a stretch.
    repeats : int
        Repetitions of the timing, in which settings alternate.
    threshold : float, m/s, m
        Error, and distance, below which nobody asks for less.
    watch : callable, optional
        Statement of what is done.

    Returns
    -------
    Tuning
        After Ctrl-C of what was done by then, `stopped`.

    Raises
    ------
    InputError
        A model that cannot be read, fewer than two worlds, or steps that `horizon` does not divide.
    CapabilityError
        An integrator whose problem is not of M.
    """
    own: dict[str, Any] = {"worlds": check_int("worlds", worlds, 2, None), "steps": steps}
    runs = Runs(os.fspath(model), **own, control=control, seed=seed, spread=spread).start_from(states)
    horizon = check_int("horizon", horizon, 1, None)
    repeats = check_int("repeats", repeats, 1, None)
    threshold = check_float("threshold", threshold, low=0.0)
    if steps % horizon:
        raise InputError(f"steps is {steps} and horizon {horizon}; a multiple of it is needed")
    mj, made = runs.load()
    from_mujoco_many(made, np.zeros((0, made.nq + made.nv)))  # what it refuses is refused here
    done = 0

    def tell(what: str) -> None:
        nonlocal done
        done += 1
        if watch is not None:
            watch(Event(done, 0, what, ""))

    measured: list[Measured] = []
    held: list[Measured] = []
    sizes: StepSizes | None = None

    def found(stopped: bool) -> Tuning:
        timed = [m for m in measured if np.isfinite(m.time)]
        return Tuning(runs, horizon, timed, held, threshold=threshold, stopped=stopped, sizes=sizes)

    def judge(stage: Stage, settings: list[Setting]) -> list[Measured]:
        out = []
        for setting in settings:
            out.append(stage.measured(setting))
            tell(setting.line or "as it is")
        return out

    try:
        stage, held_back = (Stage.of(mj, made, runs, range(i, worlds, 2), horizon) for i in (0, 1))
        measured += judge(stage, [Setting()])
        if not np.isfinite(measured[0].error).all():
            raise InputError(f"{runs.model}: these worlds diverge with the model's own setting")
        last = judge(held_back, [Setting()])
        both = [*measured, *last]
        rows, contacts = (np.concatenate([getattr(m, name) for m in both]) for name in ("rows", "contacts"))
        sizes = StepSizes(rows, contacts, can_touch(mj, made))
        if not sizes.is_enough:
            stage.time(measured, repeats, tell)
            return found(False)
        measured += judge(stage, grid(mj, made)[1:])
        stage.time(measured, min(TRIAL, repeats), tell)
        near = [m.setting for m in found(False).front if m.time <= NEAR * measured[0].time]
        known = {m.setting for m in measured}
        more = dict.fromkeys(x for s in [Setting(), *near] for x in around(mj, made, s) if x not in known)
        measured += judge(stage, list(more))
        stage.time(measured, repeats, tell)
        chosen = found(False)
        other = dict.fromkeys(m.setting for m in (chosen.faster, chosen.closer) if m is not None)
        last += judge(held_back, list(other))
        held_back.time(last, 2 * repeats, tell)
        held += last if np.isfinite(last[0].time) else []
    except KeyboardInterrupt:
        if not measured or not np.isfinite(measured[0].time):
            raise
        return found(True)
    return found(False)
