"""Each solver of lavender runs once in the comparison with peers, by the adapter that the comparison uses."""

import pytest

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


def test_bench_peers_runs_each_solver_of_lavender(problems):
    for contestant in adapters.ours():
        assert run_once(contestant, problems) < CLOSE, contestant.name
