"""Define `lavender reference`."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from lavender.base.errors import InputError
from lavender.cli.options import Reading, echo, ignore_closed_pipe, set_one_thread


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="FILES | FOLDERS...")
@click.option(
    "--prove",
    "proven",
    is_flag=True,
    help="Write only exact solutions that are enclosed with a proof, rounded.",
)
def reference(files: tuple[str, ...], proven: bool) -> None:
    """Solve problems to the floor and write references to their files.

    `lavender report --motion` then uses pile.npz.reference instead of solving pile.npz again. The content of such a
    file is judged before it is used. With --prove (extra `proof`), motion errors are distances from an exact solution,
    which depends on no solver.

    Exit code 1: no solver solves a problem, no solution is proved, or a file in a folder cannot be read. Exit code 2: a
    named file cannot be read.
    """
    from lavender.lab import bench, motion
    from lavender.lab.proof import enclose_reference, require_python_flint

    set_one_thread()
    if proven:
        require_python_flint()

    def report_line(text: str, style: str = "") -> None:
        """Print a line, even if the output is no longer read."""
        with ignore_closed_pipe():
            echo(text, style=style)

    unmet, reading = False, Reading(partial(report_line, style="yellow"))
    for item in bench.resolve(files):
        with errors(item):
            if not Path(item.source).is_file():
                raise InputError(f"{item.source} is not a file; a reference is written next to one")
            proof = enclose_reference(item.problem) if proven else None
            solution = motion.reference(item.problem.disk)
            if proof is not None and not proof.proven:
                reading.report(f"{item.name}: {proof}")
                unmet = True
            elif not solution.accepted:
                reading.report(
                    f"{item.name}: nothing reached the floor ({solution}); there is no reference to write"
                )
                unmet = True
            else:
                report_line(
                    f"{item.name}: {solution}, written: {motion.save_reference(item.problem, item.source)}"
                )
    reading.end(unmet)
