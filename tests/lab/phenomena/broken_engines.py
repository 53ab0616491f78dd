"""Functions in the place of `simulate`: each name fails in its own way."""

import os
import sys
import time
from pathlib import Path

import numpy as np

from lavender.lab.phenomena.engines.node import JsonLines


def simulate(name, scene, seconds, interval):
    if name == "dies":
        os.abort()
    if name == "sleeps":
        time.sleep(600)
    if name.startswith("waits"):  # for a program of its own, whose process id it writes to a file
        program = JsonLines(
            [sys.executable, "-c", "import os, time; print(os.getpid(), flush=True); time.sleep(600)"]
        )
        Path(name.removeprefix("waits ")).write_text(str(program.request_answer(None)))
        program.request_answer(None)
    if name == "babbles":
        return {"samples": 3, "bodies": 1, "setting": ""}, [np.ones(1)]
    os._exit(0)
