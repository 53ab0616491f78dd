"""Judge every step of many worlds: which solves stopped before convergence, their errors, and the worst states.

    result = audit("ant.xml")          # as many worlds as take about a minute; or worlds=64
    result = audit(model)              # a mujoco.MjModel as it is, also one that was changed after loading
    result = audit(env, policy=policy)  # a gymnasium environment: every step of MuJoCo in env.step
    result.errors; result.worst[0].problem
    result.write("lavender-audit"); result.page.write("lavender-audit")

An answer with an error that rounding explains, in the precision of the engine, is at its floor and did not stop before
convergence (`Residual.verdict`). MuJoCo's problems are built by `lavender.io.from_mujoco_many` again from the
state before each step with its warm start and controls: the engine's answer is reproduced to the bit.
`noslip_iterations` are applied after the problem is solved; the answer before them is judged.

A step is judged if its error is finite. When a world diverges, its later steps cannot be judged, and the step in which
it diverged is judged only if the engine's answer is finite.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from lavender.audit.engine_scenes import CLAIM_ENGINES, step_scene
from lavender.audit.environment import is_environment, iterate_environment, make_environment_runs
from lavender.audit.pieces import NOT_JUDGED, Judging, Piece, Prediction, judge_steps
from lavender.audit.result import Audit
from lavender.audit.rigid_laws import explain_steps
from lavender.audit.simulated_worlds import (
    ENGINES,
    SPREADS,
    STEP_FIELDS,
    Divergence,
    Frame,
    Runs,
    count_engine_warnings,
    iterate_frames,
    simulate_world,
)
from lavender.base.arrays import check_float, check_int
from lavender.base.errors import InputError, check_name
from lavender.io.efc import from_mujoco_many
from lavender.io.engine_step import EngineStep
from lavender.io.mujoco_memory import import_mujoco
from lavender.io.start_states import VECTOR, Control, hash_model
from lavender.judge.residuals import DEFAULT_THRESHOLD
from lavender.problem import PRECISIONS
from lavender.report.runner import Event
from lavender.report.text import format_count
from lavender.report.workers import (
    MIN_DURATION_OF_WORKERS,
    check_workers,
    connect_backend,
    map_unordered,
)

MAX_PROBLEMS_IN_MEMORY = 512  # Problems are built and judged in batches of this many.
STEPS_PER_TASK = 4096  # A worker returns its results after this many steps or fewer.
MIN_TASKS_PER_WORKER = 10  # With fewer tasks, the progress and the remaining time would be coarse.
DEFAULT_DURATION = 60.0  # [s] Without a number of worlds, the audit takes about this time.
# If `worlds` is None, at most this many are simulated; more would hardly change the quantiles.
MAX_DEFAULT_WORLDS = 4096
DEFAULT_JOINT_WORLDS = (
    8  # Default number of worlds of other engines, and of episodes of environments.
)
TIMED_STEPS = 20  # Steps of world 0 that are timed if the number of worlds is given.
MAX_CONTACT_STATES = 1000  # Up to about this many states before steps with contact are kept.
# The states before a world diverges by less than this number of steps are not kept as states with contact: their speeds
# belong to the divergence, and `slip` simulates settings for 25 steps.
DIVERGENCE_MARGIN = 25


def audit(
    model: Any,
    *,
    policy: Callable[[Any], Any] | None = None,
    worlds: int | None = None,
    steps: int = 200,
    engine: str = "mujoco",
    control: Control = "random",
    seed: int = 0,
    spread: float | None = None,
    states: Any = None,
    against: Any = None,
    keep: int | None = None,
    keep_contact_states: bool = False,
    precision: str | None = None,
    threshold: float = DEFAULT_THRESHOLD,
    max_velocity_error: float | None = None,
    njmax: int | None = None,
    workers: int = -1,
    backend: str = "loky",
    watch: Callable[[Event], None] | None = None,
) -> Audit:
    """Simulate worlds of a model and judge the engine's answer to every step.

    Parameters
    ----------
    model : path of a model (MJCF, .mjb), mujoco.MjModel, gymnasium environment, or scene
        An environment is stepped as it is: each step of MuJoCo in `env.step` is judged with the model at that time. A
        scene of the engines "kamino", "newton-mujoco" and "genesis" is as for `step_scene`.
    policy : callable, optional
        Function from the environment's observation to an action. Default: random actions.
    worlds : int, optional
        Default: as many of MuJoCo as take about a minute (`DEFAULT_DURATION`), up to 4096; 8 for other engines
        and for environments, whose worlds are episodes.
    steps : int, default 200
        Steps of the engine in each world.
    engine : {"mujoco", "mjx", "mujoco_warp", "kamino", "newton-mujoco", "genesis"}
    control, seed, spread
        See `Runs`. Default spread: the largest of 0.1, 0.01, 0.001 and 0 m/s with which trial worlds do not diverge.
    states : path of an .npz, "keyframes", or arrays, optional
        States in which the worlds start: see `lavender.io.start_states`. Default: the model's own.
    against : path of a model or mujoco.MjModel, optional
        Another model, such as one with other options, that solves the same steps from the same states.
    keep : int, optional
        Number of worst steps that are kept as problems and states. Default: the worst step of each of three worlds.
    keep_contact_states : bool
        Keep the states before up to 1000 evenly spaced steps with contact (`Audit.save_states`).
    precision : {"float64", "float32"}, optional
        Precision in which MuJoCo computes; default float64. The other engines determine it themselves.
    threshold : float, m/s
        A smaller velocity error is close enough.
    max_velocity_error : float, m/s, optional
        The headline counts the steps with a larger velocity error.
    njmax : int, optional
        Rows of each world for which MuJoCo Warp allocates memory, as in the user's own simulation: rows that it drops
        are counted. Default: as many as needed.
    workers : int
        Processes for MuJoCo; -1: one for each core.
    backend : str
        Name of a joblib backend, as for a campaign.
    watch : callable, optional
        Called with the progress.

    Returns
    -------
    Audit
        After Ctrl-C, the result of the steps so far, with `is_stopped`.

    Raises
    ------
    InputError
        The model cannot be read, the engine is not installed, a number is out of range, or an argument has no effect.
    CapabilityError
        MuJoCo does not store the matrix of the integrator "discrete"; see `lavender.io.from_mujoco`.
    UnknownName
        The engine is unknown.
    """
    check_name("engine", engine, (*ENGINES, *CLAIM_ENGINES))
    if precision not in (None, *PRECISIONS) or (precision and engine != "mujoco"):
        raise InputError(
            f"precision is {precision!r} and engine is {engine!r}; None is needed, or with engine 'mujoco' "
            f"{' or '.join(PRECISIONS)}"
        )
    check_workers(workers)
    limit = max_velocity_error
    if limit is not None:
        limit = check_float("max_velocity_error", limit, low=0.0)
    threshold = check_float("threshold", threshold, low=0.0)
    keep = None if keep is None else check_int("keep", keep, 1)
    judging = Judging(precision or "float64", threshold, keep)
    common: dict[str, Any] = {"threshold": threshold, "error_limit": limit}
    if is_environment(model):
        own = {
            "engine": engine == "mujoco",
            "control": isinstance(control, str) and control == "random",
            "spread": spread is None,
            "states": states is None,
            "against": against is None,
        }
        for name in (name for name, is_default in own.items() if not is_default):
            raise InputError(
                f"{name} has no effect with an environment, which steps itself: leave it out"
            )
        episodes = DEFAULT_JOINT_WORLDS if worlds is None else worlds
        runs = make_environment_runs(model, episodes, steps, seed)
        judging = judging.with_forces(runs)
        pieces = _audit_environment(model, policy, runs, judging)
        return _collect(Audit.with_size(runs, engine, **common), pieces, judging, watch)
    if policy is not None:
        raise InputError(
            "policy needs a gymnasium environment as model; for a model of MuJoCo give control="
        )
    if against is not None and engine != "mujoco":
        raise InputError(f"against is given and engine is {engine!r}; 'mujoco' is needed for it")
    if njmax is not None and engine != "mujoco_warp":
        raise InputError(
            f"njmax is {njmax} and engine is {engine!r}; 'mujoco_warp' is needed for it"
        )
    if engine in CLAIM_ENGINES:
        if control != "random":
            raise InputError(
                f"control needs a model of MuJoCo; scenes of {engine} have their own: leave it"
            )
        start = {"states": states, "spread": SPREADS[0] if spread is None else spread, "seed": seed}
        n = DEFAULT_JOINT_WORLDS if worlds is None else worlds
        stepped = step_scene(model, engine, worlds=n, steps=steps, **start)
        return audit_steps(
            stepped,
            engine=engine,
            name=str(model),
            threshold=threshold,
            max_velocity_error=limit,
            keep=keep,
            total=steps,
            seed=seed,
            watch=watch,
        )
    default_worlds = MAX_DEFAULT_WORLDS if engine == "mujoco" else DEFAULT_JOINT_WORLDS
    n = default_worlds if worlds is None else worlds
    runs = Runs.of_model(
        model, n, steps, states=states, against=against, control=control, seed=seed
    )
    if engine == "mujoco":
        more = (keep_contact_states, workers, backend, watch, common)
        return _audit_model(runs, judging, worlds, spread, *more)
    runs = runs.choose_spread(spread, watch)
    if watch is not None:
        watch(Event(0, 0, f"compiling {engine}", ""))
    runs = runs.with_ignored_settings(engine)
    judging = judging.with_forces(runs)
    pieces = _audit_frames(iterate_frames(engine, runs, njmax), judging, runs.model)
    return _collect(Audit.with_size(runs, engine, **common), pieces, judging, watch)


def audit_steps(
    steps: Iterable[EngineStep],
    *,
    engine: str = "engine",
    name: str = "steps",
    threshold: float = DEFAULT_THRESHOLD,
    max_velocity_error: float | None = None,
    keep: int | None = None,
    total: int = 0,
    seed: int = 0,
    watch: Callable[[Event], None] | None = None,
) -> Audit:
    """Judge the steps of an engine and compare its claims with the verdicts.

    Parameters
    ----------
    steps : iterable of EngineStep
        Results of `lavender.io.from_kamino` or `from_genesis`, one for each step, with equal numbers of worlds.
    engine, name : str
        Names of the engine and of the model in tables.
    threshold, max_velocity_error, keep, watch
        See `audit`.
    total : int, optional
        Number of steps, for the progress.
    seed : int
        Seed of the steps, for the records.

    Returns
    -------
    Audit
        Its `converged` holds the claims. After Ctrl-C it covers the steps judged so far, and `is_stopped` is true.

    Raises
    ------
    InputError
        There are no steps, or steps have different numbers of worlds.
    """
    if watch is not None:
        watch(Event(0, 0, f"compiling {engine}", ""))
    judging = Judging("float64", check_float("threshold", threshold, low=0.0), keep)
    frames = (Frame.of_step(step) for step in steps)
    runs = Runs(name, None, 1, max(total, 1), seed=seed)
    common: dict[str, Any] = {"threshold": judging.threshold, "error_limit": max_velocity_error}
    result = Audit.with_size(runs, engine, has_claims=True, **common)
    _collect(result, _audit_frames(frames, judging), judging, watch)
    if not result.n_processed:
        raise InputError("steps is empty; at least one step is needed")
    return result


def _audit_model(
    runs: Runs,
    judging: Judging,
    worlds: int | None,
    spread: float | None,
    keep_contact_states: bool,
    workers: int,
    backend: str,
    watch: Callable[[Event], None] | None,
    common: dict[str, Any],
) -> Audit:
    """Audit a model of MuJoCo: time its first world, choose the spread, and judge all worlds in worker processes."""
    processes = count_processes(workers)
    # Raise the error of an unsupported model once and before any worker starts.
    from_mujoco_many(runs.model, np.concatenate([runs.model.qpos0, np.zeros(runs.model.nv)])[None])
    timed = runs if worlds is None else replace(runs, steps=min(TIMED_STEPS, runs.steps))
    if watch is not None:
        watch(Event(0, 0, f"judging one world: {format_count(timed.steps, 'step')}", ""))
    begin = perf_counter()
    audit_worlds(timed, judging, [0])
    duration = (perf_counter() - begin) / timed.steps * runs.steps
    if worlds is None:
        expected = int(DEFAULT_DURATION * processes / max(duration, 1e-6))
        worlds = max(1, min(MAX_DEFAULT_WORLDS, expected))
    if workers == -1 and backend == "loky" and duration * worlds < MIN_DURATION_OF_WORKERS:
        workers = 1
    runs = runs.with_worlds(worlds).choose_spread(spread, watch)
    judging = judging.with_forces(runs)
    if keep_contact_states:
        share = min(1.0, MAX_CONTACT_STATES / (worlds * runs.steps))
        judging = judging._replace(contact_share=share)
    result = Audit.with_size(runs, "mujoco", **common)
    pieces = _audit_mujoco(runs, judging, range(worlds), workers, backend)
    result = _collect(result, pieces, judging, watch)
    if not result.n_processed:
        raise InputError(
            "no step was judged, because workers were lost; give fewer workers (--workers), which need less memory"
        )
    last = {d.world: d.step - DIVERGENCE_MARGIN for d in result.divergences}
    states = sorted(result.contact_states, key=lambda entry: entry[:2])
    result.contact_states[:] = [s for s in states if s.step < last.get(s.world, np.inf)]
    if not result.is_stopped:
        result.causes, result.slide = explain_steps(runs, [(w.world, w.step) for w in result.worst])
    return result


def _collect(
    result: Audit, pieces: Iterable[Piece], judging: Judging, watch: Callable[[Event], None] | None
) -> Audit:
    """Add pieces to a result until their end or Ctrl-C, and show the progress."""
    if watch is not None:
        text = f"{format_count(result.runs.worlds, 'world')} of {format_count(result.runs.steps, 'step')}"
        watch(Event(result.n_processed, result.verdict.size, text, "", phase="judging"))
    try:
        for piece in pieces:
            result.add_piece(piece, judging.keep)
            if watch is not None:
                text = f"steps, {int(result.is_unconverged.sum())} unconverged"
                watch(Event(result.n_processed, result.verdict.size, text, "", phase="judging"))
    except KeyboardInterrupt:
        if not result.n_processed:
            raise
    result.is_stopped = result.n_processed < result.verdict.size
    return result


def count_processes(workers: int) -> int:
    """Return the number of processes of `workers` (-1: one for each core)."""
    return workers if workers > 0 else max(1, (os.cpu_count() or 1) + 1 + workers)


def _audit_mujoco(
    runs: Runs, judging: Judging, worlds: Sequence[int], workers: int, backend: str
) -> Iterator[Piece]:
    """Simulate and judge MuJoCo's steps of some worlds in worker processes."""
    share = -(-len(worlds) // (MIN_TASKS_PER_WORKER * count_processes(workers)))
    n = max(1, min(STEPS_PER_TASK // runs.steps, share))
    parts = ((runs, judging, worlds[first : first + n]) for first in range(0, len(worlds), n))
    name, cluster = connect_backend(backend)
    with cluster:
        for pieces in map_unordered(audit_worlds, parts, workers, name):
            yield from pieces


def audit_worlds(runs: Runs, judging: Judging, worlds: Sequence[int]) -> list[Piece]:
    """Simulate and judge MuJoCo's steps of some worlds, in a worker."""
    with count_engine_warnings(runs.mj) as engine_warnings:
        simulations = [simulate_world(runs, world) for world in worlds]
        states, after = (np.concatenate([result[k] for result in simulations]) for k in (0, 2))
        divergences = [divergence for _, divergence, _ in simulations if divergence is not None]
        world = np.repeat(worlds, runs.steps)
        step = np.tile(np.arange(runs.steps), len(worlds))
        pieces = list(judge_states(runs.model, judging, states, world, step, after))
        if runs.against is not None:
            others = judge_states(runs.against[1], judging, states, world, step)
            pieces = [
                own._replace(against=other) for own, other in zip(pieces, others, strict=True)
            ]
    pieces[-1] = pieces[-1]._replace(divergences=divergences, engine_warnings=engine_warnings)
    return pieces


def judge_states(
    model: Any, judging: Judging, states: Any, world: Any, step: Any, after: Any = None
) -> Iterator[Piece]:
    """Judge MuJoCo's answers to the steps from states (n, size) of mjSTATE_INTEGRATION.

    `after` (n, nv) are the velocities after the steps, with which the predicted ones are compared.
    """
    judge = copy.copy(model)
    mj = import_mujoco()
    judge.opt.noslip_iterations = 0
    for i in range(0, len(states), MAX_PROBLEMS_IN_MEMORY):
        part = slice(i, i + MAX_PROBLEMS_IN_MEMORY)
        # noslip iterations change the motion, and are not judged.
        is_compared = after is not None and not model.opt.noslip_iterations
        velocity = np.full((len(states[part]), model.nv), np.nan) if is_compared else None
        batch, impulse = from_mujoco_many(judge, states[part], errors="status", velocity=velocity)

        def state_of(k: int, vectors: Any = states[part]) -> dict[str, Any]:
            data = mj.MjData(judge)
            mj.mj_setState(judge, data, vectors[k], mj.mjtState.mjSTATE_INTEGRATION)
            state = {name: np.array(getattr(data, name)) for name in STEP_FIELDS}
            origin = {"model": np.array(hash_model(judge)), "mujoco": np.array(mj.__version__)}
            return state | {VECTOR: vectors[k].copy()} | origin

        assert impulse is not None and batch.contact_counts is not None
        frame = Frame(batch, impulse, {}, batch.row_counts, batch.contact_counts)
        piece = judge_steps(frame, judging, world[part], step[part], state_of, judge)
        if velocity is not None:
            predicted = Prediction.of_steps(velocity, after[part], world[part], step[part])
            piece = piece._replace(prediction=predicted)
        yield piece


def _audit_environment(env: Any, policy: Any, runs: Runs, judging: Judging) -> Iterator[Piece]:
    """Judge the steps of MuJoCo in episodes of an environment, each with the model at its time."""
    with count_engine_warnings(runs.mj) as engine_warnings:
        for world in range(runs.worlds):
            lost: Divergence | None = None
            for model, states, after, first, diverged in iterate_environment(
                env, policy, runs, world
            ):
                step = first + np.arange(len(states))
                for piece in judge_states(
                    model, judging, states, np.full(len(states), world), step, after
                ):
                    yield piece._replace(engine_warnings=dict(engine_warnings))
                    engine_warnings.clear()
                if diverged:
                    lost = Divergence(world, int(step[-1]), "acceleration", False)
            if lost is not None:
                rest = np.arange(lost.step + 1, runs.steps)
                yield Piece.of_lost_steps(world, rest, lost)


def _audit_frames(frames: Iterable[Frame], judging: Judging, model: Any = None) -> Iterator[Piece]:
    """Judge the steps of an engine that steps all worlds at once; `model` as for `judge_steps`."""
    diverged: Any = None
    for k, frame in enumerate(frames):
        n = len(frame.batch)
        diverged = np.zeros(n, bool) if diverged is None else diverged
        if n != len(diverged):
            raise InputError(
                f"step {k} has {n} worlds, the first one {len(diverged)}; equal numbers are needed"
            )

        def state_of(i: int, state: Any = frame.state) -> dict[str, Any]:
            return {name: x[i] for name, x in state.items()}

        judging = judging._replace(precision=frame.batch.precision)
        piece = judge_steps(frame, judging, np.arange(n), np.full(n, k), state_of, model)
        lost = (piece.verdict == NOT_JUDGED) & ~diverged
        finite = [all(np.isfinite(x[i]).all() for x in frame.state.values()) for i in range(n)]
        causes = ("state before the step", "forces or acceleration")
        lost_worlds = np.flatnonzero(lost).tolist()
        divergences = [Divergence(i, k, causes[finite[i]], not finite[i]) for i in lost_worlds]
        diverged |= lost
        yield piece._replace(divergences=divergences)
