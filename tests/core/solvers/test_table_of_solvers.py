"""A built-in solver is a file and a line of the table: every command finds it."""

import os
import textwrap

from worked import ROOT, python

TOY = """
'''Projected Richardson iteration: lambda <- clip(lambda - omega w, lower, upper), omega = 1 / max_i sum_j |A_ij|.'''

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from lavender.base.arrays import check_float
from lavender.solvers.registry import Solver, SolverSpec
from lavender.solvers.sweeping import create_stopping_test, make_claim


@dataclass(frozen=True)
class Toy(Solver):
    damping: float = 1.0

    def __post_init__(self):
        check_float("damping", self.damping, above=0.0)

    def prepare(self, problem):
        omega = self.damping / max(abs(problem.csr).sum(axis=1).max(initial=0.0), 1e-300)
        watch = create_stopping_test(problem, problem.csr_data)
        return SimpleNamespace(problem=problem, omega=omega, watch=watch)

    def run(self, state, impulse, max_iter, tol, time_limit=None):
        problem, cones = state.problem, state.problem.cones

        def iterate(count, first):
            for _ in range(count):
                w = problem.csr @ impulse - problem.b
                impulse[:] = np.clip(impulse - state.omega * w, cones.lower, cones.upper)

        return make_claim(*state.watch.run_python(iterate, impulse, max_iter, tol))


SPEC = SolverSpec(
    name="toy",
    factory=Toy,
    laws=frozenset({"linear", "lcp"}),
    operators=frozenset({"matrix"}),
    options={"damping": "factor of the step, at most 1; default 1"},
    plain_sweeps=True,
    refusal=lambda problem: None if problem.is_symmetric else "needs a symmetric A",
    summary="damped projected Richardson iteration",
)
"""
#: What runs with the file in the package and its name in the table.
PRELUDE = """
import sys
import lavender.solvers as package

package.__path__.append(sys.argv[1])
package._TABLE = (*package._TABLE, "toy")
import lavender as lv
"""
#: Imports of all modules, and what finds a solver: lists, the contract, a report, the check, the command and a page.
USES = """
import importlib, pkgutil

for module in pkgutil.walk_packages(lv.__path__, "lavender."):
    if not module.name.endswith("__main__") and module.name not in ("lavender.torch", "lavender.jax"):
        importlib.import_module(module.name)

assert lv.available(external=False)[-1] == "toy" and lv.get("toy").builtin and not lv.get("toy").distribution

from lavender.contract import check_solver
found = {check.name: failure.text for check, failure in check_solver("toy")}
assert len(found) >= 13 and not any(found.values()), found

lines = lv.report.run(["stack(n=8)"], ["toy", "pgs"], lv.report.Plan(tolerances=(1e-2,), budgets=(4,), repeats=1))
report = lv.report.Report(lines)
assert {"toy", "pgs"} <= set(lv.report.select_runs(lines)["solver"])
lv.report.write(lines, sys.argv[2])
assert "toy" in open(sys.argv[2] + "/index.html").read()

table = lv.cross_check(lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0]))
assert table.ok and table["toy"].verdict == "agrees", str(table)

import contextlib, io
from lavender.cli import main
out = io.StringIO()
with contextlib.redirect_stdout(out):
    assert main(["solvers"]) == 0
assert "damped projected Richardson iteration" in " ".join(out.getvalue().split()), out.getvalue()

sys.path.insert(0, "docs")
import generate
text = generate.solver_overview()
assert "| `toy` | linear, lcp | matrix |" in text and "| `toy` | `damping` |" in text, text
"""


def test_a_file_and_a_line_of_the_table_are_sufficient_for_every_use(tmp_path):
    (tmp_path / "solvers").mkdir()
    (tmp_path / "solvers" / "toy.py").write_text(textwrap.dedent(TOY), encoding="utf-8")
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
    }
    python("-c", PRELUDE + USES, tmp_path / "solvers", tmp_path / "out", env=environment, cwd=ROOT)
