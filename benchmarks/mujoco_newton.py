"""CPU time of `solve` and `solve_many` divided by the time of MuJoCo's own Newton solver on the same rows.

    python -m benchmarks mujoco_newton [--models FOLDER ...] [--repeats 12] [--worlds 32]

The problems are states of models under random controls: the models of dm_control and gymnasium, if installed, and the
scenes in the given folders. MuJoCo solves each state from zero at the loosest tolerance at which its forces have a
relative residual of at most 1e-6, the tolerance of lavender's solves. Both times are minima of repeated calls on one
thread. Making the problem, factoring M and judging the zero impulse are not timed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click
import numpy as np

import lavender as lv
from benchmarks.output import markdown, out_option, write_json
from benchmarks.pairs import time_anew
from lavender.io import mujoco as reader
from lavender.problem import Problem

TOL = 1e-6  # [-] Relative residual of both programs.
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 0.0)  # Tolerances of MuJoCo, from the loosest.
MAX_MUJOCO_STEPS = 200
STEPS_BEFORE = 100  # Simulated steps before the first state, by which most models touch the ground.
STEPS_BETWEEN = 40
STATES_PER_MODEL = 4
STEPS_PER_CONTROL = 20  # New random controls are drawn after this number of steps.
MIN_VELOCITY = 1e-9  # [m/s] States whose rows need no impulse are left out.
SIZE_LIMITS = (10, 50, 300)  # Rows that separate the classes of size.
INSTALLED_MODELS = {"dm_control": "suite/*.xml", "gymnasium": "envs/mujoco/assets/*.xml"}


def list_models(folders: tuple[Path, ...]) -> list[Path]:
    """Return the XML files of installed packages and the scenes below the given folders."""
    found: list[Path] = []
    for package, pattern in INSTALLED_MODELS.items():
        spec = find_spec(package)
        if spec is not None and spec.origin is not None:
            found += sorted(Path(spec.origin).parent.glob(pattern))
    for folder in folders:
        found += sorted(folder.rglob("scene*.xml"))
    return found


def collect_states(path: Path, mujoco: Any) -> Iterator[tuple[Any, Any, np.ndarray]]:
    """Yield (model, data, state) of some states with constraint rows, under random controls."""
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, mujoco.FatalError) as error:
        click.echo(f"{path.name}: {error}", err=True)
        return
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    model.opt.noslip_iterations = 0
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    for step in range(STEPS_BEFORE + STEPS_BETWEEN * STATES_PER_MODEL):
        if model.nu and step % STEPS_PER_CONTROL == 0:
            data.ctrl[:] = rng.uniform(-1.0, 1.0, model.nu)
        mujoco.mj_step(model, data)
        if step >= STEPS_BEFORE and step % STEPS_BETWEEN == 0 and data.nefc:
            state = np.zeros(mujoco.mj_stateSize(model, kind))
            mujoco.mj_getState(model, data, state, kind)
            yield model, data, state
            mujoco.mj_setState(model, data, state, kind)


def measure_mujoco(
    mujoco: Any, model: Any, data: Any, state: np.ndarray, repeats: int
) -> tuple[Any, float]:
    """Return the problem of a state and the smallest time [s] of MuJoCo's solver, NaN if it does not reach TOL."""
    tolerance, steps = model.opt.tolerance, model.opt.iterations

    def begin_solve() -> None:
        mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        data.qacc_warmstart[:] = 0.0
        for stage in (
            mujoco.mj_fwdPosition,
            mujoco.mj_fwdVelocity,
            mujoco.mj_fwdActuation,
            mujoco.mj_fwdAcceleration,
        ):
            stage(model, data)

    try:
        model.opt.iterations = MAX_MUJOCO_STEPS
        model.opt.tolerance = 0.0
        begin_solve()
        mujoco.mj_fwdConstraint(model, data)
        problem = lv.io.from_mujoco(model, data)
        for model.opt.tolerance in TOLERANCES:
            elapsed = time_anew(
                begin_solve, lambda _: mujoco.mj_fwdConstraint(model, data), repeats
            )
            if lv.residual(problem, reader.impulse(model, data)).relative <= TOL:
                return problem, elapsed
        return problem, np.nan
    finally:
        model.opt.tolerance, model.opt.iterations = tolerance, steps


def copy_problem(problem: Problem) -> Problem:
    """Return a copy without derived numbers except those of the judge, which a simulation needs anyway."""
    copy = replace(problem, guess=None, copy=False)
    lv.residual(copy, np.zeros(copy.m))
    return copy


def measure_lavender(problem: Problem, repeats: int, worlds: int) -> tuple[bool, float, float]:
    """Return whether `solve` reaches TOL, and the times [s] of `solve` and, for each problem, of `solve_many`."""

    def copy_all() -> list[Problem]:
        return [copy_problem(problem) for _ in range(worlds)]

    found = lv.solve(copy_problem(problem), tol=TOL).residual
    single = time_anew(
        partial(copy_problem, problem), lambda copy: lv.solve(copy, tol=TOL), repeats
    )
    many = time_anew(copy_all, lambda copies: lv.solve_many(copies, tol=TOL), max(2, repeats // 4))
    return found.relative <= max(TOL, 2.0 * found.roundoff_floor), single, many / worlds


def name_class(m: int) -> str:
    """Return the class of a problem by its rows."""
    k = sum(m >= limit for limit in SIZE_LIMITS)
    edges = [0, *SIZE_LIMITS, 0]
    if k == 0:
        return f"under {edges[1]}"
    return f"{edges[k]}-{edges[k + 1]}" if edges[k + 1] else f"{edges[k]} or more"


def compute_mean(values: list[float]) -> float:
    """Return the geometric mean."""
    return float(np.exp(np.mean(np.log(values))))


def print_table(lines: list[dict[str, Any]]) -> None:
    """Print the geometric means of times and ratios of each class of size."""
    rows = []
    for name in dict.fromkeys(x["class"] for x in sorted(lines, key=lambda x: x["m"])):
        group = [x for x in lines if x["class"] == name]
        times = [compute_mean([x[key] for x in group]) for key in ("mujoco", "solve", "many")]
        rows.append(
            [
                name,
                str(len({x["model"] for x in group})),
                str(len(group)),
                *(f"{1e6 * t:.1f}" for t in times),
                *(f"{t / times[0]:.2f}" for t in times[1:]),
            ]
        )
    head = [
        "rows",
        "models",
        "problems",
        "MuJoCo [us]",
        "solve [us]",
        "solve_many [us]",
        "solve / MuJoCo",
        "solve_many / MuJoCo",
    ]
    click.echo(markdown(head, rows))


@click.command("mujoco_newton")
@click.option(
    "--models",
    multiple=True,
    type=click.Path(path_type=Path, exists=True),
    help="Folder with scenes of MuJoCo, besides the models of dm_control and gymnasium.",
)
@click.option(
    "--repeats", default=12, show_default=True, help="Number of measurements of each call."
)
@click.option(
    "--worlds",
    default=32,
    show_default=True,
    help="Number of problems of each call of `solve_many`.",
)
@out_option("Write every measurement to this JSON file.")
def command(models: tuple[Path, ...], repeats: int, worlds: int, out: Path | None) -> None:
    """Compare `solve` and `solve_many` with MuJoCo's Newton solver on the same rows."""
    import mujoco

    lines = []
    counts = {"refused": 0, "unsolved by MuJoCo": 0, "unsolved by lavender": 0}
    for path in list_models(models):
        for model, data, state in collect_states(path, mujoco):
            try:
                problem, reference = measure_mujoco(mujoco, model, data, state, repeats)
            except lv.LavenderError:
                counts["refused"] += 1
                continue
            if lv.residual(problem, np.zeros(problem.m)).velocity < MIN_VELOCITY:
                continue
            solved, single, many = measure_lavender(problem, repeats, worlds)
            counts["unsolved by MuJoCo"] += not np.isfinite(reference)
            counts["unsolved by lavender"] += not solved
            if solved and np.isfinite(reference):
                lines.append(
                    {
                        "model": "/".join(path.parts[-2:]),
                        "m": problem.m,
                        "class": name_class(problem.m),
                        "mujoco": reference,
                        "solve": single,
                        "many": many,
                    }
                )
    print_table(lines)
    click.echo("\n" + ", ".join(f"{n} {name}" for name, n in counts.items()))
    if out is not None:
        write_json(out, lines)
