"""`lavender reference`."""

from __future__ import annotations

from pathlib import Path

import click

from lavender.base.errors import InputError, LavenderError
from lavender.cli.options import EXIT_BAD_INPUT, EXIT_UNMET, console, going_on, one_thread, plain


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="FILES | FOLDERS...")
@click.option(
    "--prove", "proven", is_flag=True, help="Only exact solutions that are enclosed with proof, rounded."
)
def reference(files: tuple[str, ...], proven: bool) -> None:
    """Solve each problem to the floor and write the solution beside its file.

    `lavender report --motion` then uses pile.npz.reference instead of solving pile.npz again. The content of such a
    file is judged before it is used. With `--prove` (extra `proof`) motion errors are then those to an exact solution,
    which owes nothing to any solver.

    Exits with 1 when nothing solves a problem or proves a solution, or a file met in a folder cannot be read.
    """
    from lavender.lab import bench, motion
    from lavender.lab.proof import enclosed, require

    one_thread()
    if proven:
        require()
    out = console()
    unmet = missing = 0
    for item in bench.resolve(files):
        try:
            if not Path(item.source).is_file():
                raise InputError(f"{item.source} is no file; a reference is written beside one")
            if proven and not (found := enclosed(item.problem)).proven:
                raise InputError(str(found))
            written = motion.save_reference(item.problem, item.source)
            told = f"{item.name}: {motion.reference(item.problem.disk)}, written: {written}"
            with going_on():
                out.print(plain(told), highlight=False, soft_wrap=True)
        except LavenderError as error:
            with going_on():
                out.print(plain(f"{item.name}: {error}"), style="yellow", highlight=False, soft_wrap=True)
            unread = isinstance(error, InputError) and item.named and not Path(item.source).is_file()
            missing += unread
            unmet += not unread
        finally:
            item.forget()
    if missing:
        raise click.exceptions.Exit(EXIT_BAD_INPUT)
    if unmet:
        raise click.exceptions.Exit(EXIT_UNMET)
