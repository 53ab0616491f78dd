"""A built-in solver is a file and a line of the table: nothing else lists solvers, and every command finds it."""

import ast
import os
import textwrap

import pytest
from worked import ROOT, python

from lavender.solvers import registry

#: A literal with more names than half of the table is a list of all solvers.
MAX_NAMES = 6
#: Lists that a new solver need not join, with the reason.
EXPERIMENTS = {
    "lavender/report/figures.py": "solvers with the first colours; all others follow",
    "tests/export/test_build.py": "methods of the C library",
    "tests/report/test_report_tables.py": "invented times of a table",
    "tests/suite/test_stalled.py": "numbers of sweeps that were measured",
}


def find_lists_of_solvers():
    """Yield (file, line, number of names) of the literal collections with more than `MAX_NAMES` built-in solvers."""
    own = {name for name, spec in registry.specs().items() if spec.builtin and not spec.external}
    files = [
        *ROOT.glob(".ci/*"),
        *(p for f in ("lavender", "tests", "benchmarks") for p in ROOT.joinpath(f).rglob("*.py")),
    ]
    for path in sorted(files):
        if path.is_dir() or (path.name == "__init__.py" and path.parent.name == "solvers"):
            continue
        text = path.read_text(encoding="utf-8", errors="replace")
        if path.suffix != ".py" and "python" not in text.partition("\n")[0]:
            continue
        for node in ast.walk(ast.parse(text)):
            parts = getattr(node, "elts", None) or getattr(node, "keys", None) or []
            constants = [x for part in parts if part is not None for x in ast.walk(part) if isinstance(x, ast.Constant)]
            names = {x.value for x in constants if isinstance(x.value, str)} & own
            if len(names) > MAX_NAMES:
                yield path.relative_to(ROOT).as_posix(), node.lineno, len(names)


def test_no_literal_lists_all_solvers_except_the_table():
    found = [x for x in find_lists_of_solvers() if x[0] not in EXPERIMENTS]
    assert not found, f"ask lavender.available or a field of SolverSpec instead: {found}"


TOY = """
'''Projected Richardson iteration: lambda <- clip(lambda - omega w, lower, upper), omega = 1 / max_i sum_j |A_ij|.'''

from dataclasses import dataclass

import numpy as np

from lavender.base.arrays import check_float
from lavender.judge.residuals import residual
from lavender.judge.solution import Claim, Status
from lavender.solvers.registry import Solver, SolverSpec


@dataclass(frozen=True)
class Toy(Solver):
    damping: float = 1.0

    def __post_init__(self):
        check_float("damping", self.damping, above=0.0)

    def prepare(self, problem):
        return problem, self.damping / max(abs(problem.csr).sum(axis=1).max(initial=0.0), 1e-300)

    def run(self, state, impulse, max_iter, tol, time_limit=None):
        problem, omega = state
        for done in range(max_iter + 1):
            if tol > 0.0 and residual(problem, impulse).relative <= tol:
                return Claim(Status.CONVERGED, done, {"sweeps": done})
            if done < max_iter:
                w = problem.csr @ impulse - problem.b
                impulse[:] = np.clip(impulse - omega * w, problem.cones.lower, problem.cones.upper)
        return Claim(Status.MAX_ITERATIONS, max_iter, {"sweeps": max_iter})


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
USES = {
    "imports": """
import importlib, pkgutil

for module in pkgutil.walk_packages(lv.__path__, "lavender."):
    if not module.name.endswith("__main__") and module.name not in ("lavender.torch", "lavender.jax"):
        importlib.import_module(module.name)
""",
    "available": """
assert lv.available(external=False)[-1] == "toy" and lv.get("toy").builtin and not lv.get("toy").distribution
""",
    "contract": """
from lavender.contract import check_solver
found = {check.name: failure.text for check, failure in check_solver("toy")}
assert len(found) >= 6 and not any(found.values()), found
""",
    "report": """
lines = lv.report.run(["stack(n=8)"], ["toy", "pgs"], lv.report.Plan(tolerances=(1e-2,), budgets=(4,), repeats=1))
report = lv.report.Report(lines)
assert {"toy", "pgs"} <= set(lv.report.select_runs(lines)["solver"])
lv.report.write(lines, sys.argv[2])
assert "toy" in open(sys.argv[2] + "/index.html").read()
""",
    "check": """
table = lv.cross_check(lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0]))
assert table.ok and table["toy"].verdict == "agrees", str(table)
""",
    "solvers": """
import contextlib, io
from lavender.cli import main
out = io.StringIO()
with contextlib.redirect_stdout(out):
    assert main(["solvers"]) == 0
assert "damped projected Richardson iteration" in " ".join(out.getvalue().split()), out.getvalue()
""",
    "pages": """
sys.path.insert(0, "docs")
import generate
text = generate.solver_overview()
assert "| `toy` | linear, lcp | matrix |" in text and "| `toy` | `damping` |" in text, text
""",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the file of the toy solver."""
    folder = tmp_path_factory.mktemp("solvers")
    (folder / "toy.py").write_text(textwrap.dedent(TOY), encoding="utf-8")
    return folder


@pytest.mark.parametrize("use", USES)
def test_a_file_and_a_line_of_the_table_are_sufficient_for(use, folder, tmp_path):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    python("-c", PRELUDE + USES[use], folder, tmp_path / "out", env=environment, cwd=ROOT)
