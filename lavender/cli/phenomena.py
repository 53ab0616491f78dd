"""Define `lavender phenomena`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from lavender.cli.options import PATH, parse_parameters, reject_unused_options
from lavender.io.stored import check_writable, write_text

if TYPE_CHECKING:
    from lavender.lab.phenomena import Record

ENGINE_PACKAGES = ("mujoco", "pybullet", "drake", "lavendersim", "newton", "numpy")


def _split_names(text: str | None) -> list[str] | None:
    if text is None or text == "all":
        return None
    return [] if text == "none" else [w.strip() for w in text.split(",") if w.strip()]


@click.command("phenomena")
@click.argument("names", nargs=-1, metavar="[NAMES]...")
@click.option("--steppers", help="Steppers of lavender, separated by commas; default: all; none: no stepper.")
@click.option(
    "--engines", default="none", show_default=True, help="Other engines, separated by commas, or all."
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
    """Measure steppers and engines on scenes with a known motion.

    A cell shows the worst distance from the exact motion and the number of cases within all bounds. A note says which
    engine is missing, crashed, or cannot build a scene.
    """
    from lavender.lab.phenomena import ENGINE_VARIANTS, run, select_phenomena
    from lavender.lab.phenomena import table as tables

    if listed:
        reject_unused_options(context, ["steppers", "engines", "parameters", "limit", "out"], "with --list")
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
            write_text(out, json.dumps(_collect_results(records), indent=1) + "\n")

    run(
        names,
        steppers=_split_names(steppers),
        engines=_split_names(engines),
        parameters=case,
        limit=limit,
        show=show,
    )
    for heading, lines in (
        ("Steppers of lavender out of bounds", tables.list_out_of_bound_cases(records)),
        ("Without values", tables.list_notes(records)),
    ):
        if lines:
            click.echo(f"{heading}:\n" + "\n".join(f"- {x}" for x in lines) + "\n")
    click.echo(tables.format_markdown_table(records))
    ran = {r.engine for r in records}
    click.echo(
        "\n"
        + "\n".join(
            f"- {variant.name}: {variant.text}" for variant in ENGINE_VARIANTS.values() if variant.name in ran
        )
    )


def _collect_results(records: list[Record]) -> dict[str, object]:
    """Return the content of the file of --out: processor, versions and records."""
    from lavender.lab.bench.machine import get_cpu_name, get_versions
    from lavender.lab.phenomena.engines import get_npm_versions

    return {
        "cpu": get_cpu_name(),
        "versions": get_versions(ENGINE_PACKAGES) | get_npm_versions(),
        "records": [asdict(r) for r in records],
    }
