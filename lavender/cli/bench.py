"""`lavender bench`, and the commands of its own first words."""

from __future__ import annotations

import importlib
from functools import partial
from pathlib import Path
from typing import Any

import click

from lavender.cli.measuring import measure
from lavender.cli.options import (
    EXIT_INTERRUPTED,
    EXIT_UNMET,
    Asked,
    ManyValues,
    console,
    one_thread,
    plan_options,
    refuse_idle,
    was_given,
)

__all__ = ["bench"]


class Suites(ManyValues):
    """`lavender bench mujoco` is a command; other first words are files (or ./mujoco)."""

    OWN = {  # noqa: RUF012 - a constant of the class
        "mujoco": "lavender.cli.bench_mujoco:mujoco",
    }

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        """The context of the command that the first word names, or of this one."""
        if not args or args[0] not in self.OWN:
            return super().make_context(info_name, args, parent, **extra)
        module, _, attribute = self.OWN[args[0]].partition(":")
        one_thread()
        own: click.Command = getattr(importlib.import_module(module), attribute)
        return own.make_context(f"{info_name} {args[0]}", args[1:], parent, **extra)


@click.command(cls=Suites)
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@plan_options
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("records.jsonl"),
    show_default=True,
    help="File of the records.",
)
@click.pass_context
def bench(
    context: click.Context,
    files: tuple[str, ...],
    asked: Asked,
    out: Path,
) -> None:
    """As `report`, but only the records: a .jsonl file that `lavender report` shows later.

    `lavender bench mujoco` compares with MuJoCo on models of your own instead; see its own --help.
    """
    refuse_idle(context, asked.solvers)
    done = measure(files, asked, asked.plan(files), out, given=partial(was_given, context))
    shown_on = console()
    shown_on.print(f"{len(done.records)} runs in {out}", highlight=False, markup=False, soft_wrap=True)
    if done.note:
        shown_on.print(done.note.partition(";")[0], highlight=False, markup=False)
    if done.stopped:
        raise click.exceptions.Exit(EXIT_INTERRUPTED)
    if done.lost:
        raise click.exceptions.Exit(EXIT_UNMET)
