"""Settings of MuJoCo that `tune` tries, and stretches of simulated worlds on which they are measured.

Each world is run with the present setting and cut into stretches of `horizon` steps. Each setting steps from the start
of every stretch by itself, warm-started from its own answers. Measured are

    time    [s] of each step, per world: the minimum of several repeats, in which settings alternate
    error   [m/s] of the engine's answer to the problem of each step, computed by the judge
    motion  [m] largest distance of a body, at the end of a stretch, from its position in a run with converged solves

A setting with another cone, impratio or number of noslip iterations than the model defines another constraint problem:
its error is measured on that problem, its motion shows how far it deviates, and it is not recommended.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from time import perf_counter
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from lavender.audit.audit import MAX_PROBLEMS_IN_MEMORY
from lavender.audit.settings import OPTIONS, MujocoSetting, get_option_value
from lavender.audit.simulated_worlds import Runs, has_diverged, simulate_world
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.batch.residuals import residual_many
from lavender.io.efc import from_mujoco_many
from lavender.report import machine
from lavender.report.runner import Event

# Only the first round times a setting that takes more than this multiple of the present setting's time.
MAX_TIME_RATIO = 1.25
# The errors of every fourth stretch come first: they exclude most settings that are not accurate enough.
MIN_JUDGED_PARTS = 4
N_UNIT_STEPS = 3  # Steps of a part, those with the largest errors, whose rows decide the unit of a setting's error.
ERROR_QUANTILE = 0.99  # Settings are compared by this quantile of the error over all steps.


class Field(NamedTuple):
    """An attribute of `<option>`, the values that are tried, and the attributes tried together with it."""

    name: str
    values: tuple[Any, ...]
    fixed: dict[str, Any]


NEWTON, CG, PGS = ({"solver": name} for name in ("Newton", "CG", "PGS"))
TOLERANCES = (1e-3, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-15)
#: Options of MuJoCo, attributes of `<option>`. The last three change the constraint problem itself.
MUJOCO = (
    Field("tolerance", TOLERANCES, NEWTON),
    Field("iterations", (1, 2, 3, 5, 10), NEWTON),
    Field("tolerance", TOLERANCES, CG),
    Field("iterations", (3, 6, 12, 25, 50), CG),
    Field("tolerance", TOLERANCES, PGS),
    Field("iterations", (3, 6, 12, 25, 50, 100), PGS),
    Field("cone", ("pyramidal", "elliptic"), {}),
    Field("impratio", (1.0, 10.0), {}),
    Field("noslip_iterations", (0, 3, 10), {}),
)
CONVERGED_OPTIONS = {
    "solver": "Newton",
    "iterations": 300,
    "tolerance": 0.0,
    "ls_iterations": 100,
    "ls_tolerance": 1e-4,
}


@dataclass
class Progress:
    """Number of measurements that are done and, estimated, to come."""

    watch: Callable[[Event], None] | None  # Called at the beginning of each measurement.
    done: int = 0
    expected: int = 0
    loads: list[float | None] = field(
        default_factory=list
    )  # Number of runnable processes at each timing.

    def begin_measurement(self, kind: str, text: str) -> None:
        """Show the progress before a measurement, "judging" or "timing", which then counts as done."""
        if self.watch is not None:
            self.watch(Event(self.done, self.done + max(1, self.expected), f"{kind}: {text}", ""))
        if kind == "timing":
            self.loads.append(machine.count_runnable_processes())
        self.done += 1
        self.expected -= 1


@dataclass(eq=False)
class Measured:
    """Results of one setting on some worlds."""

    setting: MujocoSetting
    solver: str
    error: FloatArray = field(repr=False)  # (steps,) m/s
    motion: FloatArray = field(repr=False)  # (stretches,) m
    # (steps,) s: each time is the minimum of all repeats, which removes interruptions; infinite if it was not timed.
    times: FloatArray = field(repr=False)
    rows: Any = field(default=(), repr=False)  # (steps,) int
    contacts: Any = field(default=(), repr=False)  # (steps,) int
    unit: str = (
        "m/s"  # Unit of the largest errors: "m/s", "rad/s" or, of several rows, "m/s or rad/s".
    )

    @property
    def mean_step_time(self) -> float:
        """Mean time of a step [s]; infinite if it was not timed."""
        return float(self.times.mean())

    @property
    def worst_error(self) -> float:
        """Error [m/s] that 1 % of the steps exceed."""
        return float(np.quantile(self.error, ERROR_QUANTILE, method="higher"))

    @property
    def worst_motion(self) -> float:
        """Distance [m] that 1 % of the stretches exceed."""
        return float(np.quantile(self.motion, ERROR_QUANTILE, method="higher"))


@dataclass(eq=False)
class Stage:
    """Worlds of a MuJoCo model on which settings are measured."""

    mj: Any  # The module mujoco.
    model: Any  # mujoco.MjModel with its own setting.
    starts: FloatArray  # (n, size): state at the start of each stretch.
    controls: FloatArray  # (n, horizon, nu)
    # (n, bodies, 3) m: positions of the bodies after each stretch of the converged run.
    ends: FloatArray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def from_stretches_of_runs(cls, runs: Runs, worlds: Iterable[int], horizon: int) -> Stage:
        """Cut worlds that run with the model's own setting into stretches."""
        mj = runs.mj
        model = runs.model
        starts = []
        controls = []
        data = mj.MjData(model)
        kind = mj.mjtState.mjSTATE_INTEGRATION
        for world in worlds:
            states = simulate_world(runs, world)[0]
            for state in states:
                mj.mj_setState(model, data, state, kind)
                controls.append(np.array(data.ctrl))
            starts.append(states[::horizon])
        shape = (len(controls) // horizon, horizon, model.nu)
        configured = cls(mj, model, np.concatenate(starts), np.reshape(controls, shape))
        converged = MujocoSetting.from_options(mj, model, **CONVERGED_OPTIONS).apply_to(mj, model)
        try:
            configured.ends = configured.run_stretches(converged)[1]
        except mj.FatalError as error:
            raise InputError(f"{runs.name}: MuJoCo raised an error, {error}") from None
        return configured

    def run_stretches(
        self, model: Any, states: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Run all stretches.

        Returns (seconds of each step, positions of bodies after each stretch (n, bodies, 3) [m]), and stores the state
        before each step in `states`.
        """
        mj = self.mj
        kind = self.mj.mjtState.mjSTATE_INTEGRATION
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

    def read_state(self, step: int) -> FloatArray:
        """Return MuJoCo's state (size,) before a step, counted over all stretches, with the model's own setting."""
        mj, model = self.mj, self.model
        kind, horizon = mj.mjtState.mjSTATE_INTEGRATION, self.controls.shape[1]
        data = mj.MjData(model)
        stretch, last = divmod(step, horizon)
        mj.mj_setState(model, data, self.starts[stretch], kind)
        for k in range(last + 1):
            data.ctrl[:] = self.controls[stretch, k]
            if k < last:
                mj.mj_step(model, data)
        state = np.empty(self.starts.shape[1])
        mj.mj_getState(model, data, state, kind)
        return state

    def judge_setting(self, setting: MujocoSetting, limit: float = np.inf) -> Measured:
        """Judge a setting without timing it; its errors are infinite if a world diverges.

        After a part of the stretches with an error above `limit` [m/s], the others are not judged.
        """
        mj = self.mj
        model = setting.apply_to(self.mj, self.model)
        never = np.full(1, np.inf)
        result = Measured(setting, str(get_option_value(mj, model, "solver")), never, never, never)
        n, horizon, _ = self.controls.shape
        states = np.empty((n * horizon, self.starts.shape[1]))
        judge = copy.copy(model)
        judge.opt.noslip_iterations = 0
        error, rows, contacts = np.zeros(len(states)), *np.zeros((2, len(states)), int)
        n_parts = max(MIN_JUDGED_PARTS, -(-len(states) // MAX_PROBLEMS_IN_MEMORY))
        part_of_steps = np.repeat(np.arange(n) % n_parts, horizon)
        judged = np.zeros(len(states), bool)
        units = set[str]()
        try:
            ends = self.run_stretches(model, states)[1]
            for part in range(n_parts):
                some = part_of_steps == part
                batch, impulse = from_mujoco_many(judge, states[some], errors="status")
                found = residual_many(batch, impulse, errors="status")
                error[some] = np.nan_to_num(found.velocity_error, nan=np.inf)
                for i in np.argsort(-error[some])[:N_UNIT_STEPS].tolist():
                    if error[some][i] < np.inf and found.worst_row[i] >= 0:
                        units.add(batch[i].row_unit(int(found.worst_row[i])))
                rows[some], contacts[some] = batch.row_counts, batch.contact_counts
                judged |= some
                if error[some].max(initial=0.0) > limit:
                    break
        except (mj.FatalError, InputError):  # A step or a forward pass failed.
            return result
        distance = np.linalg.norm(ends - self.ends, axis=2).max(axis=1)
        if np.isnan(distance).any():
            return result
        sizes: dict[str, Any] = {"rows": rows[judged], "contacts": contacts[judged]}
        unit = " or ".join(sorted(units)) or "m/s"
        return replace(result, error=error[judged], motion=distance, unit=unit, **sizes)

    def judge_settings(
        self, settings: list[MujocoSetting], progress: Progress, limit: float = np.inf
    ) -> list[Measured]:
        """Judge settings one after the other (`judge_setting`)."""
        results = []
        for setting in settings:
            progress.begin_measurement("judging", setting.short_name)
            results.append(self.judge_setting(setting, limit))
        return results

    def time_settings(self, settings: list[Measured], repeats: int, progress: Progress) -> None:
        """Time the steps of all settings, which alternate in `repeats` rounds; the first is the present setting.

        A setting with which a world diverges is not timed, and one that cannot be chosen is timed once: it is slower
        than `MAX_TIME_RATIO`, or its errors exceeded the limit of `judge_setting`.
        """
        settings = [m for m in settings if np.isfinite(m.error).all()]
        models = [m.setting.apply_to(self.mj, self.model) for m in settings]
        for round_index in range(repeats):
            for m, model in zip(settings, models, strict=True):
                # Compare medians over the steps, so that an interrupted step does not exclude a setting.
                is_out = len(m.error) < len(settings[0].error)
                is_slow = np.median(m.times) > MAX_TIME_RATIO * np.median(settings[0].times)
                if np.isfinite(m.times).all() and (is_out or is_slow):
                    continue
                text = f"round {round_index + 1} of {repeats}, {m.setting.short_name}"
                progress.begin_measurement("timing", text)
                m.times = np.minimum(m.times, self.run_stretches(model)[0])


def list_first_settings(mj: Any, model: Any) -> list[MujocoSetting]:
    """List the first settings: the own one, MuJoCo's defaults, and each solver with each tolerance and budget.

    Settings that change the problem are last.
    """
    enough = {"iterations": max(100, int(model.opt.iterations))}
    tried = [{**f.fixed, f.name: x} for f in MUJOCO for x in f.values]
    tried = [enough | x if "tolerance" in x else x for x in tried]
    own = MujocoSetting.from_options(mj, model)
    mujoco_own = SimpleNamespace(opt=mj.MjOption())
    options = {name: get_option_value(mj, mujoco_own, name) for name in OPTIONS}
    default = replace(MujocoSetting.from_options(mj, model, **options), is_default=True)
    return list(
        dict.fromkeys([own, default, *(MujocoSetting.from_options(mj, model, **x) for x in tried)])
    )


def list_variants(mj: Any, model: Any, setting: MujocoSetting) -> list[MujocoSetting]:
    """List variants of a setting: other line searches, and dense instead of sparse J or the reverse."""
    options = dict(setting.options)
    stored = "dense" if mj.mj_isSparse(model) else "sparse"
    tried: list[dict[str, Any]] = [{"jacobian": stored}]
    if options.get("solver", get_option_value(mj, model, "solver")) != "PGS":
        tried += [{"ls_tolerance": x} for x in (0.1, 1e-3)] + [
            {"ls_iterations": n} for n in (5, 15, 50)
        ]
        tried += [{"jacobian": stored, "ls_tolerance": x} for x in (0.1, 1e-3)]
    return [MujocoSetting.from_options(mj, model, **options | x) for x in tried]
