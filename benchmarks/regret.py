"""CPU time of `auto` compared with every other solver of this package and with a rule of two lines, on drawn problems.

    python -m benchmarks regret [--seed 0] [--count 200] [--models FOLDER ...] [--file FILE ...]
                                [--out FILE]

Regret is (t + 50 us) / (best + 50 us). t is the CPU time of a cold call of `auto` to `TOL`, and best is the CPU time of
the fastest solver that reaches `TOL` by name; each is the minimum of alternating runs. The rule uses `newton`, or
sweeps (`anderson`) if `newton` does not accept or solve the problem, whose time is then added. Problems that no solver
solves do not count. The draws of a seed are the same on every machine: tune on some seeds, publish figures of others.
`python -m benchmarks corpus` compares `auto` of two commits on the same draws.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import click
import numpy as np

import lavender as lv
from benchmarks.output import markdown, out_option, write_json
from lavender.base.errors import LavenderError
from lavender.problem import Problem
from lavender.solvers.registry import specs

ROOT = Path(__file__).parents[1]
TOL = 1e-6  # Relative residual to reach.
SHIFT = 50e-6  # [s] Added to all times, because Python dominates shorter ones.
MAX_ROWS = 3_000
LAW_NAMES = ("coulomb", "cone")
SIZE_LIMITS = (30, 100, 300, 1000)  # Rows that separate the classes of size.
SLOWER_RATIO = 3.0  # Other solvers stop after this multiple of the wall time of `auto`.
RULE_RATIO = 20.0  # The two solvers of the rule stop after this multiple.
MIN_LIMIT, MAX_LIMIT = 0.02, 10.0  # [s] Smallest and largest such time.
CLOSE_RATIO = 1.6  # Solvers within this multiple of the fastest one are timed again.
RUN_TIME = 0.5  # [s] Alternating runs stop after this time, but not before the second.
MAX_RUNS = 5


def draw_from_generators(rng: np.random.Generator, seed: int) -> Problem:
    """Draw a problem of the tests' generators: kind, law, form and size at random."""
    from random_problems import CONTACTS, FORMS, random_generalized_problem, random_lcp

    rows = round(10.0 * (MAX_ROWS / 10.0) ** rng.random())
    kind = str(rng.choice([*CONTACTS, "lcp", "lcp", "velocities", "velocities", "velocities"]))
    law = str(rng.choice(LAW_NAMES))
    if kind == "lcp":
        m = min(rows, 600)
        return random_lcp(seed, m=m, rank=None if rng.random() < 0.7 else max(1, round(0.7 * m)))
    if kind == "velocities":
        contacts = min(rows, 900) // 3
        n = max(6, round(contacts * rng.uniform(0.5, 2.0)))
        soft = bool(rng.random() < 0.5)
        spin = bool(rng.random() < 0.2)
        return random_generalized_problem(
            seed, law, n=n, compliance=soft, contacts=contacts, spin=spin
        )
    bodies = max(3, round(rows / rng.uniform(6.0, 15.0)))
    contacts = max(2, rows // 4)
    problem = CONTACTS[kind](seed, law, bodies=bodies, joints=max(1, rows // 12), contacts=contacts)
    form = str(rng.choice(list(FORMS)))
    return FORMS[form](problem) if problem.m <= 1000 else problem


def draw_from_suite(rng: np.random.Generator, _seed: int) -> Problem:
    """Draw a family of the suite, its size and its masses."""
    k = int(rng.integers(2, 14))
    ratio = 10.0 ** float(rng.choice([0, 0, 1, 2, 3]))
    law = str(rng.choice(LAW_NAMES))
    seed = int(rng.integers(1, 1000))
    name = str(
        rng.choice(
            [
                f"box_stackF(n={k}, mass_ratio={ratio:g})",
                f"box_stack(n={k}, mass_ratio={ratio:g})",
                f"pyramidF(k={min(k, 9)}, mass_ratio={ratio:g})",
                f"pyramid(k={min(k, 9)}, mass_ratio={ratio:g})",
                f"granular(n={min(k, 9)})",
                f"granularF(n={min(k, 9)})",
                f"chain(n={8 * k})",
                f"stack(n={16 * k})",
                f"random_spd(n={20 * k}, seed={seed})",
            ]
        )
    )
    problem = lv.suite.case(name).problem
    if problem.law in LAW_NAMES:
        problem = replace(problem, friction=law)
    if problem.rows is not None and rng.random() < 0.6:
        from benchmarks.core_problems import forms

        given = forms(problem)
        problem = given[str(rng.choice(list(given)))]
    return problem


def draw_from_models(rng: np.random.Generator, paths: list[Path]) -> Problem:
    """Step a model of MuJoCo from a disturbed state with random controls; two of three are made rigid."""
    import mujoco

    from lavender.io.mujoco import from_mujoco

    path = paths[int(rng.integers(len(paths)))]
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.cone = int(rng.integers(2))
    data = mujoco.MjData(model)
    data.qvel[:] = 0.5 * rng.standard_normal(model.nv)
    for _ in range(int(rng.integers(1, 400))):
        data.ctrl[:] = rng.uniform(-1.0, 1.0, model.nu)
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    problem = from_mujoco(model, data)
    kind = int(rng.integers(3))
    if kind and problem.law in ("coulomb", "cone"):
        problem = replace(problem, friction="coulomb")
    if kind == 1 or (kind and problem.law == "lcp"):
        problem = replace(problem, compliance=np.zeros(problem.m))
    return problem


def draw_problems(
    seed: int, count: int, models: list[Path], files: list[Path]
) -> Iterator[tuple[str, int, Problem]]:
    """Yield (source, seed, problem): `count` problems of each source, then the files."""
    sys.path.insert(0, str(ROOT / "tests"))
    from benchmarks.random_families import drawn, wild

    sources: dict[str, Any] = {
        "wild": lambda rng, s: wild(s).problem,
        "drawn": lambda rng, s: drawn(s).problem,
        "generators": draw_from_generators,
        "suite": draw_from_suite,
    }
    if models:
        sources["models"] = lambda rng, s: draw_from_models(rng, models)
    for item in range(seed, seed + count):
        for name, draw in sources.items():
            try:
                problem = draw(np.random.default_rng([item, 79]), item)
            except (LavenderError, ValueError) as error:
                click.echo(f"{name} {item}: {error}", err=True)
                continue
            if 10 <= problem.m <= MAX_ROWS:
                yield name, item, problem
    for path in files:
        problem = lv.load(path)
        if problem.m <= MAX_ROWS:
            yield "files", 0, replace(problem, name=path.stem)


def call(problem: Problem, solver: str, limit: float | None = None) -> tuple[float, Any]:
    """Return the CPU time of a cold call [s] and the solution."""
    fresh = replace(problem, copy=False, guess=None)
    start = process_time()
    solution = lv.solve(fresh, solver, tol=TOL, time_limit=limit)
    return process_time() - start, solution


def is_solved(solution: Any) -> bool:
    """Return whether a solution reaches `TOL`."""
    return bool(solution.residual.relative <= TOL)


def classify(problem: Problem) -> str:
    """Return the class of a problem: rows, law and form."""
    edges = (10, *SIZE_LIMITS, MAX_ROWS)
    k = sum(problem.m > edge for edge in SIZE_LIMITS)
    rigid = " rigid" if problem.generalized is not None and not np.all(problem.compliance) else ""
    form = {"rows": "bodies", "matrix": "matrix", "generalized": f"J and M{rigid}"}[
        problem.operator
    ]
    return f"{edges[k]}-{edges[k + 1]}, {problem.law}, {form}"


def measure(problem: Problem) -> dict[str, Any] | None:
    """Return the times [s] of `auto`, of the solvers by name and of the rule; None if no solver solves the problem."""
    others = [
        name
        for name, spec in specs().items()
        if spec.builtin and not spec.external and name != "auto"
    ]
    names = [name for name in others if not specs()[name].refuses(problem)]
    begun = perf_counter()
    first, solution = call(problem, "auto")
    wall = perf_counter() - begun
    times: dict[str, float] = {"auto": first} if is_solved(solution) else {}
    for name in names:
        ratio = RULE_RATIO if name in ("newton", "anderson") else SLOWER_RATIO
        try:
            taken, result = call(problem, name, min(MAX_LIMIT, max(MIN_LIMIT, ratio * wall)))
        except LavenderError:
            continue
        if is_solved(result):
            times[name] = taken
    if not times:
        return None
    fastest = min(times.values())
    close = {name for name, taken in times.items() if taken <= CLOSE_RATIO * fastest + 2 * SHIFT}
    again = list(
        dict.fromkeys([n for n in ("auto", "newton", "anderson") if n in times] + sorted(close))
    )
    begun = perf_counter()
    runs = 0
    while runs < MAX_RUNS and (runs < 2 or perf_counter() - begun < RUN_TIME):
        if runs == 1 and fastest > 1.0:
            break
        for name in again:
            times[name] = min(times[name], call(problem, name)[0])
        runs += 1
    best = min(
        (name for name in times if name != "auto"), key=lambda name: times[name], default="auto"
    )
    rule = times.get("newton", math.nan)
    if "newton" not in times and "anderson" in times:
        lost = call(problem, "newton")[0] if "newton" in names else 0.0
        rule = lost + times["anderson"]
    return {
        "auto": times.get("auto", math.nan),
        "best": times[best],
        "solver": best,
        "rule": rule,
        "stages": [describe_stage(stage) for stage in solution.stages],
        "status": str(solution.status),
        "relative": float(solution.residual.relative),
        "times": times,
    }


def describe_stage(stage: Any) -> str:
    """Return the solver of a stage and its work."""
    work = " ".join(f"{count} {unit}" for unit, count in stage.work.items() if count)
    return f"{stage.solver} ({work})"


def compute_regret(taken: float, best: float) -> float:
    """Return the regret of a time [s] next to the best one."""
    return (taken + SHIFT) / (best + SHIFT)


def summarize(label: str, lines: list[dict[str, Any]]) -> list[str]:
    """Return the cells of a table's row: regrets of `auto` and of the rule."""
    auto = [compute_regret(x["auto"], x["best"]) for x in lines if x["auto"] == x["auto"]]
    rule = [compute_regret(x["rule"], x["best"]) for x in lines if x["rule"] == x["rule"]]
    if not auto:
        return [label, str(len(lines)), *["-"] * 5, str(len(lines)), *["-"] * 3]
    means = [math.exp(float(np.mean(np.log(x)))) for x in (auto, rule or [math.nan])]
    return [
        label,
        str(len(lines)),
        f"{means[0]:.2f}",
        f"{np.mean(auto):.2f}",
        f"{np.quantile(auto, 0.95):.2f}",
        f"{max(auto):.1f}",
        str(sum(r > 2.0 for r in auto)),
        str(len(lines) - len(auto)),
        f"{means[1]:.2f}",
        f"{max(rule, default=math.nan):.1f}",
        str(len(lines) - len(rule)),
    ]


def print_tables(lines: list[dict[str, Any]], worst: int) -> None:
    """Print regrets of all problems, of each source and class, and the problems with the largest regret."""
    head = [
        "problems",
        "count",
        "auto: geometric mean",
        "mean",
        "95 %",
        "worst",
        "above 2",
        "unsolved",
        "rule: geometric mean",
        "worst",
        "unsolved",
    ]
    cells = [summarize("all", lines)]
    for key in ("source", "class"):
        groups = sorted({x[key] for x in lines})
        cells += [summarize(group, [x for x in lines if x[key] == group]) for group in groups]
    click.echo(markdown(head, cells))
    order = sorted(
        lines,
        key=lambda x: (
            -math.inf if x["auto"] != x["auto"] else -compute_regret(x["auto"], x["best"])
        ),
    )
    click.echo(
        "\n"
        + markdown(
            [
                "problem",
                "rows",
                "class",
                "regret",
                "auto [ms]",
                "best [ms]",
                "solver",
                "stages of auto",
            ],
            [
                [
                    f"{x['source']} {x['seed']} {x['name']}",
                    x["m"],
                    x["class"],
                    f"{compute_regret(x['auto'], x['best']):.2f}",
                    f"{1e3 * x['auto']:.3g}",
                    f"{1e3 * x['best']:.3g}",
                    x["solver"],
                    ", ".join(x["stages"]) or x["status"],
                ]
                for x in order[:worst]
            ],
        )
    )


@click.command("regret")
@click.option("--seed", default=0, show_default=True, help="First seed of every source.")
@click.option("--count", default=100, show_default=True, help="Number of seeds of every source.")
@click.option(
    "--models",
    multiple=True,
    type=click.Path(path_type=Path, exists=True),
    help="Folder with XML files of MuJoCo.",
)
@click.option(
    "--file",
    "files",
    multiple=True,
    type=click.Path(path_type=Path, exists=True),
    help="Problem in a file.",
)
@click.option("--worst", default=20, show_default=True, help="Number of problems that are listed.")
@click.option(
    "--from",
    "read",
    multiple=True,
    type=click.Path(path_type=Path, exists=True),
    help="Print tables of --out files.",
)
@out_option("Write every measurement to this JSON file.")
def command(
    seed: int,
    count: int,
    models: tuple[Path, ...],
    files: tuple[Path, ...],
    worst: int,
    read: tuple[Path, ...],
    out: Path | None,
) -> None:
    """Compare auto with every solver by name on drawn problems."""
    lines: list[dict[str, Any]] = []
    if read:
        for path in read:
            lines += json.loads(path.read_text())["lines"]
        print_tables(lines, worst)
        return
    paths = sorted(path for folder in models for path in folder.rglob("*.xml"))
    unsolved = 0
    for source, item, problem in draw_problems(seed, count, paths, list(files)):
        measured = measure(problem)
        if measured is None:
            unsolved += 1
            continue
        drawn = {
            "source": source,
            "seed": item,
            "name": problem.name,
            "m": problem.m,
            "class": classify(problem),
        }
        lines.append(drawn | measured)
        if out is not None:
            write_json(out, lines)  # After each problem: a long run may be interrupted.
    print_tables(lines, worst)
    click.echo(f"\n{unsolved} problems were not solved by any solver and do not count.")
