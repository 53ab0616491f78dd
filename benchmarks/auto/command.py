"""The command `python -m benchmarks auto`."""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterator
from pathlib import Path

import click

import benchmarks.drawn  # noqa: F401 - makes them families of the suite
from benchmarks.auto.curves import curves, read, write
from benchmarks.auto.rates import count_rates, fit, gathered
from benchmarks.auto.regret import Regret, regrets, summary, table
from benchmarks.auto.replay import regret
from benchmarks.output import out_option, write_json
from lavender.bench import machine
from lavender.bench import seeds as from_seeds
from lavender.bench.cases import resolve
from lavender.errors import InputError
from lavender.io.stored import write_text
from lavender.problem import Problem

__all__ = ["command"]


@click.command("auto")
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@click.option(
    "--families", default="wild", show_default=True, help="Families with seeds, commas between them."
)
@click.option(
    "--seeds", default="0:60", show_default=True, metavar="A:B", help="Seeds of the families, B left out."
)
@click.option("--levels", default="1e-3,1e-6,1e-9", show_default=True, help="Relative residuals to reach.")
@click.option("--limit", default=2.0, show_default=True, metavar="S", help="Time of one solve.")
@click.option(
    "--repeats",
    type=click.IntRange(1),
    default=5,
    show_default=True,
    help="Timed runs of auto and of the best.",
)
@click.option("--worst", default=12, show_default=True, help="Cases to list.")
@out_option("Write every measurement here too, JSON.")
@out_option(
    "Record what each candidate does alone, turn by turn, into this file, one curve a line; compare nothing.",
    "--record",
)
@click.option(
    "--fit",
    "recorded",
    type=click.Path(path_type=Path, exists=True),
    multiple=True,
    help="Fit the rates of auto to recorded curves and print them, or write them to --out; several are read as one.",
)
def command(
    files: tuple[str, ...],
    families: str,
    seeds: str,
    levels: str,
    limit: float,
    repeats: int,
    worst: int,
    out: Path | None,
    record: Path | None,
    recorded: tuple[Path, ...],
) -> None:
    """How much slower auto is than the best of our own solvers.

    On FILES, or on families of the suite with seeds. Published seeds should be others than those tuned on.
    """
    if recorded:
        cases_of = gathered(read(recorded), lambda name: resolve([name])[0].problem)
        found_rates = fit(cases_of)
        for whose, rates in (("the rates of this version", None), ("the rates fitted now", found_rates)):
            mean = statistics.geometric_mean(regret(cases_of, rates))
            click.echo(f"regret on these curves, replayed with {whose}: {mean:.2f} in the mean", err=True)
        text = json.dumps(found_rates, indent=1) + "\n"
        click.echo(text if out is None else f"{count_rates(found_rates)} rates written to {out}")
        if out is not None:
            write_text(out, text)
        return
    first, colon, last = seeds.partition(":")
    if not (colon and first.isdecimal() and last.isdecimal() and int(first) < int(last)):
        raise InputError(f"--seeds {seeds!r}: A:B is needed, whole numbers with A < B")
    try:
        wanted = [float(word) for word in levels.replace(",", " ").split()]
    except ValueError:
        raise InputError(f"--levels {levels!r}: numbers with commas between them are needed") from None
    names = list(files) or from_seeds(families.replace(",", " ").split(), int(last) - int(first), int(first))

    def cases() -> Iterator[tuple[str, str, Problem]]:
        for item in resolve(names):
            yield item.name, item.reason, item.problem
            item.forget()

    if record is not None:
        count = write(record, curves(cases(), time_limit=limit))
        click.echo(f"{count} curves of {len(names)} problems written to {record}")
        return
    found: list[Regret] = []
    click.echo(f"{machine.cpu_name()}; {len(names)} problems, {len(wanted)} levels", err=True)
    try:
        for r in regrets(cases(), levels=wanted, time_limit=limit, repeats=repeats):
            found.append(r)
            if len(found) % 30 == 0:
                click.echo(f"{len(found)} done, mean so far {summary(found).mean:.2f}", err=True)
    finally:
        if found:
            click.echo(table(found, worst))
            if out is not None:
                write_json(out, found)
