"""Steps of a MuJoCo simulation as a folder of problems, with the engine's own answer beside each."""

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
from lavender.io.stored import ENGINE, as_path, first_bytes, folder_for_steps, write_text
from lavender.judge.residuals import AT_FLOOR, DEFAULT_THRESHOLD, UNCONVERGED, WRONG, residual
from lavender.problem import PRECISIONS, Problem

CONTROLS = ("zero", "random")
Control = str | Callable[[Any, Any, int], Any] | Any


@dataclass(frozen=True)
class Recording:
    """What `record` wrote; `str()` says it in a line."""

    folder: Path
    files: tuple[str, ...]
    without: int  # steps looked at that had no constraint
    left_out: tuple[str, ...] = field(default=())  # why a step could not be exported, one line each
    above_floor: int = 0  # of MuJoCo's answers, those that rounding does not explain
    stopped: int = 0  # of these, those more than `threshold` off
    threshold: float = DEFAULT_THRESHOLD  # m/s
    worst: str = ""  # verdict of the worst answer, by how much it is off, and where

    def __str__(self) -> str:
        more = f", {self.without} steps without constraints" if self.without else ""
        lost = f", {len(self.left_out)} left out: {self.left_out[0]}" if self.left_out else ""
        made = f"{len(self.files)} problems in {self.folder}{more}{lost}"
        if not self.above_floor:
            return made
        far = f"; the worst {self.worst}" if self.stopped else ""
        return (
            f"{made}\nMuJoCo's own answers: {self.above_floor} above their floor, {self.stopped} more than "
            f"{self.threshold:g} m/s off{far}"
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
    """Step a MuJoCo simulation and keep the problem of every `every`-th step.

    Each file holds the problem with keys of its blocks and MuJoCo's own impulse. `engine.jsonl` has a line for each:
    file, step, rows, the engine's iterations, the time of its constraint solver [s] and, by our judge, its
    residual, velocity error [m/s] and worst row, the floor of its precision and the verdict. A step in which MuJoCo's
    solver stopped before convergence has that verdict and is kept like any other. A step that cannot be exported has no
    file, and `left_out` in its line says why: whatever is measured on the others names it.

    Parameters
    ----------
    model : mujoco.MjModel
    data : mujoco.MjData
        Stepped on, from where it stands.
    folder : path
        Made where it is not.
    steps : int
        Steps of the simulation.
    every : int
    control : {"random", "zero"}, array (any, nu), or callable (model, data, step)
        "random" draws uniformly within the ranges of the actuators. An array is played row by row, again from its
        start where it ends. What a callable returns is written to `data.ctrl`, unless it is None.
    seed : int
        Of "random".
    states : path of an .npz, "keyframes", or arrays, optional
        Start states (`lavender.io.states`): the steps are divided evenly among them. The first step from a state uses
        its controls, if it has any. Default: `data` as it is.
    replace : bool
        Take the problem files of another recording out of the folder, which is refused otherwise.
    precision : {"float64", "float32"}
        In which this MuJoCo computes (`mjtNum`); written with each problem.
    threshold : float, m/s
        Velocity error up to which MuJoCo's answer is close enough.

    Returns
    -------
    Recording

    Raises
    ------
    InputError
        Not a model and its data, `steps` or `every` below 1, another control, precision or threshold, a folder
        that holds a recording; MuJoCo ends in an error (out of memory, what it does not support).
    """
    mj = adapter._mujoco(model, data)[0].mj
    steps, every = check_int("steps", steps, 1), check_int("every", every, 1)
    precision = check_choice("precision", precision, PRECISIONS)
    threshold = check_float("threshold", threshold, low=0.0)
    drive = drive_of(model, control, seed)
    starts = None if states is None else read_states(mj, model, states).take(steps)
    firsts = {} if starts is None else {steps * i // len(starts): i for i in range(len(starts))}
    kept: list[dict[str, Any]] = []
    left_out: list[dict[str, Any]] = []
    without = 0
    width = len(str(steps))
    with folder_for_steps(folder, replace) as folder:
        for step in range(steps):
            ctrl = drive(data, step)
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
                raise InputError(f"step {step + 1}: MuJoCo ends in an error, {error}") from None
            file = folder / f"step_{step + 1:0{width}d}.npz"
            try:
                found = _solved(mj, model, data, f"step {step + 1}", precision, threshold)
            except LavenderError as error:
                left_out.append({"file": file.name, "step": step + 1, "left_out": str(error)})
                continue
            if found is None:
                without += 1
                continue
            problem, own, told = found
            npz.write(problem, file, impulse=own)
            kept.append({"file": file.name, "step": step + 1, **told})
        write_text(folder / ENGINE, "".join(f"{json.dumps(line)}\n" for line in (*kept, *left_out)))
    far = [line for line in kept if line["verdict"] in (UNCONVERGED, WRONG)]
    worst = max(far, key=lambda line: float(line["velocity"]), default=None)
    verdict = UNCONVERGED if worst and worst["verdict"] == UNCONVERGED else f"is {WRONG}"
    short = worst and f"{verdict}, {worst['velocity']:.2g} m/s off at {worst['worst']} (step {worst['step']})"
    return Recording(
        folder=folder,
        files=tuple(line["file"] for line in kept),
        without=without,
        left_out=tuple(f"step {line['step']}: {line['left_out']}" for line in left_out),
        above_floor=sum(line["verdict"] != AT_FLOOR for line in kept),
        stopped=len(far),
        threshold=threshold,
        worst=short or "",
    )


def _solved(
    mj: Any, model: Any, data: Any, name: str, precision: str, threshold: float
) -> tuple[Problem, FloatArray, dict[str, Any]] | None:
    """The problem of a step, MuJoCo's impulse, and what is told of both; None without constraints."""
    start = perf_counter()
    mj.mj_fwdConstraint(model, data)
    seconds = perf_counter() - start
    if int(data.nefc) == 0:
        return None
    problem = adapter.from_mujoco(model, data, name=name)
    problem = dataclasses.replace(problem, precision=precision, copy=False)
    own = adapter.impulse(model, data)
    judged = residual(problem, own, threshold=threshold)
    told = {
        "rows": problem.m, "iterations": int(np.sum(data.solver_niter)), "seconds": seconds,
        "relative": judged.relative, "velocity": judged.velocity, "worst": judged.worst_name,
        "floor": judged.roundoff_floor, "verdict": judged.verdict, "precision": precision, "threshold": threshold,
        "solver": mj.mjtSolver(int(model.opt.solver)).name.removeprefix("mjSOL_"),
    }  # fmt: skip
    return problem, own, told


def record_file(
    path: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    steps: int,
    *,
    control: Control = "random",
    **options: Any,
) -> Recording:
    """`record` of a model by its file (MJCF); an array of controls may be given by its file (.npy), too."""
    mj, made = model_of(path)
    found = record(made, mj.MjData(made), folder, steps, control=control_of(control), **options)
    if not found.files:
        why = f" ({found.left_out[0]})" if found.left_out else ": more steps, or other controls"
        raise InputError(f"{path}: no step had a constraint that could be kept{why}")
    return found


def model_of(path: str | os.PathLike[str]) -> tuple[Any, Any]:
    """MuJoCo, and the model of a file (MJCF).

    Raises
    ------
    InputError
        MuJoCo is not installed, or cannot read the file.
    """
    mj, path = adapter.package(), str(as_path(path))
    try:
        return mj, mj.MjModel.from_xml_path(path)
    except ValueError as error:  # MuJoCo's word about a file that it cannot read
        raise InputError(f"{path}: {error}") from None


def control_of(control: Control) -> Control:
    """Controls as `record` takes them, of a file (.npy) its array."""
    return _controls(control) if isinstance(control, str) and control not in CONTROLS else control


def _controls(path: str) -> Any:
    try:
        first_bytes(path)  # of a regular file
        # as long as the file is, whatever its head says
        found = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise InputError(f"controls {path}: {error}; {', '.join(CONTROLS)}, or a .npy file") from None
    if not isinstance(found, np.ndarray):
        found.close()
        raise InputError(f"controls {path}: an archive of several arrays; a .npy file of one is needed")
    return found


def drive_of(model: Any, control: Control, seed: int) -> Callable[[Any, int], FloatArray | None]:
    """What sets the controls of (data, step); see `record`."""
    n = int(model.nu)
    if callable(control):
        call: Callable[[Any, Any, int], Any] = control

        def called(data: Any, step: int) -> FloatArray | None:
            given = call(model, data, step)
            return None if given is None else as_array(f"control of step {step}", given, (n,))

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
        raise InputError(f"control has shape {rows.shape}; (any, {n}) with a row at least is needed")
    return lambda data, step: rows[step % len(rows)]
