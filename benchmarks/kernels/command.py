"""The command `python -m benchmarks kernels`, and its tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import click

from benchmarks.kernels.cases import CASES, Row, run, scaling
from benchmarks.kernels.instructions import COUNTED, instructions
from benchmarks.kernels.limits import FOOTPRINTS, Limit, measure_limits
from benchmarks.output import folder_of, markdown, write_json
from lavender.bench import machine

__all__ = ["command", "limits_table", "scaling_table", "table"]


def _number(x: float, form: str = "{:.3g}") -> str:
    return "-" if x != x else form.format(x)


def table(rows: Sequence[Row]) -> str:
    """Every row, markdown."""
    head = (
        "case",
        "size",
        "time",
        "unit",
        "ns / unit",
        "bytes / unit",
        "instructions / unit",
        "limit",
        "share",
        "residual",
    )
    cells = []
    for r in rows:
        micro = 1e6 * r.seconds
        time = f"{micro:.2f} us" if micro < 1e3 else f"{micro / 1e3:.2f} ms"
        limit = r.limit_name and f"{r.limit_name} {1e9 * r.limit / r.work:.3g} ns"
        cells.append(
            (
                r.case, r.size, time, r.unit, f"{r.per_unit:.3g}", _number(r.bytes, "{:.0f}"), _number(r.instructions),
                limit, _number(r.share, "{:.2f}"), _number(r.residual, "{:.1e}"),
            )
        )  # fmt: skip
    return markdown(head, cells)


def limits_table(found: Sequence[Limit]) -> str:
    """The machine's limits, markdown."""
    kinds = ("read", "triad", "chase")
    value = {(x.name, x.kib): x for x in found}
    cells = [
        (f"{kib:,} KiB", *(f"{value[k, kib].value:.3g} {value[k, kib].unit}" for k in kinds))
        for kib in FOOTPRINTS
    ]
    lines = markdown(("footprint", "read", "triad", "dependent load"), cells)
    return f"{lines}\n\ndependent product and sum: {value['chain', 0].value:.2f} ns"


def scaling_table(rows: Sequence[dict[str, float]]) -> str:
    """What `scaling` gives, markdown."""
    head = (
        "contacts",
        "build s",
        "100 sweeps s",
        "residual",
        "ns / contact and sweep",
        "bare ns",
        "share",
        "MB",
    )
    return markdown(
        head,
        [
            (
                f"{r['contacts']:,.0f}", f"{r['build']:.3f}", f"{r['solve']:.3f}", f"{r['residual']:.1e}",
                f"{r['sweep']:.1f}", f"{r['bare']:.1f}", f"{r['bare'] / r['sweep']:.2f}", f"{r['megabytes']:.0f}",
            )
            for r in rows
        ],
    )  # fmt: skip


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
def command(cases: tuple[str, ...], seconds: float, largest: int, count: bool, out: Path | None) -> None:
    """Kernels, small calls and whole jobs beside the limits of this machine, measured in the same run.

    CASES are names; without them all of them, then piles of growing size.
    """
    folder_of(out)
    found: list[Row] = []
    click.echo(f"{machine.cpu_name()}\n")
    names = cases or CASES
    list(run(names=[n for n in names if n not in CASES]))  # a wrong name ends it here
    bounds = measure_limits()
    click.echo(limits_table(bounds) + "\n")
    for name in names:
        click.echo(name, err=True)
        rows = list(run([name], seconds=seconds))
        if count and name in COUNTED:
            rows = [replace(r, instructions=instructions(name)) for r in rows]
        found += rows
    click.echo(table(found))
    growth: list[dict[str, float]] = []
    if largest and not cases:
        sizes = [s for s in (1_000, 10_000, 100_000, 1_000_000) if s < largest] + [largest]
        growth = list(scaling(sizes, seconds=max(seconds, 0.5)))
        click.echo("\n" + scaling_table(growth))
    if out is not None:
        lines = [asdict(r) | {"ns_per_unit": r.per_unit, "share": r.share} for r in found]
        write_json(out, lines, limits=[asdict(x) for x in bounds], scaling=growth)
