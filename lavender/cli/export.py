"""`lavender export`."""

from __future__ import annotations

from pathlib import Path

import click

from lavender.cli.options import FOLDER, refuse_unused, say
from lavender.io.stored import lock_output

VECTORS = 4  # problems in the test vectors, at most


@click.command()
@click.argument("kind", type=click.Choice(["c"]))
@click.argument("folder", type=FOLDER)
@click.option(
    "--for", "records", type=click.Path(exists=True, path_type=Path), metavar="RECORDS",
    help="records.jsonl of a report or its folder: add the recommended solver, settings and test vectors.",
)  # fmt: skip
@click.option("--solver", help="With --for: use this solver of the records, not the recommended one.")
@click.option("--replace", is_flag=True, help="Overwrite files of an earlier export that differ.")
@click.pass_context
def export(
    context: click.Context,
    kind: str,
    folder: Path,
    records: Path | None,
    solver: str | None,
    replace: bool,
) -> None:
    """Write the kernels for use without Python: a C library with one header."""
    from lavender.export import library, vectors

    if records is None:
        refuse_unused(context, ["solver"], "without --for")
    context.with_resource(lock_output(folder, folder=True))  # before the vectors are solved for
    more = vectors.make_files(records, solver, VECTORS) if records is not None else {}
    written = library.write(folder, more=more, replace=replace)
    say(f"{len(written)} files in {folder}: {', '.join(p.name for p in written)}")
