"""Modules that an import and a first solve load."""

import json
import os

import pytest
from worked import python

LOADED = """
import json, sys

import numpy as np

numpys = set(sys.modules)  # and what .pth files of other packages load
import lavender as lv

seen = {"import": set(sys.modules) - numpys}

rng = np.random.default_rng(0)
half = rng.normal(size=(300, 100))
A = half @ half.T / 300 + 0.1 * np.eye(300)
problems = [
    lv.Problem.lcp(A, rng.normal(size=300)),
    lv.Problem.contact(A, rng.normal(size=300), 0.5),
    lv.Problem.contact(A[:30, :30], rng.normal(size=30), 0.5, friction="cone"),
    lv.Problem.from_jacobian(half, np.eye(100), rng.normal(size=100), cones=lv.Cones.contacts(0.5, 2, count=100)),
]
small = lv.Problem.contact([[2.0, 0.5], [0.5, 1.0]], [1.0, -2.0], [0.5])
bounded = lv.Problem.lcp([[2.0]], [1.0])

def loaded(name, call):
    before = set(sys.modules)
    call()
    seen[name] = set(sys.modules) - before

loaded("auto", lambda: [lv.solve(problem, time_limit=0.01) for problem in problems] + [lv.solve(small)])
loaded("jacobi", lambda: lv.solve(bounded, "jacobi", time_limit=0.01))
loaded("pgs", lambda: lv.solve(small, "pgs"))
names = list(lv.registry.specs())
loaded("listing", lambda: [lv.known(), lv.available(law="lcp")])
print(json.dumps([{name: sorted(of) for name, of in seen.items()}, names, lv.registry.get("jacobi").builtin]))
"""

#: Backends and what draws, reads files or prints: what a listing must not load.
HEAVY = {
    "matplotlib", "h5py", "qpsolvers", "osqp", "clarabel", "piqp", "daqp", "quadprog", "scs", "pandas", "proxsuite",
    "highspy", "qpalm", "rich", "click",
}  # fmt: skip


def test_import_of_the_package_loads_only_needed_modules():
    """Beyond NumPy and what it loads: lavender's own modules, 140 with all that a first solve needs."""
    seen, names, own = json.loads(python("-c", LOADED).stdout)
    seen = {name: set(of) for name, of in seen.items()}
    assert len(seen["import"]) < 160
    assert seen["import"] & {"scipy", "importlib.metadata", "pathlib"} == set()
    files = {name.rpartition(".")[2] for name in seen["import"] if name.startswith("lavender.solvers.")}
    assert files & {"lemke", "jacobi", "gauss_seidel", "sequential_impulses"} == set()
    assert "scipy.optimize" in seen["auto"] and seen["auto"] & HEAVY == set()  # Before the clock of a limit starts.
    assert "lavender.solvers.jacobi" in seen["jacobi"]
    assert [name for name in seen["jacobi"] if "external" in name or "lemke" in name] == []
    assert "scipy" not in seen["jacobi"] | seen["pgs"]
    assert seen["listing"] & HEAVY == set()
    # The order of the table, whoever was asked for first.
    assert names[:3] == ["auto", "direct", "newton"] and own


LATE = """
import os, sys
import numpy as np, lavender as lv
from lavender.solving.loop import Loop

class Watch:
    running = False
    def find_spec(self, name, *_):
        if self.running and name.partition(".")[0] == "scipy":
            raise AssertionError(name)

watch, call, rng = Watch(), Loop.call_solver, np.random.default_rng(0)
sys.meta_path.insert(0, watch)

def watched(*given):
    watch.running = True
    try:
        return call(*given)
    finally:
        watch.running = False

Loop.call_solver = watched
m, b = 120, rng.normal(size=120)
full, mu = rng.normal(size=(m, m + 20)), np.full(m // 3, 0.5)
few = 8.0 * np.eye(m)
few[np.arange(m), rng.permutation(m)] += 0.5
jac, mass, v, cones = full[:, :60], np.eye(60), b[:60], lv.Cones.contacts(mu)
problems = {
    "linear": lambda: lv.Problem.linear(full @ full.T, b),
    "lcp": lambda: lv.Problem.lcp(full @ full.T, b),
    "few entries": lambda: lv.Problem.lcp(few + few.T, b),
    "asymmetric": lambda: lv.Problem.lcp(few, b),
    "singular": lambda: lv.Problem.lcp(jac @ jac.T, b),
    "coulomb": lambda: lv.Problem.contact(full @ full.T, b, mu),
    "cone": lambda: lv.Problem.contact(full @ full.T, b, mu, friction="cone"),
    "generalised": lambda: lv.Problem.from_jacobian(jac, mass, v, cones=cones),
}
for solver, kind in (words.split(": ") for words in sys.argv[1:]):
    child = os.fork()  # each in a process of its own, which has imported nothing else
    if not child:
        assert any([lv.solve(problems[kind](), solver, time_limit=0.2).work for _ in range(3)])
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0, (solver, kind)
"""


@pytest.mark.nightly
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that fork")
def test_solve_with_a_limit_imports_scipy_before_its_clock():
    """Counted and never done, it made every call of a process within 0.3 s late: a set-up of 1 ms never began."""
    solved = {  # `auto` counts what it has to load as a set-up, and does without where that is too long
        "direct": ("linear", "few entries", "asymmetric", "singular"),
        "lemke": ("lcp", "singular"),
        "newton": ("coulomb", "generalised"),
        "admm": ("cone", "generalised"),
    }
    python("-c", LATE, *(f"{solver}: {kind}" for solver, kinds in solved.items() for kind in kinds))
