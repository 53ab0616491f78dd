"""A built-in solver of one file and one line in the table: every package, command and requirement accepts it."""

import subprocess
import sys

import pytest

import lavender as lv

SOLVER = '''
"""Projected gradients: lambda <- clip(lambda - s (A lambda - b), lower, upper), s = damping / |A|_inf."""

from dataclasses import dataclass

import numpy as np

from lavender.base.arrays import check_float
from lavender.judge.residuals import residual
from lavender.judge.solution import Claim, Status
from lavender.solvers.registry import Solver, SolverSpec


@dataclass(frozen=True)
class ProjectedGradients(Solver):
    damping: float = 1.0

    def __post_init__(self):
        check_float("damping", self.damping, above=0.0)

    def prepare(self, problem):
        norm = np.max(abs(problem.csr).sum(axis=1), initial=0.0)
        return problem, self.damping / max(norm, 1e-300)

    def run(self, state, impulse, max_iter, tol, time_limit):
        problem, step = state
        for done in range(max_iter + 1):
            if tol > 0.0 and residual(problem, impulse).relative <= tol:
                return Claim(Status.CONVERGED, done, {"products": done})
            if done < max_iter:
                gradient = problem.csr @ impulse - problem.b
                impulse[:] = np.clip(impulse - step * gradient, problem.cones.lower, problem.cones.upper)
        return Claim(Status.MAX_ITERATIONS, max_iter, {"products": max_iter})


SPEC = SolverSpec(
    name="projected_gradients",
    factory=ProjectedGradients,
    laws=frozenset({"lcp"}),
    operators=frozenset({"matrix"}),
    options={"damping": "factor of the step length"},
    summary="projected gradients with a fixed step",
)
'''

#: Program that adds the solver in the folder argv[1] to the table, then runs the code argv[2].
ADD_SOLVER = """
import sys
from lavender import solvers
solvers.__path__.append(sys.argv[1])
solvers._TABLE += ("projected_gradients",)
code = sys.argv[2]
del sys.argv[1:3]
exec(code)
"""

IMPORT_EVERYTHING = """
import importlib, pkgutil
import lavender as lv

for module in pkgutil.walk_packages(lv.__path__, "lavender."):
    if not module.name.endswith("__main__"):
        try:
            importlib.import_module(module.name)
        except lv.SolverUnavailable:  # The package of an extra is not installed.
            assert module.name in ("lavender.torch", "lavender.jax")
assert lv.known()["projected_gradients"] is None
assert "projected_gradients" in lv.available(lv.Problem.lcp([[1.0]], [1.0]))
"""

RUN_COMMAND = "from lavender.cli.entry import main; main()"

#: Arguments of the commands that run solvers or compile them.
ARGUMENTS = {
    "solve": ("problem.npz", "--solver", "projected_gradients"),
    "check": ("problem.npz", "--solvers", "projected_gradients", "pgs", "--reference", "newton"),
    "report": ("problem.npz", "--solvers", "projected_gradients", "--tolerances", "1e-3", "--budgets", "4", "--repeats",
               "1", "--no-figures"),
    "solvers": (), "contract": ("projected_gradients",), "export": ("c", "library"),
}  # fmt: skip


@pytest.fixture(scope="module")
def run_with_solver(tmp_path_factory):
    """Run code in a process to whose table the solver was added, and return what it printed."""
    folder = tmp_path_factory.mktemp("added")
    (folder / "projected_gradients.py").write_text(SOLVER, encoding="utf-8")
    lv.io.save(lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0]), folder / "problem.npz")

    def run(code, *arguments):
        command = [sys.executable, "-c", ADD_SOLVER, str(folder), code, *arguments]
        process = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600, check=False)
        assert process.returncode == 0, process.stdout + process.stderr
        return process.stdout

    return run


def test_every_module_imports_with_an_added_solver(run_with_solver):
    run_with_solver(IMPORT_EVERYTHING)


@pytest.mark.parametrize("command", ARGUMENTS)
def test_command_with_an_added_solver_runs(run_with_solver, command):
    printed = run_with_solver(RUN_COMMAND, command, *ARGUMENTS[command])
    if {"projected_gradients", "solvers"} & {command, *ARGUMENTS[command]}:
        assert "projected_gradients" in printed
