"""Each engine and solver of the comparisons runs once: packages that are not installed have stand-ins here.

A stand-in has the names and arguments that the adapter uses, so that a name that is renamed on either side of an
adapter fails here and not in the next comparison.
"""

import importlib.util
import pkgutil
import sys
from unittest.mock import MagicMock

import pytest

import benchmarks
import lavender as lv
from benchmarks.peers import adapters
from lavender import suite

CASES = ("two_particles", "box_stack(n=2)", "chain(n=4)", "box_stack(n=2, friction=cone)", "box_stackF(n=2)")
# The loosest third of the settings reach this residual on problems of a few rows.
CLOSE = 1e-2


@pytest.fixture(scope="module")
def problems():
    return [suite.case(name).problem for name in CASES]


def run_once(contestant, problems):
    """Return the residual of one run on the first problem that the contestant accepts."""
    for problem in problems:
        if contestant.refuses(problem) is not None:
            continue
        calls = list(contestant.runs(problem, 5.0))
        if calls:
            seconds, impulse = calls[min(6, len(calls) - 1)]()
            assert seconds >= 0.0
            return lv.residual(problem, impulse).relative
    raise AssertionError(f"{contestant.name} accepts none of {CASES}")


@pytest.mark.parametrize("name", [m.name for m in pkgutil.walk_packages(benchmarks.__path__, "benchmarks.")])
def test_every_module_of_the_benchmarks_can_be_imported(name, monkeypatch):
    for package in ("pybullet", "lavendersim", "mujoco"):
        if importlib.util.find_spec(package) is None:
            monkeypatch.setitem(sys.modules, package, MagicMock())
    monkeypatch.delitem(sys.modules, name, raising=False)
    if name.endswith(("__main__", "siconos_server", "kernels.microbenchmarks")):
        pytest.skip("it is a program, or compiled when it is run")
    if name.startswith("benchmarks.score.adapters."):
        pytest.skip("it is imported in the environment of its engine")
    known = sys.modules.copy()
    parent = importlib.import_module(name.rpartition(".")[0])
    names = dict(vars(parent))
    try:
        assert importlib.import_module(name).__doc__
    finally:  # Modules that hold a stand-in, or classes of a second import, must not stay.
        for other in set(sys.modules) - set(known):
            if other.startswith("benchmarks."):
                del sys.modules[other]
        sys.modules.update(known)
        vars(parent).update(names)  # A second import binds the module to its name in the package.


def test_bench_peers_runs_each_solver_of_lavender(problems):
    for contestant in adapters.ours():
        assert run_once(contestant, problems) < CLOSE, contestant.name
