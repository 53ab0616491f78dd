"""Record the steps of a MuJoCo simulation as a folder of problems, each with the engine's own answer."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any
from zipfile import BadZipFile

import numpy as np

from lavender.base.arrays import FloatArray, as_array, check_choice, check_float, check_int
from lavender.base.errors import InputError, LavenderError
from lavender.io import mujoco as adapter
from lavender.io import npz
from lavender.io.states import read_states
from lavender.io.stored import ENGINE, SUFFIXES, as_path, lock_step_folder, read_first_bytes, write_text
from lavender.judge.residuals import AT_FLOOR, DEFAULT_THRESHOLD, UNCONVERGED, WRONG, residual
from lavender.problem import PRECISIONS, Problem

CONTROLS = ("zero", "random")
Control = str | Callable[[Any, Any, int], Any] | Any


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
        Verdict, velocity error and row of the worst answer.
    """

    folder: Path
    files: tuple[str, ...]
    without: int
    left_out: tuple[str, ...] = field(default=())
    above_floor: int = 0
    stopped: int = 0
    threshold: float = DEFAULT_THRESHOLD
    worst: str = ""

    def __str__(self) -> str:
        unconstrained = f", {self.without} steps without constraints" if self.without else ""
        failed = f", {len(self.left_out)} left out: {self.left_out[0]}" if self.left_out else ""
        written = f"{len(self.files)} problems in {self.folder}{unconstrained}{failed}"
        if not self.above_floor:
            return written
        worst = f"; the worst {self.worst}" if self.stopped else ""
        return (
            f"{written}\nMuJoCo's own answers: {self.above_floor} above their floor, {self.stopped} more than "
            f"{self.threshold:g} m/s off{worst}"
        )


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
    islands than it counts, 20), the time of both [s], and the judge's result: residual, velocity error [m/s], worst
    row, round-off floor of the precision, and verdict. A step in which MuJoCo's solver stopped before convergence is
    written with that verdict. A step that cannot be exported has no file; its line holds the reason as `left_out`,
    which is reported with every measurement of the other steps.

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
        Start states (`lavender.io.states`): the steps are divided evenly among them. The first step from a state uses
        its controls, if it has any. Default: `data` as it is.
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
    mj = adapter._check_model(model, data)[0].mj
    steps, every = check_int("steps", steps, 1), check_int("every", every, 1)
    precision = check_choice("precision", precision, PRECISIONS)
    threshold = check_float("threshold", threshold, low=0.0)
    control_at = make_controller(model, control, seed)
    starts = None if states is None else read_states(mj, model, states).select_evenly(steps)
    firsts = {} if starts is None else {steps * i // len(starts): i for i in range(len(starts))}
    records: list[dict[str, Any]] = []
    left_out: list[dict[str, Any]] = []
    without = 0
    width = len(str(steps))
    with lock_step_folder(folder, replace) as folder:
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
            file = folder / f"step_{step + 1:0{width}d}.npz"
            try:
                result = _solve_step(mj, model, data, f"step {step + 1}", precision, threshold)
            except LavenderError as error:
                left_out.append({"file": file.name, "step": step + 1, "left_out": str(error)})
                continue
            if result is None:
                without += 1
                continue
            problem, impulse, facts = result
            npz.write(problem, file, impulse=impulse)
            records.append({"file": file.name, "step": step + 1, **facts})
        write_text(folder / ENGINE, "".join(f"{json.dumps(line)}\n" for line in (*records, *left_out)))
    above_threshold = [line for line in records if line["verdict"] in (UNCONVERGED, WRONG)]
    worst = max(above_threshold, key=lambda line: float(line["velocity"]), default=None)
    short = ""
    if worst is not None:
        verdict = UNCONVERGED if worst["verdict"] == UNCONVERGED else f"is {WRONG}"
        short = f"{verdict}, {worst['velocity']:.2g} m/s off at {worst['worst']} (step {worst['step']})"
    return Recording(
        folder=folder,
        files=tuple(line["file"] for line in records),
        without=without,
        left_out=tuple(f"step {line['step']}: {line['left_out']}" for line in left_out),
        above_floor=sum(line["verdict"] != AT_FLOOR for line in records),
        stopped=len(above_threshold),
        threshold=threshold,
        worst=short,
    )


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
    judged = residual(problem, impulse, threshold=threshold)
    facts = {
        "rows": problem.m, "iterations": iterations, "seconds": seconds,
        "noslip_iterations": None if iterations is None or total is None else total - iterations,
        "relative": judged.relative, "velocity": judged.velocity, "worst": judged.worst_name,
        "floor": judged.roundoff_floor, "verdict": judged.verdict, "precision": precision, "threshold": threshold,
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
    mj, path = adapter.import_mujoco(), str(as_path(path))
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
    except (OSError, ValueError, EOFError, BadZipFile) as error:
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
