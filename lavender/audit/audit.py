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
from collections.abc import Callable, Iterator
from dataclasses import replace
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from lavender.audit.result import N_WORST_WORLDS, NOT_JUDGED, WORST_ROW_ERRORS, Audit, Piece, StepState, Worst
from lavender.audit.simulated_worlds import (
    ENGINES,
    N_TRIAL_WORLDS,
    Divergence,
    Runs,
    can_any_geoms_collide,
    count_engine_warnings,
    iterate_frames,
    simulate_world,
    split_state_vector,
)
from lavender.base.arrays import FloatArray, check_float, check_int
from lavender.base.errors import InputError, check_name
from lavender.batch.data import Batch
from lavender.batch.residuals import residual_many
from lavender.io.efc import from_mujoco_many
from lavender.io.start_states import VECTOR, Control
from lavender.judge.residuals import DEFAULT_THRESHOLD, UNCONVERGED, VERDICTS, WRONG
from lavender.problem import PRECISIONS
from lavender.report import machine
from lavender.report.runner import Event
from lavender.report.text import format_count
from lavender.report.workers import check_workers, connect_backend, map_unordered

MAX_PROBLEMS_IN_MEMORY = 512  # Problems are built and judged in batches of this many.
STEPS_PER_TASK = 4096  # A worker returns its results after this many steps or fewer.
MIN_TASKS_PER_WORKER = 10  # With fewer tasks, the progress and the remaining time would be coarse.
DEFAULT_DURATION = 60.0  # [s] Without a number of worlds, the audit takes about this time.
MIN_PROGRESS_TIME = 1.0  # [s] The remaining time is estimated only after results have arrived for this long.
# If `worlds` is None, at most this many are simulated; more would hardly change the quantiles.
MAX_DEFAULT_WORLDS = 4096
# World 0 is first judged in this process for these numbers of steps, so that Ctrl-C soon after the start has a result.
FIRST_STEPS = (1, 20)
MAX_CONTACT_STATES = 1000  # Up to about this many states before steps with contact are kept.
# The states before a world diverges by less than this number of steps are not kept as states with contact: their speeds
# are those of the divergence, and `slip` simulates settings for 25 steps.
DIVERGENCE_MARGIN = 25
AUDIT_BUSY_CONSEQUENCE = (
    "The audit took longer than on an idle machine; its errors do not depend on the load."
)
# Matches "contact 12 " at the start of a row's name. The number differs between steps and is removed from names.
CONTACT_NUMBER = re.compile(r"^contact \d+ ")


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
    first_lost = {d.world: d.step for d in result.divergences}
    result.contact_states[:] = sorted(
        (s for s in result.contact_states if s.step < first_lost.get(s.world, np.inf) - DIVERGENCE_MARGIN),
        key=lambda entry: entry[:2],
    )
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


def count_processes(workers: int) -> int:
    """Return the number of processes of `workers` (-1: one for each core)."""
    return workers if workers > 0 else max(1, (os.cpu_count() or 1) + 1 + workers)


def choose_world_count(duration: float, processes: int) -> int:
    """Return the number of worlds that take about `DEFAULT_DURATION` in `processes` processes.

    `duration` [s] is the time in which one world was simulated and judged.
    """
    return max(1, min(MAX_DEFAULT_WORLDS, int(DEFAULT_DURATION * processes / max(duration, 1e-6))))


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
