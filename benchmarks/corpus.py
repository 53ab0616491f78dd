"""Figures of two commits on inputs that nobody here wrote: programs, recorded problems, FCLIB, reports, robot models.

    python -m benchmarks corpus --base COMMIT|FOLDER [--problems FOLDER] [--solver auto ...] [--drawn 20] [--out FILE]

The base commit is built in a worktree that is removed in the end, unless it is a built checkout. A process in each
checkout solves the same inputs in turn, and this checkout judges both answers. Inputs:

    programs   the folder `programs` beside the folder of problems, or that of tests/field. "Right": the objective
               differs from the optimal value, and rows are violated, by at most 1e-5 of their terms; "solved": right,
               and `found`. "Alone": the backend called by qpsolvers, with its own settings or ALONE
    problems   every file of --problems (default: the variable LAVENDER_PROBLEMS) and its folders; FCLIB is *.hdf5
    drawn      problems of `python -m benchmarks regret`
    sequences  50 steps of the robots of `python -m benchmarks worlds`, as one batch: cold, each from the
               solution of the step before, and from its own solution
    reports    tests/field/test_reports.py of this checkout, run with either commit
    models     published robot models (tests/field): steps whose judged answer predicts MuJoCo's own next velocity

Times are CPU times, the smaller of two alternating runs. What is missing is said and left out. About ten minutes.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pairs import ROOT, Answer, Checkout, build_base, run_timed, serve

TOL, RIGHT = 1e-6, 1e-5
LIMIT = 5.0  # [s] Time limit of a solve.
REPEATED_BELOW = 1.0  # [s] Calls that take longer run once.
ANSWER_LIMIT = 20.0  # [s] A process that answers later is ended: some backends alone have no limit.
N_MODELS = 12
#: Settings of backends that stop far above RIGHT by default.
ALONE = {
    "osqp": {"eps_abs": 1e-8, "eps_rel": 1e-8, "max_iter": 100_000},
    "proxqp": {"eps_abs": 1e-8, "eps_rel": 1e-8},
}
STARTS = "cold", "from the step before", "from the solution"
BACKENDS = ("clarabel", "piqp", "daqp", "proxqp", "quadprog", "osqp", "highs")


# -- in a process of either checkout ----------------------------------------------------------------


def read_program(path: str | Path) -> dict[str, Any]:
    """Return the arrays of a program in a file."""
    import scipy.sparse as sp

    with np.load(path) as data:
        arrays = {
            key: data[key] for key in ("q", "b", "h", "lb", "ub", "P", "A", "G") if key in data
        }
        for key in "PAG":
            if f"{key}_data" in data:
                parts = (data[f"{key}_{part}"] for part in ("data", "indices", "indptr"))
                arrays[key] = sp.csc_array(tuple(parts), tuple(data[f"{key}_shape"]))
    return arrays


def is_right(arrays: dict[str, Any], optimum: float, x: Any) -> bool:
    """Return whether x satisfies the rows and has the optimal objective, both to RIGHT of their terms."""
    if x is None or not np.isfinite(x).all():
        return False
    objective = 0.5 * x @ (arrays["P"] @ x) + arrays["q"] @ x
    terms = max(abs(optimum), 1e-3 * np.abs(arrays["q"]) @ np.abs(x), 1.0)
    if abs(objective - optimum) > RIGHT * terms:
        return False
    for matrix, side, is_equation in (("A", "b", True), ("G", "h", False)):
        if matrix in arrays:
            gap = arrays[matrix] @ x - arrays[side]
            size = abs(arrays[matrix]) @ np.abs(x) + np.abs(arrays[side])
            if np.any((np.abs(gap) if is_equation else gap) > RIGHT * np.maximum(size, 1e-3)):
                return False
    size = np.maximum(np.abs(x).max(initial=0.0), 1.0)
    low = arrays.get("lb", -np.inf)
    high = arrays.get("ub", np.inf)
    return bool(np.all((x >= low - RIGHT * size) & (x <= high + RIGHT * size)))


def solve_program(path: str, optimum: float, solver: str) -> Answer:
    """Solve a program by this package."""
    import lavender as lv

    arrays = read_program(path)
    answer, seconds = run_timed(
        lambda: lv.solve_qp(**arrays, solver=solver, tol=TOL, time_limit=LIMIT)
    )
    right = is_right(arrays, optimum, answer.x)
    return {
        "status": answer.solution.status.name,
        "right": right,
        "found": bool(answer.found),
        "seconds": seconds,
    }


def solve_program_alone(path: str, optimum: float, solver: str) -> Answer:
    """Solve a program by a backend itself."""
    import qpsolvers
    import scipy.sparse as sp

    arrays = read_program(path)
    given = {k: sp.csc_matrix(v) if sp.issparse(v) else v for k, v in arrays.items()}
    if solver in ("daqp", "quadprog"):
        given = {k: v.toarray() if sp.issparse(v) else v for k, v in given.items()}
    x, seconds = run_timed(
        lambda: qpsolvers.solve_qp(**given, solver=solver, **ALONE.get(solver, {}))
    )
    return {"right": is_right(arrays, optimum, x), "found": x is not None, "seconds": seconds}


def solve_problem(path: str, solver: str, out: str) -> Answer:
    """Solve a problem of a file without derived data, and write the impulse."""
    from dataclasses import replace

    import lavender as lv

    problem = replace(lv.load(path), copy=False, guess=None)
    solution, seconds = run_timed(lambda: lv.solve(problem, solver, tol=TOL, time_limit=LIMIT))
    np.save(out, solution.impulse)
    return {"status": solution.status.name, "work": dict(solution.work), "seconds": seconds}


def step_models(tests: str) -> Answer:
    """Count the steps of published models whose judged answer predicts the engine's own next velocity."""
    sys.path.insert(0, tests)
    sys.path.insert(0, f"{tests}/field")
    import test_published_models as published

    import lavender as lv

    count = Counter[str]()
    mj = published.mj
    for (_, model), _ in zip(published.iterate_models(), range(N_MODELS), strict=False):
        count["models"] += 1
        model.opt.enableflags &= ~int(mj.mjtEnableBit.mjENBL_SLEEP)
        model.opt.noslip_iterations = 0
        for name in published.INTEGRATORS:
            model.opt.integrator = getattr(
                mj.mjtIntegrator, f"mjINT_{name}", mj.mjtIntegrator.mjINT_EULER
            )
            try:
                states, after = published.step_model(model, count["models"])
                velocity = np.full(after.shape, np.nan)
                if len(states):
                    lv.io.from_mujoco_many(model, states, errors="status", velocity=velocity)
            except (lv.InputError, lv.CapabilityError, mj.FatalError):
                count["models refused"] += 1
                continue
            gap = np.abs(velocity - after).max(axis=1, initial=0.0)
            size = np.maximum(np.abs(after).max(axis=1, initial=0.0), 1.0)
            count["steps"] += len(states)
            count["steps as predicted"] += int((gap <= published.TOLERANCE * size).sum())
    return dict(count)


@cache
def read_robots() -> dict[str, Any]:
    """Return the model of each robot, or nothing without MuJoCo."""
    if find_spec("mujoco") is None:
        return {}
    from benchmarks.worlds import iterate_robots

    return dict(iterate_robots())


def solve_sequence(robot: str, start: str) -> Answer:
    """Solve the recorded steps of a robot from one of STARTS; `relative` is the largest one of a step above TOL."""
    import lavender as lv
    from benchmarks.worlds import record_states

    states = record_states(read_robots()[robot])
    before, batch = (
        lv.io.from_mujoco_many(read_robots()[robot], x)[0] for x in (states[:-1], states[1:])
    )
    given = None
    if start != STARTS[0]:
        solved = lv.solve_many(before if start == STARTS[1] else batch, tol=TOL)
        given = batch.make_start(solved)
    runs = [run_timed(partial(lv.solve_many, batch, impulse=given, tol=TOL)) for _ in range(5)]
    many = runs[0][0]
    return {
        "status": str(Counter(status.name for status in many.status)),
        "work": dict(sum((Counter(s.work) for s in many), Counter[str]())),
        "relative": float(np.where(many.success, 0.0, many.relative).max(initial=0.0)),
        "seconds": min(seconds for _, seconds in runs),
    }


CALLS: dict[str, Callable[..., Answer]] = {
    f.__name__: f
    for f in (solve_program, solve_program_alone, solve_problem, solve_sequence, step_models)
}


# -- in this process ---------------------------------------------------------------------------------


def ask(side: Checkout, *call: Any) -> Answer:
    """Return the answer of a checkout; a backend that answers later than ANSWER_LIMIT is ended."""
    return side.ask(*call, limit=None if call[0] == "step_models" else ANSWER_LIMIT)


def ask_both(sides: list[Checkout], *call: Any, out: list[str] | None = None) -> list[Answer]:
    """Return the answers of both checkouts, each with the smaller time of two alternating runs."""
    given = [(*call, path) for path in out] if out else [call, call]
    answers = [ask(side, *own) for side, own in zip(sides, given, strict=True)]
    if max(a["seconds"] for a in answers) < REPEATED_BELOW:
        for side, own, answer in zip(sides, given, answers, strict=True):
            answer["seconds"] = min(answer["seconds"], ask(side, *own)["seconds"])
    return answers


def compare_programs(sides: list[Checkout], folder: Path, backends: list[str]) -> Iterator[Answer]:
    """Yield a row for each program and solver: right alone, and through both commits."""
    optima = json.loads((ROOT / "tests/field/programs/objectives.json").read_text())
    for path in sorted(folder.rglob("*.npz")):
        if path.stem not in optima:  # Not convex, or without a known optimal value.
            continue
        for solver in ("auto", *backends):
            call = str(path), optima[path.stem], solver
            alone = None if solver == "auto" else ask(sides[1], "solve_program_alone", *call)
            base, head = ask_both(sides, "solve_program", *call)
            yield {
                "group": "programs",
                "name": path.stem,
                "solver": solver,
                "alone": alone,
                "base": base,
                "head": head,
            }


def compare_problems(
    sides: list[Checkout], files: list[tuple[str, Path]], solvers: tuple[str, ...]
) -> Iterator[Answer]:
    """Yield a row for each problem and solver, with both residuals judged by this checkout."""
    import lavender as lv

    with tempfile.TemporaryDirectory() as work:
        out = [f"{work}/{side}.npy" for side in ("base", "head")]
        for group, path in files:
            for solver in solvers:
                answers = ask_both(sides, "solve_problem", str(path), solver, out=out)
                for answer, impulse in zip(answers, out, strict=True):
                    if Path(impulse).exists():
                        answer["relative"] = float(
                            lv.residual(lv.load(path), np.load(impulse)).relative
                        )
                        Path(impulse).unlink()
                yield {
                    "group": group,
                    "name": path.stem,
                    "solver": solver,
                    "base": answers[0],
                    "head": answers[1],
                }


def compare_sequences(sides: list[Checkout]) -> Iterator[Answer]:
    """Yield a row for each robot and start."""
    for robot in read_robots():
        for start in STARTS:
            base, head = ask_both(sides, "solve_sequence", robot, start)
            yield {
                "group": "sequences",
                "name": robot,
                "solver": start,
                "base": base,
                "head": head,
            }


def list_problems(folder: Path) -> list[tuple[str, Path]]:
    """Return (group, file) of the problems of a folder: FCLIB, and the others by their folder."""
    files = sorted(path for suffix in ("npz", "hdf5") for path in folder.rglob(f"*.{suffix}"))
    return [
        (
            "FCLIB"
            if path.suffix == ".hdf5"
            else "reference"
            if path.parent == folder
            else path.parent.name,
            path,
        )
        for path in files
    ]


def write_drawn_problems(count: int, folder: Path) -> list[tuple[str, Path]]:
    """Write the problems of the first seeds of `regret`; return (group, file)."""
    from dataclasses import replace

    from benchmarks.random_families import draw_problems
    from benchmarks.regret import MAX_ROWS

    files = []
    for source, seed, problem in draw_problems(0, count, MAX_ROWS):
        path = folder / f"{source}_{seed}.npz"
        replace(problem, guess=None).save(path)
        files.append((f"drawn: {source}", path))
    return files


def run_reports(folder: Path) -> str:
    """Run the table of public reports of this checkout with the package of a checkout; return the last line."""
    table = str(ROOT / "tests/field/test_reports.py")
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-n",
        "0",
        "-p",
        "no:cacheprovider",
        "--tb=no",
        table,
    ]
    command += ["-c", str(ROOT / "pyproject.toml"), "--rootdir", str(ROOT)]
    environment = os.environ | {"PYTHONPATH": str(folder)}
    ended = subprocess.run(
        command, cwd=folder, env=environment, text=True, capture_output=True, check=False
    )
    return ended.stdout.strip().rpartition("\n")[2]


def is_solved(answer: Answer) -> bool:
    """Return whether a program is found and right, or a problem's residual is within the tolerance."""
    if "relative" in answer:
        return bool(answer["relative"] <= TOL)
    return bool(answer.get("right") and answer.get("found"))


def summarize(rows: list[Answer]) -> list[list[str]]:
    """Return a table's lines: by group and solver, solved by either commit, lost, work, and ratios of times."""
    lines = []
    keys = list(dict.fromkeys((row["group"], row["solver"]) for row in rows))
    for key in keys:
        own = [row for row in rows if (row["group"], row["solver"]) == key]
        alone = [row["alone"] for row in own if row.get("alone")]
        solved = [[is_solved(row[side]) for row in own] for side in ("base", "head")]
        both = [row for row, *is_both in zip(own, *solved, strict=True) if all(is_both)]
        ratios = sorted(row["head"]["seconds"] / max(row["base"]["seconds"], 1e-9) for row in both)
        work = [
            [
                sum(row[side].get("work", {}).get(kind, 0) for row in both)
                for side in ("base", "head")
            ]
            for kind in ("factorisations", "sweeps")
        ]
        wrong = [
            sum(bool(row[x].get("found") and not row[x]["right"]) for row in own)
            for x in ("base", "head")
        ]
        lines.append(
            [
                *key,
                str(len(own)),
                str(sum(a.get("right", False) for a in alone)) if alone else "",
                f"{sum(solved[0])} -> {sum(solved[1])}",
                f"{wrong[0]} -> {wrong[1]}",
                str(sum(row["base"]["status"] != row["head"]["status"] for row in own)),
                *(f"{x} -> {y}" if x or y else "" for x, y in work),
                f"{np.median(ratios):.2f}" if ratios else "",
                f"{ratios[-1]:.2f}" if ratios else "",
            ]
        )
    return lines


def list_changes(rows: list[Answer]) -> Iterator[str]:
    """Yield a sentence for each input that only one of the commits solves."""
    for row in rows:
        base, head = is_solved(row["base"]), is_solved(row["head"])
        if base != head:
            own = [
                f"{a['status']}, {a['relative']:.1e}" if "relative" in a else a["status"]
                for a in (row["base"], row["head"])
            ]
            yield f"{'lost' if base else 'gained'}: {row['name']} by {row['solver']}: {own[0]} -> {own[1]}"


def list_models(sides: list[Checkout]) -> Iterator[str]:
    """Yield a sentence on the published models for each commit, or on what is missing."""
    if find_spec("mujoco") is None:
        yield "robot models: mujoco is not installed"
        return
    for name, side in zip(("base", "head"), sides, strict=True):
        count = ask(side, "step_models", str(ROOT / "tests"))
        yield f"robot models, {name}: " + ", ".join(
            f"{key} {value}" for key, value in count.items()
        )


def make_command() -> Any:
    """Return the click command; a process of another checkout does not need it."""
    import click

    from benchmarks.output import markdown, out_option, write_json

    @click.command("corpus")
    @click.option("--base", required=True, help="Commit to compare with, or a built checkout.")
    @click.option(
        "--problems",
        type=click.Path(path_type=Path, exists=True),
        envvar="LAVENDER_PROBLEMS",
        help="Folder of recorded problems.",
    )
    @click.option(
        "--solver",
        "solvers",
        multiple=True,
        default=("auto",),
        show_default=True,
        help="Of problems.",
    )
    @click.option(
        "--drawn", default=20, show_default=True, help="Number of seeds of drawn problems."
    )
    @out_option("Write every answer to this JSON file.")
    def command(
        base: str, problems: Path | None, solvers: tuple[str, ...], drawn: int, out: Path | None
    ) -> None:
        """Compare two commits on programs, problems, reports and models that nobody here wrote."""
        import lavender as lv

        installed = lv.available(lv.Problem.from_qp(np.eye(1), [1.0]))
        backends = [name for name in BACKENDS if name in installed]
        if missing := [name for name in BACKENDS if name not in installed]:
            click.echo(f"not installed: {', '.join(missing)}")
        beside = (
            problems.resolve().parent / "programs" if problems else ROOT / "tests/field/programs"
        )
        programs = beside if beside.is_dir() else ROOT / "tests/field/programs"
        if problems is None:
            click.echo("recorded problems and FCLIB: LAVENDER_PROBLEMS does not name a folder")
        reports = ROOT / "tests/field/test_reports.py"
        with build_base(base) as folder, tempfile.TemporaryDirectory() as work:
            sides = [Checkout(folder, __file__), Checkout(ROOT, __file__)]
            files = [
                *(list_problems(problems) if problems else []),
                *write_drawn_problems(drawn, Path(work)),
            ]
            rows = [
                *compare_programs(sides, programs, backends),
                *compare_problems(sides, files, solvers),
                *compare_sequences(sides),
            ]
            head = [
                "inputs",
                "solver",
                "number",
                "right alone",
                "solved",
                "wrong and found",
                "other status",
                "factorisations",
                "sweeps",
                "CPU time: median ratio",
                "largest",
            ]
            click.echo(markdown(head, summarize(rows)))
            click.echo(
                "\n".join(list_changes(rows)) or "no input is solved by one of the commits only"
            )
            if reports.exists():
                click.echo(f"reports: {run_reports(folder)} -> {run_reports(ROOT)}")
            else:
                click.echo("reports: tests/field/test_reports.py is not there")
            for line in list_models(sides):
                click.echo(line)
        if out is not None:
            write_json(out, rows)

    return command


if __name__ == "__main__":
    serve(CALLS)
else:
    command = make_command()
