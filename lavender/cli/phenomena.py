"""`lavender phenomena`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import click

from lavender.bench.machine import cpu_name, versions
from lavender.cli.options import parameters_of
from lavender.phenomena import WAYS, Record, chosen, run
from lavender.phenomena import table as tables
from lavender.phenomena.engines import versions_of_node

__all__ = ["phenomena"]

PACKAGES = ("mujoco", "pybullet", "drake", "lavendersim", "newton", "numpy")


def _names(text: str | None) -> list[str] | None:
    return None if text is None or text == "all" else [w.strip() for w in text.split(",") if w.strip()]


@click.command("phenomena")
@click.argument("names", nargs=-1, metavar="[NAMES]...")
@click.option("--steppers", default=None, help="Names with commas; default: all of ours. none: without ours.")
@click.option("--engines", default="none", show_default=True, help="Engines of others, with commas, or all.")
@click.option(
    "--set",
    "parameters",
    multiple=True,
    metavar="NAME=VALUE",
    help="A parameter, e.g. slope=0.9: one case in the place of a phenomenon's own; may be repeated.",
)
@click.option(
    "--limit", type=click.FloatRange(min=1.0), default=120.0, show_default=True, metavar="S",
    help="Wall time of one case in an engine of others.",
)  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), default=None, help="Every measurement, JSON.")
@click.option(
    "--list", "listed", is_flag=True, help="Tell what each is, its truth and its bounds; run nothing."
)
def phenomena(
    names: tuple[str, ...],
    steppers: str | None,
    engines: str,
    parameters: tuple[str, ...],
    limit: float,
    out: Path | None,
    listed: bool,
) -> None:
    """Scenes whose motion is known, measured in every stepper, and in the engines of others.

    A cell is the worst distance from the truth and the number of cases within all bounds. An engine that is missing,
    crashes, or cannot build a scene is a note.
    """
    if listed:
        click.echo(tables.described(chosen(names)))
        return
    if out is not None and not out.parent.is_dir():
        raise click.UsageError(f"{out}: there is no folder {out.parent}")
    case = parameters_of(parameters) if parameters else None
    some = {"steppers": _names(steppers), "engines": _names(engines)}
    found: list[Record] = []

    def show(record: Record) -> None:
        found.append(record)
        click.echo(tables.line(record), err=True)
        if out is not None:
            out.write_text(json.dumps(_told(found), indent=1) + "\n", encoding="utf-8")

    run(
        names,
        steppers=[] if some["steppers"] == ["none"] else some["steppers"],
        engines=[] if some["engines"] == ["none"] else some["engines"],
        parameters=case,
        limit=limit,
        show=show,
    )
    for heading, lines in (
        ("Ours out of their bounds", tables.losses(found)),
        ("Without values", tables.notes(found)),
    ):
        if lines:
            click.echo(f"{heading}:\n" + "\n".join(f"- {x}" for x in lines) + "\n")
    click.echo(tables.table(found))
    ran = {r.engine for r in found}
    click.echo("\n" + "\n".join(f"- {way.name}: {way.text}" for way in WAYS.values() if way.name in ran))


def _told(found: list[Record]) -> dict[str, object]:
    return {
        "cpu": cpu_name(),
        "versions": versions(PACKAGES) | versions_of_node(),
        "records": [asdict(r) for r in found],
    }
