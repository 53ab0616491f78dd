"""Define `lavender export`."""

from __future__ import annotations

from pathlib import Path

import click

from lavender.cli.options import FOLDER, print_escaped, reject_unused_options
from lavender.io.stored import lock_output

MAX_TEST_PROBLEMS = 4  # Largest number of problems in the test vectors.


@click.command()
@click.argument("kind", type=click.Choice(["c"]))
@click.argument("folder", type=FOLDER)
@click.option(
    "--records", "records", type=click.Path(exists=True, path_type=Path), metavar="RECORDS",
    help="records.jsonl of a report or its folder: add the recommended solver, settings and test vectors.",
)  # fmt: skip
@click.option("--solver", help="With --records: use this solver of the records, not the recommended one.")
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
    """Write the kernels as a C library with one header.

    The library does not need Python.
    """
    from lavender.export import library, vectors

    if records is None:
        reject_unused_options(context, ["solver"], "without --records")
    context.with_resource(lock_output(folder, folder=True))  # Lock the folder before the long computation.
    more = vectors.make_export_files(records, solver, MAX_TEST_PROBLEMS) if records is not None else {}
    written = library.write(folder, more=more, replace=replace)
    print_escaped(f"{len(written)} files in {folder}: {', '.join(p.name for p in written)}")
