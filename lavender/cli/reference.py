"""Define `lavender reference`."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from lavender.base.errors import InputError
from lavender.cli.options import (
    ErrorReporter,
    continue_after_closed_output,
    limit_to_one_thread,
    print_escaped,
)


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="FILES | FOLDERS...")
@click.option(
    "--prove", "proven", is_flag=True, help="Write only proven exact solutions, rounded to float64."
)
def reference(files: tuple[str, ...], proven: bool) -> None:
    """Solve problems to the floor and write reference solutions.

    The solution of pile.npz is written to pile.npz.reference, which `lavender report --motion` uses instead of solving
    pile.npz again. The content of such a file is judged before it is used. With `--prove` (extra `proof`), motion
    errors are relative to an exact solution, which does not depend on a solver.

    Exit code 1: a problem was not solved to the floor, or its solution was not proven; or a file in a folder
    cannot be read. Exit code 2: a named file cannot be read.
    """
    from lavender.lab import bench, motion
    from lavender.lab.proof import enclose_reference, require_python_flint

    limit_to_one_thread()
    if proven:
        require_python_flint()

    def print_line(text: str, style: str = "") -> None:
        with continue_after_closed_output():
            print_escaped(text, style=style)

    unmet, errors = False, ErrorReporter(partial(print_line, style="yellow"))
    for item in bench.resolve_sources(files):
        with errors(item):
            if not Path(item.source).is_file():
                raise InputError(f"{item.source} is not a file; a reference is written next to a file")
            proof = enclose_reference(item.problem) if proven else None
            reference = motion.get_reference(item.problem.disk)
            if proof is not None and not proof.proven:
                errors.report(f"{item.name}: {proof}")
                unmet = True
            elif not reference.is_accepted:
                errors.report(
                    f"{item.name}: no solver reached the floor ({reference}); no reference is written"
                )
                unmet = True
            else:
                print_line(
                    f"{item.name}: {reference}, written: {motion.save_reference(item.problem, item.source)}"
                )
    errors.exit(unmet)
