"""Engines and solvers of others: what is compared is the same problem and the same scene, and losses are kept."""

import importlib.util
import json
import math
import os
import time

import pytest
from click.testing import CliRunner

import lavender as lv
from benchmarks.peers import adapters, engines, race
from benchmarks.peers import tables as comparison
from benchmarks.peers.adapters import Contestant, Result, ours
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


def by_name(name, siconos=""):
    return next(c for c in [*ours(), *adapters.contestants(siconos)] if c.name == name)


def is_adapter(name):
    """Whether the conversion is of `adapters` itself; those of `lavender.external` have tests of their own."""
    return any(word in name for word in ("own interface", " cones ", "pinocchio", "scipy"))


@pytest.mark.parametrize("kind", SMALL)
def test_bench_peers_every_adapter_solves_the_same_problem(kind):
    # A wrong sign, bound or order of rows would leave a residual near 1.
    problem = suite.case(SMALL[kind]).problem
    for contestant in adapters.contestants():
        if not is_adapter(contestant.name) or contestant.refuses(problem) is not None:
            continue
        if contestant.name.startswith("quadprog") and "impulse" in contestant.name:
            continue  # needs a definite A, which contacts of a face do not have
        least = reached(contestant, problem)
        # 1e-4: all get there at their tightest setting, some interior points no further with friction.
        assert least is None or least < 1e-4, f"{contestant.name} on {SMALL[kind]}: {least:.1e}"


def test_race_keeps_times_residuals_and_sides():
    problem = suite.case("stack(n=4)").problem
    names = ("pgs", "direct", "direct, from scratch", "scipy spsolve")
    told = []
    (results,) = race.race([("a", problem)], list(map(by_name, names)), rounds=2, watch=told.append)
    assert {r.solver for r in results} == {"pgs", "direct", "direct, from scratch"}  # an LCP is not linear
    for r in results:
        assert r.note == "" and not r.peer
        assert r.time(1e-9) > 0.0 and math.isfinite(r.time(1e-9))
        assert r.time(1e-3) <= r.time(1e-9)
        assert math.isinf(r.time(0.0)) or min(relative for _, relative in r.runs) == 0.0
    assert told[0] == "a: direct" or told[0].startswith("a: ")


def _dies(problem, limit):
    os._exit(3)
    yield


def _raises(problem, limit):
    yield lambda: (1e-3, problem.start())
    raise RuntimeError("no more")


def _hangs(problem, limit):
    yield lambda: (1e-3, problem.start())
    time.sleep(600.0)
    yield


@pytest.mark.parametrize(
    ("runs", "kept", "note", "patience"),
    [(_dies, 0, "died", 600.0), (_raises, 1, "no more", 600.0), (_hangs, 1, "without an answer", 4.0)],
)
def test_race_with_a_failing_solver_keeps_other_runs(runs, kept, note, patience, monkeypatch):
    monkeypatch.setattr(race, "PATIENCE", patience)
    problem = suite.case("two_particles").problem
    ((result,),) = race.race([("a", problem)], [Contestant("x", True, runs)], limit=0.1, rounds=1)
    assert len(result.runs) == kept
    assert note in result.note


def results_by_hand():
    """Two problems: one where ours is faster, one where a peer is, and alone at the smallest error."""

    def of(problem, rows, solver, peer, *runs):
        return Result(problem, rows, "lcp", solver, peer, list(runs))

    return [
        of("big", 2000, "pgs", False, (1.0, 1e-4), (4.0, 1e-10)), of("big", 2000, "auto", False, (2.0, 1e-10)),
        of("big", 2000, "pgs, from scratch", False, (3.0, 1e-10)),
        of("big", 2000, "osqp", True, (10.0, 1e-7), (40.0, 1e-11)), of("small", 8, "pgs", False, (6.0, 1e-7)),
        of("small", 8, "auto", False, (8.0, 1e-7)), of("small", 8, "daqp", True, (2.0, 1e-12)),
        of("small", 8, "osqp", True, (1.0, 1e-2)),
    ]  # fmt: skip


def test_ratios_means_and_losses():
    compared = comparison.compare(results_by_hand())
    by = {(c.problem, c.target): c for c in compared}
    assert by["big", 1e-3].ratio == 0.1 and by["big", 1e-3].ours == "pgs"
    assert by["big", 1e-9].ratio == 0.05 and by["big", 1e-9].ours == "auto"
    assert by["big", 1e-6].scratch == 3.0
    assert by["small", 1e-3].ratio == 3.0 and by["small", 1e-3].peer == "daqp"
    assert math.isinf(by["small", 1e-9].ratio)
    means = {(m.which, m.target): m for m in comparison.means(results_by_hand())}
    assert means["cases, 1000 rows and more", 1e-6].ours == pytest.approx(0.2)
    assert means["cases, smaller", 1e-3].auto == pytest.approx(4.0)
    assert means["cases, smaller", 1e-9].compared == 0 and math.isnan(means["cases, smaller", 1e-9].ours)
    # SciPy's factorisations are peers of the last group alone.
    more = [*results_by_hand(), Result("big", 2000, "linear", "scipy banded", True, [(1.0, 1e-15)])]
    means = {(m.which, m.target): m for m in comparison.means(more)}
    assert means["cases, 1000 rows and more", 1e-6].ours == pytest.approx(0.2)
    assert means["all, SciPy too, 1000 rows and more", 1e-6].ours == pytest.approx(2.0)
    assert not any(which.startswith("exported") for which, _ in means)
    assert [(c.problem, c.target) for c in comparison.losses(compared)] == [
        ("small", 1e-9),
        ("small", 1e-3),
        ("small", 1e-6),
    ]
    text = comparison.solvers_tables(results_by_hand())
    assert "Lost: 3 of 6." in text
    assert "- small at 1e-09: daqp against -, only the peer" in text


# -- engines ---------------------------------------------------------------------------------------


def test_bench_peers_command_steps_one_scene_in_every_engine_and_keeps_losses(tmp_path, monkeypatch):
    out, steps = tmp_path / "peers.json", []

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
        assert any(package in s.engine for s in steps) == (importlib.util.find_spec(package) is not None)
    for s in steps:
        assert s.time > 0.0 and s.note == "" and f"| stack6 | {s.engine} |" in done.output
        # Four points under each of six boxes; MuJoCo adds a few between edges while PGS lets boxes tilt.
        assert 24 <= s.contacts <= 40
        assert 0.0 <= s.depth < 0.01 and s.speed < 0.1
        assert math.isnan(s.relative) == ("pybullet" in s.engine)
    lost = [s for s in steps if comparison.over_ours(s, steps) < 1.0]
    assert done.output.count("- stack6: ") == len(lost)
    assert all(f"- stack6: {s.engine}," in done.output for s in lost)
