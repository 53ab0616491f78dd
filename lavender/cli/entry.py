"""The group of all commands, and the entry point that converts exceptions to exit codes."""

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
from lavender.cli.options import EXIT_BAD_INPUT, EXIT_INTERRUPTED, discard_output, echo

#: Commands by subject, as `lavender --help` lists them.
SECTIONS = {
    "Solve and judge": ("solve", "check", "prove", "explain", "doctor"),
    "Measure": ("report", "reference", "solvers", "cases", "problems", "bench"),
    "MuJoCo": ("record", "audit", "tune"),
    "Engine": ("run", "view", "web", "phenomena"),
    "C library": ("export",),
}
#: Name -> the module that defines the command.
COMMANDS = {name: f"lavender.cli.{name}" for names in SECTIONS.values() for name in names} | dict.fromkeys(
    ("view", "web"), "lavender.sim.web.command"
)


class Commands(click.Group):
    """Commands by name, each imported when it is used."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Reject empty arguments, which would be read as the current folder."""
        if any(word == "" or (word.startswith("--") and word.endswith("=")) for word in args):
            raise click.UsageError("an empty argument: is a shell variable not set?", ctx)
        return super().parse_args(ctx, args)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands."""
        return sorted(COMMANDS)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands under the headings of `COMMAND_GROUPS`."""
        width = max(map(len, COMMANDS))
        limit = formatter.width - 6 - width
        for heading, names in COMMAND_GROUPS.items():
            commands = [(name, self.get_command(ctx, name)) for name in names]
            with formatter.section(heading):
                formatter.write_dl(
                    [(name.ljust(width), c.get_short_help_str(limit)) for name, c in commands if c]
                )

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command and return it."""
        if cmd_name not in COMMANDS:
            if not ctx.resilient_parsing:  # Shell completion also passes incomplete names.
                raise UnknownName("command", cmd_name, COMMANDS)
            return None
        command: click.Command = getattr(importlib.import_module(COMMANDS[cmd_name]), cmd_name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands by subject, without cutting descriptions off."""
        width = max(map(len, COMMANDS))
        for section, names in SECTIONS.items():
            with formatter.section(section):
                commands = [(name, self.get_command(ctx, name)) for name in names]
                formatter.write_dl(
                    [
                        (name.ljust(width), c.get_short_help_str(limit=200))
                        for name, c in commands
                        if c is not None
                    ]
                )


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="lavender")
def cli() -> None:
    """Solve and compare constraint problems of rigid-body simulation.

    Problems are files (.npz, .hdf5), folders of them, or cases of the built-in suite such as "stack(n=64)".
    """


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line: lavender's errors become one line and exit code 2, Ctrl-C ends with 130.

    SIGTERM (from a batch queue or from `timeout`) is handled like Ctrl-C and ends with 143; a second one ends the
    process at once.
    """
    _early_sigint.restore_handler()
    with _recorded_signals() as received:
        try:
            code = _run_command(args)
        except Exception as error:
            if not received:
                raise
            echo(f"lavender: {type(error).__name__}: {error}", err=True)
            code = EXIT_BAD_INPUT
    if received and code not in (0, EXIT_INTERRUPTED):
        click.echo("lavender: stopped", err=True)
        code = EXIT_INTERRUPTED
    if code == EXIT_INTERRUPTED and signal.SIGTERM in received:
        code = 128 + signal.SIGTERM
    raise SystemExit(code)


#: Signal that stops a command -> Python's default handler.
STOPS: dict[int, Any] = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}


@contextlib.contextmanager
def _recorded_signals() -> Iterator[list[int]]:
    """Collect the signals that arrive: C libraries may replace the exception that a signal raises in them."""
    received: list[int] = []

    def record_signal(number: int, frame: FrameType | None) -> None:
        """Record a signal and raise KeyboardInterrupt."""
        received.append(number)
        if number == signal.SIGTERM:
            signal.signal(number, signal.SIG_DFL)
        signal.default_int_handler(number, frame)

    for number, default in STOPS.items():
        with contextlib.suppress(ValueError):  # Only the main thread may set handlers.
            if signal.getsignal(number) is default:
                signal.signal(number, record_signal)
    try:
        yield received
    finally:
        for number, default in STOPS.items():
            if signal.getsignal(number) is record_signal:
                signal.signal(number, default)


def _run_command(args: Sequence[str] | None) -> int:
    """Run a command and return its exit code; print the reason if it failed."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # The stream is closed: the next file would get its descriptor.
            null_device = os.open(os.devnull, os.O_WRONLY)
            setattr(sys, name, open(null_device, "w", encoding="utf-8", closefd=False))  # noqa: SIM115 - open until exit
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # File names may contain bytes that are not text.
    try:
        code = cli.main(
            args=None if args is None else list(args), prog_name="lavender", standalone_mode=False
        )
        sys.stdout.flush()
    except LavenderError as error:
        echo(f"lavender: {error}", err=True)
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
        # The output is no longer read, as in `lavender solvers | head`; click and rich convert this to an exit.
        discard_output()
        code = 0
    except MemoryError as error:
        click.echo(
            f"lavender: not enough memory ({str(error) or 'none is left'}): give a smaller problem", err=True
        )
        code = EXIT_BAD_INPUT
    except OSError as error:  # For example, the disk of a redirected stdout is full.
        click.echo(f"lavender: {error}{_explain_os_error()}", err=True)
        code = EXIT_BAD_INPUT
    return code if isinstance(code, int) else 0


def _explain_os_error() -> str:
    """Return an explanation if the working directory no longer exists; otherwise an empty string."""
    try:
        os.getcwd()
    except OSError:
        return " (the working directory is gone: change to a folder that exists)"
    return ""
