"""`lavender phenomena`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import click

from lavender.bench.machine import cpu_name, versions
from lavender.cli.options import parameters_of
from lavender.engine.picture import PICTURES
from lavender.phenomena import WAYS, Record, Track, chosen, run
from lavender.phenomena import motion as motions
from lavender.phenomena import table as tables
from lavender.phenomena.engines import versions_of_node
from lavender.phenomena.film import save_film
from lavender.scene.steppers import STEPPERS

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
    "--motion", is_flag=True, help="Steppers' distance from a reference on six scenes, against time."
)
@click.option(
    "--plot", type=click.Path(path_type=Path), default=None, help="Figure of --motion (.svg, .png)."
)
@click.option(
    "--film", type=click.Path(path_type=Path), default=None,
    help="One phenomenon as each engine does it, beside each other: .gif, .mp4 (animations), .png, .svg (strips).",
)  # fmt: skip
@click.option(
    "--magnify", type=click.FloatRange(min=1.0), default=1.0, show_default=True,
    help="Show distances from the first engine of --film so many times as large.",
)  # fmt: skip
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
    motion: bool,
    plot: Path | None,
    film: Path | None,
    magnify: float,
    listed: bool,
) -> None:
    """Scenes whose motion is known, measured in every stepper, and in the engines of others.

    A cell is the worst distance from the truth and the number of cases within all bounds. An engine that is missing,
    crashes, or cannot build a scene is a note.
    """
    if listed:
        click.echo(tables.described(chosen(names)))
        return
    for path in (out, plot, film):
        if path is not None and not path.parent.is_dir():
            raise click.UsageError(f"{path}: there is no folder {path.parent}")
    if motion:
        if names or parameters or engines != "none" or film is not None:
            raise click.UsageError("--motion goes with --steppers, --out and --plot; its scenes are its own")
        _motion(_names(steppers), out, plot)
        return
    if plot is not None:
        raise click.UsageError("--plot goes with --motion")
    if film is not None and (len(names) != 1 or film.suffix.lower() not in PICTURES):
        raise click.UsageError(f"--film takes one phenomenon, and a file that ends in {', '.join(PICTURES)}")
    case = parameters_of(parameters) if parameters else None
    if film is not None and case is None:
        case = dict(chosen(names)[0].cases[0])
    some = {"steppers": _names(steppers), "engines": _names(engines)}
    found: list[Record] = []
    tracks: dict[str, Track] = {}

    def keep(record: Record, track: Track) -> None:
        if film is not None:
            tracks[record.engine] = track

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
        keep=keep,
    )
    if film is not None:
        save_film(chosen(names)[0], found[0].case, tracks, film, magnify)
    for heading, lines in (
        ("Ours out of their bounds", tables.losses(found)),
        ("Without values", tables.notes(found)),
    ):
        if lines:
            click.echo(f"{heading}:\n" + "\n".join(f"- {x}" for x in lines) + "\n")
    click.echo(tables.table(found))
    ran = {r.engine for r in found}
    click.echo("\n" + "\n".join(f"- {way.name}: {way.text}" for way in WAYS.values() if way.name in ran))


def _motion(steppers: list[str] | None, out: Path | None, plot: Path | None) -> None:
    def show(point: motions.Point) -> None:
        words = point.note or f"{1e3 * point.distance:.3g} mm, {1e3 * point.cpu:.3g} ms a second"
        click.echo(f"{point.scene}, {point.stepper} {point.substeps} x {point.sweeps}: {words}", err=True)

    found = motions.measure(steppers=steppers or tuple(STEPPERS), show=show)
    if out is not None:
        points = [asdict(p) for p in found]
        out.write_text(json.dumps({"cpu": cpu_name(), "points": points}, indent=1) + "\n", encoding="utf-8")
    if plot is not None:
        motions.plot(found, plot)
    click.echo(motions.table(found))


def _told(found: list[Record]) -> dict[str, object]:
    return {
        "cpu": cpu_name(),
        "versions": versions(PACKAGES) | versions_of_node(),
        "records": [asdict(r) for r in found],
    }
