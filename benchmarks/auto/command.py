"""The command `python -m benchmarks auto`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import click

from benchmarks.auto.record import Record, as_line, read, records
from benchmarks.auto.replay import RULES, fit, regrets, summary
from benchmarks.output import out_option
from lavender.base.errors import InputError
from lavender.io.stored import write_text
from lavender.judge.residuals import reference
from lavender.lab.bench import seeds as from_seeds
from lavender.lab.bench.cases import resolve
from lavender.problem import OPERATORS, Problem

__all__ = ["command"]


@click.command("auto")
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@click.option(
    "--families", default="wild", show_default=True, help="Families with seeds, commas between them."
)
@click.option(
    "--seeds", default="0:60", show_default=True, metavar="A:B", help="Seeds of the families, B left out."
)
@click.option("--limit", default=1.0, show_default=True, metavar="S", help="CPU time of one curve.")
@out_option("Record every solver and `auto` into this file.", "--record")
@click.option(
    "--judge", type=click.Path(path_type=Path, exists=True), multiple=True, help="Regret on such records."
)
@click.option(
    "--fit", "recorded", type=click.Path(path_type=Path, exists=True), multiple=True, help="Fit the rates."
)
@out_option("Write the fitted rates here.")
def command(
    files: tuple[str, ...], families: str, seeds: str, limit: float, record: Path | None, judge: tuple[Path, ...],
    recorded: tuple[Path, ...], out: Path | None,
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
    first, colon, last = seeds.partition(":")
    if not (colon and first.isdecimal() and last.isdecimal() and int(first) < int(last)):
        raise InputError(f"--seeds {seeds!r}: A:B is needed, whole numbers with A < B")
    if record is None:
        raise InputError(
            "nothing to do: --record FILE runs solvers, --judge FILE and --fit FILE read what it wrote"
        )
    names = list(files) or from_seeds(families.replace(",", " ").split(), int(last) - int(first), int(first))

    def problems() -> Iterator[tuple[str, Problem]]:
        for item in resolve(names):
            yield item.name, item.problem
            item.forget()

    with record.open("w", encoding="utf-8") as file:
        for found in records(problems(), limit):
            file.write(as_line(found))


def gathered(paths: tuple[Path, ...]) -> list[tuple[Problem, dict[str, Record]]]:
    """Each problem with the curves of its solvers."""
    found = []
    for case, curves in groupby(read(paths), key=lambda record: record.case):
        problem = resolve([case])[0].problem.disk
        reference(problem)
        found.append((problem, {record.solver: record for record in curves}))
    return found
