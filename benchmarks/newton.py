"""What every form, start, phase and factorisation of `newton` is worth: each taken out alone.

    python -m benchmarks newton [--sets hard,default,wild,scenes] [--seeds 9000:9060] [--rows 1000]
                                [--files 'robots/*.npz'] [--tol 1e-6] [--limit 2] [--only NAME]

A part is taken out by putting something in its place while a problem is solved (with it, itself), a phase by leaving it
out. A line for each part and class (law, operator, size) on which its absence changes the result's bits or work: those
so changed and all of the class that the part is for, those then unsolved and those that only then are solved,
factorisations and CPU time without over with, geometric means of what changed (time of problems solved both ways, the
two solved in turn), CPU time over all of the class, and at worst.
"""

from __future__ import annotations

import glob
import math
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple
from unittest.mock import patch

import click
import numpy as np

import lavender as lv
from benchmarks.made import forms
from benchmarks.output import markdown
from lavender import suite
from lavender.judge.residuals import nothing_to_do
from lavender.lab.suite import lots
from lavender.problem import Problem
from lavender.sim.scene.gallery import SCENES
from lavender.solvers import newton
from lavender.solvers.newton_systems import sparse, systems
from lavender.solvers.warm_start import NOTHING
from lavender_ext.newton.solve import PHASES


class Asked(NamedTuple):
    """Which problems, and how they are solved."""

    sets: list[str]
    seeds: str
    rows: int
    files: str
    tol: float
    limit: float  # s


Part = tuple[Callable[[Problem], bool], list[tuple[Any, str, Any]], dict[str, Any]]


def bounded(p: Problem) -> bool:
    """Bounded rows alone."""
    return p.law in ("linear", "lcp")


def coulombs(p: Problem) -> bool:
    """Coulomb's law."""
    return p.law == "coulomb"


def convexs(p: Problem) -> bool:
    """Any other."""
    return p.law != "coulomb"


def matrix(p: Problem) -> bool:
    """Given as A."""
    return p.matrix is not None


def bodies(p: Problem) -> bool:
    """Given by bodies."""
    return p.rows is not None


def general(p: Problem) -> bool:
    """Given by J and M."""
    return p.generalized is not None and not p.cones.has_round


def anything(_p: Problem) -> bool:
    """Every problem."""
    return True


_BEGUN = systems.System.__init__


def _without(*phases: str) -> tuple[Any, str, Any]:
    """Newton's method leaves these out."""

    def begin(self: Any, problem: Problem, solve: Any) -> None:
        _BEGUN(self, problem, solve)
        solve.without = sum(PHASES[name] for name in phases)

    return systems.System, "__init__", begin


def _singular(*_: Any, **_kwargs: Any) -> Any:
    raise RuntimeError


def _left(*_: Any) -> tuple[int, int, int]:
    return NOTHING


FORM_ROWS = {"form": "impulse"}
PARTS: dict[str, Part] = {
    # forms
    "velocities of bodies": (bodies, [], FORM_ROWS),
    "bodies apart from J and M": (bodies, [], {"as": "J and M"}),
    "velocities of J and M": (general, [], FORM_ROWS),
    "rows after velocities": (general, [], {"form": "velocity"}),
    # starts
    "warm start": (bodies, [(newton, "warm_start", _left)], {}),
    # phases
    "exchanges": (bounded, [_without("exchanges")], {}),
    "interior point": (convexs, [_without("interior point")], {}),
    "augmented interior point": (convexs, [_without("approach")], {}),
    "proximal rounds, convex": (convexs, [_without("rounds")], {}),
    "walks": (coulombs, [_without("pursuit")], {}),
    "De Saxce": (coulombs, [_without("De Saxce")], {}),
    "walk from the cone law": (coulombs, [_without("relaxation")], {}),
    "path": (coulombs, [_without("path")], {}),
    "augmented steps": (bodies, [_without("augmented steps")], {}),
    # factorisations
    "dense": (matrix, [(systems, "DENSE_ROWS", -1), (systems, "is_full", lambda *_: False)], {}),
    "sparse panels of A": (matrix, [(systems, "is_full", lambda *_: True)], {}),
    "SuperLU after panels": (matrix, [(sparse, "sparse_lu", _singular)], {}),
    "panels over bodies": (bodies, [(systems, "PANELS", math.inf)], {}),
    "block rows over bodies": (bodies, [(systems, "PANELS", 0.0)], {}),
}  # fmt: skip


def problems(args: Asked) -> Iterator[tuple[str, Problem]]:
    """Name and problem of all that is asked for."""
    for name in args.sets:
        if name in lots.__all__:
            first, last = map(int, args.seeds.split(":"))
            for seed in range(first, last):
                yield f"{name}({seed})", getattr(lots, name)(seed=seed, rows=args.rows).problem
        elif name == "scenes":
            for scene in SCENES:
                simulation = lv.Simulation(lv.Scene(scene, solver="newton"))
                for step in range(1, 121):
                    simulation.step()
                    if step in (5, 30, 60, 119, 120):
                        yield f"{scene} {step}", simulation.constraint_problem()
        else:
            for case in suite.cases(name):
                yield case.name, case.problem
    for path in sorted(glob.glob(args.files)) if args.files else ():
        yield Path(path).stem, lv.io.load(path)


def kind(p: Problem) -> str:
    """Class of a problem: law, operator, size."""
    operator = "J and M" if p.generalized is not None else "bodies" if p.rows is not None else "A"
    size = "64" if p.m <= 64 else "300" if p.m <= 300 else "more"
    return f"{p.law}, {operator}, {size}"


def run(p: Problem, part: Part | None, args: Asked) -> tuple[bool, int, float, bytes]:
    """(solved or proven infeasible, factorisations, CPU time [s], impulse and work)."""
    with ExitStack() as stack:
        options: dict[str, Any] = {}
        for where, name, instead in () if part is None else part[1]:
            stack.enter_context(patch.object(where, name, instead))
        options.update({} if part is None else part[2])
        begun = process_time()
        try:
            guess = p.guess
            made = forms(p)["J and M"] if options.pop("as", None) else replace(p, copy=False)
            begun = process_time()
            found = lv.solve(made, "newton", impulse=guess, tol=args.tol, time_limit=args.limit, **options)
        except (lv.LavenderError, ValueError, MemoryError):  # what is left has no room for it
            return False, 0, process_time() - begun, b""
        took = process_time() - begun
    r = found.residual
    good = found.success or r.at_floor or found.status.name == "INFEASIBLE"
    return (
        good,
        found.work.get("factorisations", 0),
        took,
        found.impulse.tobytes() + repr(dict(found.work)).encode(),
    )


def compare(p: Problem, parts: dict[str, Part], args: Asked) -> Iterator[dict[str, Any]]:
    """A record for every part that is for such a problem."""
    run(p, None, args)
    first = run(p, None, args)
    for name, part in parts.items():
        if not part[0](p):
            continue
        same = part[0], [(where, what, getattr(where, what)) for where, what, _ in part[1]], {}
        without = run(p, part, args)
        changed = without[3] != first[3]
        times, least = [without[2]], [first[2]]
        if changed and without[0] and first[0]:
            for _ in range(2 if without[2] + first[2] < 0.3 else 0):
                least.append(run(p, same, args)[2])
                times.append(run(p, part, args)[2])
        yield {
            "part": name, "kind": kind(p), "changed": changed, "rows": p.m, "with": first[0], "without": without[0],
            "factors": (without[1] + 1) / (first[1] + 1), "time": min(times) / min(least),
            "ms": 1e3 * min(least),
        }  # fmt: skip


def table(records: list[dict[str, Any]]) -> str:
    """A line for each part, and for each of its classes, markdown."""
    grouped = defaultdict(list)
    for r in records:
        grouped[r["part"], ""].append(r)
        grouped[r["part"], r["kind"]].append(r)
    order = {name: i for i, name in enumerate(PARTS)}
    lines = []
    for (part, of), rs in sorted(grouped.items(), key=lambda item: (order[item[0][0]], item[0][1])):
        changed = [r for r in rs if r["changed"]]
        both = [r for r in changed if r["with"] and r["without"]]
        log = {k: [math.log(r[k]) for r in both] for k in ("factors", "time")}
        mean = [math.exp(np.mean(log[k])) if both else math.nan for k in log]
        of_all = math.exp(sum(log["time"]) / len(rs))
        worst = max((r["time"] for r in both), default=math.nan)
        lost = sum(r["with"] and not r["without"] for r in rs)
        won = sum(r["without"] and not r["with"] for r in rs)
        numbers = (f"{mean[0]:.2f}", f"{mean[1]:.2f}", f"{of_all:.2f}", f"{worst:.1f}")
        if changed:
            lines.append(("" if of else part, of or "all", len(changed), len(rs), lost, won, *numbers))
    head = ("without", "class", "changed", "of", "lost", "won", "factors", "time", "of all", "worst")
    return markdown(head, lines)


@click.command("newton")
@click.option("--sets", default="hard,default,wild,scenes", show_default=True, help="Names with commas.")
@click.option("--seeds", default="9000:9060", show_default=True, help="Of wild.")
@click.option("--rows", default=1000, show_default=True, help="Of wild, at most.")
@click.option("--files", default="", help="Problem files besides, a pattern.")
@click.option("--tol", default=1e-6, show_default=True)
@click.option("--limit", default=2.0, show_default=True, help="Of one solve [s].")
@click.option("--only", multiple=True, type=click.Choice(list(PARTS)), help="Parts; default: all.")
def command(
    sets: str,
    seeds: str,
    rows: int,
    files: str,
    tol: float,
    limit: float,
    only: tuple[str, ...],
) -> None:
    """What every form, start, phase and factorisation of newton is worth: each taken out alone."""
    args = Asked(sets.replace(",", " ").split(), seeds, rows, files, tol, limit)
    parts, records = {name: PARTS[name] for name in only or PARTS}, []
    for name, problem in problems(args):
        if problem.m and not nothing_to_do(problem):
            records += [{"name": name} | record for record in compare(problem, parts, args)]
    click.echo(table(records))
