"""Define `lavender phenomena`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from lavender.cli.options import PATH, parse_parameters, reject_unused
from lavender.io.stored import writable, write_text

if TYPE_CHECKING:
    from lavender.lab.phenomena import Record

ENGINE_PACKAGES = ("mujoco", "pybullet", "drake", "lavendersim", "newton", "numpy")


def _names(text: str | None) -> list[str] | None:
    """Split a comma-separated list of names; None selects all."""
    if text is None or text == "all":
        return None
    return [] if text == "none" else [w.strip() for w in text.split(",") if w.strip()]


@click.command("phenomena")
@click.argument("names", nargs=-1, metavar="[NAMES]...")
@click.option("--steppers", help="lavender's steppers, separated by commas, or none; default: all.")
@click.option(
    "--engines",
    default="none",
    show_default=True,
    help="Other engines, separated by commas, or all, or none.",
)
@click.option(
    "--set",
    "parameters",
    multiple=True,
    metavar="NAME=VALUE",
    help="Set a parameter, e.g. slope=0.9: one case instead of the phenomenon's own; may be repeated.",
)
@click.option(
    "--limit", type=click.FloatRange(min=1.0), default=120.0, show_default=True, metavar="S",
    help="Limit of the wall time of one case in another engine.",
)  # fmt: skip
@click.option("--out", type=PATH, help="Write every measurement as JSON.")
@click.option(
    "--list",
    "listed",
    is_flag=True,
    help="Describe each phenomenon, its exact motion and its bounds; run nothing.",
)
@click.pass_context
def phenomena(
    context: click.Context,
    names: tuple[str, ...],
    steppers: str | None,
    engines: str,
    parameters: tuple[str, ...],
    limit: float,
    out: Path | None,
    listed: bool,
) -> None:
    """Measure steppers and engines on scenes with known motion.

    A cell shows the worst distance from the exact motion and the number of cases within all bounds. A note says which
    engine is missing, crashed, or cannot build a scene.
    """
    from lavender.lab.phenomena import WAYS, run, select_phenomena
    from lavender.lab.phenomena import table as tables

    if listed:
        reject_unused(context, ["steppers", "engines", "parameters", "limit", "out"], "with --list")
        click.echo(tables.describe_phenomena(select_phenomena(names)))
        return
    if out is not None:
        check_writable(out)
    case = parse_parameters(parameters) if parameters else None
    records: list[Record] = []

    def show(record: Record) -> None:
        records.append(record)
        click.echo(tables.format_record(record), err=True)
        if out is not None:
            write_text(out, json.dumps(_to_json(records), indent=1) + "\n")

    run(
        names,
        steppers=_split_names(steppers),
        engines=_split_names(engines),
        parameters=case,
        limit=limit,
        show=show,
    )
    for heading, lines in (
        ("lavender's steppers out of their bounds", tables.out_of_bound_cases(records)),
        ("Without values", tables.notes(records)),
    ):
        if lines:
            click.echo(f"{heading}:\n" + "\n".join(f"- {x}" for x in lines) + "\n")
    click.echo(tables.table(records))
    measured = {r.engine for r in records}
    click.echo("\n" + "\n".join(f"- {way.name}: {way.text}" for way in WAYS.values() if way.name in measured))


def _to_json(records: list[Record]) -> dict[str, object]:
    """Collect records with the machine and versions."""
    from lavender.lab.bench.machine import cpu_name, versions
    from lavender.lab.phenomena.engines import versions_of_node

    return {
        "cpu": cpu_name(),
        "versions": versions(PACKAGES) | versions_of_node(),
        "records": [asdict(r) for r in records],
    }
