"""Measure an engine's settings on worlds of one model or scene: time of a step, error, and the line to copy.

    result = tune("ant.xml", worlds=16, steps=200)
    result.faster, result.closer; result.summary_page.write("lavender-tune")
    tune("scene.py", engine="kamino")

Settings are chosen on the worlds with even numbers. The chosen settings are tested on the worlds with odd numbers,
which are held back. `lavender.audit.tune.measured` describes the measurements. If less than the fraction
`MIN_CONTACT_SHARE` of the steps has contact, only the present setting is measured and no setting is recommended.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lavender.audit.settings import Setting
from lavender.audit.simulated_worlds import SPREADS, Runs, can_any_geoms_collide, count_engine_warnings
from lavender.audit.step_sizes import StepSizes
from lavender.audit.tune.measured import Measured, Progress, Stage
from lavender.audit.tune.mujoco_settings import MujocoStage
from lavender.audit.tune.recommendation import Tuning
from lavender.audit.tune.world_settings import make_kamino_stages, make_warp_stages
from lavender.base.arrays import check_float, check_int
from lavender.base.errors import InputError, check_name
from lavender.io.efc import from_mujoco_many
from lavender.io.start_states import Control
from lavender.judge.residuals import DEFAULT_THRESHOLD
from lavender.report import machine
from lavender.report.runner import Event

TUNE_ENGINES = ("mujoco", "mujoco_warp", "kamino")
# After this many rounds of timing, variants of the settings near the Pareto front are tried.
N_TRIAL_ROUNDS = 2
# Variants of a setting on the Pareto front are tried if it takes at most this multiple of the present setting's time.
MAX_VARIED_TIME_RATIO = 1.5
# Assumed number of settings with variants that are tried, to estimate the remaining time.
EXPECTED_VARIED_SETTINGS = 4
TUNE_BUSY_CONSEQUENCE = "The times are invalid; measure again on an idle machine."


def tune(
    model: str | os.PathLike[str],
    *,
    engine: str = "mujoco",
    worlds: int = 16,
    steps: int = 200,
    control: Control = "random",
    seed: int = 0,
    spread: float | None = None,
    states: Any = None,
    horizon: int = 10,
    repeats: int = 5,
    threshold: float = DEFAULT_THRESHOLD,
    max_velocity_error: float | None = None,
    watch: Callable[[Event], None] | None = None,
) -> Tuning:
    """Measure an engine's settings on worlds of a model or scene.

    Parameters
    ----------
    model : path (MJCF)
        For "kamino" the path of a Python file or a name, as for `lavender.audit.engine_scenes.step_scene`.
    engine : {"mujoco", "mujoco_warp", "kamino"}
        The last two step all worlds at once; the time of a step is divided by the number of worlds.
    worlds, steps, control, seed, spread
        See `Runs` and, for the default spread, `audit`. Half of the worlds are held back; `steps` is a multiple of
        `horizon`. Scenes of Kamino set their own controls.
    states : path of an .npz, "keyframes", or arrays, optional
        States in which the worlds start: see `audit`, and for "kamino" `lavender.audit.engine_scenes`.
    horizon : int
        Number of steps of a stretch.
    repeats : int
        Repetitions of the timing, in which settings alternate.
    threshold : float, m/s, m
        Errors [m/s] and distances [m] up to this number count as accurate enough.
    max_velocity_error : float, m/s, optional
        Also recommend the fastest setting with an error of at most this number in every step of all worlds.
    watch : callable, optional
        Called with the progress.

    Returns
    -------
    Tuning
        After Ctrl-C, it holds the results so far, and its `stopped` is true. Before the first round of timing, these
        are the present setting on one stretch of one world, and then on all worlds.

    Raises
    ------
    InputError
        The model cannot be read, the engine is not installed, there are fewer than two worlds, or `horizon` does not
        divide `steps`.
    CapabilityError
        MuJoCo does not store the matrix of the integrator "discrete" (see `lavender.io.from_mujoco`), or a world has
        more rows than the engine has memory for.
    UnknownName
        The engine is unknown.
    """
    check_name("engine", engine, TUNE_ENGINES)
    worlds = check_int("worlds", worlds, 2, None)
    horizon, repeats = check_int("horizon", horizon, 1, None), check_int("repeats", repeats, 1, None)
    threshold, name = check_float("threshold", threshold, low=0.0), os.fspath(model)
    if spread is not None:
        check_float("spread", spread, low=0.0)
    if max_velocity_error is not None:
        max_velocity_error = check_float("max_velocity_error", max_velocity_error, low=0.0)
    if check_int("steps", steps, 1, None) % horizon:
        raise InputError(f"steps is {steps} and horizon is {horizon}; steps must be a multiple of horizon")
    if engine == "kamino":
        if control != "random":
            raise InputError(
                "control needs a model of MuJoCo; a scene of kamino sets its own controls: leave it out"
            )
        start = {"states": states, "spread": SPREADS[0] if spread is None else spread, "seed": seed}
        return run_tuning(
            lambda: make_kamino_stages(name, worlds, steps, horizon, **start),
            name, horizon, repeats, threshold, can_touch=True, n_held_worlds=worlds // 2,
            error_limit=max_velocity_error, watch=watch, first_phase="compiling kamino, then simulating the worlds",
        )  # fmt: skip
    runs = Runs(name, worlds, steps, control=control, seed=seed).with_start_states(states)
    note = ""
    mj, configured = runs.load_model()
    # Raise the error of an unsupported model here, before any world is simulated.
    from_mujoco_many(configured, np.zeros((0, configured.nq + configured.nv)))

    def make_stages() -> Sequence[Stage]:
        """Simulate all worlds; return the stages of the worlds with even numbers and of those with odd numbers."""
        nonlocal runs, note
        runs, note = runs.choose_spread() if spread is None else (replace(runs, spread=spread), "")
        if engine == "mujoco_warp":
            return make_warp_stages(mj, configured, runs, horizon)
        return [
            MujocoStage.from_stretches_of_runs(mj, configured, runs, range(i, worlds, 2), horizon)
            for i in (0, 1)
        ]

    def make_first_stage() -> Stage:
        """Simulate the first stretch of world 0, which starts without noise."""
        first = replace(runs, steps=horizon)
        return MujocoStage.from_stretches_of_runs(mj, configured, first, range(1), horizon)

    with count_engine_warnings(mj):  # Settings with which worlds diverge are left out.
        tuning = run_tuning(
            make_stages, name, horizon, repeats, threshold, can_touch=can_any_geoms_collide(mj, configured),
            n_held_worlds=worlds // 2, error_limit=max_velocity_error, watch=watch,
            make_first_stage=make_first_stage if engine == "mujoco" else None,
            first_phase=f"{'simulating' if engine == 'mujoco' else f'compiling {engine}, then simulating'} the worlds",
        )  # fmt: skip
    return replace(tuning, notes=" ".join(filter(None, (runs.sleep_note, note))))


def run_tuning(
    make_stages: Callable[[], Sequence[Stage]],
    model: str,
    horizon: int,
    repeats: int,
    threshold: float,
    *,
    can_touch: bool,
    n_held_worlds: int,
    error_limit: float | None = None,
    watch: Callable[[Event], None] | None = None,
    make_first_stage: Callable[[], Stage] | None = None,
    first_phase: str = "simulating the worlds",
) -> Tuning:
    """Measure settings on one stage, and measure the chosen settings on a second stage.

    Parameters
    ----------
    make_stages : callable
        Returns the stage on which settings are chosen, and the stage of the worlds held back.
    model : str
        Name in messages and tables.
    horizon, repeats, threshold, watch
        As for `tune`.
    can_touch : bool
        Whether bodies of the model can collide, see `StepSizes`.
    n_held_worlds : int
        Number of worlds held back.
    error_limit : float, m/s, optional
        Also choose the fastest setting whose error does not exceed this number on both stages.
    make_first_stage : callable, optional
        Returns a small stage, on which the present setting is measured first: the result of a measurement that Ctrl-C
        stops before this setting is measured on the other stages.
    first_phase : str
        Shown until the first measurement.
    """
    progress = Progress(watch)
    held_errors: dict[Setting, float] = {}
    measured: list[Measured] = []
    held: list[Measured] = []
    early: list[Measured] = []  # The present setting, timed once; the result until the first round of timing.
    sizes: StepSizes | None = None

    def make_result(stopped: bool) -> Tuning:
        """Build the result so far."""
        timed = [m for m in measured if np.isfinite(m.mean_step_time)] or early
        busy = machine.make_busy_warning(progress.loads, os.cpu_count() or 1, TUNE_BUSY_CONSEQUENCE)
        return Tuning(
            model, horizon, timed, held, threshold=threshold, stopped=stopped, sizes=sizes, busy=busy,
            n_held_worlds=n_held_worlds, error_limit=error_limit, held_errors=dict(held_errors),
        )  # fmt: skip

    def judge(stage: Stage, settings: list[Setting]) -> list[Measured]:
        """Return the judged results of settings on a stage."""
        results = []
        for setting in settings:
            progress.begin_measurement("judging", setting.name)
            results.append(stage.judge_setting(setting))
        return results

    def measure_early(stage: Stage, judged: Measured) -> None:
        """Time the present setting once, if no world diverges, as the result so far."""
        nonlocal sizes
        timed = replace(judged)
        stage.time_settings([timed], 1, Progress(None))
        if np.isfinite(timed.mean_step_time):
            early[:] = [timed]
            sizes = StepSizes(timed.rows, timed.contacts, can_touch)

    if watch is not None:
        watch(Event(0, 0, first_phase, ""))
    try:
        if make_first_stage is not None:
            first_stage = make_first_stage()
            measure_early(first_stage, first_stage.judge_setting(first_stage.own_setting))
        stage, held_back = make_stages()
        own, first_settings = stage.own_setting, stage.list_first_settings()
        n_variants = len(stage.list_variants(own)) * EXPECTED_VARIED_SETTINGS
        n_first, n_trial = len(first_settings), min(N_TRIAL_ROUNDS, repeats)
        # Three settings on the worlds held back, each timed in twice as many rounds.
        n_held = 3 * (1 + 2 * repeats)
        progress.expected = n_first * (1 + n_trial + repeats) + n_variants * (1 + repeats) + n_held
        measured += judge(stage, [own])
        if not np.isfinite(measured[0].error).all():
            raise InputError(
                f"{model}: worlds diverge with the model's own setting, so other settings cannot be "
                "compared with it: give other controls, states or fewer steps"
            )
        measure_early(stage, measured[0])
        last = judge(held_back, [own])
        both = [*measured, *last]
        rows, contacts = (np.concatenate([getattr(m, name) for m in both]) for name in ("rows", "contacts"))
        sizes = StepSizes(rows, contacts, can_touch)
        if not sizes.has_enough_contact:
            progress.expected = repeats
            stage.time_settings(measured, repeats, progress)
            return make_result(False)
        measured += judge(stage, first_settings[1:])
        stage.time_settings(measured, n_trial, progress)
        near = [
            m.setting
            for m in make_result(False).pareto_front
            if m.mean_step_time <= MAX_VARIED_TIME_RATIO * measured[0].mean_step_time
        ]
        known = {m.setting for m in measured}
        more = dict.fromkeys(x for s in [own, *near] for x in stage.list_variants(s) if x not in known)
        progress.expected = len(more) + (len(measured) + len(more)) * repeats + n_held
        measured += judge(stage, list(more))
        stage.time_settings(measured, repeats, progress)
        chosen = make_result(False)
        other = dict.fromkeys(m.setting for m in (chosen.faster, chosen.closer) if m is not None)
        last += judge(held_back, list(other))
        held_errors |= {m.setting: float(m.error.max()) for m in last}
        # Judge the fastest setting within the limit on the worlds held back; if it exceeds the limit there, the next.
        tested: dict[Setting, Measured] = {m.setting: m for m in last}
        while error_limit is not None and (setting := make_result(False).limit_choice.setting) not in tested:
            (tested[setting],) = judge(held_back, [setting])
            held_errors[setting] = float(tested[setting].error.max())
        if error_limit is not None and all(m.setting != setting for m in last):
            last.append(tested[setting])
        progress.expected = 2 * repeats * len(last)
        held_back.time_settings(last, 2 * repeats, progress)
        held += last if np.isfinite(last[0].mean_step_time) else []
    except KeyboardInterrupt:
        if not early:
            raise
        return make_result(True)
    return make_result(False)
