"""`lavender bench kernels`."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import click

from lavender.bench import machine
from lavender.bench.kernels import CASES, COUNTED, Row, instructions, measure_limits, run, scaling
from lavender.io.stored import write_text
from lavender.report.kernels import limits_table, scaling_table, table

__all__ = ["kernels"]


@click.command("kernels")
@click.argument("cases", nargs=-1, metavar="[CASES]...")
@click.option("--seconds", default=0.2, show_default=True, metavar="S", help="Time for each case.")
@click.option(
    "--largest",
    default=1_000_000,
    show_default=True,
    help="Contacts of the scaling table's last row; 0: no table.",
)
@click.option(
    "--instructions", "count", is_flag=True, help="Count instructions by valgrind's callgrind, minutes."
)
@click.option("--out", type=click.Path(path_type=Path), default=None, help="Write every row here too, JSON.")
def kernels(cases: tuple[str, ...], seconds: float, largest: int, count: bool, out: Path | None) -> None:
    """Kernels, small calls and whole jobs beside the limits of this machine, measured in the same run.

    CASES are names; without them all of them, then piles of growing size.
    """
    found: list[Row] = []
    click.echo(f"{machine.cpu_name()}\n")
    names = cases or CASES
    list(run(names=[n for n in names if n not in CASES]))  # a wrong name ends it here
    bounds = measure_limits()
    click.echo("\n".join(limits_table(bounds)) + "\n")
    for name in names:
        click.echo(name, err=True)
        rows = list(run([name], seconds=seconds))
        if count and name in COUNTED:
            rows = [replace(r, instructions=instructions(name)) for r in rows]
        found += rows
    click.echo("\n".join(table(found)))
    growth: list[dict[str, float]] = []
    if largest and not cases:
        sizes = [s for s in (1_000, 10_000, 100_000, 1_000_000) if s < largest] + [largest]
        growth = list(scaling(sizes, seconds=max(seconds, 0.5)))
        click.echo("\n" + "\n".join(scaling_table(growth)))
    if out is not None:
        record = {
            "cpu": machine.cpu_name(), "versions": machine.versions(), "limits": [asdict(x) for x in bounds],
            "rows": [asdict(r) | {"ns_per_unit": r.per_unit, "share": r.share} for r in found], "scaling": growth,
        }  # fmt: skip
        write_text(out, json.dumps(record, indent=1))
