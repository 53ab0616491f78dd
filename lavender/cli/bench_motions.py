"""`lavender bench motions`."""

from __future__ import annotations

from pathlib import Path

import click

from lavender.bench.cases import resolve, structure_of
from lavender.bench.motions import Branches, Sample, branches, is_searched, samples, write_csv
from lavender.errors import InputError
from lavender.report.motions import figure, several_table, table

__all__ = ["motions"]


@click.command("motions")
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@click.option("--runs", type=click.IntRange(0), default=12, show_default=True, help="Runs of each search.")
@click.option(
    "--rows", type=click.IntRange(1), default=3000, show_default=True, help="Leave larger problems out."
)
@click.option(
    "--calibrate/--no-calibrate", default=True, show_default=True, help="Residual against motion error."
)
@click.option(
    "--search/--no-search", default=True, show_default=True, help="Several motions of each problem."
)
@click.option(
    "--figure", "picture", type=click.Path(path_type=Path), help="Residual against motion error, drawn."
)
@click.option("--out", type=click.Path(path_type=Path), help="Folder for samples.csv and motions.csv.")
def motions(
    files: tuple[str, ...],
    runs: int,
    rows: int,
    calibrate: bool,
    search: bool,
    picture: Path | None,
    out: Path | None,
) -> None:
    """What a residual tells of the motion, and how many motions a problem has.

    On FILES, or on the default set of the suite.
    """
    if out is not None and not out.is_dir():
        raise InputError(f"--out {out}: there is no such folder")
    if picture is not None and not calibrate:
        raise InputError("--figure draws the calibration; leave out --no-calibrate")
    seen: list[Sample] = []
    found: list[Branches] = []
    left = 0
    for item in resolve(files or ["default"]):
        problem = item.problem
        if not is_searched(problem, rows):
            left += 1
            continue
        structure = " + ".join(structure_of(problem))
        if search:
            found.append(branches(item.name, problem, structure, runs))
            click.echo(
                f"{item.name}: {found[-1].motions} motions, {found[-1].spread:.2g} m/s apart", err=True
            )
        if calibrate:
            seen += samples(item.name, problem, structure)
        item.forget()
    if seen:
        click.echo(table(seen))
    if found:
        click.echo(("\n" if seen else "") + several_table(found))
    if left:
        click.echo(f"\n{left} problems left out: empty, above {rows} rows, or without a solver here.")
    if picture is not None:
        figure(seen, picture)
    if out is not None:
        write_csv(seen, out / "samples.csv")
        write_csv(found, out / "motions.csv")
