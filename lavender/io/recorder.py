"""Record problems in a folder, of any simulation loop (`Recorder`) or of the steps of a MuJoCo model (`record`).

    with lavender.io.Recorder("failing", keep_worst=16, when=lambda v: v.verdict == "wrong") as recorder:
        for _ in range(10_000):
            scene.step()
            recorder.add(lavender.io.from_genesis(scene), state={"qpos": scene.get_qpos()})

The folder holds a problem file for each recorded world and step with the engine's impulse, `engine.jsonl` with a line
of JSON for each (verdict, errors, the engine's claims), and `states` with the states (docs/formats.md).
`lavender report`, `lavender check` and `lavender explain` read it.

`read_states` reads start states of a MuJoCo simulation. A file holds `state`, with a vector of mjSTATE_INTEGRATION in
each row, or arrays with the names of MjData, of which qpos and qvel are required. Only the vector contains all that a
step depends on (warm start, controls, mocap bodies, applied forces, the state of plug-ins), except which trees sleep:
MuJoCo wakes all trees when a state is set. Quantities without an array have the values of a new MjData.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import heapq
import json
import os
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from lavender.base.arrays import (
    FloatArray,
    as_array,
    check_bool,
    check_choice,
    check_float,
    check_int,
    to_numpy,
)
from lavender.base.errors import InputError, LavenderError
from lavender.batch.data import Batch
from lavender.batch.residuals import residual_many
from lavender.io import mujoco as adapter
from lavender.io.engine_step import Claims, EngineStep
from lavender.io.mujoco_memory import import_mujoco, read_step
from lavender.io.stored import (
    ENGINE,
    STATES_FOLDER,
    SUFFIXES,
    Archive,
    as_path,
    lock_step_folder,
    make_folder,
    read_first_bytes,
    write_arrays,
    write_npz,
    write_text,
)
from lavender.judge.residuals import AT_FLOOR, DEFAULT_THRESHOLD, UNCONVERGED, WRONG, residual
from lavender.problem import PRECISIONS, Problem

CONTROLS = ("zero", "random")
Control = str | Callable[[Any, Any, int], Any] | Any
KEYFRAMES = "keyframes"
VECTOR = "state"
NEEDED = ("qpos", "qvel")
OPTIONAL = (
    "act", "ctrl", "qacc_warmstart", "time", "mocap_pos", "mocap_quat", "userdata", "eq_active", "qfrc_applied",
    "xfrc_applied",
)  # fmt: skip
LABELS = ("world", "step")  # Additional arrays in the files of `lavender audit`: the origin of each state.


def describe_answer(problem: Problem, impulse: Any, threshold: float) -> dict[str, Any]:
    """Return the entries of a line of `engine.jsonl` that follow from a problem and the engine's impulse (m,) [N s]."""
    judged = residual(problem, impulse, threshold=threshold)
    return {
        "rows": problem.m, "relative": judged.relative, "velocity": judged.velocity, "worst": judged.worst_name,
        "floor": judged.roundoff_floor, "verdict": judged.verdict, "precision": problem.precision,
        "threshold": threshold,
    }  # fmt: skip


def write_lines(folder: Path, lines: Iterable[Mapping[str, Any]]) -> None:
    """Write the lines of `engine.jsonl`."""
    write_text(folder / ENGINE, "".join(f"{json.dumps(line)}\n" for line in lines))


# -- any loop ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StepVerdict:
    """Verdict about the engine's answer for one world in one step; `Recorder` passes it to `when`.

    Parameters
    ----------
    step, world : int
        Number of the call of `add`, from 0, and the world's index in it.
    rows : int
    velocity_error : float, m/s
        Velocity error of the worst row; NaN if the world cannot be judged.
    relative : float
        Relative residual [-].
    verdict : str
        As `Residual.verdict`; "" if the world cannot be judged.
    claimed : bool or None
        Whether the engine reports convergence; None if it makes no claim.
    """

    step: int
    world: int
    rows: int
    velocity_error: float
    relative: float
    verdict: str
    claimed: bool | None = None


class Recorder:
    """Write problems of a simulation loop to a folder.

    A world of a step is recorded if at least one of `every`, `when` and `keep_worst` selects it.

    Parameters
    ----------
    folder : path
        Created if it does not exist. It is locked until `close`, or until the end of a `with` block.
    every : int, optional
        Record all worlds of every k-th step.
    keep_worst : int, default 0
        Keep the k answers with the largest velocity errors so far; files of answers that are no longer among them are
        removed, unless `every` or `when` selected them.
    when : callable, optional
        Called with the `StepVerdict` of each world; a true result selects it.
    threshold : float, default 1e-4 m/s
        Velocity error up to which an answer is close enough (`Residual.verdict`).
    solver : str, default "engine"
        Name of the engine's solver in the records.
    replace : bool, default False
        Whether to remove the problem files of another recording from the folder; if false, such files raise an error.

    Raises
    ------
    InputError
        No world can be selected, an argument is invalid, or the folder holds a recording or cannot be written.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        *,
        every: int | None = None,
        keep_worst: int = 0,
        when: Callable[[StepVerdict], object] | None = None,
        threshold: float = DEFAULT_THRESHOLD,
        solver: str = "engine",
        replace: bool = False,
    ) -> None:
        self.every = None if every is None else check_int("every", every, 1)
        self.keep_worst, self.threshold = (
            check_int("keep_worst", keep_worst),
            check_float("threshold", threshold, low=0.0),
        )
        if when is not None and not callable(when):
            raise InputError(f"when is {when!r:.60}; a function of a StepVerdict is needed")
        if self.every is None and not self.keep_worst and when is None:
            raise InputError(
                "no condition selects steps, so that nothing would be recorded: give every=, keep_worst= "
                "or when="
            )
        self.when, self.solver, self.n_steps = when, solver, 0
        self._stack = contextlib.ExitStack()
        self.folder = self._stack.enter_context(lock_step_folder(folder, check_bool("replace", replace)))
        self._lines: dict[str, dict[str, Any]] = {}
        # Heap of (velocity error, file) with the smallest error first.
        self._worst: list[tuple[float, str]] = []
        self._unjudged: set[int] = set()  # Worlds with a line about their first step that cannot be judged.
        self._removed: list[str] = []  # Files without a line, to be deleted after the lines are written.
        self._is_closed = False

    def __repr__(self) -> str:
        return f"<Recorder of {self.folder}: {self.n_steps} steps, {len(self.files)} files>"

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the folder's lock; the recording is complete after each `add`."""
        self._is_closed = True
        self._stack.close()

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the problem files."""
        return tuple(name for name, line in self._lines.items() if "left_out" not in line)

    def add(
        self,
        problems: EngineStep | Batch | Problem | tuple[Any, Any],
        impulse: Any = None,
        *,
        claims: Claims | None = None,
        state: Mapping[str, Any] | None = None,
    ) -> list[StepVerdict]:
        """Judge one step of all worlds and record the selected ones.

        Parameters
        ----------
        problems : EngineStep, Batch or Problem, or a pair of one of the latter two and the impulses
            Results of `from_kamino`, `from_genesis`, `from_efc`, `from_mujoco_many` and `from_mujoco`.
        impulse : array, N s
            The engine's answer, unless `problems` contains it.
        claims : Claims, optional
            The engine's claims, unless `problems` contains them.
        state : dict of arrays, optional
            State before the step: names and arrays of numbers or texts. Arrays have one entry for each world of a batch
            in their first dimension.

        Returns
        -------
        list of StepVerdict
            One for each world.

        Raises
        ------
        InputError
            The impulses are missing or have another shape, a state has another number of worlds or holds objects, or
            the recorder is closed: nothing of the step is then recorded. Or a file cannot be written. Worlds that
            cannot be judged raise no error; their first step has a line with the reason.
        """
        if self._is_closed:
            raise InputError(
                f"the recording {self.folder} is closed: call add before close, or make another Recorder"
            )
        if isinstance(problems, EngineStep):
            state = problems.state if state is None else state
            problems, impulse, claims = problems[:3]
        elif isinstance(problems, tuple):
            problems, impulse = problems
        if impulse is None:
            raise InputError("impulse is missing: give the engine's answer [N s] to judge")
        verdicts, reasons = self._judge_worlds(problems, impulse, claims)
        states = self._split_states(state, len(verdicts), isinstance(problems, Problem))
        changed = False
        for verdict in verdicts:
            changed |= self._record_selected_world(
                verdict, problems, impulse, claims, states, reasons.get(verdict.world, "")
            )
        if changed:
            write_lines(self.folder, self._lines.values())
        # If the process is killed before, files have no line, which no reader needs.
        for name in self._removed:
            for path in (self.folder / name, self.folder / STATES_FOLDER / name):
                Path(path).unlink(missing_ok=True)
        self._removed.clear()
        self.n_steps += 1
        return verdicts

    def _judge_worlds(
        self, problems: Any, impulse: Any, claims: Claims | None
    ) -> tuple[list[StepVerdict], dict[int, str]]:
        """Return the verdict of each world, and the reasons why worlds could not be judged."""
        if isinstance(problems, Problem):
            own = residual(problems, impulse, threshold=self.threshold)
            rows, numbers, reasons = [problems.m], [(own.velocity, own.relative, own.verdict)], {}
        elif isinstance(problems, Batch):
            many = residual_many(problems, impulse, threshold=self.threshold, errors="status")
            rows = problems.row_counts.tolist()
            numbers = list(
                zip(many.velocity_error.tolist(), many.relative.tolist(), many.verdict.tolist(), strict=True)
            )
            reasons = {i: str(error) for i, error in many.faults.items()}
        else:
            raise InputError(
                f"problems is a {type(problems).__name__}; a Problem, a Batch or the result of an importer is needed"
            )
        claimed = [None] * len(rows) if claims is None else claims.converged.tolist()
        verdicts = [
            StepVerdict(self.n_steps, i, rows[i], *numbers[i], claimed=claimed[i]) for i in range(len(rows))
        ]
        return verdicts, reasons

    def _split_states(
        self, state: Mapping[str, Any] | None, n: int, is_single: bool
    ) -> Callable[[int], dict[str, Any]] | None:
        """Return a function that returns the state of a world, or None without states."""
        if state is None:
            return None
        if not isinstance(state, Mapping) or not all(
            isinstance(name, str) and name and not set(name) & {"/", "\\", "\0"} for name in state
        ):
            raise InputError(
                f"state is {state!r:.60}; a dict of arrays is needed, with texts without / and \\ as names"
            )
        arrays = {name: np.asarray(to_numpy(f"state {name!r}", x)) for name, x in state.items()}
        for name, x in arrays.items():
            if x.dtype.hasobject:
                raise InputError(
                    f"state {name!r} holds objects ({x.dtype}), which no reader could load: an array of numbers or "
                    "texts is needed; fill up lists of different lengths"
                )
        if is_single:
            return lambda i: arrays
        for name, x in arrays.items():
            if x.ndim == 0 or len(x) != n:
                raise InputError(
                    f"state {name!r} has shape {x.shape}; a first dimension of {n} worlds is needed"
                )
        return lambda i: {name: x[i] for name, x in arrays.items()}

    def _record_selected_world(
        self,
        verdict: StepVerdict,
        problems: Any,
        impulse: Any,
        claims: Claims | None,
        states: Any,
        reason: str,
    ) -> bool:
        """Record a world of this step if it is selected; return whether the records changed."""
        i, error = verdict.world, verdict.velocity_error
        is_selected = self.every is not None and verdict.step % self.every == 0
        is_selected = bool(self.when is not None and self.when(verdict)) or is_selected
        name = f"step_{verdict.step:06d}_world_{i:04d}.npz"
        if reason:
            if not is_selected and i in self._unjudged:
                return False
            self._unjudged.add(i)
            self._lines[name] = {"file": name, "step": verdict.step, "world": i, "left_out": reason}
            return True
        is_worst = self.keep_worst > 0 and verdict.rows > 0 and (
            len(self._worst) < self.keep_worst or error > self._worst[0][0]
        )  # fmt: skip
        if not (is_selected or is_worst) or verdict.rows == 0:
            return False
        is_single = isinstance(problems, Problem)
        problem = problems if is_single else problems[i]
        lam = to_numpy("impulse", impulse)
        own = lam if is_single else lam.reshape(-1)[problems.rows_of(i)]
        try:
            line: dict[str, Any] = {
                "file": name, "step": verdict.step, "world": i, "solver": self.solver, "seconds": float("nan"),
                **describe_answer(problem, own, self.threshold),
            }  # fmt: skip
            if states is not None:
                write_arrays(make_folder(self.folder / STATES_FOLDER) / name, states(i))
            write_npz(problem, self.folder / name, impulse=own)
        except LavenderError as failure:
            self._lines[name] = {"file": name, "step": verdict.step, "world": i, "left_out": str(failure)}
            return True
        if claims is not None:
            line["claimed"], line["iterations"] = bool(claims.converged[i]), int(claims.iterations[i])
            line["claimed_residuals"] = {key: float(x[i]) for key, x in claims.residuals.items()}
        self._lines[name] = line
        if is_worst:
            self._add_to_worst_files(error, name)
        if is_selected:
            line["selected"] = True
        return True

    def _add_to_worst_files(self, error: float, name: str) -> None:
        """Add a file to the `keep_worst` files with the largest errors; remove the one it replaces, unless selected."""
        if len(self._worst) < self.keep_worst:
            heapq.heappush(self._worst, (error, name))
            return
        _, removed = heapq.heapreplace(self._worst, (error, name))
        if not self._lines[removed].get("selected"):
            del self._lines[removed]
            self._removed.append(removed)


def read_recorded_state(folder: str | os.PathLike[str], file: str) -> dict[str, np.ndarray]:
    """Return the state (dict of arrays) that a `Recorder` stored with a problem file of its folder.

    Raises
    ------
    InputError
        The file has no state, or the state cannot be read.
    """
    path = Path(folder) / STATES_FOLDER / file
    if not path.is_file():
        raise InputError(
            f"{path} does not exist, because {file} was recorded without state=; record the steps again "
            "with state="
        )
    try:
        with np.load(path, allow_pickle=False) as stored:
            return dict(stored)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"cannot read the state {path}: {error}; record the steps again") from None


# -- MuJoCo ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Recording:
    """Summary of the files that `record` wrote; `str()` formats it.

    Parameters
    ----------
    folder : path
    files : tuple of str
        Names of the problem files.
    without : int
        Number of selected steps that had no constraints and therefore have no file.
    left_out : tuple of str
        Reasons why steps could not be exported, one line each.
    above_floor : int
        Number of MuJoCo's answers with an error above the round-off floor.
    stopped : int
        Number of MuJoCo's answers with an error above the round-off floor and a velocity error above `threshold`.
    threshold : float, m/s
    worst : str
        Velocity error, row, step and verdict of the worst answer.
    n_starts : int
        Number of start states of the recorded steps; 0 if the recording is one simulation.
    is_interrupted : bool
        Whether Ctrl-C ended the recording early.
    """

    folder: Path
    files: tuple[str, ...]
    without: int
    left_out: tuple[str, ...] = field(default=())
    above_floor: int = 0
    stopped: int = 0
    threshold: float = DEFAULT_THRESHOLD
    worst: str = ""
    n_starts: int = 0
    is_interrupted: bool = False

    def __str__(self) -> str:
        lines = [f"{len(self.files)} problems in {self.folder}"]
        if self.n_starts:
            lines.append(
                f"from {self.n_starts} start states; steps from different states are independent problems"
            )
        if self.without:
            lines.append(f"{self.without} steps without constraints")
        if self.left_out:
            lines.append(f"{len(self.left_out)} left out: {self.left_out[0]}")
        if self.above_floor:
            threshold = f"{self.threshold:g}".replace("e-0", "e-")
            counts = f"{self.above_floor} above their floor, {self.stopped} more than {threshold} m/s off"
            lines.append(f"MuJoCo's own answers: {counts}")
        return "\n".join(lines + ([f"worst: {self.worst}"] if self.stopped else []))


def record(
    model: Any,
    data: Any,
    folder: str | os.PathLike[str],
    steps: int,
    *,
    every: int = 1,
    control: Control = "random",
    seed: int = 0,
    states: Any = None,
    replace: bool = False,
    precision: str = "float64",
    threshold: float = DEFAULT_THRESHOLD,
) -> Recording:
    """Step a MuJoCo simulation and write the problem of every `every`-th step to a file.

    Each file holds the problem with keys of its blocks and MuJoCo's own impulse. `engine.jsonl` has a line for each
    file: file, step, rows, the iterations of the engine's solver and of noslip (in all islands; null if MuJoCo has more
    islands than it counts, 20), the time of both [s], the number of the start state (if `states` are given), and the
    judge's result: residual, velocity error [m/s], worst row, round-off floor of the precision, and verdict. After
    Ctrl-C, the lines and the result describe the steps until then. A step in which MuJoCo's solver stopped before
    convergence is written with that verdict. A step that cannot be exported has no file; its line holds the reason as
    `left_out`, which is reported with every measurement of the other steps.

    Parameters
    ----------
    model : mujoco.MjModel
    data : mujoco.MjData
        Initial state; it is advanced by the steps.
    folder : path
        Created if it does not exist.
    steps : int
        Steps of the simulation.
    every : int
    control : {"random", "zero"}, array (any, nu), or callable (model, data, step)
        "random" draws uniformly within the ranges of the actuators. An array has the controls of consecutive steps and
        is repeated from its start when it ends. The result of a callable is written to `data.ctrl`, unless it is None.
    seed : int
        Seed of "random".
    states : path of an .npz, "keyframes", or arrays, optional
        Start states (`read_states`): the steps are divided evenly among them. The first step from a state uses
        its controls, if it has any. Steps from different states are independent problems. Default: `data` as it is.
    replace : bool
        Whether to remove the problem files of another recording from the folder; if false, such files raise an error.
    precision : {"float64", "float32"}
        Precision in which this MuJoCo computes (`mjtNum`); written with each problem.
    threshold : float, m/s
        Velocity error up to which MuJoCo's answer is close enough.

    Returns
    -------
    Recording

    Raises
    ------
    InputError
        The arguments are not a model and its data; `steps` or `every` is below 1; the control, precision or threshold
        is invalid; the folder holds a recording; MuJoCo raises an error (out of memory, an unsupported feature).
    """
    mj = read_step(model, data).cache.mj
    steps, every = check_int("steps", steps, 1), check_int("every", every, 1)
    precision = check_choice("precision", precision, PRECISIONS)
    threshold = check_float("threshold", threshold, low=0.0)
    control_at = make_controller(model, control, seed)
    starts = None if states is None else read_states(mj, model, states).select_evenly(steps)
    records: list[dict[str, Any]] = []
    left_out: list[dict[str, Any]] = []
    without, is_interrupted = 0, False
    width, file = len(str(steps)), Path()
    with lock_step_folder(folder, replace) as folder:
        try:
            for step, start in iterate_steps(mj, model, data, steps, every, control_at, starts):
                file = folder / f"step_{step:0{width}d}.npz"
                line = {"file": file.name, "step": step} | ({} if starts is None else {"start": start})
                try:
                    result = _solve_step(mj, model, data, f"step {step}", precision, threshold)
                except LavenderError as error:
                    left_out.append({**line, "left_out": str(error)})
                    continue
                if result is None:
                    without += 1
                    continue
                problem, impulse, facts = result
                write_npz(problem, file, impulse=impulse)
                records.append({**line, **facts})
        except KeyboardInterrupt:
            if not records:
                raise
            is_interrupted = True
            if records[-1]["file"] != file.name:
                file.unlink(missing_ok=True)  # A file without a line would belong to another recording.
        write_lines(folder, (*records, *left_out))
    above_threshold = [line for line in records if line["verdict"] in (UNCONVERGED, WRONG)]
    worst = max(above_threshold, key=lambda line: float(line["velocity"]), default=None)
    short = ""
    if worst is not None:
        verdict = "it " + (UNCONVERGED if worst["verdict"] == UNCONVERGED else f"is {WRONG}")
        short = f"{worst['velocity']:.2g} m/s off at {worst['worst']}, step {worst['step']}: {verdict}"
    return Recording(
        folder=folder,
        files=tuple(line["file"] for line in records),
        without=without,
        left_out=tuple(f"step {line['step']}: {line['left_out']}" for line in left_out),
        above_floor=sum(line["verdict"] != AT_FLOOR for line in records),
        stopped=len(above_threshold),
        threshold=threshold,
        worst=short,
        n_starts=len({line["start"] for line in records if "start" in line}),
        is_interrupted=is_interrupted,
    )


def iterate_steps(
    mj: Any, model: Any, data: Any, steps: int, every: int, control_at: Callable[..., Any], starts: Any
) -> Iterator[tuple[int, int]]:
    """Step a simulation; yield the numbers of every `every`-th step and of its start state.

    `data` then has the constraints of the state after the step. The steps are divided evenly among the start states.
    The first step from a state uses its controls, if it has any.
    """
    firsts = {} if starts is None else {steps * i // len(starts): i for i in range(len(starts))}
    i = 0
    for step in range(steps):
        ctrl = control_at(data, step)
        if starts is not None and step in firsts:
            i = firsts[step]
            mj.mj_setState(model, data, starts.vectors[i], mj.mjtState.mjSTATE_INTEGRATION)
            ctrl = ctrl if starts.controls is None else starts.controls[i]
        if ctrl is not None:
            data.ctrl[:] = ctrl
        try:
            mj.mj_step(model, data)
            if (step + 1) % every:
                continue
            mj.mj_forward(model, data)
        except mj.FatalError as error:
            raise InputError(f"step {step + 1}: MuJoCo raised an error, {error}") from None
        yield step + 1, i


def _solve_step(
    mj: Any, model: Any, data: Any, name: str, precision: str, threshold: float
) -> tuple[Problem, FloatArray, dict[str, Any]] | None:
    """Solve the constraints of the present state with MuJoCo without advancing time; return None without constraints.

    Returns
    -------
    (Problem, (m,) N s, dict) or None
        The problem, MuJoCo's impulse, and the record of both.
    """
    # The same solve from the same warm start, without noslip, has the iterations of the solver alone.
    noslip, iterations = int(model.opt.noslip_iterations), None
    if noslip > 0:
        model.opt.noslip_iterations = 0
        try:
            mj.mj_fwdConstraint(model, data)
        finally:
            model.opt.noslip_iterations = noslip
        iterations = count_iterations(data)
    start = perf_counter()
    mj.mj_fwdConstraint(model, data)
    seconds = perf_counter() - start
    total = count_iterations(data)
    iterations = iterations if noslip > 0 else total
    if int(data.nefc) == 0:
        return None
    problem = adapter.from_mujoco(model, data, name=name)
    problem = dataclasses.replace(problem, precision=precision, copy=False)
    impulse = adapter.impulse(model, data)
    facts = describe_answer(problem, impulse, threshold) | {
        "iterations": iterations, "seconds": seconds,
        "noslip_iterations": None if iterations is None or total is None else total - iterations,
        "solver": mj.mjtSolver(int(model.opt.solver)).name.removeprefix("mjSOL_"),
    }  # fmt: skip
    return problem, impulse, facts


def count_iterations(data: Any) -> int | None:
    """Return MuJoCo's iterations in all islands, with those of noslip; None if it has not counted all islands."""
    return int(np.sum(data.solver_niter)) if data.nisland <= len(data.solver_niter) else None


def record_file(
    path: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    steps: int,
    *,
    control: Control = "random",
    **options: Any,
) -> Recording:
    """Call `record` for a model file (MJCF); an array of controls may also be given as a file (.npy).

    Raises
    ------
    InputError
        `record` raises it, or no step had a constraint that could be exported.
    """
    mj, model = load_model(path)
    result = record(model, mj.MjData(model), folder, steps, control=load_controls(control), **options)
    if not result.files:
        why = f" ({result.left_out[0]})" if result.left_out else ": more steps, or other controls"
        raise InputError(f"{path}: no step had a constraint that could be recorded{why}")
    return result


def load_model(path: str | os.PathLike[str]) -> tuple[Any, Any]:
    """Return the module mujoco and the model of a file (MJCF).

    Raises
    ------
    InputError
        MuJoCo is not installed, or cannot read the file, or the file is a problem.
    """
    mj, path = import_mujoco(), str(as_path(path))
    if Path(path).suffix.lower() in SUFFIXES:
        raise InputError(
            f"{path} has the suffix of a problem file; a model of MuJoCo (MJCF) is needed: `lavender check` and "
            "`lavender report` read problems"
        )
    try:
        return mj, mj.MjModel.from_xml_path(path)
    except ValueError as error:  # MuJoCo raises it for a file that it cannot read.
        raise InputError(f"{path}: {error}") from None


def load_controls(control: Control) -> Control:
    """Return controls for `record`: the array of a file (.npy), or `control` unchanged."""
    return _load_controls_npy(control) if isinstance(control, str) and control not in CONTROLS else control


def _load_controls_npy(path: str) -> Any:
    """Return the array of a .npy file; raise InputError if it cannot be read or holds several arrays."""
    try:
        read_first_bytes(path)  # Raises an error if `path` is not a regular file.
        # A memory map cannot be longer than the file, whatever size the header declares.
        result = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            f"controls {path} cannot be read ({error}); one of {', '.join(CONTROLS)}, or a .npy file of one "
            "array, is needed"
        ) from None
    if not isinstance(result, np.ndarray):
        result.close()
        raise InputError(
            f"controls {path}: it is an archive of several arrays; a .npy file of one array is needed"
        )
    return result


def make_controller(model: Any, control: Control, seed: int) -> Callable[[Any, int], FloatArray | None]:
    """Return a function (data, step) -> controls (nu,) or None; see `record`."""
    n = int(model.nu)
    if callable(control):
        call: Callable[[Any, Any, int], Any] = control

        def called(data: Any, step: int) -> FloatArray | None:
            values = call(model, data, step)
            return None if values is None else as_array(f"control of step {step}", values, (n,))

        return called
    if isinstance(control, str):
        if control not in CONTROLS:
            raise InputError(
                f"control is {control!r}; one of {', '.join(CONTROLS)}, an array or a function is needed"
            )
        if control == "zero":
            return lambda data, step: np.zeros(n)
        rng = np.random.default_rng(check_int("seed", seed, high=None))
        limited = np.array(model.actuator_ctrllimited, bool)[:, None]
        low, high = np.where(limited, np.array(model.actuator_ctrlrange), [-1.0, 1.0]).T
        return lambda data, step: rng.uniform(low, high)
    rows = as_array("control", control, (None, n))
    if len(rows) == 0:
        raise InputError(f"control has shape {rows.shape}; (any, {n}) with at least one row is needed")
    return lambda data, step: rows[step % len(rows)]


# -- start states of MuJoCo ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class StartStates:
    """States in which simulations start.

    Parameters
    ----------
    vectors : (n, size)
        State vectors of mjSTATE_INTEGRATION, as `mj_getState` returns them.
    controls : (n, nu), optional
        Controls of the first step; None if the source has none.
    missing : tuple of str
        Quantities on which a step depends and that arrays of states lack: "warm start", "controls".
    """

    vectors: FloatArray
    controls: FloatArray | None = None
    missing: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.vectors)

    def select_evenly(self, count: int) -> StartStates:
        """Return at most `count` of the states, evenly spaced."""
        if len(self) <= count:
            return self
        chosen = np.arange(count) * len(self) // count
        controls = None if self.controls is None else self.controls[chosen]
        return dataclasses.replace(self, vectors=self.vectors[chosen], controls=controls)


def can_sleep(mj: Any, model: Any) -> bool:
    """Return whether the model has <flag sleep="enable"/>."""
    flag = getattr(mj.mjtEnableBit, "mjENBL_SLEEP", 0)
    return bool(model.opt.enableflags & int(flag))


def without_sleep(mj: Any, model: Any) -> Any:
    """Return a copy of the model with <flag sleep="disable"/>, or the model itself if it has this flag.

    A state does not contain which trees sleep. A simulation whose steps are repeated from states must not use sleep.
    """
    if not can_sleep(mj, model):
        return model
    awake = copy.copy(model)
    awake.opt.enableflags &= ~int(mj.mjtEnableBit.mjENBL_SLEEP)
    return awake


def read_states(mj: Any, model: Any, source: Any) -> StartStates:
    """Read start states.

    Parameters
    ----------
    mj : module
        MuJoCo.
    model : mujoco.MjModel
    source : path of an .npz, "keyframes", mapping of arrays, array (n, size), or StartStates

    Returns
    -------
    StartStates

    Raises
    ------
    InputError
        The file cannot be read, or its arrays do not fit the model; a number is not finite; the model has no
        keyframes.
    """
    if isinstance(source, StartStates):
        return source
    if isinstance(source, str) and source == KEYFRAMES:
        return _read_keyframes(mj, model)
    if isinstance(source, (str, os.PathLike)):
        read_first_bytes(source)  # Raises an error if `source` is not a regular file.
        with contextlib.closing(Archive(source)) as archive:
            return _read_arrays(mj, model, dict(archive), f"states {os.fspath(source)}")
    arrays = source if isinstance(source, Mapping) else {VECTOR: source}
    return _read_arrays(mj, model, arrays, "states")


def check_array_names(source: str, names: Iterable[str], valid: Iterable[str]) -> None:
    """Raise InputError at the first name that is neither valid nor one of `LABELS`; `source` begins the message."""
    valid = tuple(valid)
    for name in names:
        if name not in (*valid, *LABELS):
            raise InputError(
                f"{source} has an array {name!r}, which is not part of a state; the arrays of a state are "
                f"{', '.join(valid)}: remove or rename it"
            )


def _read_keyframes(mj: Any, model: Any) -> StartStates:
    """Return the model's keyframes; raise InputError if it has none."""
    if not model.nkey:
        raise InputError(
            "states are 'keyframes', but the model has no keyframes; give an .npz file of states, or add "
            "keyframes to the model"
        )
    data, vectors = mj.MjData(model), []
    for key in range(model.nkey):
        mj.mj_resetDataKeyframe(model, data, key)
        vectors.append(_read_state_vector(mj, model, data))
    return StartStates(np.array(vectors), np.array(model.key_ctrl, float).reshape(model.nkey, model.nu))


def _read_arrays(mj: Any, model: Any, arrays: Mapping[str, Any], source: str) -> StartStates:
    """Build states from arrays by name; `source` begins the error messages."""
    check_array_names(source, arrays, (VECTOR, *NEEDED, *OPTIONAL))
    if VECTOR in arrays:
        return _read_vectors(mj, model, arrays[VECTOR], source)
    missing = [name for name in NEEDED if name not in arrays]
    if missing:
        raise InputError(
            f"{source} has no {' and no '.join(missing)}; {VECTOR!r}, or qpos and qvel, are needed"
        )
    data = mj.MjData(model)
    parts: dict[str, FloatArray] = {}
    for name in (*NEEDED, *OPTIONAL):
        if name in arrays:
            shape = np.shape(getattr(data, name))
            values = np.asarray(arrays[name])
            values = values[None] if values.ndim == len(shape) else values
            parts[name] = as_array(f"{source}: {name}", values, (None, *shape))
    counts = {name: len(x) for name, x in parts.items()}
    n = counts["qpos"]
    if n == 0 or set(counts.values()) != {n}:
        sizes = ", ".join(f"{count} of {name}" for name, count in counts.items())
        raise InputError(
            f"{source} holds states of different numbers: {sizes}; all arrays must have the same number of "
            "entries, at least one"
        )
    vectors = []
    for i in range(n):
        data = mj.MjData(model)
        for name, x in parts.items():
            if name == "time":
                data.time = float(x[i])
            else:
                getattr(data, name)[:] = x[i]
        vectors.append(_read_state_vector(mj, model, data))
    has = {"warm start": "qacc_warmstart" in parts, "controls": "ctrl" in parts or not model.nu}
    absent = tuple(name for name, is_present in has.items() if not is_present)
    return StartStates(np.array(vectors), parts.get("ctrl"), absent)


def _read_vectors(mj: Any, model: Any, states: Any, source: str) -> StartStates:
    """Build states from vectors (n, size) of mjSTATE_PHYSICS, mjSTATE_FULLPHYSICS or mjSTATE_INTEGRATION."""
    integration = mj.mjtState.mjSTATE_INTEGRATION
    kinds = {mj.mj_stateSize(model, kind): kind for kind in
             (mj.mjtState.mjSTATE_PHYSICS, mj.mjtState.mjSTATE_FULLPHYSICS, integration)}  # fmt: skip
    states = np.asarray(states)
    states = as_array(f"{source}: {VECTOR}", states[None] if states.ndim == 1 else states, (None, None))
    n, size = states.shape
    if size not in kinds or n == 0:
        raise InputError(
            f"{source}: {VECTOR} has shape {states.shape}; (n, {mj.mj_stateSize(model, integration)}) of "
            "mjSTATE_INTEGRATION, n at least 1, is needed for this model"
        )
    vectors, controls = [], []
    for state in states:
        data = mj.MjData(model)
        mj.mj_setState(model, data, state, kinds[size])
        vectors.append(_read_state_vector(mj, model, data))
        controls.append(np.array(data.ctrl))
    if kinds[size] == integration:
        return StartStates(np.array(vectors), np.array(controls))
    return StartStates(np.array(vectors), missing=("warm start", *(("controls",) if model.nu else ())))


def _read_state_vector(mj: Any, model: Any, data: Any) -> FloatArray:
    kind = mj.mjtState.mjSTATE_INTEGRATION
    vector = np.empty(mj.mj_stateSize(model, kind))
    mj.mj_getState(model, data, vector, kind)
    return vector
