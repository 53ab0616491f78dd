"""A program of another language that answers each line of JSON with one.

It has no limit and no group of its own: it is started by a process of `lavender.base.apart.process`, and ended with it.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
from collections.abc import Sequence
from typing import Any


class Lines:
    """`ask` it, and `end` it; OSError where the system does not start it."""

    def __init__(self, command: Sequence[str]) -> None:
        self._name = command[0]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, encoding="utf-8"
        )

    def ask(self, message: Any) -> Any:
        """Its answer; EOFError where it ended instead, ValueError where the answer is no JSON."""
        asks, answers = self._process.stdin, self._process.stdout
        assert asks is not None and answers is not None
        with contextlib.suppress(OSError):  # it died: there is no answer
            asks.write(json.dumps(message) + "\n")
            asks.flush()
        said = answers.readline()
        if not said:
            raise EOFError(f"{self._name} ended with status {self._process.wait()}")
        return json.loads(said)

    def end(self) -> None:
        """End it: it has nothing to lose."""
        self._process.kill()
        with contextlib.suppress(OSError):  # an end of a pipe that it left
            self._process.communicate()
