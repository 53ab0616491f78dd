"""`python -m benchmarks corpus`: what counts as right and solved, and what the table and the list of changes say."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import corpus, pairs, worlds

PROGRAMS = Path(__file__).parents[1] / "field" / "programs"
OPTIMA = json.loads((PROGRAMS / "objectives.json").read_text())


def test_right_is_the_optimum_within_its_rows_and_nothing_else():
    path = PROGRAMS / "DUALC1.npz"
    arrays = corpus.read_program(path)
    x = corpus.solve_program(str(path), OPTIMA["DUALC1"], "auto")
    assert x["right"] and x["found"] and corpus.is_solved(x)
    assert not corpus.is_right(arrays, OPTIMA["DUALC1"], None)
    n = len(arrays["q"])
    for wrong in (np.zeros(n), np.full(n, np.nan), np.full(n, 1e3)):
        assert not corpus.is_right(arrays, OPTIMA["DUALC1"], wrong)
    rows = {
        "P": np.eye(2),
        "q": np.zeros(2),
        "A": np.ones((1, 2)),
        "b": np.ones(1),
        "lb": np.zeros(2),
    }
    assert corpus.is_right(rows, 0.25, np.array([0.5, 0.5]))
    assert not corpus.is_right(rows | {"b": np.full(1, 1.1)}, 0.25, np.array([0.5, 0.5]))
    assert not corpus.is_right(rows | {"lb": np.full(2, 0.6)}, 0.25, np.array([0.5, 0.5]))
    assert not corpus.is_right(rows, 0.26, np.array([0.5, 0.5]))


def test_two_checkouts_answer_alike_and_survive_an_error(tmp_path):
    sides = [corpus.Checkout(corpus.ROOT, corpus.__file__) for _ in range(2)]
    [group] = {
        group for group, _ in corpus.write_drawn_problems(1, tmp_path) if group == "drawn: suite"
    }
    rows = list(
        corpus.compare_problems(sides, [(group, tmp_path / "suite_0.npz")], ("auto", "no_such"))
    )
    assert corpus.is_solved(rows[0]["base"]) and rows[0]["base"]["work"] == rows[0]["head"]["work"]
    assert "UnknownName" in rows[1]["base"]["status"] and not corpus.is_solved(rows[1]["head"])
    assert [line[:5] for line in corpus.summarize(rows)] == [
        [group, "auto", "1", "", "1 -> 1"],
        [group, "no_such", "1", "", "0 -> 0"],
    ]
    assert list(corpus.list_changes(rows)) == []
    rows[0]["head"]["relative"] = 1.0
    assert [line.split(":")[0] for line in corpus.list_changes(rows)] == ["lost"]
    for side in sides:
        side.process.communicate()
        assert side.process.returncode == 0


def test_sequences_are_solved_from_every_start_and_by_less_work_near_it(monkeypatch):
    mujoco = pytest.importorskip("mujoco")
    robot = {"hopper": mujoco.MjModel.from_xml_string(worlds.HOPPER)}
    monkeypatch.setattr(corpus, "read_robots", lambda: robot)
    cold, warm, exact = (corpus.solve_sequence("hopper", start) for start in corpus.STARTS)
    assert all(corpus.is_solved(answer) for answer in (cold, warm, exact))
    assert warm["work"]["sweeps"] < cold["work"]["sweeps"] and not exact["work"].get("sweeps")


def test_sheets_end_with_means_of_ratios_and_wanted_ones():
    best = [worlds.describe("a", {"cold": 1.0, "next step": x}, 1) for x in (0.5, 2.0)]
    mean, wanted = worlds.summarize("sequences", best)
    assert list(mean.values()) == ["geometric mean", "", "1.00"]
    assert list(wanted) == list(best[0]) and wanted["next step"] == "0.80"


def test_pairs_compare_a_statement_of_two_checkouts_and_report_an_error():
    sides = [pairs.Checkout(pairs.ROOT), pairs.Checkout(pairs.ROOT)]
    setup = "import lavender as lv; p = lv.suite.case('stack(n=4)').problem"
    cells = pairs.compare_statement(sides, 0, setup, "lv.solve(p)")
    base, head, ratio = map(float, cells[:3])
    assert base > 0.0 and head > 0.0 and ratio > 0.0
    assert pairs.compare_statement(sides, 1, setup, "q") == [
        "",
        "",
        "",
        "NameError: name 'q' is not defined",
    ]
    for side in sides:
        side.process.communicate()
        assert side.process.returncode == 0


def test_pairs_time_functions_in_turn_and_count_only_the_call():
    done = []
    times = pairs.time_alternately(
        lambda: done.append("a"),
        lambda: done.append("b"),
        rounds=3,
        before=lambda: done.append("-"),
    )
    assert times.shape == (3, 2) and (times >= 0.0).all()
    assert "".join(done) == 3 * "-a-b"
    assert pairs.describe_ratio(np.array([[1.0, 2.0], [2.0, 6.0], [1.0, 4.0]])) == [
        "1e+06",
        "4e+06",
        "3.00",
        "2.20 to 3.80",
    ]
