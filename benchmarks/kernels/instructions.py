"""Instructions of a unit of work, counted by valgrind's callgrind."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.kernels.cases import frictionless, sweeps
from benchmarks.kernels.problems import lattice_pile, tridiagonal
from lavender.errors import InputError, SolverUnavailable
from lavender.problem import Problem
from lavender.solve import solve
from lavender_ext.judge import measure

__all__ = ["COUNTED", "counted", "instructions"]

ROOT = Path(__file__).parents[2]  # of the checkout
_COUNT = """
import sys
from benchmarks import kernels
name, n = sys.argv[1], int(sys.argv[2])
call, work = kernels.counted(name)
call()
for _ in range(n):
    call()
"""
COUNTED = ("impulses", "pgs", "pgs-tridiagonal", "jacobi", "block", "judge", "solve-8")


def counted(name: str) -> tuple[Callable[[], Any], float]:
    """A call of a case and its work, for counting instructions."""
    if name == "solve-8":
        j = np.random.default_rng(8).normal(size=(8, 10))
        problem = Problem.lcp(j @ j.T, np.ones(8))
        return lambda: solve(problem, "pgs", tol=0.0, max_iter=8), 1.0
    if name == "judge":
        problem = lattice_pile(1_000)
        lam, w, e = problem.start() + 0.01, np.empty(problem.m), np.empty(problem.m)
        return lambda: measure.judge(problem.data, lam, w, e, False), float(problem.n_blocks)
    solver = {"impulses": "sequential_impulses", "block": "block_gauss_seidel"}.get(
        name, name.partition("-")[0]
    )
    if solver in ("pgs", "jacobi"):
        problem = tridiagonal(2_000) if name.endswith("tridiagonal") else frictionless(1_000)
        return sweeps(problem, solver, 1)[0], float(problem.csr.nnz)
    problem = lattice_pile(1_000)
    return sweeps(problem, solver, 1)[0], float(problem.n_blocks)


def instructions(name: str, calls: int = 50) -> float:
    """Instructions of a unit of a case, by callgrind: the difference of two runs, about a minute.

    Raises
    ------
    SolverUnavailable
        valgrind is not installed.
    InputError
        The case is not one of `COUNTED`, or valgrind failed.
    """
    if name not in COUNTED:
        raise InputError(f"instructions of {name!r} are not counted; of {', '.join(COUNTED)} they are")
    if shutil.which("valgrind") is None:
        raise SolverUnavailable("counting instructions needs valgrind (Debian: apt install valgrind)")
    totals = []
    with tempfile.TemporaryDirectory() as folder:
        for n in (0, calls):
            out = Path(folder, f"{n}.out")
            done = subprocess.run(
                [
                    "valgrind", "--tool=callgrind", f"--callgrind-out-file={out}",
                    sys.executable, "-c", _COUNT, name, str(n),
                ],
                capture_output=True,
                text=True,
                check=False,
                cwd=ROOT,
                env={**_environment(), "PYTHONHASHSEED": "0"},
            )  # fmt: skip
            found = re.search(
                r"^(?:summary|totals):\s*(\d+)", out.read_text() if out.exists() else "", re.MULTILINE
            )
            if done.returncode or not found:
                raise InputError(f"valgrind failed on {name}: {done.stderr.strip()[-300:]}")
            totals.append(int(found[1]))
    return (totals[1] - totals[0]) / (calls * counted(name)[1])


def _environment() -> dict[str, str]:
    return {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
