"""The group of all commands, and the entry point that turns what they raise into an exit code."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from types import FrameType
from typing import Any

import click

from lavender._version import __version__
from lavender.base import early_sigint as _early_sigint
from lavender.base.errors import LavenderError, UnknownName
from lavender.cli.options import EXIT_BAD_INPUT, EXIT_INTERRUPTED, say, suggest_new_option, unheard

#: Name -> the module that has the command.
COMMANDS = {
    name: f"lavender.cli.{name}"
    for name in ("audit", "bench", "cases", "check", "doctor", "explain", "export", "phenomena", "problems", "prove",
                 "record", "reference", "report", "run", "solve", "solvers", "tune")
} | dict.fromkeys(("view", "web"), "lavender.sim.web.command")  # fmt: skip


class Commands(click.Group):
    """Commands by name, each imported when it is asked for."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """An empty word would be read as the present folder."""
        if any(word == "" or (word.startswith("--") and word.endswith("=")) for word in args):
            raise click.UsageError("an empty argument: is a variable of the shell not set?", ctx)
        return super().parse_args(ctx, args)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Every name."""
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command of that name in its module."""
        if cmd_name not in COMMANDS:
            if not ctx.resilient_parsing:  # of a shell that completes words
                raise UnknownName("command", cmd_name, COMMANDS)
            return None
        command: click.Command = getattr(importlib.import_module(COMMANDS[cmd_name]), cmd_name)
        return command


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="lavender")
def cli() -> None:
    """Solve and compare constraint problems of rigid-body simulation: any solver by name, its error, its cost.

    Problems are files (.npz, .hdf5), folders of them, or cases of the built-in suite such as "stack(n=64)".
    """


def main(args: Sequence[str] | None = None) -> None:
    """Entry point: what lavender raises on purpose becomes one line and status 2, whatever Ctrl-C ends 130.

    SIGTERM, of a queue whose time is over or of `timeout`, is as Ctrl-C, with 143; a second one ends it at once.
    """
    _early_sigint.restore_handler()
    with _interruptions() as came:
        try:
            code = _code_of(args)
        except Exception as error:
            if not came:
                raise
            say(f"lavender: {type(error).__name__}: {error}", err=True)
            code = EXIT_BAD_INPUT
    if came and code not in (0, EXIT_INTERRUPTED):
        click.echo("lavender: stopped", err=True)
        code = EXIT_INTERRUPTED
    if code == EXIT_INTERRUPTED and signal.SIGTERM in came:
        code = 128 + signal.SIGTERM
    raise SystemExit(code)


#: What stops a command -> what Python does with it by itself.
STOPS: dict[int, Any] = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}


@contextlib.contextmanager
def _interruptions() -> Iterator[list[int]]:
    """Those that came: libraries in C make an error of their own of the exception that one raises in them."""
    came: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        came.append(number)
        if number == signal.SIGTERM:
            signal.signal(number, signal.SIG_DFL)
        signal.default_int_handler(number, frame)

    for number, usual in STOPS.items():
        with contextlib.suppress(ValueError):  # of another thread than the first
            if signal.getsignal(number) is usual:
                signal.signal(number, note)
    try:
        yield came
    finally:
        for number, usual in STOPS.items():
            if signal.getsignal(number) is note:
                signal.signal(number, usual)


def _code_of(args: Sequence[str] | None) -> int:
    """The exit code of a command, told what ended it."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # it was closed: a file that is opened next would stand in its place
            nowhere = os.open(os.devnull, os.O_WRONLY)
            setattr(sys, name, open(nowhere, "w", encoding="utf-8", closefd=False))  # noqa: SIM115 - to the end
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names of files may be of bytes that are no text
    try:
        code = cli.main(
            args=None if args is None else list(args), prog_name="lavender", standalone_mode=False
        )
        sys.stdout.flush()
    except LavenderError as error:
        say(f"lavender: {error}", err=True)
        code = EXIT_BAD_INPUT
    except click.exceptions.ClickException as error:
        if isinstance(error, click.NoSuchOption):
            suggest_new_option(error)
        error.show()
        code = error.exit_code
    except (click.exceptions.Abort, KeyboardInterrupt):
        click.echo("lavender: stopped", err=True)
        code = EXIT_INTERRUPTED
    except (BrokenPipeError, SystemExit):
        # `lavender solvers | head`: nobody reads any more, which click and rich turn into an exit of their own.
        unheard()
        code = 0
    except MemoryError as error:
        click.echo(
            f"lavender: not enough memory ({str(error) or 'none left'}): give a smaller problem", err=True
        )
        code = EXIT_BAD_INPUT
    except OSError as error:  # a full disk behind stdout, for one
        click.echo(f"lavender: {error}{_where()}", err=True)
        code = EXIT_BAD_INPUT
    return code if isinstance(code, int) else 0


def _where() -> str:
    """What explains an error of the system."""
    try:
        os.getcwd()
    except OSError:
        return " (the working directory is gone: change to a folder that is there)"
    return ""
