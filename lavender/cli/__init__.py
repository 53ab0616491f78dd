"""The command line `lavender`, with one module for each command.

A command imports its modules when it runs, so that --help is fast.
"""

import sys

from lavender.base import early_sigint as _early_sigint

_early_sigint.exit_on_sigint()  # `main` restores the handler.

from lavender.base.errors import InputError, require_packages  # noqa: E402

try:
    require_packages("the command line", "click", "rich", "threadpoolctl")
except InputError as error:
    sys.stderr.write(f"lavender: {error}\n")
    raise SystemExit(2) from None  # EXIT_BAD_INPUT, which is defined in a module that needs click

from lavender.cli.entry import cli, main  # noqa: E402
from lavender.cli.options import EXIT_BAD_INPUT, EXIT_INFEASIBLE, EXIT_INTERRUPTED, EXIT_UNMET  # noqa: E402

__all__ = ["EXIT_BAD_INPUT", "EXIT_INFEASIBLE", "EXIT_INTERRUPTED", "EXIT_UNMET", "cli", "main"]
