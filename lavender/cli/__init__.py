"""The command line `lavender`, with one module for each command.

A command imports its modules when it runs, so that --help is fast.
"""

import sys

from lavender.base.errors import InputError, require_packages

try:
    require_packages("the command line", "click", "rich", "threadpoolctl")
except InputError as error:
    sys.stderr.write(f"lavender: {error}\n")
    # The value of EXIT_BAD_INPUT, whose module cannot be imported without click.
    raise SystemExit(2) from None

from lavender.cli.entry import cli, main
from lavender.cli.options import EXIT_BAD_INPUT, EXIT_INFEASIBLE, EXIT_INTERRUPTED, EXIT_UNMET

__all__ = ["EXIT_BAD_INPUT", "EXIT_INFEASIBLE", "EXIT_INTERRUPTED", "EXIT_UNMET", "cli", "main"]
