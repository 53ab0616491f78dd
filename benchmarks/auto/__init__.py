"""What `auto` loses against the best of its solvers, what each line of its tree gains, and the rates of its counts.

record    what each solver does alone, turn by turn, and `auto` beside them, in one run
replay    the tree on such records, with a line put in or taken out
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from itertools import groupby
from operator import attrgetter
from pathlib import Path

import click

from benchmarks.auto.record import Record, records
from benchmarks.auto.replay import RULES, fit, regrets, summary
from benchmarks.output import out_option
from lavender.base.errors import InputError
from lavender.cli.options import Listed, Seeds
from lavender.io.stored import write_text
from lavender.judge.residuals import reference
from lavender.lab.bench import seeds as from_seeds
from lavender.lab.bench.cases import resolve
from lavender.problem import OPERATORS, Problem

__all__ = ["command"]

RECORDS = click.Path(path_type=Path, exists=True)


@click.command("auto")
@click.argument("names", nargs=-1)
@click.option("--families", type=Listed(str), default="wild", show_default=True, help="Families with seeds.")
@click.option("--seeds", type=Seeds(), default="0:60", show_default=True, help="Of the families, B left out.")
@click.option("--limit", default=1.0, show_default=True, metavar="S", help="CPU time of one curve.")
@out_option("Record every solver and `auto` into this file.", "--record")
@click.option("--judge", type=RECORDS, multiple=True, help="Regret on such records.")
@click.option("--fit", "recorded", type=RECORDS, multiple=True, help="Fit the rates.")
@out_option("Write the fitted rates here.")
def command(
    names: tuple[str, ...], families: tuple[str, ...], seeds: range, limit: float, record: Path | None,
    judge: tuple[Path, ...], recorded: tuple[Path, ...], out: Path | None,
) -> None:  # fmt: skip
    """How much slower auto is than the best of its solvers: --record, then --judge; --fit writes its rates."""
    if recorded:
        text = json.dumps(fit(gathered(recorded)), indent=1) + "\n"
        click.echo(text)
        if out is not None:
            write_text(out, text)
        return
    if judge:
        cases = gathered(judge)
        for operator in ("", *OPERATORS):
            some = [case for case in cases if operator in ("", case[0].operator) and "auto" in case[1]]
            click.echo(f"{operator or 'all':12} {summary(regrets(some, None))}")
        for name, rule in RULES.items():
            click.echo(f"{name:40} {summary(regrets(cases, rule))}")
        return
    if record is None:
        raise InputError("nothing to do: --record FILE runs solvers, --judge and --fit read what it wrote")
    drawn = from_seeds(families, len(seeds), seeds.start)

    def problems() -> Iterator[tuple[str, Problem]]:
        for item in resolve(names or drawn):
            yield item.name, item.problem
            item.forget()

    with record.open("w", encoding="utf-8") as file:
        for found in records(problems(), limit):
            file.write(json.dumps(asdict(found)) + "\n")


def gathered(paths: tuple[Path, ...]) -> list[tuple[Problem, dict[str, Record]]]:
    """Each problem with the curves of its solvers."""
    lines = (line for path in paths for line in path.read_text(encoding="utf-8").splitlines())
    found = []
    for case, curves in groupby((Record(**json.loads(line)) for line in lines), attrgetter("case")):
        problem = resolve([case])[0].problem.disk
        reference(problem)
        found.append((problem, {record.solver: record for record in curves}))
    return found
