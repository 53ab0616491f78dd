"""Processes in the place of an engine's: each answers once, that it is there, and then fails in its own way."""

import os
import sys
import time
from pathlib import Path

from lavender.base.apart.lines import Lines
from lavender.base.apart.served import answer, begin, receive


def serve(lifeline):
    requests, answers = begin(lifeline)
    answer(answers, "{}", b"")
    name, _, _, _ = receive(requests)
    if name == "dies":
        os.abort()
    if name == "sleeps":
        time.sleep(600)
    if name.startswith("waits"):  # for a program of its own, whose number it leaves in a file
        lines = Lines(
            [sys.executable, "-c", "import os, time; print(os.getpid(), flush=True); time.sleep(600)"]
        )
        Path(name.removeprefix("waits ")).write_text(str(lines.ask(None)))
        lines.ask(None)
    if name == "babbles":
        answer(answers, '{"samples": 3, "bodies": 1, "setting": ""}', b"12345678")
        time.sleep(600)
    sys.exit(0)
