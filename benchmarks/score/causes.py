"""Whose error a cell of MuJoCo is: parts of the difference to the rigid laws, summed over steps of the run.

    python -m benchmarks.score.causes

`lavender.compare` divides the velocity change of one step that a rigid step would not make into solver, integrator,
softness and friction (cone and law). At N_SAMPLES states of a run, the parts of the velocities of bodies, or of hinges
if there are only hinges, are added up and projected on the direction of the sum:

    share(part) = sum_k part_k . D / sum_k total_k . D      D = sum_k total_k

so that shares sum to 1. Each step starts from the engine's own state: an error that grows by itself counts where it is
made. If no step differs from the rigid one, the error is of the time step alone. RK4 has no single step to divide.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.score.adapters import CannotExpress
from benchmarks.score.adapters.mjcf import get_start, make_xml
from benchmarks.score.records import Record, read_records
from benchmarks.score.run import COLUMNS, get_settings, get_settings_key
from benchmarks.score.scenes import SCENES, Description, classify
from benchmarks.score.settings import ENGINES
from lavender.base.arrays import FloatArray
from lavender.base.errors import LavenderError
from lavender.io.stored import write_text

PATH = Path(__file__).with_name("causes.csv")
ROWS = ("mujoco", "mujoco-noslip", "mujoco-soft", "mujoco-pgs")
N_SAMPLES = 40  # steps of a simulation that are divided
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
    """Simulates scenes in MuJoCo and adds up the parts of the steps that it divides."""

    def __init__(self, options: dict[str, Any]) -> None:
        self.options = options
        self.parts: list[dict[str, FloatArray]] = []
        self.unsolved = 0

    def run(self, scene: Description, dt: float, every: float) -> tuple[FloatArray, FloatArray]:
        """Simulate a scene; see `scenes.Run`."""
        import mujoco

        from benchmarks.score.adapters.mujoco_c import build

        engine = build(scene, {"dt": dt, **self.options})
        settings = {k: v for k, v in self.options.items() if k != "hard"}
        text = make_xml(scene, dt, settings, "hard" in self.options)
        model = mujoco.MjModel.from_xml_string(text)
        data = mujoco.MjData(model)
        velocity, forces, control = get_start(scene)
        data.qvel[:], data.ctrl[:] = velocity, control
        data.xfrc_applied[1 : len(forces) + 1, :3] = forces
        total = round(scene["seconds"] / dt)
        between = max(1, round(every / dt))
        sampled = set(np.linspace(0, total - 1, N_SAMPLES).astype(int).tolist())
        states = [np.array(engine.get_state(), float)]
        for k in range(total):
            if k in sampled:
                self._divide(model, data)
            engine.step()
            mujoco.mj_step(model, data)
            if (k + 1) % between == 0 or k + 1 == total:
                states.append(np.array(engine.get_state(), float))
        t = np.array([*range(0, total, between), total], float) * dt
        return t, np.array(states)

    def _divide(self, model: Any, data: Any) -> None:
        """Add the parts of the next step."""
        import lavender
        from lavender.io import step_from_mujoco

        try:
            found = lavender.compare(step_from_mujoco(model, data))
        except LavenderError:
            self.unsolved += 1
            return
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
        if size <= 1e-20 * max(1, len(self.parts)) ** 2:  # (m/s)^2: rounding of each step
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
    sampler = Sampler(get_settings(ENGINES[name], level))
    found = SCENES[scene].measure(sampler.run, 1.0 / rate)
    error = found[0] if isinstance(found, tuple) else found
    return error, sampler.get_shares(), len(sampler.parts)


def list_cells(rows: dict[tuple[str, str, int, str], Record]) -> list[Record]:
    """Return the cells of MuJoCo with one simulation that are not good at 1/240 s."""
    return [
        row
        for row in rows.values()
        if row.engine in ROWS and (row.level, row.rate) in COLUMNS[:2]
        if not row.note and not SCENES[row.scene].curve and classify(row.scene, row.error) > 0
        if row.level == "accurate" or row.engine in ("mujoco", "mujoco-pgs")
    ]


def read_causes(path: Path = PATH) -> list[dict[str, Any]]:
    """Return the cells of the file, shares as numbers."""
    with path.open(encoding="utf-8", newline="") as file:
        rows: list[dict[str, Any]] = list(csv.DictReader(file))
    for row in rows:
        row |= {key: float(row[key]) for key in (*PARTS, "error")}
        row |= {key: int(row[key]) for key in ("rate", "steps")}
    return rows


def main() -> None:
    """Divide all cells and write the file."""
    head = ("engine", "level", "rate", "scene", "settings", "error", "steps", *PARTS)
    lines = [",".join(head)]
    for row in sorted(list_cells(read_records()), key=lambda row: row.key):
        try:
            error, shares, steps = measure_causes(row.engine, (row.level, row.rate), row.scene)
        except CannotExpress:
            continue
        values = [f"{error:.4g}", str(steps), *(f"{shares[name]:.4f}" for name in PARTS)]
        settings = get_settings_key(ENGINES[row.engine], row.level)
        lines.append(",".join([row.engine, row.level, str(row.rate), row.scene, settings, *values]))
        print(lines[-1], row.error, flush=True)
    write_text(PATH, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
