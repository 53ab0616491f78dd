"""Instructions of a unit of work, counted by valgrind's callgrind."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.kernels.cases import job
from lavender.base.errors import InputError, SolverUnavailable

ROOT = Path(__file__).parents[2]  # root of the checkout
_COUNT = """
import sys
from benchmarks.kernels.cases import job
call = job(sys.argv[1]).call
call()
for _ in range(int(sys.argv[2])):
    call()
"""
COUNTED = ("impulses", "pgs", "pgs-tridiagonal", "block", "solve-8")


def instructions(name: str, calls: int = 10) -> float:
    """Return the instructions per unit of work of a case from two runs in callgrind; takes about a minute.

    Raises
    ------
    SolverUnavailable
        valgrind is not installed.
    InputError
        The case is not in `COUNTED`, or valgrind failed.
    """
    if name not in COUNTED:
        raise InputError(
            f"instructions of {name!r} are not counted; of {', '.join(COUNTED)} they are"
        )
    if shutil.which("valgrind") is None:
        raise SolverUnavailable(
            "counting instructions needs valgrind (Debian: apt install valgrind)"
        )
    one_thread = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONHASHSEED": "0"}
    totals = []
    with tempfile.TemporaryDirectory() as folder:
        for n in (0, calls):
            out = Path(folder, f"{n}.out")
            done = subprocess.run(
                [
                    "valgrind",
                    "--tool=callgrind",
                    f"--callgrind-out-file={out}",
                    sys.executable,
                    "-c",
                    _COUNT,
                    name,
                    str(n),
                ],
                capture_output=True,
                text=True,
                check=False,
                cwd=ROOT,
                env={**os.environ, **one_thread},
            )
            text = out.read_text() if out.exists() else ""
            found = re.search(r"^(?:summary|totals):\s*(\d+)", text, re.MULTILINE)
            if done.returncode or not found:
                raise InputError(f"valgrind failed on {name}: {done.stderr.strip()[-300:]}")
            totals.append(int(found[1]))
    return (totals[1] - totals[0]) / (calls * job(name).work)
