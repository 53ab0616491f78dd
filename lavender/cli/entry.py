"""Define the group of all commands and the entry point `main`, which converts exceptions to exit codes."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Sequence

import click

from lavender._version import __version__
from lavender.base.errors import LavenderError, UnknownName
from lavender.base.exits import EXIT_BAD_INPUT, EXIT_INTERRUPTED
from lavender.cli.options import print_escaped

#: Names of the commands by the heading under which `lavender --help` lists them.
COMMAND_GROUPS = {
    "Solve and judge": ("solve", "judge", "check", "explain"),
    "Measure": ("report",),
    "MuJoCo": ("record", "audit", "tune", "slip", "compare"),
    "Engine": ("run", "web"),
    "Tools": ("solvers", "contract", "doctor", "export"),
}
#: Module of each command.
COMMANDS = {
    **{name: f"lavender.cli.{name}" for names in COMMAND_GROUPS.values() for name in names},
    **dict.fromkeys(("explain", "record", "contract", "doctor", "export"), "lavender.cli.tools"),
    "web": "lavender.sim.web.command",
}


class Commands(click.Group):
    """Group of all commands. The module of a command is imported when the command is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands."""
        return sorted(COMMANDS)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands under the headings of `COMMAND_GROUPS`."""
        width = max(map(len, COMMANDS))
        limit = formatter.width - 6 - width
        for heading, names in COMMAND_GROUPS.items():
            commands = [(name, self.get_command(ctx, name)) for name in names]
            rows = [(name.ljust(width), c.get_short_help_str(limit)) for name, c in commands if c]
            with formatter.section(heading):
                formatter.write_dl(rows)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return a command; an unknown name raises UnknownName."""
        if cmd_name not in COMMANDS:
            if (
                not ctx.resilient_parsing
            ):  # While a shell completes words, unknown names raise no error.
                raise UnknownName("command", cmd_name, COMMANDS)
            return None
        command: click.Command = getattr(importlib.import_module(COMMANDS[cmd_name]), cmd_name)
        return command


@click.group(
    cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110}
)
@click.version_option(__version__, prog_name="lavender")
def cli() -> None:
    """Solve constraint problems of rigid-body simulation, and compare the error and the cost of solvers.

    Problems are files (.npz, .hdf5), folders of them, or cases of the built-in suite such as "stack(n=64)".
    """


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line. An error of lavender is printed as one line and exits with 2, Ctrl-C exits with 130."""
    try:
        with warnings.catch_warnings():
            # Print a warning as one line, without the line of source that issued it.
            warnings.showwarning = lambda message, *place, **more: print_escaped(
                f"lavender: warning: {message}", err=True
            )
            words = None if args is None else list(args)
            code = cli.main(words, prog_name="lavender", standalone_mode=False)
    except LavenderError as error:
        print_escaped(f"lavender: {error}", err=True)
        code = EXIT_BAD_INPUT
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except (click.Abort, KeyboardInterrupt):  # click raises Abort from KeyboardInterrupt.
        click.echo("lavender: stopped", err=True)
        code = EXIT_INTERRUPTED
    raise SystemExit(code if isinstance(code, int) else 0)
