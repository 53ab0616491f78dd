"""Every step of many worlds judged: how many ended early, how wrong they are and where, and the worst to go back to.

    found = audit("ant.xml", worlds=64, steps=200)
    found.table_of_errors; found.worst[0].problem; found.write("lavender-audit"); found.sheet.write("lavender-audit")

An answer that rounding explains, in the precision of the engine, is at its floor and no early stop
(`Residual.verdict`). MuJoCo's problems are those of `lavender.io.from_mujoco_many`, made anew from the state before
each step, its warm start and controls: its own answer to the bit. `noslip_iterations` come after the problem, and what
is judged is the answer before them. An answer are forces: MuJoCo's Newton and CG move bodies by accelerations of their
own, which an early stop leaves less far off (docs/mujoco.md).
"""

from __future__ import annotations

import copy
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray, number
from lavender.base.errors import InputError, UnknownName
from lavender.io import npz
from lavender.io.efc import from_mujoco_many
from lavender.io.recording import Control
from lavender.io.stored import folder_for_steps, write_arrays
from lavender.judge.many import residual_many
from lavender.judge.residuals import AT_FLOOR, CLOSE, ENOUGH, UNCONVERGED, WRONG
from lavender.lab.bench.running.campaign import check_workers, connected, hand_out
from lavender.lab.bench.running.runner import Event
from lavender.lab.report.curves import Curve, Figure
from lavender.lab.report.sheet import Part as Section
from lavender.lab.report.sheet import Sheet
from lavender.lab.report.table import Cell, Table
from lavender.lab.report.text import count, percent, size
from lavender.lab.worlds import ENGINES, Runs, fields_of, frames, states_of
from lavender.problem import PRECISIONS, Problem
from lavender.problem.batch import Batch

VERDICTS = (AT_FLOOR, CLOSE, UNCONVERGED, WRONG, "not finite")
NUMBERS = ("velocity", "impulse", "relative", "floor")  # m/s, N s, -, - of the worst row
QUANTILES = (0.5, 0.9, 0.99, 0.999, 1.0)
AT_ONCE = 512  # problems in memory
TASK = 4096  # steps that a worker does between two answers
WORST = 3  # worlds that are kept as files
POINTS = 60  # of a curve over time
OF_ERRORS = (
    "Of the worst row of each step. At its floor: rounding explains the error, in the engine's precision. Close "
    "enough: no row is further off than the threshold. Stopped early, or wrong: the rest. The errors are of the "
    "engine's forces: the accelerations by which MuJoCo's Newton and CG move bodies are mostly less far off."
)
OF_FILES = (
    "Problems with the engine's impulses, in the folder worst; states.npz holds the states to go back to."
)
NUMBER = re.compile(r"^contact \d+ ")  # of a contact within its step, which says nothing over steps


@dataclass(frozen=True)
class Worst:
    """The worst step of a world."""

    velocity: float  # m/s
    world: int
    step: int
    where: str  # row
    problem: Problem = field(repr=False)
    impulse: FloatArray = field(repr=False)  # (m,) N s, the engine's
    state: dict[str, FloatArray] = field(repr=False)  # before the step, by the names of MjData


class Piece(NamedTuple):
    """What was found of some steps."""

    world: Any  # (k,) int
    step: Any
    numbers: FloatArray  # (len(NUMBERS), k)
    verdict: Any  # (k,) places in VERDICTS
    where: list[tuple[int, str]]  # place among these steps and row, of those that ended early
    worst: list[Worst]


@dataclass(frozen=True, eq=False)
class Audit:
    """What `audit` found.

    Parameters
    ----------
    runs : Runs
    engine : str
    numbers : (4, worlds, steps)
        Errors of the worst row [m/s, N s], relative residual and its floor; NaN where nothing was judged.
    verdict : (worlds, steps) int
        Places in `VERDICTS`; -1 where the audit did not come.
    where : dict
        Row (without the contact's number): how often it was the worst of an early stop, by how much at most [m/s].
    worst : list of Worst
    stopped : bool
        By Ctrl-C, or workers were lost.
    """

    runs: Runs
    engine: str
    numbers: FloatArray
    verdict: Any
    where: dict[str, tuple[int, float]]
    worst: list[Worst]
    stopped: bool = False

    @property
    def early(self) -> Any:
        """(worlds, steps) bool: stopped early, or wrong."""
        return (self.verdict == VERDICTS.index(UNCONVERGED)) | (self.verdict == VERDICTS.index(WRONG))

    @property
    def done(self) -> int:
        """Steps judged."""
        return int(np.count_nonzero(self.verdict >= 0))

    @property
    def apart(self) -> Any:
        """(worlds,) bool: not finite from some step on."""
        return (self.verdict == VERDICTS.index("not finite")).any(axis=1)

    @property
    def largest(self) -> float:
        """Largest velocity error that rounding does not explain [m/s]; infinite where a world is not finite."""
        if self.apart.any():
            return np.inf
        return float(np.max(self.numbers[0][self.verdict > VERDICTS.index(AT_FLOOR)], initial=0.0))

    @property
    def head(self) -> str:
        """All in a sentence."""
        early, of = self.early, np.count_nonzero((self.verdict >= 0).any(axis=1))
        begun = f"{Path(self.runs.model).name}, {self.engine}: "
        done = f"{self.done} steps of {count(int(of), 'world')}"
        lost = int(self.apart.sum())
        end = (
            f". {count(lost, 'world')} flew apart, of which no step is judged from there on." if lost else "."
        )
        if not early.any():
            return f"{begun}none of {done} ended early{end}"
        return (
            f"{begun}{np.count_nonzero(early)} of {done} ended early ({percent(int(early.sum()), self.done, 1)}), in "
            f"{np.count_nonzero(early.any(axis=1))} worlds; {size(self.largest)} m/s off in the worst{end}"
        )

    @property
    def table_of_errors(self) -> Table:
        """Quantiles of the errors over all steps, and over those that ended early."""
        heads = ["error", *(f"{100.0 * q:g} %" for q in QUANTILES[:-1]), "worst"]
        rows: list[list[str | Cell]] = []
        for of, chosen in (("all steps", self.verdict >= 0), ("early stops", self.early)):
            for name, unit, x in (("velocity", "m/s", self.numbers[0]), ("impulse", "N s", self.numbers[1])):
                known = x[chosen & np.isfinite(x)]
                if len(known):
                    found = np.quantile(known, QUANTILES, method="higher")
                    rows.append([f"{name} [{unit}], {of}", *map(size, found.tolist())])
        return Table(heads, rows, words=frozenset({"error"}))

    @property
    def table_of_verdicts(self) -> Table:
        """How many steps, in how many worlds."""
        rows = []
        for i, word in enumerate(VERDICTS):
            here = self.verdict == i
            if here.any():
                worlds = str(np.count_nonzero(here.any(axis=1)))
                rows.append([word, str(here.sum()), percent(int(here.sum()), self.done, 2), worlds])
        return Table(["verdict", "steps", "share", "worlds"], rows, words=frozenset({"verdict"}))

    @property
    def table_of_rows(self) -> Table:
        """Where early stops have their worst row, most often first."""
        ranked = sorted(self.where.items(), key=lambda entry: -entry[1][0])
        rows = [[name, str(n), size(most)] for name, (n, most) in ranked]
        return Table(["worst row", "early stops", "at most [m/s]"], rows)

    @property
    def table_of_worst(self) -> Table:
        """The worlds that are kept as files."""
        rows = [
            [f"worst_{i}.npz", str(w.world), str(w.step), size(w.velocity), w.where]
            for i, w in enumerate(self.worst, 1)
        ]
        return Table(
            ["file", "world", "step", "m/s", "worst row"], rows, words=frozenset({"file", "worst row"})
        )

    @property
    def figure(self) -> Figure:
        """Errors over time."""
        width = -(-self.runs.steps // POINTS)
        parts = [self.numbers[0][:, k : k + width] for k in range(0, self.runs.steps, width)]
        known = [(k * width, p[np.isfinite(p)]) for k, p in enumerate(parts) if np.isfinite(p).any()]
        curves = tuple(
            Curve.of(name, name, [(k, float(np.quantile(p, q, method="higher")) or np.nan) for k, p in known])
            for name, q in (("median", 0.5), ("99 %", 0.99), ("worst", 1.0)) if known
        )  # fmt: skip
        return Figure("over-time", "over time", "step", "velocity error [m/s]", curves, x_log=False)

    def write(self, folder: str | os.PathLike[str]) -> None:
        """`records.npz`, the worst as `worst/worst_1.npz`, and `states.npz`; the page is `sheet.write`.

        `records.npz` holds `velocity` [m/s], `impulse` [N s], `relative`, `floor`, `verdict` (worlds, steps) and
        `verdicts`; `states.npz` qpos, qvel, act, ctrl, qacc_warmstart of the worst, a row each, before their step.
        """
        folder = Path(folder)
        with folder_for_steps(folder / "worst", replace=True) as worst:
            for i, w in enumerate(self.worst, 1):
                npz.write(w.problem, worst / f"worst_{i}.npz", impulse=w.impulse)
        names = self.worst[0].state if self.worst else ()
        states = {name: np.array([w.state[name] for w in self.worst]) for name in names}
        places = {name: np.array([getattr(w, name) for w in self.worst], int) for name in ("world", "step")}
        held = dict(zip(NUMBERS, self.numbers, strict=True))
        write_arrays(folder / "states.npz", states | places)
        write_arrays(folder / "records.npz", held | {"verdict": self.verdict, "verdicts": np.array(VERDICTS)})

    @property
    def told(self) -> dict[str, Any]:
        """The sums, as `numbers.json` has them."""
        runs, early, largest = self.runs, self.early, self.largest
        return {
            "head": self.head, "engine": self.engine, "model": runs.model, "worlds": runs.worlds, "steps": runs.steps,
            "seed": runs.seed, "done": self.done, "early": int(early.sum()),
            "worlds_early": int(early.any(axis=1).sum()), "worlds_apart": int(self.apart.sum()),
            "largest": largest if np.isfinite(largest) else None, "stopped": self.stopped,
        }  # fmt: skip

    @property
    def sheet(self) -> Sheet:
        """The page."""
        return Sheet(
            "lavender audit", self.head,
            [
                Section("How wrong", [self.table_of_errors, self.table_of_verdicts], [self.figure], OF_ERRORS, short=4),
                Section("Where", [self.table_of_rows], short=5, note="Rows that were the worst of an early stop."),
                Section("The worst worlds", [self.table_of_worst], short=WORST, note=OF_FILES),
            ],
            self.told,
            self.stopped,
        )  # fmt: skip


def audit(
    model: str | os.PathLike[str],
    *,
    worlds: int = 4096,
    steps: int = 200,
    engine: str = "mujoco",
    control: Control = "random",
    seed: int = 0,
    spread: float = 0.1,
    precision: str | None = None,
    threshold: float = ENOUGH,
    workers: int = -1,
    backend: str = "loky",
    watch: Callable[[Event], None] | None = None,
) -> Audit:
    """Simulate worlds of a model and judge the engine's answer to every step.

    Parameters
    ----------
    model : path (MJCF)
    worlds, steps, control, seed, spread : as `Runs`
    engine : {"mujoco", "mjx", "mujoco_warp"}
    precision : {"float64", "float32"}, optional
        In which MuJoCo computes; default float64. The others say it themselves.
    threshold : float, m/s
        Velocity error that is close enough.
    workers : int
        Processes, of MuJoCo; -1: one for each core.
    backend : str
        Of joblib, as of a campaign.
    watch : callable, optional
        Told of what is done.

    Returns
    -------
    Audit
        After Ctrl-C of what was done by then, `stopped`.

    Raises
    ------
    InputError
        A model that cannot be read, an engine that is not installed, numbers out of range.
    CapabilityError
        An integrator whose problem is not of M.
    UnknownName
        Another engine.
    """
    if engine not in ENGINES:
        raise UnknownName("engine", engine, ENGINES)
    if precision not in (None, *PRECISIONS) or (precision and engine != "mujoco"):
        raise InputError(f"precision is {precision!r}; {' or '.join(PRECISIONS)}, of MuJoCo alone, is needed")
    check_workers(workers)
    runs = Runs(os.fspath(model), worlds, steps, control=control, seed=seed, spread=spread)
    how = precision or "float64", number("threshold", threshold, low=0.0)
    numbers, verdict = np.full((len(NUMBERS), worlds, steps), np.nan), np.full((worlds, steps), -1, np.int8)
    found = Audit(runs, engine, numbers, verdict, where={}, worst=[])
    if engine == "mujoco":
        pieces = _by_mujoco(runs, how, workers, backend)
    else:
        pieces = _by_frames(engine, runs, how[1])
    try:
        for piece in pieces:
            numbers[:, piece.world, piece.step] = piece.numbers
            verdict[piece.world, piece.step] = piece.verdict
            for i, name in piece.where:
                n, most = found.where.get(name, (0, 0.0))
                found.where[name] = n + 1, max(most, float(piece.numbers[0, i]))
            found.worst[:] = _worst([*found.worst, *piece.worst])
            if watch is not None:
                watch(Event(found.done, worlds * steps, f"{int(found.early.sum())} early", ""))
    except KeyboardInterrupt:
        if not found.done:
            raise
    if not found.done:
        raise InputError("no step was judged: workers were lost; fewer of them (--workers) need less memory")
    return replace(found, stopped=found.done < worlds * steps)


def _worst(some: list[Worst]) -> list[Worst]:
    """The worst of them, each of another world."""
    kept: dict[int, Worst] = {}
    for w in sorted(some, key=lambda w: (-w.velocity, w.world, w.step)):
        kept.setdefault(w.world, w)
    return list(kept.values())[:WORST]


def _by_mujoco(runs: Runs, how: tuple[str, float], workers: int, backend: str) -> Iterator[Piece]:
    _, model = runs.load()
    from_mujoco_many(model, np.concatenate([model.qpos0, np.zeros(model.nv)])[None])  # refuses here, once
    many = max(1, min(TASK // runs.steps, runs.worlds))
    parts = (
        (runs, how, range(first, min(first + many, runs.worlds))) for first in range(0, runs.worlds, many)
    )
    name, cluster = connected(backend)
    with cluster:
        for pieces in hand_out(simulated, parts, workers, name):
            yield from pieces


def simulated(runs: Runs, how: tuple[str, float], worlds: range) -> list[Piece]:
    """MuJoCo's steps of some worlds, in a worker."""
    mj, model = runs.load()
    states = np.concatenate([states_of(mj, model, runs, world) for world in worlds])
    judge = copy.copy(model)
    judge.opt.noslip_iterations = 0
    world, step = np.repeat(worlds, runs.steps), np.tile(np.arange(runs.steps), len(worlds))
    out = []
    for i in range(0, len(states), AT_ONCE):
        some = slice(i, i + AT_ONCE)
        batch, impulse = from_mujoco_many(judge, states[some], errors="status")
        assert impulse is not None

        def state_of(k: int, some: FloatArray = states[some]) -> dict[str, FloatArray]:
            return fields_of(mj, model, some[k])

        out.append(_judged(batch, impulse, how, world[some], step[some], state_of))
    return out


def _by_frames(engine: str, runs: Runs, threshold: float) -> Iterator[Piece]:
    world = np.arange(runs.worlds)
    for step, frame in enumerate(frames(engine, runs)):

        def state_of(k: int, frame: Any = frame) -> dict[str, FloatArray]:
            return {name: x[k] for name, x in frame.state.items()}

        how = frame.batch.precision, threshold
        yield _judged(frame.batch, frame.impulse, how, world, np.full(runs.worlds, step), state_of)


def _judged(
    batch: Batch,
    impulse: FloatArray,
    how: tuple[str, float],
    world: Any,
    step: Any,
    state_of: Callable[[int], Any],
) -> Piece:
    found = residual_many(batch, impulse, precision=how[0], threshold=how[1], errors="status")
    numbers = np.array([found.velocity_error, found.impulse_error, found.relative, found.floor])
    words = found.verdict
    verdict = np.full(len(words), len(VERDICTS) - 1, np.int8)
    for i, word in enumerate(VERDICTS[:-1]):
        verdict[words == word] = i
    early = np.flatnonzero((words == UNCONVERGED) | (words == WRONG))
    rows = {int(i): found[int(i)].worst_name for i in early}
    order = early[np.argsort(-numbers[0, early], kind="stable")]
    _, first = np.unique(world[order], return_index=True)
    flat, worst = impulse.reshape(-1), []
    for i in order[np.sort(first)][:WORST].tolist():
        own = flat[batch.rows_of(i)].copy()
        at = int(world[i]), int(step[i])
        kept = {"where": rows[i], "problem": batch[i], "impulse": own, "state": state_of(i)}
        worst.append(Worst(float(numbers[0, i]), *at, **kept))
    where = [(i, NUMBER.sub("contact ", name)) for i, name in rows.items()]
    return Piece(world, step, numbers, verdict, where=where, worst=worst)
