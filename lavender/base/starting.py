"""Ctrl-C while the command `lavender` is still being imported: status 130 and one word, as later.

First of all imports, of the package and of its command line. It does nothing in other programs, nor in threads, nor
where somebody handles the signal.
"""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

STATUS = 130  # what shells show of a command that Ctrl-C ended


def _is_command() -> bool:
    first = sys.argv[0] if sys.argv else ""
    if first == "-m":  # as long as the module is looked for; its name stands alone or as in -Imlavender
        word = sys.orig_argv[-len(sys.argv)]
        return (word.partition("m")[2] if word.startswith("-") else word) in ("lavender", "lavender.cli")
    folder, name = os.path.split(first)
    if name == "__main__.py":
        return folder == os.path.dirname(os.path.dirname(__file__))
    return name.removesuffix(".exe").removesuffix("-script.py") == "lavender"


def _stop(number: int, frame: FrameType | None) -> None:
    os.write(2, b"lavender: stopped\n")
    os._exit(STATUS)  # nothing is begun that would have to be undone


def begin() -> None:
    """From here on Ctrl-C ends the command at once."""
    if _is_command() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        try:
            signal.signal(signal.SIGINT, _stop)
        except ValueError:  # of another thread than the first
            return


def end() -> None:
    """From here on Ctrl-C is what it was."""
    if signal.getsignal(signal.SIGINT) is _stop:
        signal.signal(signal.SIGINT, signal.default_int_handler)


begin()
