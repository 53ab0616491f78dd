"""Measure settings of MuJoCo on worlds of one model: time of a step, error, and the line to copy.

    result = tune("ant.xml", worlds=16, steps=200)
    result.faster, result.closer; result.page.write("lavender-tune")

Settings are chosen on the worlds with even numbers. The chosen settings are tested on the worlds with odd numbers,
which are held back. `lavender.audit.tune.mujoco_settings` describes the measurements. If less than the fraction
`MIN_CONTACT_SHARE` of the steps has contact, only the present setting is measured and no setting is recommended.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np

from lavender.audit.idle_settings import MIN_CHANGE, PHYSICS_OPTIONS, list_idle_settings
from lavender.audit.page import StepSizes
from lavender.audit.provenance import describe_provenance
from lavender.audit.settings import MujocoSetting
from lavender.audit.simulated_worlds import Runs, can_any_geoms_collide, count_engine_warnings
from lavender.audit.tune.mujoco_settings import Progress, Stage, list_first_settings, list_variants
from lavender.audit.tune.recommendation import Tuning
from lavender.base.arrays import check_float, check_int
from lavender.base.errors import InputError
from lavender.io.efc import from_mujoco_many
from lavender.io.start_states import Control
from lavender.judge.residuals import DEFAULT_THRESHOLD
from lavender.report import machine
from lavender.report.runner import Event

# After this many rounds of timing, variants of the settings near the Pareto front are tried.
N_TRIAL_ROUNDS = 2
# Variants of a setting on the Pareto front are tried if it takes up to this multiple of the present setting's time.
MAX_VARIED_TIME_RATIO = 1.5
# Assumed number of settings with variants that are tried, to estimate the remaining time.
EXPECTED_VARIED_SETTINGS = 4
TUNE_BUSY_CONSEQUENCE = "The times are invalid; measure again on an idle machine."


def tune(
    model: Any,
    *,
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
    """Measure settings of MuJoCo on worlds of a model.

    Parameters
    ----------
    model : path of a model (MJCF, .mjb) or mujoco.MjModel
    worlds, steps, control, seed, spread
        See `Runs` and, for the default spread, `audit`. Half of the worlds are held back; `steps` is a multiple of
        `horizon`.
    states : path of an .npz, "keyframes", or arrays, optional
        States in which the worlds start: see `audit`.
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
        After Ctrl-C, it holds the settings that were timed, and its `stopped` is true.

    Raises
    ------
    InputError
        The model cannot be read, there are fewer than two worlds, or `horizon` does not divide `steps`.
    CapabilityError
        MuJoCo does not store the matrix of the integrator "discrete" (see `lavender.io.from_mujoco`).
    """
    worlds = check_int("worlds", worlds, 2, None)
    horizon, repeats = (
        check_int("horizon", horizon, 1, None),
        check_int("repeats", repeats, 1, None),
    )
    threshold = check_float("threshold", threshold, low=0.0)
    if spread is not None:
        check_float("spread", spread, low=0.0)
    error_limit = max_velocity_error
    if error_limit is not None:
        error_limit = check_float("max_velocity_error", error_limit, low=0.0)
    if check_int("steps", steps, 1, None) % horizon:
        raise InputError(
            f"steps is {steps} and horizon is {horizon}; steps must be a multiple of horizon"
        )
    runs = Runs.of_model(model, worlds, steps, states=states, control=control, seed=seed)
    # Raise the error of an unsupported model here, before any world is simulated.
    from_mujoco_many(runs.model, np.zeros((0, runs.model.nq + runs.model.nv)))
    if watch is not None:
        watch(Event(0, 0, "simulating the worlds", ""))
    with count_engine_warnings(runs.mj):  # Settings with which worlds diverge are left out.
        runs = runs.choose_spread(spread)
        tuning = Tuning(
            runs.name,
            horizon,
            [],
            [],
            threshold,
            notes=runs.notes,
            n_held_worlds=worlds // 2,
            error_limit=error_limit,
            held_errors={},
            provenance=describe_provenance(runs.model, runs.name),
        )
        progress = Progress(watch)
        try:
            _measure_settings(tuning, runs, repeats, progress)
        except KeyboardInterrupt:
            if not tuning.measured or not np.isfinite(tuning.present_result.mean_step_time):
                raise
            tuning.stopped = True
    tuning.measured = [m for m in tuning.measured if np.isfinite(m.mean_step_time)]
    tuning.busy = machine.make_busy_warning(
        progress.loads, os.cpu_count() or 1, TUNE_BUSY_CONSEQUENCE
    )
    return tuning


def _measure_settings(tuning: Tuning, runs: Runs, repeats: int, progress: Progress) -> None:
    """Measure settings on the worlds with even numbers, and the chosen settings on the others; add the results."""
    measured, held_errors, error_limit = tuning.measured, tuning.held_errors, tuning.error_limit
    halves = [range(i, runs.worlds, 2) for i in (0, 1)]
    stage, held_back = (Stage.from_stretches_of_runs(runs, half, tuning.horizon) for half in halves)
    own = MujocoSetting()
    first_settings = list_first_settings(runs.mj, runs.model)
    n_variants = len(list_variants(runs.mj, runs.model, own)) * EXPECTED_VARIED_SETTINGS
    n_first = len(first_settings)
    n_trial = min(N_TRIAL_ROUNDS, repeats)
    # Three settings on the worlds held back, each timed in twice as many rounds.
    n_held = 3 * (1 + 2 * repeats)
    progress.expected = n_first * (1 + n_trial + repeats) + n_variants * (1 + repeats) + n_held
    measured += stage.judge_settings([own], progress)
    if not np.isfinite(measured[0].error).all():
        raise InputError(
            f"{runs.name}: worlds diverge with the model's own setting, so other settings cannot be "
            "compared with it: give other controls, states or fewer steps"
        )
    held = held_back.judge_settings([own], progress)
    both = [*measured, *held]
    rows, contacts = (
        np.concatenate([getattr(m, name) for m in both]) for name in ("rows", "contacts")
    )
    tuning.sizes = StepSizes(rows, contacts, can_any_geoms_collide(runs.mj, runs.model))
    if not tuning.sizes.has_enough_contact:
        progress.expected = repeats
        stage.time_settings(measured, repeats, progress)
        return
    first_settings = _leave_idle_out(tuning, stage, first_settings)
    # Settings with a larger error cannot be chosen.
    limit = max(float(measured[0].error.max()), tuning.threshold, error_limit or 0.0)
    measured += stage.judge_settings(first_settings[1:], progress, limit)
    stage.time_settings(measured, n_trial, progress)
    longest = MAX_VARIED_TIME_RATIO * measured[0].mean_step_time
    near = [m.setting for m in tuning.pareto_front if m.mean_step_time <= longest]
    known = {m.setting for m in measured}
    more = dict.fromkeys(
        x for s in [own, *near] for x in list_variants(runs.mj, runs.model, s) if x not in known
    )
    progress.expected = len(more) + (len(measured) + len(more)) * repeats + n_held
    measured += stage.judge_settings(list(more), progress, limit)
    stage.time_settings(measured, repeats, progress)
    other = dict.fromkeys(m.setting for m in (tuning.faster, tuning.closer) if m is not None)
    held += held_back.judge_settings(list(other), progress)
    held_errors |= {m.setting: float(m.error.max()) for m in held}
    # Judge the fastest setting within the limit on the worlds held back; if it exceeds the limit there, the next.
    tested = {m.setting: m for m in held}
    while error_limit is not None and (setting := tuning.limit_choice.setting) not in tested:
        (tested[setting],) = held_back.judge_settings([setting], progress)
        held_errors[setting] = float(tested[setting].error.max())
    if error_limit is not None and all(m.setting != setting for m in held):
        held.append(tested[setting])
    progress.expected = 2 * repeats * len(held)
    held_back.time_settings(held, 2 * repeats, progress)
    tuning.held = held if np.isfinite(held[0].mean_step_time) else []


def _leave_idle_out(
    tuning: Tuning, stage: Stage, settings: list[MujocoSetting]
) -> list[MujocoSetting]:
    """Return the settings without those of physics that hardly change the worst step; a note names them."""
    tried = {
        s: s.apply_to(stage.mj, stage.model)
        for s in settings if s.options and all(name in PHYSICS_OPTIONS for name, _ in s.options)
    }  # fmt: skip
    worst = stage.read_state(int(np.argmax(tuning.measured[0].error)))
    idle = list_idle_settings(stage.mj, stage.model, worst, tried)
    if idle:
        names = "; ".join(s.short_name for s in idle)
        change = f"less than {100.0 * MIN_CHANGE:.0f} %"
        tuning.left_out = f"Not timed, because it changes the worst step by {change}: {names}."
    return [s for s in settings if s not in idle]
