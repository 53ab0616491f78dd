"""The plug-in of examples/plugin, installed as a user would: found by name, checked with `lavender contract`."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from worked import python

ROOT = Path(__file__).resolve().parent.parent.parent
FOLDER = ROOT / "examples" / "plugin"

if importlib.util.find_spec("pip") is None:
    pytest.skip("pip is not installed: plug-ins are installed with it", allow_module_level=True)
FOUND = {d.name: d.version for d in metadata.distributions(name="setuptools")}
if int(FOUND.get("setuptools", "0").split(".")[0]) < 77:
    pytest.skip(
        "the plug-in is built by the setuptools that is here, 77 or newer", allow_module_level=True
    )

SOLVES = """
import sys, warnings
import numpy as np
import lavender as lv
from lavender import suite
from lavender.cli import main

with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    assert "pgs" in lv.available()
assert ["nonsense" in str(w.message) for w in caught] == [True], caught
assert "apgd" in lv.available(law="lcp"), lv.known()
for name in ("stack(n=6)", "granular(n=3)", "random_spd(n=30, condition=100)"):
    problem = suite.case(name).problem
    found = lv.solve(problem, "apgd", tol=1e-9, max_iter=20_000)
    assert found.success and found.work["products"] > 0, found
    exact = lv.solve(problem, "direct", tol=1e-9)
    # Slack is unique; both are within 1e-9 of the largest right-hand side, times the conditioning (below 1e3).
    np.testing.assert_allclose(found.slack, exact.slack, rtol=0.0, atol=1e-6 * abs(problem.b).max())
assert "symmetric" in lv.known(lv.Problem.lcp([[2.0, 1.0], [0.0, 2.0]], [1.0, 1.0]))["apgd"]
main(["solvers"])
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Variables of a process that finds the plug-in beside lavender."""
    folder = tmp_path_factory.mktemp("plugin")
    shutil.copytree(FOLDER, folder / "source", ignore=shutil.ignore_patterns("build", "*.egg-info"))
    installed = folder / "installed"
    alone = ("--quiet", "--no-index", "--no-build-isolation", "--no-deps")
    python("-m", "pip", "install", *alone, "--target", installed, folder / "source")
    paths = [str(installed), str(ROOT), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}


def test_plugin_example_next_to_a_broken_plug_in_solves(environment, tmp_path):
    info = tmp_path / "broken-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[lavender.solvers]\nnonsense = no_such_module:SPEC\n")
    path = os.pathsep.join([str(tmp_path), environment["PYTHONPATH"]])
    assert "apgd" in python("-c", SOLVES, env={**environment, "PYTHONPATH": path}).stdout


def test_meets_the_contract_of_every_solver(environment):
    report = python("-m", "lavender", "contract", "apgd", env=environment).stdout
    assert "NOT MET" not in report
    met, total = re.search(r"^apgd meets (\d+) of (\d+) requirements$", report, re.M).groups()
    assert met == total and int(met) >= 14  # Those of a resumable solver without orders and seeds.
    assert "orders_change_the_sweep" in report.splitlines()[-1]


COMPILED = FOLDER / "compiled"


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Variables of a process that finds the plug-in in Cython, built by pip in an environment of its own."""
    clone = tmp_path_factory.mktemp("clone")
    source = clone / "examples" / "plugin" / "compiled"
    shutil.copytree(COMPILED, source, ignore=shutil.ignore_patterns("build", "*.egg-info", "*.c"))
    headers = ROOT / "lavender_ext"
    for path in [*headers.rglob("*.pxd"), *headers.rglob("__init__.py")]:
        copy = clone / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy)
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--no-deps",
        "--target",
        clone / "installed",
        source,
    ]
    done = subprocess.run(pip, capture_output=True, text=True, timeout=600)
    missing = re.search(
        r"No matching distribution found for (setuptools|cython)", done.stdout + done.stderr
    )
    if done.returncode and missing:
        pytest.skip("no package index: setuptools and Cython of the build cannot be installed")
    assert done.returncode == 0, done.stdout + done.stderr
    paths = [str(clone / "installed"), str(ROOT), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}


def test_plugin_in_cython_outside_of_a_clone_finds_the_installed_headers(tmp_path):
    """Its kernel is translated with the headers of the lavender that is installed, at any depth of folders."""
    source = tmp_path / "compiled"
    shutil.copytree(COMPILED, source, ignore=shutil.ignore_patterns("build", "*.egg-info", "*.c"))
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    known = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    named = python("setup.py", "--name", env=known, cwd=source).stdout
    assert named.splitlines()[-1] == "lavender-sgs" and (source / "lavender_sgs_kernel.c").exists()


SWEEPS = """
import numpy as np
import lavender as lv
from lavender import suite

simulation = lv.Simulation(lv.Scene("card_house"))
for _ in range(10):
    simulation.step()
for problem in (simulation.constraint_problem(), suite.case("boxed_friction(n=2)").problem):
    # The first sweep of both is forwards. Impulses of 1e-3 N s and the rounding of a few additions.
    one, two = (lv.solve(problem, name, tol=0.0, max_iter=1).impulse for name in ("sgs", "pgs"))
    assert abs(two).max() > 1e-3
    np.testing.assert_allclose(one, two, rtol=0.0, atol=1e-12)
"""


def test_plugin_in_cython_is_built_in_isolation_and_meets_the_contract(compiled):
    python("-c", SWEEPS, env=compiled)
    report = python("-m", "lavender", "contract", "sgs", env=compiled).stdout
    met, total = re.search(r"^sgs meets (\d+) of (\d+) requirements$", report, re.M).groups()
    assert "NOT MET" not in report and met == total and int(met) >= 13


FAULTY = """
from dataclasses import replace
import lavender as lv
from lavender_apgd import APGD, SPEC as APGD_SPEC

class Faulty(APGD):
    def run(self, state, impulse, n, tol, time_limit=None):
        if tol == 0.0:
            raise ZeroDivisionError("planted")
        return lv.Claim(lv.Status.CONVERGED, 1, {"products": 1})

SPEC = replace(APGD_SPEC, name="faulty", factory=Faulty)
"""


def test_plugin_example_with_a_fault_fails_only_its_checks(environment, tmp_path):
    info = tmp_path / "faulty-1.0.dist-info"
    info.mkdir()
    (tmp_path / "faulty.py").write_text(FAULTY)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: faulty\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[lavender.solvers]\nfaulty = faulty:SPEC\n")
    path = os.pathsep.join([str(tmp_path), environment["PYTHONPATH"]])
    report = python(
        "-m", "lavender", "contract", "faulty", env={**environment, "PYTHONPATH": path}, status=1
    ).stdout
    assert "np." not in report and "Traceback" not in report and "assert" not in report
    assert "CONVERGED and lv.residual(problem, impulse).relative <= 1e-08" in report
    assert "ZeroDivisionError: planted" in report
    assert "met      The factory accepts the options of the spec" in report
