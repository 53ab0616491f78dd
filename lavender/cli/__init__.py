"""The command line `lavender`, with one module for each command; `tools` has the small ones.

A command imports its modules when it runs, so that --help is fast.
"""

import sys

from lavender.base.errors import InputError, require_packages
from lavender.base.exits import (
    EXIT_BAD_INPUT,
    EXIT_CODES,
    EXIT_INFEASIBLE,
    EXIT_INTERRUPTED,
    EXIT_UNMET,
)

try:
    require_packages("the command line", "click", "rich", "threadpoolctl")
except InputError as error:
    sys.stderr.write(f"lavender: {error}\n")
    raise SystemExit(EXIT_BAD_INPUT) from None

from lavender.cli.entry import cli, main

__all__ = [
    "EXIT_BAD_INPUT",
    "EXIT_CODES",
    "EXIT_INFEASIBLE",
    "EXIT_INTERRUPTED",
    "EXIT_UNMET",
    "cli",
    "main",
]
