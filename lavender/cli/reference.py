"""`lavender reference`."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from lavender.base.errors import InputError
from lavender.cli.options import Reading, going_on, one_thread, say


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

    Exit code 1: nothing solves a problem or proves a solution, or a file in a folder cannot be read. Exit code 2: a
    named file cannot be read.
    """
    from lavender.lab import bench, motion
    from lavender.lab.proof import enclosed, require

    one_thread()
    if proven:
        require()

    def tell(text: str, style: str = "") -> None:
        with going_on():
            say(text, style=style)

    unmet, reading = False, Reading(partial(tell, style="yellow"))
    for item in bench.resolve(files):
        with reading(item):
            if not Path(item.source).is_file():
                raise InputError(f"{item.source} is no file; a reference is written beside one")
            proof = enclosed(item.problem) if proven else None
            found = motion.reference(item.problem.disk)
            if proof is not None and not proof.proven:
                reading.tell(f"{item.name}: {proof}")
                unmet = True
            elif not found.accepted:
                reading.tell(
                    f"{item.name}: nothing reached the floor ({found}); there is no reference to write"
                )
                unmet = True
            else:
                tell(f"{item.name}: {found}, written: {motion.save_reference(item.problem, item.source)}")
    reading.end(unmet)
