"""Cost of exact friction against the number of rows: `auto`, named solvers, mixes of them, another checkout, Siconos.

    python -m benchmarks scale [--structures NAMES] [--rows N ...] [--sliding V ...] [--spread S ...] [--seed 7]
                               [--case NAME ...] [--limit 20] [--base CHECKOUT ...] [--siconos PYTHON] [--out FILE]
                               [--from FILE ...] [--figure FILE] [--law coulomb] [--tol 1e-6] [--without STATE ...]

`--without` names a state of `lavender_ext/newton/plan.pxd`. `newton` of a copy of this checkout, built without that
state, solves the same problems. A state remains in the plan if a problem is lost or takes 1.3 times as long without it.

Every solve runs in a process of its own, which reads the problem from a file, solves a small problem first, and then
solves to `--tol` without a start: CPU time of one thread, smallest of alternating runs if a run is short; increase of
the peak memory of the process; factorisations. Answers are judged by this checkout, under `--law`. A mix is a list of
stages (solver, law, iterations), each started from the impulse of the one before, which ends as soon as Coulomb's law
is met. Regret is the time of `auto` divided by the time of the fastest named solver or mix. If `auto` solves a problem,
the others end after `MAX_SLOWDOWN` times its time; the regret is 1 if none of them solves it until then. Limits
are wall times; on a loaded machine they are multiplied by the load per core. The growth exponent of a structure is the
slope of log time over log rows, by least squares from `MIN_GROWTH_ROWS` rows on.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing
from itertools import chain, product
from pathlib import Path
from typing import Any

import click
import numpy as np

import lavender as lv
from benchmarks.output import markdown, out_option, write_json
from benchmarks.pairs import ROOT, Checkout
from benchmarks.peers.adapters import check_siconos, contestants
from benchmarks.scale_structures import HELD_OUT, STRUCTURES, build

PLAN = Path("lavender_ext", "newton", "plan.pxd")
SIZES = (900, 3_000, 10_000, 30_000, 60_000, 200_000)
MIN_GROWTH_ROWS = 2_500
MAX_SLOWDOWN, MIN_LIMIT = (
    3.0,
    0.2,
)  # Others may take this multiple of the time of `auto`, or this time [s].
START_TIME = 60.0  # [s] A process may take this much longer than the limit of its solve.
SICONOS_MAX_ROWS = 8_000  # Larger problems take Siconos longer than any limit of a table.
SICONOS_SOLVERS = ("siconos NSGS", "siconos ADMM", "siconos NSN_AC")
Stage = tuple[
    str, str, int
]  # solver, law ("coulomb": that of the problem), iterations (0: the solver's default)
Copy = tuple[
    str, str, Path, str
]  # name in tables, interpreter, folder of a built checkout, contestant
CONTESTANTS: dict[str, tuple[Stage, ...]] = {
    "auto": (("auto", "coulomb", 0),),
    "newton": (("newton", "coulomb", 0),),
    "anderson": (("anderson", "coulomb", 20_000),),
    "admm": (("admm", "coulomb", 0),),
    "nncg": (("nncg", "coulomb", 20_000),),
    "sweeps, relaxed then exact": (("anderson", "cone", 2_000), ("anderson", "coulomb", 2_000)),
    "newton, relaxed": (("anderson", "cone", 100), ("newton", "cone", 0)),
    "admm, relaxed": (("anderson", "cone", 100), ("admm", "cone", 0)),
    "sweeps then admm": (("anderson", "coulomb", 100), ("admm", "coulomb", 0)),
}
WORKER = Path(__file__).with_name("scale_worker.py")


def run_siconos(
    problem: lv.Problem, python: str, limit: float, tol: float
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield (name, measurement) for each of Siconos' solvers: the first tolerance at which the judge accepts."""
    for contestant in contestants(python):
        if contestant.name not in SICONOS_SOLVERS or contestant.refuses(problem):
            continue
        residual, seconds = math.inf, math.nan
        for call in contestant.runs(problem, limit):
            seconds, impulse = call()
            residual = lv.residual(problem, impulse).relative
            if residual <= tol:
                break
        yield contestant.name, {"time": seconds, "residual": residual, "solved": residual <= tol}


def build_without(state: str, folder: Path) -> Copy:
    """Build a copy of this checkout in which Newton's plan leaves out a state, and return it."""
    copy = folder / f"without {state}"
    ignored = shutil.ignore_patterns(".git", ".venv", ".hypothesis", "__pycache__")
    shutil.copytree(ROOT, copy, ignore=ignored, symlinks=True)
    plan = (copy / PLAN).read_text(encoding="utf-8")
    states = re.findall(
        r"\b[A-Z_]+(?= = )", "".join(re.findall(r"# states of PLAN_.*?\n\n", plan, re.DOTALL))
    )
    branch = f"if state == {state}:\n"
    if state not in states or plan.count(branch) != 1:
        raise click.BadParameter(
            f"{state!r} is not a state of {PLAN} with a phase; the states are {', '.join(states)}"
        )
    # The state begins no phase, so that the next state follows.
    without = f"if state == {state}:\n        pass\n    elif state < 0:\n"
    (copy / PLAN).write_text(plan.replace(branch, without), encoding="utf-8")
    subprocess.run(
        [sys.executable, "setup.py", "-q", "build_ext", "--inplace"], cwd=copy, check=True
    )
    return f"newton without {state}", sys.executable, copy, "newton"


def measure(
    problem: lv.Problem, names: list[str], copies: list[Copy], limit: float, tol: float
) -> dict[str, dict[str, Any]]:
    """Return {contestant: {time [s], memory [MiB], residual, solved, work}} on one problem."""
    tasks = [(name, sys.executable, ROOT, CONTESTANTS[name]) for name in names]
    tasks[1:1] = [
        (name, python, folder, CONTESTANTS[stages]) for name, python, folder, stages in copies
    ]
    measured = {}
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary) / "problem.npz"
        problem.save(path)
        for name, python, folder, stages in tasks:
            auto = measured.get("auto")
            allowed = limit
            if name in CONTESTANTS and auto is not None and auto["solved"]:
                allowed = min(limit, max(MIN_LIMIT, MAX_SLOWDOWN * auto["time"]))
            allowed *= max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
            Path(f"{path}.npy").unlink(missing_ok=True)
            with closing(Checkout(folder, WORKER, python)) as worker:
                task = "solve_stages", str(path), stages, allowed, tol
                found = worker.ask(*task, limit=allowed + START_TIME)
            if "status" not in found:
                found["residual"] = float(lv.residual(problem, np.load(f"{path}.npy")).relative)
            else:
                click.echo(f"{name}: {found['status']}", err=True)
                found = {
                    "time": math.nan,
                    "memory": math.nan,
                    "residual": math.inf,
                    "work": {},
                    "stages": [],
                }
            measured[name] = found | {"solved": found["residual"] <= tol}
    return measured


def compute_regret(line: dict[str, Any]) -> tuple[float, str]:
    """Return the regret of `auto` and the fastest contestant; NaN if `auto` does not solve the problem."""
    others = {
        name: found["time"]
        for name, found in line["runs"].items()
        if found["solved"] and name in CONTESTANTS and name != "auto"
    }
    auto = line["runs"]["auto"]
    if not others:
        return (1.0 if auto["solved"] else math.nan), "auto" if auto["solved"] else "-"
    best = min(others, key=lambda name: others[name])
    return (auto["time"] / others[best] if auto["solved"] else math.nan), best


def fit_exponent(rows: Any, times: Any) -> float:
    """Return the slope of log time over log rows by least squares; NaN for fewer than three sizes."""
    return float(np.polyfit(np.log(rows), np.log(times), 1)[0]) if len(set(rows)) >= 3 else math.nan


def format_run(found: dict[str, Any] | None) -> str:
    """Return the time [s] of a run, or its residual if it did not solve the problem."""
    if found is None:
        return ""
    return f"{found['time']:.3g}" if found["solved"] else f"({found['residual']:.0e})"


def print_tables(lines: list[dict[str, Any]]) -> None:
    """Print each problem, the regret of `auto`, and the growth exponents on structures at rest."""
    extra = list(
        dict.fromkeys(name for line in lines for name in line["runs"] if name not in CONTESTANTS)
    )
    rows = []
    for line in lines:
        auto = line["runs"]["auto"]
        regret, best = compute_regret(line)
        rows.append(
            [
                line["structure"],
                line["sliding"],
                line["spread"],
                line["seed"],
                line["m"],
                format_run(auto),
                f"{auto['memory']:.0f}",
                auto["work"].get("factorisations", 0),
                best,
                format_run(line["runs"].get(best)),
                f"{regret:.2f}",
                *(format_run(line["runs"].get(name)) for name in extra),
            ]
        )
    click.echo(
        markdown(
            [
                "structure",
                "sliding [m/s]",
                "mass spread",
                "seed",
                "rows",
                "auto [s]",
                "memory [MiB]",
                "factorisations",
                "best",
                "best [s]",
                "regret",
                *(f"{name} [s]" for name in extra),
            ],
            rows,
        )
    )
    compared = [line for line in lines if len(line["runs"].keys() & CONTESTANTS.keys()) > 1]
    for label in ("all", "held out"):
        regrets = [
            compute_regret(line)[0]
            for line in compared
            if label == "all" or line["structure"] in HELD_OUT
        ]
        solved = [regret for regret in regrets if regret == regret]
        if solved:
            click.echo(
                f"\nregret, {label}: median {np.median(solved):.2f}, worst {max(solved):.2f}; "
                f"{len(regrets) - len(solved)} of {len(regrets)} problems not solved by auto"
            )
    cells = []
    for name, spread in product(STRUCTURES, sorted({line["spread"] for line in lines})):
        chosen = [
            line
            for line in lines
            if line["structure"] == name
            and line["spread"] == spread
            and line["sliding"] == 0.0
            and line["m"] >= MIN_GROWTH_ROWS
        ]
        points = [
            (line["m"], line["runs"]["auto"]["time"])
            for line in chosen
            if line["runs"]["auto"]["solved"]
        ]
        if points:
            m, times = zip(*points, strict=True)
            cells.append(
                [
                    name,
                    f"{spread:g}",
                    min(m),
                    max(m),
                    f"{fit_exponent(m, times):.2f}",
                    len(chosen) - len(points),
                ]
            )
    if cells:
        head = [
            "structure at rest",
            "mass spread",
            "rows from",
            "to",
            "growth exponent of auto",
            "not solved",
        ]
        click.echo("\n" + markdown(head, cells))


def draw_figure(lines: list[dict[str, Any]], path: Path) -> None:
    """Draw the time of `auto` against rows for equal masses: bodies at rest, bodies that slide; crosses: not solved."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        1, 2, figsize=(9, 3.8), sharex=True, sharey=True, layout="constrained"
    )
    speeds = sorted({line["sliding"] for line in lines} - {0.0})[
        -1:
    ]  # The largest speed of the measurements
    for axis, speed in zip(axes, (0.0, *speeds), strict=False):
        for k, name in enumerate(STRUCTURES):
            chosen = sorted(
                (line["m"], line["runs"]["auto"]["time"], line["runs"]["auto"]["solved"])
                for line in lines
                if (line["structure"], line["sliding"], line["spread"]) == (name, speed, 0.0)
            )
            for solved, style in ((True, "o-"), (False, "x")):
                points = [
                    (m, time) for m, time, reached in chosen if reached == solved and time == time
                ]
                if points:
                    label = name if solved or not any(reached for *_, reached in chosen) else None
                    axis.plot(
                        *zip(*points, strict=True), style, color=f"C{k}", ms=4, lw=1, label=label
                    )
        axis.set(
            xscale="log",
            yscale="log",
            xlabel="rows",
            title=f"sliding at {speed:g} m/s" if speed else "at rest",
        )
        axis.grid(alpha=0.3)
    start = np.array([3e3, 2e5])
    axes[0].plot(start, 2e-6 * start, "k:", lw=1, label="proportional to rows")
    axes[0].set_ylabel("CPU time of auto [s]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    figure.savefig(path, dpi=120)
    plt.close(figure)


@click.command("scale")
@click.option(
    "--structures",
    default=",".join(STRUCTURES),
    show_default=True,
    help="Names, separated by commas.",
)
@click.option(
    "--rows",
    multiple=True,
    type=int,
    help="Approximate number of rows; several times. Default: all sizes.",
)
@click.option(
    "--sliding", multiple=True, type=float, default=(0.0, 0.1, 0.5), show_default=True, help="[m/s]"
)
@click.option(
    "--spread",
    multiple=True,
    type=float,
    default=(0.0, 1.0),
    show_default=True,
    help="Spread of log mass.",
)
@click.option("--seed", multiple=True, type=int, default=(7,), show_default=True)
@click.option(
    "--case", "cases", multiple=True, help="A suite case instead of structures; several times."
)
@click.option(
    "--solvers",
    default=",".join(CONTESTANTS),
    help="Contestants, separated by commas; auto is always run.",
)
@click.option("--limit", default=20.0, show_default=True, help="Time limit of a solve [s].")
@click.option(
    "--base",
    "bases",
    multiple=True,
    type=click.Path(path_type=Path, exists=True),
    help="Built checkout with a .venv, whose auto solves the same problems; several times.",
)
@click.option(
    "--without",
    "states",
    multiple=True,
    help="State that a copy of Newton's plan leaves out; several times.",
)
@click.option(
    "--law",
    type=click.Choice(["coulomb", "cone"]),
    default="coulomb",
    show_default=True,
    help="Law of friction.",
)
@click.option("--tol", default=1e-6, show_default=True, help="Relative residual to reach.")
@click.option(
    "--siconos", envvar="LAVENDER_SICONOS", default="", help="Interpreter that has Siconos."
)
@click.option(
    "--from",
    "read",
    multiple=True,
    type=click.Path(path_type=Path, exists=True),
    help="Print tables of --out files.",
)
@click.option(
    "--figure", type=click.Path(path_type=Path), help="Draw time against rows to this file."
)
@out_option("Write every measurement to this JSON file, after each problem.")
def command(
    structures: str,
    rows: tuple[int, ...],
    sliding: tuple[float, ...],
    spread: tuple[float, ...],
    seed: tuple[int, ...],
    cases: tuple[str, ...],
    solvers: str,
    limit: float,
    bases: tuple[Path, ...],
    states: tuple[str, ...],
    law: str,
    tol: float,
    siconos: str,
    read: tuple[Path, ...],
    figure: Path | None,
    out: Path | None,
) -> None:
    """Measure the cost of exact friction against the number of rows."""
    names = ["auto", *(name for name in split_names(solvers, CONTESTANTS) if name != "auto")]
    if siconos:
        check_siconos(siconos)
    lines: list[dict[str, Any]] = [
        line for path in read for line in json.loads(path.read_text())["lines"]
    ]
    plan = product(split_names(structures, STRUCTURES), rows or SIZES, sliding, spread, seed)
    problems = (
        ((name, size, speed, deviation, draw), build(name, size, speed, deviation, draw))
        for name, size, speed, deviation, draw in (() if read or cases else plan)
    )
    named = ((describe_case(case), case.problem) for case in map(lv.suite.case, cases))
    copies: list[Copy] = [
        (f"auto of {base.name}", str(base.resolve() / ".venv/bin/python"), base.resolve(), "auto")
        for base in bases
    ]
    with tempfile.TemporaryDirectory() as folder:
        copies += [build_without(state, Path(folder)) for state in states]
        for (name, size, speed, deviation, draw), given in chain(problems, named):
            problem = given.relaxed("cone") if law == "cone" else given
            runs = measure(problem, names, copies, limit, tol)
            if siconos and problem.m <= SICONOS_MAX_ROWS:
                runs |= dict(run_siconos(problem, siconos, limit, tol))
            line = {
                "structure": name,
                "rows": size,
                "m": problem.m,
                "sliding": speed,
                "spread": deviation,
                "seed": draw,
                "runs": runs,
            }
            lines.append(line)
            click.echo(
                f"{given.name} {problem.m} rows: "
                + ", ".join(f"{key} {format_run(found)}" for key, found in runs.items()),
                err=True,
            )
            if out is not None:
                write_json(out, lines)
    print_tables(lines)
    if figure is not None:
        draw_figure(lines, figure)


def describe_case(case: lv.suite.Case) -> tuple[str, int, float, float, int]:
    """Return structure, rows, sliding [m/s], spread and seed of a suite case; the structure is the case's name."""
    values = case.parameters
    return case.name, case.problem.m, values.get("sliding", 0.0), 0.0, values.get("seed", 0)


def split_names(text: str, known: dict[str, Any]) -> list[str]:
    """Return the names of a list separated by commas (names with a comma are matched whole), in the order of `known`.

    Raises
    ------
    click.BadParameter
        A name is not known.
    """
    rest = text
    chosen = []
    for name in sorted(known, key=len, reverse=True):
        if f",{name}," in f",{rest},":
            chosen.append(name)
            rest = f",{rest},".replace(f",{name},", ",,").strip(",")
    if rest.strip(","):
        raise click.BadParameter(
            f"{rest.strip(',')!r} is not known; the names are {'; '.join(known)}"
        )
    return [name for name in known if name in chosen]
