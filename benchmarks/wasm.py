"""Cost of the kernels in WebAssembly (Node) beside the native ones, on the same numbers.

    python -m benchmarks wasm [--rounds 5] [--out FILE]

Both sides start from the same bytes and do the same arithmetic to the last bit (tests/web/test_wasm.py), so a
ratio compares code, never work. A substep is timed as a run of substeps from a settled state, restored before
every repetition; a sweep as a run of sweeps that goes on where the last stopped. Native and Node take turns,
round by round, and the least time of each side counts: other work on the machine only adds. One thread. A
repetition takes some 2 ms, so that on a busy machine too some pass without an interruption, and each side
repeats for at least half a second, since Node first runs code that it has made quickly and replaces it between
two calls.
"""

from __future__ import annotations

import json
import platform
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import click
import numpy as np
import scipy.sparse as sp

import lavender as lv
from benchmarks.output import folder_of, markdown, write_json
from lavender import registry
from lavender.engine import Snapshot
from lavender.engine.state import State
from lavender.web import pages
from lavender.web.scenes import layout
from lavender_ext.host import memory

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests" / "wasm"))

from record import Writer, record_problem  # noqa: E402

#: Scene, parameters, steps to settle, substeps of one repetition.
SCENES: dict[str, tuple[str, dict[str, Any], int, int]] = {
    "stack of 6": ("stack", {}, 240, 100),
    "pyramid of 55": ("pyramid", {}, 240, 8),
    "chain of 20": ("chain", {}, 60, 80),
    "pile of 300": ("pile", {"n": 300}, 240, 4),
}
TARGET = 1.3  # times native
LEAST = 0.5  # s, of repetitions in a turn, here and in wasm.mjs


def problems() -> dict[str, tuple[lv.Problem, int]]:
    """Problem and sweeps of one repetition: PGS over A, sequential impulses over the factored form."""
    rng = np.random.default_rng(0)
    n = 20_000
    g = sp.random_array((n, n), density=3.0 / n, rng=rng, format="csr")
    a = (g @ g.T + sp.diags_array(np.full(n, 1.0))).tocsr()
    simulation = lv.Simulation("pyramid")
    for _ in range(60):
        simulation.step()
    factored = simulation.constraint_problem()
    matrix = lv.Problem(
        factored.b, factored.cones, factored.delassus(), guess=factored.guess, name="pyramid, A"
    )
    return {
        f"pgs, {n} rows, {a.nnz / n:.0f} entries each": (lv.Problem.lcp(a, rng.normal(size=n)), 4),
        f"pgs, pyramid, {matrix.m} rows with friction": (matrix, 100),
        f"sequential impulses, pyramid, {factored.m} rows": (factored, 100),
    }


def give_room(simulation: lv.Simulation, substeps: int) -> None:
    """Buffers in which the coming substeps fit, so that no repetition has to grow them."""
    while True:
        start = simulation.snapshot()
        if simulation.state.kernel.substeps(substeps)[1] == substeps:
            simulation.restore(start)
            return
        room = State(simulation.state.grown().size)
        buffers = (start.size, start.real.copy(), start.index.copy(), start.keys.copy())
        memory.move(*buffers, room.size, room.real, room.index, room.keys)
        simulation.state = room


def start_of(writer: Writer, start: Snapshot) -> dict[str, Any]:
    """Sizes of a snapshot, and where its buffers are."""
    kinds = {"real": "<f8", "index": "<i4", "keys": "<u8"}
    places = {name: writer.put(getattr(start, name), kind) for name, kind in kinds.items()}
    return {"size": start.size.tolist(), "buffers": places}


def native_substeps(simulation: lv.Simulation, substeps: int) -> float:
    """Seconds of one substep."""
    kernel = simulation.state.kernel
    start = perf_counter()
    _, done = kernel.substeps(substeps)
    time = perf_counter() - start
    if done != substeps:
        raise RuntimeError(f"{done} of {substeps} substeps were done")
    return time / substeps


def native_sweeps(problem: lv.Problem, sweeps: int, repeats: int) -> float:
    """Seconds of one sweep, the least of some runs that go on where the last stopped."""
    spec = registry.get("pgs" if problem.rows is None else "sequential_impulses")
    solver = spec.factory()
    state = solver.prepare(problem)
    impulse = problem.start() if problem.guess is None else problem.guess.copy()
    best, begun, done = np.inf, perf_counter(), 0
    while done < repeats or perf_counter() - begun < LEAST:
        start = perf_counter()
        solver.run(state, impulse, sweeps, 0.0)
        best = min(best, (perf_counter() - start) / sweeps)
        done += 1
    return float(best)


@click.command("wasm")
@click.option("--rounds", default=5, show_default=True, help="Turns of native and Node.")
@click.option("--repeats", default=4, show_default=True, help="Repetitions within a turn.")
@click.option("--out", type=click.Path(path_type=Path), default=None, help="JSON of the numbers.")
def command(rounds: int, repeats: int, out: Path | None) -> None:
    """Cost of the kernels in WebAssembly (Node) beside the native ones, on the same numbers."""
    folder_of(out)
    node = subprocess.run(["node", "--version"], capture_output=True, text=True, check=True).stdout.strip()
    best: dict[str, dict[str, float]] = {}
    with TemporaryDirectory() as folder:
        work, writer = Path(folder), Writer()
        (work / "lavender.wasm").write_bytes(pages.module(print))
        scenes, starts = {}, {}
        for name, (gallery, parameters, settle, substeps) in SCENES.items():
            simulation = lv.Simulation(lv.Scene(gallery, **parameters))
            for _ in range(settle):
                simulation.step()
            give_room(simulation, substeps)
            starts[name] = (simulation, simulation.snapshot(), substeps)
            scenes[name] = start_of(writer, starts[name][1]) | {"substeps": substeps}
        cases = problems()
        recorded = {
            name: record_problem(writer, p, 1, "given", 0) | {"run": n} for name, (p, n) in cases.items()
        }
        (work / "bench.json").write_text(
            json.dumps({"layout": layout(), "scenes": scenes, "problems": recorded}, allow_nan=False)
        )
        (work / "bench.bin").write_bytes(b"".join(writer.parts))
        script = ROOT / "benchmarks" / "wasm.mjs"
        for _ in range(rounds):
            times: dict[str, dict[str, float]] = {"native": {}, "wasm": {}}
            for name, (simulation, snapshot, substeps) in starts.items():
                begun, found = perf_counter(), []
                while len(found) < repeats or perf_counter() - begun < LEAST:
                    simulation.restore(snapshot)
                    found.append(native_substeps(simulation, substeps))
                times["native"][name] = min(found)
            for name, (problem, sweeps) in cases.items():
                times["native"][name] = native_sweeps(problem, sweeps, repeats)
            command = ["node", str(script), folder, str(repeats)]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            times["wasm"] = json.loads(done.stdout)
            for side, found_times in times.items():
                for name, time in found_times.items():
                    entry = best.setdefault(name, {})
                    entry[side] = min(time, entry.get(side, np.inf))
    where = f"{platform.machine()}, CPython {platform.python_version()}, Node {node}"
    click.echo(f"{where}, {rounds} turns, least times\n")
    rows = []
    for name, entry in best.items():
        entry["ratio"] = entry["wasm"] / entry["native"]
        unit = "sweep" if name in cases else "substep"
        late = "" if entry["ratio"] <= TARGET else f" (above {TARGET})"
        rows.append(
            (
                name, unit, *(f"{1e6 * entry[side]:.2f}" for side in ("native", "wasm")), f"{entry['ratio']:.2f}{late}",
            )
        )  # fmt: skip
    click.echo(markdown(("case", "unit", "native [µs]", "wasm [µs]", "ratio"), rows))
    if out is not None:
        write_json(out, [{"case": name, **entry} for name, entry in best.items()], node=node)
