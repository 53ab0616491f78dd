"""The command `lavender`: one file for each of its subcommands.

A command imports the modules that it needs when it runs, so that --help is quick.
"""

from lavender.base import early_sigint as _early_sigint

_early_sigint.install_handler()  # It is active until `main` runs.

from lavender.cli.entry import cli, main  # noqa: E402
from lavender.cli.options import EXIT_BAD_INPUT, EXIT_INFEASIBLE, EXIT_INTERRUPTED, EXIT_UNMET  # noqa: E402

__all__ = ["EXIT_BAD_INPUT", "EXIT_INFEASIBLE", "EXIT_INTERRUPTED", "EXIT_UNMET", "cli", "main"]
