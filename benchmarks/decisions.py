"""Counted work of `auto` on fixed problems with each of its numbers halved and doubled.

    python -m benchmarks decisions

The work of a solve is the estimated cost of its sweeps and factorisations (`lavender/solvers/costs.py`), so that the
result is the same on every machine. Under a time limit, the clock stands still and the stages that may start are
counted. Each change runs in a process of its own, because compiled calls copy the numbers when they are imported.
"""

from __future__ import annotations

import importlib.util
import json
import math
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import click

ROOT = Path(__file__).parents[1]
DECISIONS_PATH = ROOT / "lavender" / "solvers" / "decisions.py"
FACTORS = (0.5, 2.0)


def load_decisions() -> object:
    """Import `lavender.solvers.decisions` without the modules that copy its numbers."""
    spec = importlib.util.spec_from_file_location("lavender.solvers.decisions", DECISIONS_PATH)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def count_work(name: str, factor: float) -> dict[str, float]:
    """Return the counted work [ns] of each problem with the number `name` multiplied by `factor`, in this process."""
    decisions = load_decisions().DECISIONS  # type: ignore[attr-defined]
    setattr(decisions, name, factor * getattr(decisions, name))
    sys.path.insert(0, str(ROOT / "tests"))

    from calls import over_velocities  # type: ignore[import-not-found]
    from random_problems import general, random_generalized_problem, random_lcp, without_solution  # type: ignore[import-not-found]

    import lavender as lv
    from benchmarks.core_problems import forms, stacks
    from benchmarks.random_families import drawn, wild
    from lavender.base.deadline import Deadline
    from lavender.judge.residuals import get_zero_impulse_reference
    from lavender.problem import Problem
    from lavender.solving.compiled_call import choose_call_deadline
    from lavender.solving.stages import DecisionTree

    def pile(n: int) -> Problem:
        return lv.suite.granular(n=n, friction="coulomb").problem

    problems = {
        "40 rows": lambda: random_lcp(3, m=40),
        "80 rows": lambda: random_lcp(0, m=80),
        "200 rows": lambda: random_lcp(1, m=200),
        "islands of 36 rows": lambda: forms(stacks(6, 3, 0.4, False))["bodies"],
        "islands of 180 rows": lambda: forms(stacks(4, 15, 0.4, False))["bodies"],
        "islands of 120 rows": lambda: forms(stacks(4, 10, 0.4, False))["bodies"],
        "band": lambda: Problem.lcp(
            lv.suite.stack(n=300).problem.csr, lv.suite.stack(n=300).problem.b
        ),
        "stack": lambda: lv.suite.case("box_stackF(n=12, mass_ratio=50)").problem,
        "soft velocities": lambda: random_generalized_problem(
            1, "cone", n=150, compliance=True, contacts=60
        ),
        "many soft velocities": lambda: over_velocities(90, 150, compliance=300.0),
        "loose pile": lambda: pile(5),
        "velocities of a pile": lambda: general(pile(4)),
        "pyramid": lambda: lv.suite.pyramid(k=6, friction="coulomb").problem,
        "heavy pyramid": lambda: lv.suite.case("pyramidF(k=6, mass_ratio=1e4)").problem,
        "hard matrix": lambda: drawn(99860, part="judged").problem,
        "rows after velocities": lambda: drawn(102121, part="judged").problem,
        "slow": lambda: wild(24, rows=600).problem,
        "no solution": lambda: without_solution(1, 90),
        "infeasible": lambda: lv.suite.case("painleve()").problem,
    }
    counted = {}
    for label, make in problems.items():
        problem = make().disk
        get_zero_impulse_reference(problem)
        solution = lv.solve(problem)
        tree = DecisionTree(problem)
        work = solution.work
        factorisation = (
            tree.newton_state.cost / tree.newton_state.steps if tree.newton_state else 0.0
        )
        sweeps = work.get("sweeps", 0) + 2 * work.get("solves", 0)
        counted[label] = sweeps * tree.sweep + work.get("factorisations", 0) * factorisation
        limited = DecisionTree(problem, Deadline(1e9))
        for limit in (1e-3, 1e-2, 1e-1):  # [s]
            limited.deadline = Deadline(limit)
            fits = limited.has_time("newton", limited.min_newton_cost)
            call = choose_call_deadline(problem, Deadline(limit))
            share = ((call and call.get_remaining_seconds()) or 0.0) / limit
            counted[f"{label}, {limit:g} s"] = 1.0 + fits + round(2.0 * share, 1)
        counted[f"{label}, stages"] = math.fsum(
            min(stage.iterations, 1e9) * (1 + i)
            for i, stage in enumerate(lv.explain(problem).stages)
        )
        halving = SimpleNamespace(best=1.0)
        total = 0.0
        for stage in DecisionTree(problem, log=halving):
            halving.best *= 0.5
            total += min(stage.cost, 1e12)
        counted[f"{label}, all stages"] = total
    return counted


def run_changed(name: str, factor: float) -> dict[str, float]:
    """Return `count_work` of a new process."""
    code = "import json; from benchmarks.decisions import count_work; "
    code += f"print(json.dumps(count_work({name!r}, {factor})))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    counted: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return counted


def compare_work(before: dict[str, float], after: dict[str, float]) -> tuple[float, int]:
    """Return the geometric mean ratio of the work of the solves, and the number of changed items."""
    solved = [
        label for label in before if "," not in label and before[label] > 0.0 and after[label] > 0.0
    ]
    ratios = [math.log(after[label] / before[label]) for label in solved]
    changed = sum(before[label] != after[label] for label in before)
    return math.exp(math.fsum(ratios) / len(ratios)), changed


@click.command("decisions")
def command() -> None:
    """Count the work of auto with each of its numbers halved and doubled."""
    from benchmarks.output import markdown
    from lavender.solvers.decisions import NUMBERS

    base = run_changed(NUMBERS[0].name, 1.0)
    lines = []
    for number in NUMBERS:
        cells = [number.name, f"{number.value:g}", number.unit]
        for factor in FACTORS:
            ratio, changed = compare_work(base, run_changed(number.name, factor))
            cells.append(f"{ratio:.3f} ({changed})")
        lines.append(cells)
    head = [
        "number",
        "value",
        "unit",
        "halved: work (changed items)",
        "doubled: work (changed items)",
    ]
    click.echo(markdown(head, lines))
