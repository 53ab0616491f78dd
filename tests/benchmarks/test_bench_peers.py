"""Engines and solvers of others: what is compared is the same problem and the same scene, and losses are kept."""

import importlib.util
import json
import math
import sys

import pytest
from click.testing import CliRunner

import lavender as lv
from benchmarks.peers import adapters, box3d, engines
from benchmarks.peers import tables as comparison
from benchmarks.peers.adapters import ours
from benchmarks.peers.command import command
from lavender import suite

SMALL = {  # laws and kinds of bounds that adapters must translate
    "lcp": "box_stack(n=2)",
    "linear": "chain(n=4)",
    "boxed": "boxed_friction(n=2, scene=granular)",
    "cone": "box_stack(n=2, friction=cone)",
    "coulomb": "box_stackF(n=2)",
}


def reached(contestant, problem, limit=5.0):
    """The least residual of a contestant's settings, in this process; None where it has no way."""
    found = [lv.residual(problem, call()[1]).relative for call in contestant.runs(problem, limit)]
    return min(found, default=None)


def is_adapter(name):
    """Whether the conversion is of `adapters` itself; those of `lavender.programs` have tests of their own."""
    return any(word in name for word in ("own interface", " cones ", "pinocchio", "scipy"))


@pytest.mark.parametrize("kind", SMALL)
def test_bench_peers_every_adapter_solves_the_same_problem(kind):
    # A wrong sign, bound or order of rows would leave a residual near 1.
    problem = suite.case(SMALL[kind]).problem
    compared = [*ours(), *(c for c in adapters.contestants() if is_adapter(c.name))]
    for contestant in compared:
        if contestant.refuses(problem) is not None:
            continue
        if contestant.name.startswith("quadprog") and "impulse" in contestant.name:
            continue  # needs a definite A, which contacts of a face do not have
        least = reached(contestant, problem)
        # 1e-4: all get there at their tightest setting, some interior points no further with friction.
        assert least is None or least < 1e-4, f"{contestant.name} on {SMALL[kind]}: {least:.1e}"


def test_bench_peers_command_steps_one_scene_in_every_engine_and_keeps_losses(
    tmp_path, monkeypatch
):
    out = tmp_path / "peers.json"
    steps = []

    def short(scene, sweeps):
        steps.extend(measured(scene, sweeps, settle=200, rounds=1))
        return steps

    measured = engines.measure_scene
    monkeypatch.setattr(engines, "measure_scene", short)
    words = ["--no-solvers", "--scenes", "stack6", "--out", str(out)]
    done = CliRunner().invoke(command, words, catch_exceptions=False)
    assert done.exit_code == 0 and "not here: " in done.output
    assert [s["engine"] for s in json.loads(out.read_text())["steps"]] == [s.engine for s in steps]
    assert [s.engine for s in steps[:2]] == ["lavender, 16 sweeps", "lavender newton"]
    for package in ("mujoco", "pybullet"):
        assert any(package in s.engine for s in steps) == (
            importlib.util.find_spec(package) is not None
        )
    for s in steps:
        assert s.time > 0.0 and s.note == "" and f"| stack6 | {s.engine} |" in done.output
        # Four points under each of six boxes; MuJoCo adds a few between edges while PGS lets boxes tilt.
        assert 24 <= s.contacts <= 40
        assert 0.0 <= s.depth < 0.01 and s.speed < 0.1
        assert math.isnan(s.relative) == ("pybullet" in s.engine)
    lost = [s for s in steps if comparison.over_ours(s, steps) < 1.0]
    assert done.output.count("- stack6: ") == len(lost)
    assert all(f"- stack6: {s.engine}," in done.output for s in lost)


STEADY = """#!{python}
import sys
dt, substeps, friction, n = sys.stdin.readline().split()
boxes = [sys.stdin.readline().split()[:3] for _ in range(int(n))]
for steps in sys.stdin:
    print(2e-3 * int(steps), *(x for box in boxes for x in box), flush=True)
"""


def test_bench_peers_box3d_gets_the_scene_and_is_timed_beside_lavender(tmp_path):
    # A program with the interface of box3d_steps.c, in which nothing moves and a step takes 2 ms.
    program = tmp_path / "steady"
    program.write_text(STEADY.format(python=sys.executable), encoding="utf-8")
    program.chmod(0o755)
    found = box3d.measure(program, "tower 6", rounds=2)
    assert found.time[-1] == pytest.approx(2e-3)
    for time, ratio in zip(found.time[:2], found.ratio, strict=True):
        assert ratio == pytest.approx(time / 2e-3, rel=0.5)
    assert (found.lateral[-1], found.vertical[-1]) == (0.0, 0.0)
    for vertical in found.vertical[:2]:
        assert 0.0 < vertical < 1e-3  # m, the slop that LavenderSim allows
    assert "| tower 6 |" in box3d.format_table([found])


def test_bench_peers_box3d_needs_a_checkout(tmp_path):
    result = CliRunner().invoke(command, ["--box3d", str(tmp_path)])
    assert result.exit_code and "checkout" in str(result.exception)
