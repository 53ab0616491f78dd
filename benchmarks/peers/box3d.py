"""LavenderSim beside Box3D: CPU time of a step and how far resting boxes move, alternating on the same scenes.

Box3D is not a package; the user names a checkout of https://github.com/erincatto/box3d, from which CMake builds the
library, without its validation. Both engines take steps of 1/60 s in four substeps; LavenderSim has four sweeps a
substep. Box3D has soft contacts, one friction point with twist for each pair, and reuses the contacts of pairs that
hardly move; LavenderSim has friction at each point and rigid contacts, and builds contacts in every step, or keeps
those of bodies that moved by less than `RECYCLE`.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.output import markdown
from benchmarks.pairs import run_timed
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.sim.engine import Simulation
from lavender.sim.scene import Scene

DT, SUBSTEPS, SWEEPS = 1 / 60, 4, 4
FRICTION = 0.5
RECYCLE = 1e-3  # m
HALF = 0.5  # m, of all cubes
SOURCE = Path(__file__).with_name("box3d_steps.c")


def make_tower(n: int) -> FloatArray:
    """Return the centres (n, 3) [m] of a tower of cubes."""
    return np.array([(0.0, 0.0, i + HALF) for i in range(n)])


def make_pyramid(base: int) -> FloatArray:
    """Return the centres [m] of a wall of cubes with `base` cubes in the lowest row."""
    return np.array([(0.5 * i + j - i, 0.0, i + HALF) for i in range(base) for j in range(i, base)])


def make_pile(n: int) -> FloatArray:
    """Return the centres [m] of cubes that fall in columns of a grid of ten by ten."""
    shift = np.random.default_rng(1).uniform(-0.2, 0.2, (n, 2))
    k = np.arange(n)
    grid = np.column_stack([k % 10 * 1.1, k // 10 % 10 * 1.1]) + shift
    return np.column_stack([grid, 0.6 + 1.2 * (k // 100)])


#: Scenes: {name: (centres [m], steps before the timing, timed steps in each round)}.
SCENES: dict[str, tuple[Callable[[], FloatArray], int, int]] = {
    "box": (lambda: make_tower(1), 60, 4000),
    "tower 6": (lambda: make_tower(6), 60, 600),
    "tower 10": (lambda: make_tower(10), 60, 400),
    "tower 20": (lambda: make_tower(20), 60, 240),
    "pyramid 210": (lambda: make_pyramid(20), 60, 48),
    "pyramid 1830": (lambda: make_pyramid(60), 20, 8),
    "pile 1000": (lambda: make_pile(1000), 240, 12),
}


@dataclass(frozen=True)
class Beside:
    """Results on one scene: LavenderSim, LavenderSim with kept contacts, Box3D."""

    scene: str
    time: tuple[float, ...]  # s, median CPU time of a step
    ratio: tuple[float, ...]  # medians of the rounds' ratios to Box3D, of the first two
    lateral: tuple[float, ...]  # m, largest displacement since the start
    vertical: tuple[float, ...]  # m


def build(checkout: Path, folder: Path) -> Path:
    """Build Box3D from a checkout and the program `box3d_steps.c` in `folder`; return the program.

    Raises
    ------
    InputError
        The folder is no checkout of Box3D, or does not build.
    """
    if not (checkout / "include" / "box3d" / "box3d.h").exists():
        raise InputError(
            f"{str(checkout)!r} has no include/box3d/box3d.h; a checkout of "
            "https://github.com/erincatto/box3d is needed"
        )
    off = [f"-DBOX3D_{part}=OFF" for part in ("VALIDATE", "SAMPLES", "UNIT_TESTS")]
    library = folder / "box3d"
    program = folder / "box3d_steps"
    commands = (
        ["cmake", "-S", checkout, "-B", library, "-DCMAKE_BUILD_TYPE=Release", *off],
        ["cmake", "--build", library, "--target", "box3d"],
        ["cc", "-O2", f"-I{checkout / 'include'}", SOURCE, "-o", program],
    )
    for command in commands:
        words = [str(word) for word in command]
        if words[0] == "cc":
            words += [*map(str, sorted(library.rglob("libbox3d*.a"))), "-lm", "-lpthread"]
        done = subprocess.run(words, capture_output=True, text=True)
        if done.returncode:
            raise InputError(f"Box3D does not build: {' '.join(words)}\n{done.stderr[-1000:]}")
    return program


class Box3D:
    """Cubes in Box3D, in a process of its own."""

    def __init__(self, program: Path, centres: FloatArray) -> None:
        self.process = subprocess.Popen(
            [str(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        lines = [f"{DT!r} {SUBSTEPS} {FRICTION} {len(centres)}"]
        lines += [
            " ".join(repr(float(x)) for x in (*centre, HALF, HALF, HALF)) for centre in centres
        ]
        self._write("\n".join(lines))

    def _write(self, text: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(text + "\n")
        self.process.stdin.flush()

    def run(self, steps: int) -> tuple[float, FloatArray]:
        """Do steps; return their CPU time [s] and the centres (n, 3) [m]."""
        self._write(str(steps))
        assert self.process.stdout is not None
        time, *places = map(float, self.process.stdout.readline().split())
        return time, np.array(places).reshape(-1, 3)

    def close(self) -> None:
        """End the process."""
        self.process.communicate()


class Lavender:
    """The same cubes in LavenderSim."""

    def __init__(self, centres: FloatArray, recycle: float) -> None:
        given = {"substeps": SUBSTEPS, "solver_iterations": SWEEPS, "friction": FRICTION}
        scene = Scene(dt=DT, recycle=recycle, **given)
        scene.add_plane()
        for centre in centres:
            scene.add_box((2 * HALF,) * 3, position=tuple(centre))
        self.simulation = Simulation(scene)

    def run(self, steps: int) -> tuple[float, FloatArray]:
        """Do steps; return their CPU time [s] and the centres (n, 3) [m]."""
        (observation, *_), seconds = run_timed(partial(self.simulation.run, steps))
        return seconds, observation["positions"][1:]


def measure(program: Path, scene: str, rounds: int = 5) -> Beside:
    """Measure a scene in the engines, in alternating rounds."""
    make, settle, steps = SCENES[scene]
    centres = make()
    engines = (Lavender(centres, 0.0), Lavender(centres, RECYCLE), Box3D(program, centres))
    try:
        for engine in engines:
            engine.run(settle)
        results = [[engine.run(steps) for engine in engines] for _ in range(rounds)]
    finally:
        engines[-1].close()
    moved = [np.asarray(places) - centres for _, places in results[-1]]
    times = np.array([[time / steps for time, _ in one] for one in results])
    return Beside(
        scene,
        tuple(map(median, times.T)),
        tuple(median(times[:, i] / times[:, -1]) for i in range(2)),
        tuple(float(np.hypot(d[:, 0], d[:, 1]).max()) for d in moved),
        tuple(float(np.abs(d[:, 2]).max()) for d in moved),
    )


def format_table(results: Sequence[Beside]) -> str:
    """Return the results as a table in Markdown: CPU times of a step, ratios to Box3D, displacements."""
    rows = []
    for r in results:
        moved = [f"{1e3 * a:.2f}/{1e3 * b:.2f}" for a, b in zip(r.lateral, r.vertical, strict=True)]
        times = [f"{1e6 * t:.1f}" for t in r.time]
        rows.append([r.scene, *times, *(f"{x:.2f}" for x in r.ratio), *moved])
    names = "LavenderSim", "with `recycle`", "Box3D"
    head = [f"{name}, µs" for name in names] + [f"ratio {name}" for name in names[:2]]
    return markdown(["scene", *head, *(f"moved {name}, mm" for name in names)], rows)
