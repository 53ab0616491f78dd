"""Define `lavender export`."""

from __future__ import annotations

from pathlib import Path

import click

from lavender.cli.options import FOLDER, print_escaped
from lavender.io.stored import lock_output


@click.command()
@click.argument("kind", type=click.Choice(["c"]))
@click.argument("folder", type=FOLDER)
@click.option("--replace", is_flag=True, help="Overwrite files of an earlier export that differ.")
@click.pass_context
def export(context: click.Context, kind: str, folder: Path, replace: bool) -> None:
    """Write the kernels as a C library with one header.

    The library does not need Python.
    """
    from lavender.export import library

    context.with_resource(lock_output(folder, folder=True))  # Lock the folder before the long computation.
    written = library.write(folder, replace=replace)
    print_escaped(f"{len(written)} files in {folder}: {', '.join(p.name for p in written)}")
