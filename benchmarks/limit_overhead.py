"""CPU time of calls with a time limit that does not bind, divided by the time of the same calls without a limit.

    python -m benchmarks limit_overhead [--models FOLDER ...] [--file FILE ...] [--limit 10] [--seconds 0.3]

Each call is measured in three ways: cold (no derived data), warm (the same problem again, from 0.9 times its solution)
and prepared (the problem replaced by a cold copy). The times are minima of alternating batches. The problems are the
columns and piles of `benchmarks rates`, states of models of MuJoCo, and files.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from time import perf_counter, thread_time_ns
from typing import Any

import click
import numpy as np

import lavender as lv
from benchmarks.output import markdown, out_option, write_json
from benchmarks.rates import draw_problems
from benchmarks.regret import draw_from_models
from lavender.problem import Problem

SIZE_LIMITS = (65, 130, 300)  # Rows that separate the classes of size.
STATES_PER_MODEL = 4
MAX_ROWS = 3_000
BATCH_TIME = 1e-3  # [s] Length of one measured batch of calls.
MAX_BATCH = 50
MIN_BATCHES = 4

Timed = Callable[[], Any]


def collect_problems(models: list[Path], files: list[Path]) -> Iterator[tuple[str, Problem]]:
    """Yield (source, problem): columns and piles under each law, then states of models, then files."""
    for law in ("lcp", "coulomb", "cone"):
        for _, problem in draw_problems(law):
            yield "generated", problem
    for k, path in enumerate(models):
        for state in range(STATES_PER_MODEL):
            try:
                yield "models", draw_from_models(np.random.default_rng([k, state]), [path])
            except Exception as error:
                click.echo(f"{path.name}: {error}", err=True)
                break
    for path in files:
        yield "files", lv.load(path)


def make_calls(
    problem: Problem, limit: float | None, solver: str
) -> dict[str, Callable[[int], Timed]]:
    """Return, for each way of calling, a function that prepares so many solves as one function."""

    def prepare_cold(count: int) -> Timed:
        copies = [replace(problem, copy=False) for _ in range(count)]
        return lambda: [lv.solve(copy, solver, time_limit=limit) for copy in copies]

    known = replace(problem, copy=False)
    start = 0.9 * lv.solve(known, solver).impulse

    def prepare_warm(count: int) -> Timed:
        return lambda: [
            lv.solve(known, solver, impulse=start, time_limit=limit) for _ in range(count)
        ]

    prepared = lv.prepare(replace(problem, copy=False), solver)

    def prepare_prepared(count: int) -> Timed:
        copies = [replace(problem, copy=False) for _ in range(count)]
        return lambda: [prepared.solve(copy, time_limit=limit) for copy in copies]

    return {"cold": prepare_cold, "warm": prepare_warm, "prepared": prepare_prepared}


def measure(
    problem: Problem, limit: float, solver: str, seconds: float
) -> dict[str, tuple[float, float]]:
    """Return for each way of calling the smallest CPU time of a call [s] without and with the limit."""
    plain = make_calls(problem, None, solver)
    limited = make_calls(problem, limit, solver)
    found = {}
    for kind in plain:
        pair = plain[kind], limited[kind]
        begun = perf_counter()
        pair[0](1)()
        count = max(1, min(MAX_BATCH, int(BATCH_TIME / (perf_counter() - begun))))
        best = [np.inf, np.inf]
        batches = 0
        begun = perf_counter()
        while batches < MIN_BATCHES or perf_counter() - begun < seconds:
            for i in (0, 1) if batches % 2 else (1, 0):
                call = pair[i](count)
                start = thread_time_ns()
                call()
                best[i] = min(best[i], 1e-9 * (thread_time_ns() - start) / count)
            batches += 1
        found[kind] = (best[0], best[1])
    return found


def name_class(problem: Problem) -> str:
    """Return the class of a problem by its rows."""
    k = sum(problem.m >= edge for edge in SIZE_LIMITS)
    edges = [0, *SIZE_LIMITS]
    return f"{edges[k]:03d} rows or more"


def print_tables(lines: list[dict[str, Any]], worst: int) -> None:
    """Print mean and largest ratio of each class and form, and the problems with the largest ratios."""
    kinds = ("cold", "warm", "prepared")
    groups = [("all", lines)]
    for key in ("class", "form", "source"):
        groups += [
            (name, [x for x in lines if x[key] == name]) for name in sorted({x[key] for x in lines})
        ]
    pairs = sorted({(x["class"], x["form"]) for x in lines})
    groups += [
        (f"{c}, {f}", [x for x in lines if (x["class"], x["form"]) == (c, f)]) for c, f in pairs
    ]
    rows = []
    for name, group in groups:
        cells = [name, str(len(group))]
        for kind in kinds:
            ratios = [x[kind][1] / x[kind][0] for x in group]
            cells += [
                f"{np.exp(np.mean(np.log(ratios))):.3f}",
                f"{np.median(ratios):.3f}",
                f"{max(ratios):.2f}",
            ]
        rows.append(cells)
    head = ["problems", "count"] + [
        f"{kind}: {x}" for kind in kinds for x in ("mean", "median", "worst")
    ]
    click.echo(markdown(head, rows))
    flat = [(x[kind][1] / x[kind][0], kind, x) for x in lines for kind in kinds]
    flat.sort(key=lambda item: -item[0])
    click.echo(
        "\n"
        + markdown(
            ["problem", "rows", "form", "law", "call", "ratio", "without [us]", "with [us]"],
            [
                [
                    x["name"],
                    x["m"],
                    x["form"],
                    x["law"],
                    kind,
                    f"{ratio:.3f}",
                    f"{1e6 * x[kind][0]:.1f}",
                    f"{1e6 * x[kind][1]:.1f}",
                ]
                for ratio, kind, x in flat[:worst]
            ],
        )
    )


@click.command("limit_overhead")
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
@click.option("--solver", default="auto", show_default=True)
@click.option("--limit", default=10.0, show_default=True, help="Time limit [s].")
@click.option(
    "--seconds", default=0.3, show_default=True, help="Wall time [s] of each measurement."
)
@click.option("--worst", default=12, show_default=True, help="Number of calls that are listed.")
@out_option("Write every measurement to this JSON file.")
def command(
    models: tuple[Path, ...],
    files: tuple[Path, ...],
    solver: str,
    limit: float,
    seconds: float,
    worst: int,
    out: Path | None,
) -> None:
    """Measure the overhead of a time limit that does not bind."""
    paths = sorted(path for folder in models for path in folder.rglob("*.xml"))
    lines = []
    gc.disable()
    for source, problem in collect_problems(paths, list(files)):
        if not 0 < problem.m <= MAX_ROWS:
            continue
        form = {"rows": "bodies", "matrix": "matrix", "generalized": "J and M"}[problem.operator]
        lines.append(
            {
                "source": source,
                "name": problem.name,
                "m": problem.m,
                "law": problem.law,
                "form": form,
                "class": name_class(problem),
                **measure(problem, limit, solver, seconds),
            }
        )
        gc.collect()
    print_tables(lines, worst)
    if out is not None:
        write_json(out, lines)
