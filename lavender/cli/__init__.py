"""The command line `lavender`, with one module for each command.

A command imports its modules when it runs, so that --help is fast.
"""

from lavender.base import early_sigint as _early_sigint

_early_sigint.install_handler()  # `main` restores the handler.

from lavender.cli.entry import cli, main  # noqa: E402
from lavender.cli.options import EXIT_BAD_INPUT, EXIT_INFEASIBLE, EXIT_INTERRUPTED, EXIT_UNMET  # noqa: E402

__all__ = ["EXIT_BAD_INPUT", "EXIT_INFEASIBLE", "EXIT_INTERRUPTED", "EXIT_UNMET", "cli", "main"]
