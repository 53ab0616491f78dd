"""Time per world of `solve_many` and `residual_many`, compared with MuJoCo's Newton's method and by itself.

    python -m benchmarks worlds engine [--models FILE ...] [--worlds 1000] [--seed 0]
    python -m benchmarks worlds random [--worlds 100000] [--seed 0]

`engine`: states of models along random controls, every tenth step, cold. For each state MuJoCo uses the largest of
seven tolerances for which its result is within 1e-6 by lavender's judge. Only `mj_fwdConstraint` is timed, directly
after the preceding stages of a step: the factorisation of M is not included, and its data is in the cache. Lavender
gets J and M as arrays, factorises M, solves to 1e-6 and judges. Rounds alternate, and the smallest time counts: wall
time of each MuJoCo call, thread CPU time of all of lavender's worlds.
`random`: random problems, with and without the construction of the batch from arrays, and the judge alone.
"""

from __future__ import annotations

import copy
import tracemalloc
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from statistics import geometric_mean
from time import perf_counter, thread_time
from typing import Any

import click
import numpy as np

import lavender as lv
from benchmarks.output import markdown
from lavender.base.errors import LavenderError
from lavender.io.recording import count_iterations
from lavender.lab.simulated_worlds import Runs, simulate_world

TOL = 1e-6
TOLERANCES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-15)  # of MuJoCo
CLASSES = ((1, 10), (10, 50), (50, 300))  # rows
FEW = 15  # classes with fewer states are not reported
LOOK = 10  # steps between two states
ROUNDS = 7
PACKAGES = {"dm_control": "suite", "gymnasium": "envs/mujoco/assets"}


def installed() -> Iterator[Path]:
    """Yield the models of dm_control's suite and of gymnasium, if these are installed."""
    for package, folder in PACKAGES.items():
        found = find_spec(package)
        for place in (found.submodule_search_locations or ()) if found else ():
            yield from sorted((Path(place) / folder).glob("*.xml"))


def states(path: Path, worlds: int, seed: int) -> tuple[Any, Any, np.ndarray]:
    """Return MuJoCo, the model with cold Newton's method, and `worlds` states of ten runs."""
    runs = Runs(str(path), worlds=10, steps=LOOK * -(-worlds // 10), seed=seed)
    mj, model = runs.load_model()
    found = np.concatenate(
        [simulate_world(mj, model, runs, i)[0][LOOK - 1 :: LOOK] for i in range(runs.worlds)]
    )
    model.opt.solver = mj.mjtSolver.mjSOL_NEWTON
    model.opt.disableflags |= int(mj.mjtDisableBit.mjDSBL_WARMSTART)
    model.opt.iterations, model.opt.noslip_iterations = 200, 0
    return mj, model, found[np.isfinite(found).all(axis=1)]


def beside(path: Path, worlds: int, seed: int) -> Iterator[tuple[int, list[Any], float]]:
    """Yield (index of the class, cells of the table, ratio of times) for each class of rows."""
    mj, model, given = states(path, worlds, seed)
    models = []
    for tolerance in TOLERANCES:
        models.append(copy.copy(model))
        models[-1].opt.tolerance = tolerance
    chosen, good = np.zeros(len(given), int), np.zeros(len(given), bool)
    for k, asked in reversed(list(enumerate(models))):
        batch, impulse = lv.io.from_mujoco_many(asked, given)
        found = lv.residual_many(batch, impulse)
        good |= (enough := found.relative <= TOL)
        chosen[enough] = k
    rows = batch.at[:, 0]
    moved = lv.residual_many(batch, np.zeros(batch.shape)).energy > 1e-12
    for which, (low, high) in enumerate(CLASSES):
        pick = np.flatnonzero((rows >= low) & (rows < high) & moved & good)
        if len(pick) < FEW:
            continue
        part, _ = lv.io.from_mujoco_many(model, np.tile(given[pick], (max(1, 1000 // len(pick)), 1)))
        own, each, ours = [models[k] for k in chosen[pick]], np.full((2, len(pick)), np.inf), np.inf
        for _ in range(ROUNDS):
            each = np.minimum(each, engine_times(mj, own, given[pick]))
            begun = thread_time()
            many = lv.solve_many(part, tol=TOL)
            ours = min(ours, 1e6 * (thread_time() - begun) / len(part))
        theirs, steps = 1e6 * each[0].mean(), each[1].mean()
        ratio = ours / theirs
        yield (
            which,
            [
                f"{path.parent.name}/{path.stem}", f"{low} to {high}", len(pick), f"{rows[pick].mean():.1f}", model.nv,
                ("pyramid", "elliptic")[model.opt.cone], f"{theirs:.1f}", f"{ours:.1f}", f"{ratio:.2f}", f"{steps:.1f}",
                f"{many.iterations.mean():.1f}", int((~many.success).sum()),
            ],
            ratio,
        )  # fmt: skip


def engine_times(mj: Any, models: list[Any], given: np.ndarray) -> np.ndarray:
    """Return the time [s] of `mj_fwdConstraint` and its iterations for each state (2, n)."""
    data, kind = mj.MjData(models[0]), mj.mjtState.mjSTATE_INTEGRATION
    out = np.empty((2, len(given)))
    for i, model in enumerate(models):
        mj.mj_setState(model, data, given[i], kind)
        for stage in (mj.mj_fwdPosition, mj.mj_fwdVelocity, mj.mj_fwdActuation, mj.mj_fwdAcceleration):
            stage(model, data)
        begun = perf_counter()
        mj.mj_fwdConstraint(model, data)
        out[0, i] = perf_counter() - begun
        iterations = count_iterations(data)
        out[1, i] = np.nan if iterations is None else iterations
    return out


def dense_drawn(cones: lv.Cones) -> Callable[[int, np.random.Generator], Any]:
    """Return a generator of problems with 12 rows and 18 velocities, J dense."""

    def draw(n: int, rng: np.random.Generator) -> tuple[tuple[Any, ...], dict[str, Any]]:
        half, jac = rng.standard_normal((n, 18, 18)), rng.standard_normal((n, 12, 18))
        mass = half @ half.swapaxes(1, 2) / 18 + np.eye(18)
        return (jac, mass, rng.standard_normal((n, 18))), {"cones": cones, "friction": "cone"}

    return draw


def robots_drawn(n: int, rng: np.random.Generator) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Return random robots: four limbs of eight joints on a free body, 24 to 55 bounded soft rows at limb ends."""
    limb, count = np.repeat(np.arange(4), 8), rng.integers(24, 56, n)
    above = np.tri(32, dtype=bool) & (
        limb[:, None] == limb
    )  # a joint moves its own body and the following ones of its limb
    reach = np.hstack([np.ones((32, 6), bool), above])
    mass = np.tile(0.1 * np.eye(38), (n, 1, 1))
    for body in reach:
        x = rng.standard_normal((n, 3, 38)) * body
        mass += x.swapaxes(1, 2) @ x / 3
    jac = rng.standard_normal((n, 55, 38)) * reach[8 * rng.integers(0, 4, (n, 55)) + 7]
    cones = [lv.Cones.bounded(np.zeros(m), np.inf) for m in count]
    return (jac, mass, rng.standard_normal((n, 38))), {"cones": cones, "compliance": 0.05, "count": count}


def drawn(worlds: int, seed: int) -> str:
    """Return the table of random problems, which are drawn and solved in parts to limit memory."""
    lines = []
    draws = {
        "12 bounded rows, 18 velocities": (dense_drawn(lv.Cones.bounded(np.zeros(12), np.inf)), 10_000),
        "4 contacts, 18 velocities": (dense_drawn(lv.Cones.contacts(0.5, count=4)), 10_000),
        "24 to 55 bounded rows, 38 velocities": (robots_drawn, 1_000),
    }
    for name, (draw, part) in draws.items():
        took, solved = np.zeros(3), 0
        parts = max(1, worlds // 10_000)
        for k in range(parts):
            arrays, more = draw(part, np.random.default_rng([seed, k]))
            clocks = [thread_time()]
            batch = lv.Batch(*arrays, **more)
            clocks.append(thread_time())
            many = lv.solve_many(batch, tol=TOL)
            clocks.append(thread_time())
            lv.residual_many(batch, many.impulse)
            clocks.append(thread_time())
            took += np.diff(clocks) / (part * parts)
            solved += int(many.success.sum())
        tracemalloc.start()
        kept = lv.Batch(*arrays, **more)
        many = lv.solve_many(kept, tol=TOL)
        size = sum(x.nbytes for x in (*arrays, many.impulse, many.velocity))
        memory = (
            1.0
            + max(0, tracemalloc.get_traced_memory()[1] - many.impulse.nbytes - many.velocity.nbytes) / size
        )
        tracemalloc.stop()
        made, solve, judge = 1e6 * took
        lines.append((name, part * parts, f"{solved / (part * parts):.4f}", f"{made + solve:.1f}", f"{solve:.1f}",
                      f"{1e6 / judge:.0f}", f"{memory:.2f}"))  # fmt: skip
    head = ("problems", "worlds", "solved", "µs with making", "µs", "verdicts a second", "memory over arrays")
    return markdown(head, lines)


@click.group("worlds")
def command() -> None:
    """Measure solve_many and residual_many per world, compared with MuJoCo's Newton's method and by themselves."""


@command.command("engine")
@click.option(
    "--models", multiple=True, type=click.Path(path_type=Path), help="MJCF; default: those installed."
)
@click.option("--worlds", default=1000, show_default=True, help="Of each model.")
@click.option("--seed", default=0, show_default=True)
def engine_command(models: tuple[Path, ...], worlds: int, seed: int) -> None:
    """Compare with MuJoCo's Newton's method on the same states."""
    lines, ratios = [], [[] for _ in CLASSES]  # type: list[list[Any]], list[list[float]]
    for path in models or installed():
        try:
            for which, cells, ratio in beside(path, worlds, seed):
                lines.append(cells)
                ratios[which].append(ratio)
        except LavenderError as error:  # not a complete model, or its problems cannot be imported
            click.echo(f"{path.name}: {error}", err=True)
    head = (
        "model",
        "rows",
        "states",
        "mean",
        "nv",
        "cones",
        "engine µs",
        "µs",
        "ratio",
        "its steps",
        "steps",
        "left",
    )
    click.echo(markdown(head, lines))
    for (low, high), of in zip(CLASSES, ratios, strict=True):
        if of:
            click.echo(
                f"{low} to {high} rows: {geometric_mean(of):.2f} of {len(of)}, {min(of):.2f} to {max(of):.2f}"
            )


@command.command("random")
@click.option("--worlds", default=100_000, show_default=True, help="Of 12 rows; a tenth of the others.")
@click.option("--seed", default=0, show_default=True)
def random_command(worlds: int, seed: int) -> None:
    """Measure random problems."""
    click.echo(drawn(worlds, seed))
