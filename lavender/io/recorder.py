"""Record problems of any simulation loop in a folder.

    with lavender.io.Recorder("failing", keep_worst=16, when=lambda v: v.verdict == "wrong") as recorder:
        for _ in range(10_000):
            scene.step()
            recorder.add(lavender.io.from_genesis(scene), state={"qpos": scene.get_qpos()})

The folder holds a problem file for each recorded world and step with the engine's impulse, `engine.jsonl` with a line
of JSON for each (verdict, errors, the engine's claims), and `states` with the states (docs/formats.md).
`lavender report`, `lavender check` and `lavender explain` read it.
"""

from __future__ import annotations

import heapq
import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lavender.base.arrays import check_float, check_int, to_numpy
from lavender.base.errors import InputError, LavenderError
from lavender.batch.data import Batch
from lavender.batch.residuals import residual_many
from lavender.io.engine_step import Claims, EngineStep
from lavender.io.mujoco import compute_prediction_gap
from lavender.io.npz import write_npz
from lavender.io.stored import (
    ENGINE,
    STATES_FOLDER,
    format_json,
    make_folder,
    prepare_step_folder,
    read_arrays,
    write_arrays,
    write_text,
)
from lavender.io.velocities import reconstruct
from lavender.judge.residuals import DEFAULT_THRESHOLD, residual
from lavender.problem import Problem


def describe_answer(problem: Problem, impulse: Any, threshold: float) -> dict[str, Any]:
    """Return the entries of a line of `engine.jsonl` that follow from a problem and the engine's impulse (m,) [N s]."""
    judged = residual(problem, impulse, threshold=threshold)
    return (
        {
            "rows": problem.m,
            "relative": judged.relative,
            "velocity": judged.velocity,
            "worst": judged.worst_label,
            "floor": judged.roundoff_floor,
            "verdict": judged.verdict,
            "precision": problem.precision,
            "threshold": threshold,
        }
        | ({"lost_digits": judged.lost_digits} if judged.lost_digits else {})
        | ({"moved_by": judged.moved_by} if judged.moved_by != "impulse" else {})
    )


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
    prediction_gap : float, m/s or rad/s
        Largest difference of MuJoCo's velocity after `mj_step` from the one that the judged answer predicts; 0 up to
        rounding, NaN if it is not compared.
    """

    step: int
    world: int
    rows: int
    velocity_error: float
    relative: float
    verdict: str
    claimed: bool | None = None
    prediction_gap: float = float("nan")


class Recorder:
    """Write problems of a simulation loop to a folder.

    A world of a step is recorded if at least one of `every`, `when` and `keep_worst` selects it.

    Parameters
    ----------
    folder : path
        Created if it does not exist.
    every : int, optional
        Record all worlds of every k-th step.
    keep_worst : int, default 0
        Keep the k answers with the largest velocity errors so far; files of answers that are no longer among them are
        removed, unless `every` or `when` selected them.
    when : callable, optional
        Called with the `StepVerdict` of each world; a true result selects it.
    threshold : float, default 1e-6 m/s
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
        self.keep_worst = check_int("keep_worst", keep_worst)
        self.threshold = check_float("threshold", threshold, low=0.0)
        if when is not None and not callable(when):
            raise InputError(f"when is {when!r:.60}; a function of a StepVerdict is needed")
        if self.every is None and not self.keep_worst and when is None:
            raise InputError(
                "no condition selects steps to record: give every=, keep_worst= or when="
            )
        self.when = when
        self.solver = solver
        self.n_steps = 0
        self.folder = prepare_step_folder(folder, replace)
        self.lines: dict[str, dict[str, Any]] = {}  # Lines of `engine.jsonl` by file.
        # Heap of (velocity error, file) with the smallest error first.
        self._worst: list[tuple[float, str]] = []
        self._unjudged: set[int] = (
            set()
        )  # Worlds with a line about their first step that cannot be judged.
        self._removed: list[
            str
        ] = []  # Files without a line, to be deleted after the lines are written.
        self._is_closed = False
        self._has_warned = False  # Of a step that differs from its prediction.

    def __repr__(self) -> str:
        return f"<Recorder of {self.folder}: {self.n_steps} steps, {len(self.files)} files>"

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Reject further steps; the recording is complete after each `add`."""
        self._is_closed = True

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the problem files."""
        return tuple(name for name, line in self.lines.items() if "left_out" not in line)

    def add(
        self,
        problems: EngineStep | Batch | Problem | tuple[Any, Any],
        impulse: Any = None,
        *,
        velocity: Any = None,
        seconds: float | None = None,
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
        velocity : (n, 6), planar (n, 3) or (nv,), m/s, rad/s, optional
            Velocities after the engine's solve, in place of the impulses of a single problem, which `reconstruct`
            computes. Its line has `reconstructed` and `left_over`, the largest velocity that no impulse explains.
        seconds : float, s, optional
            Time of the engine's solve of the step.
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
            raise InputError(f"the recording {self.folder} is closed: call add before close")
        if isinstance(problems, EngineStep):
            state = problems.state if state is None else state
            problems, impulse, claims = problems[:3]
        elif isinstance(problems, tuple):
            problems, impulse = problems
        facts: dict[str, Any] = {
            "seconds": float("nan") if seconds is None else check_float("seconds", seconds, low=0.0)
        }
        if velocity is not None:
            if impulse is not None or not isinstance(problems, Problem):
                raise InputError("velocity replaces the impulse of one problem: leave impulse out")
            impulse, left_over = reconstruct(problems, velocity)
            facts |= {"reconstructed": True, "left_over": left_over}
        if impulse is None:
            raise InputError(
                "impulse is missing: give the engine's answer [N s] to judge, or velocity="
            )
        verdicts, reasons = self._judge_worlds(problems, impulse, claims)
        states = self._split_states(state, len(verdicts), isinstance(problems, Problem))
        changed = False
        for verdict in verdicts:
            reason = reasons.get(verdict.world, "")
            changed |= self._record_selected_world(
                verdict, problems, impulse, claims, states, reason, facts
            )
        if changed or self._removed:
            self.write_lines()
        self.n_steps += 1
        return verdicts

    def write_step(
        self,
        line: dict[str, Any],
        problem: Problem,
        impulse: Any,
        state: Mapping[str, Any] | None = None,
        gap: Any = None,
    ) -> None:
        """Write the files of a step, and add its line; Ctrl-C leaves no file without a line."""
        path = self.folder / line["file"]
        if state is not None:
            write_arrays(make_folder(self.folder / STATES_FOLDER) / path.name, state)
        try:
            write_npz(problem, path, impulse=impulse, gap=gap)
            self.lines[path.name] = line
        finally:
            if path.name not in self.lines:
                path.unlink(missing_ok=True)

    def leave_out(self, line: dict[str, Any], reason: object) -> None:
        """Add the line of a step without a file, with the reason."""
        self.lines[line["file"]] = {**line, "left_out": str(reason)}

    def write_lines(self) -> None:
        """Write `engine.jsonl`, then delete the files that no longer have a line."""
        write_text(
            self.folder / ENGINE, "".join(f"{format_json(line)}\n" for line in self.lines.values())
        )
        for name in self._removed:
            for path in (self.folder / name, self.folder / STATES_FOLDER / name):
                path.unlink(missing_ok=True)
        self._removed.clear()

    def _judge_worlds(
        self, problems: Any, impulse: Any, claims: Claims | None
    ) -> tuple[list[StepVerdict], dict[int, str]]:
        """Return the verdict of each world, and the reasons why worlds could not be judged."""
        if isinstance(problems, Problem):
            own = residual(problems, impulse, threshold=self.threshold)
            rows = [problems.m]
            numbers = [(own.velocity, own.relative, own.verdict)]
            reasons = {}
        elif isinstance(problems, Batch):
            many = residual_many(problems, impulse, threshold=self.threshold, errors="status")
            rows = problems.row_counts.tolist()
            columns = (many.velocity_error, many.relative, many.verdict)
            numbers = list(zip(*(x.tolist() for x in columns), strict=True))
            reasons = {i: str(error) for i, error in many.faults.items()}
        else:
            raise InputError(
                f"problems is a {type(problems).__name__}; a Problem, a Batch or the result of an importer is needed"
            )
        gap = compute_prediction_gap(problems) if isinstance(problems, Problem) else float("nan")
        if gap > 0.0 and not self._has_warned:
            self._has_warned = True
            warnings.warn(
                f"step {self.n_steps}: MuJoCo's velocity after the step differs by {gap:.1e} m/s or rad/s from the one "
                "that its answer predicts: the model or the state was changed within or after mj_step, for example by "
                "a callback. The verdict is that of another step",
                stacklevel=3,
            )
        claimed = [None] * len(rows) if claims is None else claims.converged.tolist()
        verdicts = [
            StepVerdict(
                self.n_steps, i, rows[i], *numbers[i], claimed=claimed[i], prediction_gap=gap
            )
            for i in range(len(rows))
        ]
        return verdicts, reasons

    def _split_states(
        self, state: Mapping[str, Any] | None, n: int, is_single: bool
    ) -> Callable[[int], dict[str, Any]] | None:
        """Return a function that returns the state of a world, or None without states."""
        if state is None:
            return None
        names = state if isinstance(state, Mapping) else [""]
        if not all(
            isinstance(name, str) and name and not set(name) & {"/", "\\", "\0"} for name in names
        ):
            raise InputError(
                f"state is {state!r:.60}; a dict of arrays, names without / and \\, is needed"
            )
        arrays = {name: np.asarray(to_numpy(f"state {name!r}", x)) for name, x in state.items()}
        for name, x in arrays.items():
            if x.dtype.hasobject:
                raise InputError(
                    f"state {name!r} holds objects ({x.dtype}); numbers or texts are needed"
                )
        if is_single:
            return lambda i: arrays
        for name, x in arrays.items():
            if x.ndim == 0 or len(x) != n:
                raise InputError(f"state {name!r} has shape {x.shape}; ({n} worlds, ...) is needed")
        return lambda i: {name: x[i] for name, x in arrays.items()}

    def _record_selected_world(
        self,
        verdict: StepVerdict,
        problems: Any,
        impulse: Any,
        claims: Claims | None,
        states: Any,
        reason: str,
        more: dict[str, Any],
    ) -> bool:
        """Record a world of this step if it is selected; return whether the records changed."""
        i, error = verdict.world, verdict.velocity_error
        is_selected = self.every is not None and verdict.step % self.every == 0
        is_selected = bool(self.when is not None and self.when(verdict)) or is_selected
        name = f"step_{verdict.step:06d}_world_{i:04d}.npz"
        line: dict[str, Any] = {"file": name, "step": verdict.step, "world": i}
        if reason:
            if not is_selected and i in self._unjudged:
                return False
            self._unjudged.add(i)
            self.leave_out(line, reason)
            return True
        is_worst = (
            self.keep_worst > 0
            and verdict.rows > 0
            and (len(self._worst) < self.keep_worst or error > self._worst[0][0])
        )
        if not (is_selected or is_worst) or verdict.rows == 0:
            return False
        is_single = isinstance(problems, Problem)
        problem = problems if is_single else problems[i]
        lam = to_numpy("impulse", impulse)
        own = lam if is_single else lam.reshape(-1)[problems.rows_of(i)]
        try:
            facts: dict[str, Any] = {"solver": self.solver, **more}
            facts |= describe_answer(problem, own, self.threshold)
            if claims is not None:
                facts["claimed"], facts["iterations"] = (
                    bool(claims.converged[i]),
                    int(claims.iterations[i]),
                )
                facts["claimed_residuals"] = {
                    key: float(x[i]) for key, x in claims.residuals.items()
                }
            if verdict.prediction_gap > 0.0:
                facts["prediction_gap"] = verdict.prediction_gap
            if is_selected:
                facts["selected"] = True
            if self.every is not None and verdict.step % self.every == 0:
                facts["every"] = self.every
            self.write_step(line | facts, problem, own, None if states is None else states(i))
        except LavenderError as failure:
            self.leave_out(line, failure)
            return True
        if is_worst:
            heapq.heappush(self._worst, (error, name))
        if len(self._worst) > self.keep_worst:
            _, removed = heapq.heappop(self._worst)
            if not self.lines[removed].get("selected"):
                del self.lines[removed]
                self._removed.append(removed)
        return True


def read_recorded_state(folder: str | os.PathLike[str], file: str) -> dict[str, np.ndarray]:
    """Return the state (dict of arrays) that a `Recorder` stored with a problem file of its folder.

    Raises
    ------
    InputError
        The file has no state, or the state cannot be read.
    """
    path = Path(folder) / STATES_FOLDER / file
    if not path.is_file():
        raise InputError(f"{path} does not exist; a problem recorded with state= is needed")
    return read_arrays(path)
