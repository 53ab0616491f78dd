"""What islands cost beside their solve: the same small problem many times, together and alone.

    python -m benchmarks islands [--count 1000] [--repeats 7]

CPU time, the least of the repeats, of `auto` and others on all of them as one problem.
"""

from __future__ import annotations

import click

import lavender as lv
from benchmarks.clock import cpu
from benchmarks.made import forms, fresh, stacks


@click.command("islands")
@click.option("--count", default=1000, show_default=True, help="Islands.")
@click.option("--height", default=2, show_default=True, help="Cubes of each.")
@click.option("--corners", default=1, show_default=True, help="Contacts between two cubes.")
@click.option("--repeats", default=7, show_default=True)
@click.option("--tol", default=1e-6, show_default=True)
@click.option("--others", default="anderson,newton,direct", show_default=True, help="Solvers beside auto.")
def command(count: int, height: int, corners: int, repeats: int, tol: float, others: str) -> None:
    """Many small problems as one: a line for each law, form and kind of islands."""
    for mu, law in ((None, "none"), (0.5, "coulomb"), (0.5, "cone")):
        for equal in (False, True):
            problem = stacks(count, height, mu, equal, corners)
            if law == "cone":
                problem = problem.relaxed("cone")
            for form, given in forms(problem).items():
                solution = lv.solve(given, tol=tol)
                auto = cpu(lambda p=given: lv.solve(fresh(p), tol=tol), repeats)
                said = []
                for name in others.replace(",", " ").split():
                    if name in lv.available(given):
                        done = lv.solve(given, name, tol=tol, time_limit=2.0)
                        t = cpu(lambda p=given, n=name: lv.solve(fresh(p), n, tol=tol, time_limit=2.0), 3)
                        said.append(f"{name} {1e3 * t:.1f}{'' if done.success else ' (no)'}")
                click.echo(
                    f"{law:8} {form:8} {'equal' if equal else 'drawn'} {given.m} rows: auto {1e3 * auto:.2f} ms, "
                    f"{', '.join(said)}; {solution.message}"
                )
