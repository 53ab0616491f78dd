"""The group of all commands, and the entry point that turns what they raise into an exit code."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Sequence

import click

from lavender import _starting
from lavender._version import __version__
from lavender.cli.bench import bench
from lavender.cli.cases import cases
from lavender.cli.check import check
from lavender.cli.doctor import doctor
from lavender.cli.explain import explain
from lavender.cli.export import export
from lavender.cli.options import EXIT_BAD_INPUT, EXIT_INTERRUPTED
from lavender.cli.phenomena import phenomena
from lavender.cli.record import record
from lavender.cli.reference import reference
from lavender.cli.report import report
from lavender.cli.run import run
from lavender.cli.solve import solve
from lavender.cli.solvers import solvers
from lavender.errors import LavenderError
from lavender.web.command import view, web

__all__ = ["cli", "main"]


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="lavender")
def cli() -> None:
    """Solve and compare constraint problems of rigid-body simulation: any solver by name, its error, its cost.

    Problems are files (.npz, .hdf5), folders of them, or cases of the built-in suite such as "stack(n=64)".
    """


for _command in (
    report, bench, check, solve, explain, reference, solvers, cases, run, record, phenomena, export, web, view, doctor,
):  # fmt: skip
    cli.add_command(_command)


def main(args: Sequence[str] | None = None) -> None:
    """Entry point: what lavender raises on purpose becomes one line and status 2."""
    _starting.end()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names of files may be of bytes that are no text
    try:
        code = cli.main(
            args=None if args is None else list(args), prog_name="lavender", standalone_mode=False
        )
    except LavenderError as error:
        click.echo(f"lavender: {error}", err=True)
        code = EXIT_BAD_INPUT
    except click.exceptions.ClickException as error:
        error.show()
        code = error.exit_code
    except (click.exceptions.Abort, KeyboardInterrupt):
        click.echo("lavender: stopped", err=True)
        code = EXIT_INTERRUPTED
    except BrokenPipeError:
        # `lavender solvers | head`: nobody reads any more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except MemoryError as error:
        click.echo(f"lavender: not enough memory ({error or 'none left'}): give a smaller problem", err=True)
        code = EXIT_BAD_INPUT
    except OSError as error:  # a full disk behind stdout, for one
        click.echo(f"lavender: {error}", err=True)
        code = EXIT_BAD_INPUT
    raise SystemExit(code if isinstance(code, int) else 0)
