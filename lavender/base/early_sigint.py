"""End the command `lavender` with status 130 and one line if Ctrl-C comes while it is being imported.

This module is imported first, by the package and by its command line. It does nothing in other programs, in threads
other than the main thread, or if SIGINT already has a handler.
"""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

EXIT_INTERRUPTED = 130  # Shells report this status for a command that Ctrl-C ended.


def _is_lavender_command() -> bool:
    """Return whether this process runs the command `lavender`, as a script or by `python -m`."""
    program = sys.argv[0] if sys.argv else ""
    if program == "-m":
        # `sys.argv[0]` is "-m" until Python has found the module: read the original command line instead.
        option = sys.orig_argv[-len(sys.argv)]
        module = (
            option.partition("m")[2] if option.startswith("-") else option
        )  # The option is "-Imlavender" or "lavender".
        return module in ("lavender", "lavender.cli")
    folder, name = os.path.split(program)
    if name == "__main__.py":
        return folder == os.path.dirname(os.path.dirname(__file__))
    return name.removesuffix(".exe").removesuffix("-script.py") == "lavender"


def _exit_on_signal(number: int, frame: FrameType | None) -> None:
    os.write(2, b"lavender: stopped\n")
    os._exit(EXIT_INTERRUPTED)  # End without clean-up, which is not needed before the command has started.


def exit_on_sigint() -> None:
    """Let Ctrl-C end the command at once."""
    if _is_lavender_command() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        try:
            signal.signal(signal.SIGINT, _exit_on_signal)
        except ValueError:  # Handlers can only be set in the main thread.
            return


def restore_keyboard_interrupt() -> None:
    """Let Ctrl-C raise KeyboardInterrupt again."""
    if signal.getsignal(signal.SIGINT) is _exit_on_signal:
        signal.signal(signal.SIGINT, signal.default_int_handler)


exit_on_sigint()
