"""The command `python -m benchmarks kernels`, and its table."""

from __future__ import annotations

from collections.abc import Sequence

import click

from benchmarks.kernels.cases import CASES, Row, run
from benchmarks.output import markdown
from lavender.report import machine


def _number(x: float, form: str = "{:.3g}") -> str:
    return "-" if x != x else form.format(x)


def table(rows: Sequence[Row]) -> str:
    """Return the rows as a markdown table."""
    head = (
        "case",
        "size",
        "time",
        "unit",
        "ns / unit",
        "beside",
        "share",
        "residual",
    )
    cells = []
    for r in rows:
        micro = 1e6 * r.seconds
        time = f"{micro:.2f} us" if micro < 1e3 else f"{micro / 1e3:.2f} ms"
        beside = r.beside and f"{r.beside} {1e9 * r.limit / r.work:.3g} ns"
        cells.append(
            (
                r.case,
                r.size,
                time,
                r.unit,
                f"{r.per_unit:.3g}",
                beside,
                _number(r.share, "{:.2f}"),
                _number(r.residual, "{:.1e}"),
            )
        )
    return markdown(head, cells)


@click.command("kernels")
@click.argument("cases", nargs=-1, metavar="[CASES]...")
@click.option("--seconds", default=0.2, show_default=True, metavar="S", help="Time for each case.")
def command(cases: tuple[str, ...], seconds: float) -> None:
    """Measure kernels and small calls alternately with bare loops of the same mathematics.

    CASES are names of cases; default: all.
    """
    click.echo(f"{machine.get_cpu_name()}\n")
    found: list[Row] = []
    list(run([name for name in cases if name not in CASES]))  # raises an error for an unknown name
    for name in cases or CASES:
        click.echo(name, err=True)
        found += run([name], seconds=seconds)
    click.echo(table(found))
