"""Modules that an import and a first solve load."""

import json
import shutil
import subprocess
import sys

from worked import ROOT, python

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
    "matplotlib",
    "h5py",
    "qpsolvers",
    "osqp",
    "clarabel",
    "piqp",
    "daqp",
    "quadprog",
    "scs",
    "pandas",
    "proxsuite",
    "highspy",
    "qpalm",
    "rich",
    "click",
}


def test_import_of_the_package_loads_only_needed_modules():
    """Beyond NumPy and what it loads: lavender's own modules and those of the standard library."""
    seen, names, own = json.loads(python("-c", LOADED).stdout)
    seen = {name: set(of) for name, of in seen.items()}
    packages = {name.partition(".")[0] for name in seen["import"]} - sys.stdlib_module_names
    others = {name for name in packages if "cython" not in name and name != "_utility"}
    assert others <= {"lavender", "lavender_ext", "numpy"}
    assert seen["import"] & {"scipy", "importlib.metadata", "pathlib"} == set()
    files = {
        name.rpartition(".")[2] for name in seen["import"] if name.startswith("lavender.solvers.")
    }
    assert files & {"lemke", "jacobi", "gauss_seidel", "sequential_impulses"} == set()
    assert (
        "scipy.optimize" in seen["auto"] and seen["auto"] & HEAVY == set()
    )  # Before the clock of a limit starts.
    assert "lavender.solvers.jacobi" in seen["jacobi"]
    assert [name for name in seen["jacobi"] if "external" in name or "lemke" in name] == []
    assert "scipy" not in seen["jacobi"] | seen["pgs"]
    assert seen["listing"] & HEAVY == set()
    # The order of the table, whoever was asked for first.
    assert names[:3] == ["auto", "direct", "newton"] and own


def test_import_of_a_clone_without_kernels_names_the_command_in_three_lines(tmp_path):
    for name in ("lavender", "lavender_ext"):
        shutil.copytree(
            ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("*.so", "*.pyd", "*.c")
        )
    done = subprocess.run(
        [sys.executable, "-c", "import lavender"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
    )
    *_, first, second, third = done.stderr.strip().splitlines()
    assert first.startswith(
        f"ImportError: the kernels in {tmp_path / 'lavender_ext'} are not built"
    )
    assert f"pip install -e {tmp_path}" in second and "outside of" in third
