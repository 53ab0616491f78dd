"""Step a MuJoCo simulation and record the problem of every n-th step in a folder."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_choice, check_float, check_int
from lavender.base.errors import InputError, LavenderError
from lavender.io import mujoco as adapter
from lavender.io.mujoco_memory import read_step
from lavender.io.recorder import Recorder, describe_answer
from lavender.io.start_states import (
    Control,
    load_controls,
    load_model,
    make_controller,
    read_states,
)
from lavender.judge.residuals import AT_FLOOR, DEFAULT_THRESHOLD, UNCONVERGED, WRONG
from lavender.problem import PRECISIONS, Problem


@dataclass(frozen=True)
class Recording:
    """Result of `record`; `str()` is a summary.

    Parameters
    ----------
    folder : path
    lines : tuple of dict
        Lines of `engine.jsonl`: each selected step with constraints, in order. A step without a file has `left_out`.
    without : int
        Number of selected steps that had no constraints and therefore have no line.
    is_interrupted : bool
        Whether Ctrl-C ended the recording early.
    """

    folder: Path
    lines: tuple[dict[str, Any], ...]
    without: int = 0
    is_interrupted: bool = False

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the problem files."""
        return tuple(line["file"] for line in self.lines if "left_out" not in line)

    @property
    def left_out(self) -> tuple[str, ...]:
        """Reasons why steps could not be exported, one line each."""
        return tuple(
            f"step {line['step']}: {line['left_out']}" for line in self.lines if "left_out" in line
        )

    def __str__(self) -> str:
        judged = [line for line in self.lines if "left_out" not in line]
        above = [line for line in judged if line["verdict"] != AT_FLOOR]
        far = [line for line in above if line["verdict"] in (UNCONVERGED, WRONG)]
        text = [f"{len(judged)} problems in {self.folder}"]
        if starts := {line["start"] for line in judged if "start" in line}:
            text.append(
                f"from {len(starts)} start states; steps from different states are independent problems"
            )
        if self.without:
            text.append(f"{self.without} steps without constraints")
        if self.left_out:
            text.append(f"{len(self.left_out)} left out: {self.left_out[0]}")
        if above:
            count = f"{len(far)} more than {above[0]['threshold']:g}".replace("e-0", "e-")
            text.append(f"MuJoCo's own answers: {len(above)} above their floor, {count} m/s off")
        if far:
            worst = max(far, key=lambda line: float(line["velocity"]))
            verdict = "it " + (UNCONVERGED if worst["verdict"] == UNCONVERGED else f"is {WRONG}")
            place = f"{worst['velocity']:.2g} m/s off at {worst['worst']}, step {worst['step']}"
            text.append(f"worst: {place}: {verdict}")
        return "\n".join(text)


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
        Start states (`read_states`): the steps are divided evenly among them. The first step from a state has
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
    without = 0
    is_interrupted = False
    width = len(str(steps))
    with Recorder(folder, every=1, threshold=threshold, replace=replace) as recorder:
        try:
            for step, start in iterate_steps(mj, model, data, steps, every, control_at, starts):
                line = {"file": f"step_{step:0{width}d}.npz", "step": step}
                line |= {} if starts is None else {"start": start}
                try:
                    result = _solve_step(mj, model, data, f"step {step}", precision, threshold)
                except LavenderError as error:
                    recorder.leave_out(line, error)
                    continue
                if result is None:
                    without += 1
                    continue
                problem, impulse, facts = result
                gap = adapter.read_gaps(data, problem)
                recorder.write_step(line | facts, problem, impulse, gap=gap)
        except KeyboardInterrupt:
            if not recorder.files:
                raise
            is_interrupted = True
        recorder.write_lines()
    return Recording(recorder.folder, tuple(recorder.lines.values()), without, is_interrupted)


def iterate_steps(
    mj: Any,
    model: Any,
    data: Any,
    steps: int,
    every: int,
    control_at: Callable[..., Any],
    starts: Any,
) -> Iterator[tuple[int, int]]:
    """Step a simulation; yield the numbers of every `every`-th step and of its start state.

    `data` then has the constraints of the state after the step. The steps are divided evenly among the start states.
    The first step from a start state has the constraints of this state under its controls, if it has any, and every
    `every`-th step is counted from there.
    """
    firsts = {} if starts is None else {steps * i // len(starts): i for i in range(len(starts))}
    i = first = 0
    for step in range(steps):
        try:
            if step in firsts:
                i = firsts[step]
                first = step
                mj.mj_setState(model, data, starts.vectors[i], mj.mjtState.mjSTATE_INTEGRATION)
            elif firsts:
                mj.mj_step(model, data)  # From the previous constraints, under their controls.
            ctrl = control_at(data, step)
            if step in firsts and starts.controls is not None:
                ctrl = starts.controls[i]
            if ctrl is not None:
                data.ctrl[:] = ctrl
            if not firsts:
                mj.mj_step(model, data)
            if (step - first if firsts else step + 1) % every:
                continue
            mj.mj_forward(model, data)
        except mj.FatalError as error:
            raise InputError(f"step {step + 1}: MuJoCo raised an error, {error}") from None
        yield step + 1, i


def _solve_step(
    mj: Any, model: Any, data: Any, name: str, precision: str, threshold: float
) -> tuple[Problem, FloatArray, dict[str, Any]] | None:
    """Solve the constraints of the present state with MuJoCo without advancing time.

    Return the problem, MuJoCo's impulse (m,) [N s], and the record of both; None without constraints.
    """
    # The same solve from the same warm start, without noslip, has the iterations of the solver alone.
    noslip = int(model.opt.noslip_iterations)
    iterations = None
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
        "iterations": iterations,
        "seconds": seconds,
        "noslip_iterations": None if iterations is None or total is None else total - iterations,
        "solver": mj.mjtSolver(int(model.opt.solver)).name.removeprefix("mjSOL_"),
    }
    return problem, impulse, facts


def count_iterations(data: Any) -> int | None:
    """Return MuJoCo's iterations in all islands, noslip included; None if it has not counted all islands."""
    return int(np.sum(data.solver_niter)) if data.nisland <= len(data.solver_niter) else None


def record_file(
    path: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    steps: int,
    *,
    control: Control = "random",
    **options: Any,
) -> Recording:
    """Call `record` for a model file (MJCF); an array of controls may also be given as a file (.npy)."""
    mj, model = load_model(path)
    result = record(
        model, mj.MjData(model), folder, steps, control=load_controls(control), **options
    )
    if not result.files:
        every = options.get("every", 1)
        why = f" ({result.left_out[0]})" if result.left_out else ": more steps, or other controls"
        if every > 1 and not result.left_out:
            why += f", or every step (every is {every})"
        raise InputError(f"{path}: no step had a constraint that could be recorded{why}")
    return result
