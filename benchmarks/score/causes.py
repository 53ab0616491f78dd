"""Whose error a cell is: parts of the difference to the rigid laws, summed over steps of the run.

    python -m benchmarks.score.causes mjx

divides the cells of the rows of engines that are named, of all of `ROWS` without a name, in the environment of the
engine, which needs lavender too; cells of other engines stay in the file.

`lavender.compare` divides the velocity change of one step that a rigid step would not make into solver, integrator,
softness and friction (cone and law). At N_SAMPLES states of a run, the parts of the velocities of bodies, or of hinges
if there are only hinges, are added up and projected on the direction of the sum:

    share(part) = sum_k part_k . D / sum_k total_k . D      D = sum_k total_k

so that shares sum to 1. Each step starts from the engine's own state: an error that grows by itself counts where it is
made. If no step differs from the rigid one, the error is of the time step alone: of positions that follow velocities,
of the order of events within a step. RK4 has no single step to divide. LavenderSim's steps are read as problems, in
which gravity and gyroscopic torque have acted already: its integrator counts as time step.
"""

from __future__ import annotations

import csv
import importlib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.score.adapters import CannotExpress, Running
from benchmarks.score.records import Record, read_records
from benchmarks.score.run import COLUMNS, get_settings, get_settings_key
from benchmarks.score.scenes import SCENES, Description, classify
from benchmarks.score.settings import ENGINES
from lavender.base.arrays import FloatArray
from lavender.base.errors import LavenderError
from lavender.io.stored import write_text

PATH = Path(__file__).with_name("causes.csv")
#: Rows whose steps can be read. Those of MuJoCo that differ in accurate settings only have no cells by default.
ROWS = (
    "lavender",
    "mujoco",
    "mujoco-noslip",
    "mujoco-soft",
    "mujoco-exact",
    "mujoco-pgs",
    "mjx",
)
ACCURATE_ONLY = ("mujoco-noslip", "mujoco-soft", "mujoco-exact")
N_SAMPLES = 40  # steps of a simulation that are divided
#: m/s; smaller mean differences of a step are rounding, or the compliance of the rigid twin.
ROUNDING = {"float64": 1e-6, "float32": 1e-5}
#: Parts of `lavender.compare` -> those of the page. A part of friction is "cone" or "law".
NAMES = {
    "solver": "solver",
    "lost digits": "solver",
    "noslip": "noslip",
    "integrator": "integrator",
    "softness": "softness",
    "shape": "cone",
    "law": "law",
}
PARTS = (*dict.fromkeys(NAMES.values()), "rest", "time step")


class Sampler:
    """Simulates scenes in an engine and adds up the parts of the steps that it divides."""

    def __init__(self, build: Callable[..., Running], options: dict[str, Any]) -> None:
        self.build, self.options = build, options
        self.parts: list[dict[str, FloatArray]] = []
        self.rounding = 0.0
        self.unsolved = 0

    def run(self, scene: Description, dt: float, every: float) -> tuple[FloatArray, FloatArray]:
        """Simulate a scene; see `scenes.Run`."""
        engine = self.build(scene, {"dt": dt, **self.options})
        assert engine.read_step is not None
        total = round(scene["seconds"] / dt)
        between = max(1, round(every / dt))
        sampled = set(np.linspace(0, total - 1, N_SAMPLES).astype(int).tolist())
        states = [np.array(engine.get_state(), float)]
        for k in range(total):
            if k in sampled:
                self._divide(engine.read_step())
            else:
                engine.step()
            if (k + 1) % between == 0 or k + 1 == total:
                states.append(np.array(engine.get_state(), float))
        t = np.array([*range(0, total, between), total], float) * dt
        engine.close()
        return t, np.array(states)

    def _divide(self, record: Any) -> None:
        """Add the parts of a step."""
        import lavender

        if record is None:
            return
        try:
            found = lavender.compare(record)
        except LavenderError:
            self.unsolved += 1
            return
        self.rounding = ROUNDING[record.precision]
        angular = np.asarray(found.a.angular, bool)
        moves = angular if angular.all() else ~angular  # of hinges, or of bodies
        parts = dict.fromkeys(PARTS, np.zeros(int(moves.sum())))
        for part in found.parts.values():
            for piece in part.parts or (part,):
                name = NAMES.get(piece.name, NAMES.get(part.name, "rest"))
                parts[name] = parts[name] + piece.mean[moves]
        parts["total"] = found.difference[moves]
        self.parts.append(parts)

    def get_shares(self) -> dict[str, float]:
        """Return the shares of the parts; they sum to 1."""
        shares = dict.fromkeys(PARTS, 0.0)
        sums = {name: sum(parts[name] for parts in self.parts) for name in (self.parts or [{}])[0]}
        whole = sums.get("total", np.zeros(1))
        size = float(whole @ whole)
        if size <= (self.rounding * len(self.parts)) ** 2:
            shares["time step"] = 1.0
            return shares
        for name in PARTS:
            shares[name] = float(sums[name] @ whole) / size
        return shares


def measure_causes(
    name: str, column: tuple[str, int], scene: str
) -> tuple[float, dict[str, float], int]:
    """Return error and shares of a cell, and the number of steps that were divided."""
    level, rate = column
    entry = ENGINES[name]
    build = importlib.import_module(f"benchmarks.score.adapters.{entry.adapter}").build
    sampler = Sampler(build, get_settings(entry, level))
    found = SCENES[scene].measure(sampler.run, 1.0 / rate)
    error = found[0] if isinstance(found, tuple) else found
    return error, sampler.get_shares(), len(sampler.parts)


def list_cells(
    rows: dict[tuple[str, str, int, str], Record], names: Sequence[str] = ROWS
) -> list[Record]:
    """Return the cells of some rows with one simulation that are not good at 1/240 s."""
    return [
        row
        for row in rows.values()
        if row.engine in names and (row.level, row.rate) in COLUMNS[:2]
        if not row.note and not SCENES[row.scene].curve and classify(row.scene, row.error) > 0
        if row.level == "accurate" or row.engine not in ACCURATE_ONLY
    ]


def read_causes(path: Path = PATH) -> list[dict[str, Any]]:
    """Return the cells of the file, shares as numbers."""
    with path.open(encoding="utf-8", newline="") as file:
        rows: list[dict[str, Any]] = list(csv.DictReader(file))
    for row in rows:
        row |= {key: float(row[key]) for key in (*PARTS, "error")}
        row |= {key: int(row[key]) for key in ("rate", "steps")}
    return rows


def write_causes(cells: Sequence[dict[str, Any]], path: Path = PATH) -> None:
    """Write the cells, sorted."""
    head = ("engine", "level", "rate", "scene", "settings", "error", "steps", *PARTS)
    digits = {"error": ".4g"} | dict.fromkeys(PARTS, ".4f")
    lines = [",".join(format(cell[key], digits.get(key, "")) for key in head) for cell in cells]
    write_text(path, "\n".join([",".join(head), *sorted(lines)]) + "\n")


def main(names: Sequence[str]) -> None:
    """Divide the cells of some rows, and keep the others of the file."""
    names = names or ROWS
    kept = [cell for cell in read_causes() if cell["engine"] not in names]
    for row in sorted(list_cells(read_records(), names), key=lambda row: row.key):
        column = (row.level, row.rate)
        try:
            error, shares, steps = measure_causes(row.engine, column, row.scene)
        except CannotExpress:
            continue
        settings = get_settings_key(ENGINES[row.engine], row.level)
        cell = {"engine": row.engine, "level": row.level, "rate": row.rate, "scene": row.scene}
        cell |= {"settings": settings, "error": error, "steps": steps, **shares}
        kept.append(cell)
        write_causes(kept)
        print(cell, row.error, flush=True)
    write_causes(kept)


if __name__ == "__main__":
    main(sys.argv[1:])
