"""Legal problems at the edge of float64: every solver returns, with numbers or the word for having none.

The solves run in processes of their own under a watchdog (`hostile.py`), so that a hang fails and does not hang.
"""

import json
import subprocess
import sys
from pathlib import Path

import hostile
import pytest

import lavender as lv

HERE = lv.available()
OURS = lv.available(external=False)
SEEDS = {True: 80, False: 160}  # problems for a backend, for a solver of ours


def in_its_own_process(names, seeds):
    command = [sys.executable, "hostile.py", ",".join(names), "0", str(seeds)]
    return subprocess.Popen(
        command, cwd=Path(__file__).parent.parent, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.fixture(scope="module")
def outcome():
    """Solver -> what its process said of it; of the one at which a process ended, its last words."""
    groups = [[*OURS, hostile.STEPS], [name for name in HERE if name not in OURS]]
    processes = [in_its_own_process(names, SEEDS[names is groups[1]]) for names in groups if names]
    found = {}
    for process in processes:
        out, err = process.communicate()
        for line in map(json.loads, out.splitlines()):
            if "begins" in line:
                found[line["begins"]] = f"did not come back:\n{err[-3000:]}"
            else:
                found[line["solver"]] = line
    return found


@pytest.mark.parametrize("name", [*HERE, hostile.STEPS])
def test_every_hostile_problem_comes_back_with_a_result(name, outcome):
    said = outcome.get(name, "its process ended before its turn")
    assert isinstance(said, dict), said
    assert said["solves"] >= 10, "nearly every problem was refused: nothing is tested"
    assert not said["complaints"], "\n".join(said["complaints"][:5])


def test_the_watchdog_ends_what_hangs():
    """A solver that never returns is killed, and named."""
    script = """
import hostile, lavender as lv
hostile.PATIENCE = 1.0
class Hang:
    def prepare(self, problem): return problem
    def update(self, state, problem): return problem
    def run(self, *_):
        while True: pass
lv.register(lv.SolverSpec(name="hang", factory=Hang, laws={"lcp"}, summary="", resumable=False))
hostile.draw = lambda seed: (lv.Problem.lcp([[1.0]], [1.0]), None, 1e-6, 5)
hostile.main(["hang", "pgs"], [0])
"""
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=Path(__file__).parent.parent,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode != 0
    assert json.loads(done.stdout.splitlines()[-1]) == {"begins": "hang"}
    assert "Timeout" in done.stderr


def test_every_generator_is_drawn_and_draws_the_same_again():
    for seed in range(4 * len(hostile.GENERATORS)):
        one, two = hostile.draw(seed), hostile.draw(seed)
        assert one[0] == two[0]
        assert one[2:] == two[2:]
