"""Regret of auto: arithmetic on made-up measurements, and a small run that measures."""

import json
import math
from dataclasses import replace

import pytest

import lavender as lv
from lavender import suite
from lavender.bench import regret
from lavender.cli import main
from lavender.report.regret import table

ONE = regret.Regret(
    case="x",
    rows=8,
    law="lcp",
    reason="made up",
    level=1e-6,
    best="direct",
    best_time=1e-4,
    auto_time=2e-4,
    auto_solved=True,
    auto_ran="",
)


def test_regret_is_a_ratio_of_shifted_times():
    assert ONE.plain == pytest.approx(2.0)
    assert ONE.shifted == pytest.approx(2.5e-4 / 1.5e-4)
    assert replace(ONE, auto_solved=False).shifted == math.inf
    assert replace(ONE, best="", best_time=math.inf).shifted == 1.0


def test_summary_counts_failures_apart():
    found = [
        *(replace(ONE, auto_time=1e-4) for _ in range(18)),
        replace(ONE, auto_time=9e-4),
        replace(ONE, auto_time=4e-3),
        replace(ONE, auto_solved=False),
        replace(ONE, best="", best_time=math.inf, auto_solved=False),
    ]
    s = regret.summary(found)
    assert (s.count, s.unsolved, s.nobody) == (21, 1, 1)
    assert s.worst == pytest.approx(4.05e-3 / 1.5e-4)
    assert s.p95 == pytest.approx(9.5e-4 / 1.5e-4)
    assert s.mean == pytest.approx(math.exp((math.log(9.5 / 1.5) + math.log(40.5 / 1.5)) / 20))
    assert "1 of them not by auto" in table(found)


def test_a_run_times_what_solved():
    cases = [(c.name, c.reason, c.problem) for c in (suite.stack(8), suite.chain(5))]
    found = list(regret.regrets(cases, levels=(1e-3, 1e-6), repeats=2))
    assert [(r.case, r.level) for r in found] == [
        ("stack(n=8)", 1e-3), ("stack(n=8)", 1e-6), ("chain(n=5)", 1e-3), ("chain(n=5)", 1e-6),
    ]  # fmt: skip
    for r in found:
        assert r.best in regret.own_solvers()
        assert r.auto_solved
        assert 0.0 < r.best_time < 1.0
        assert 0.0 < r.auto_time < 1.0
        assert r.shifted <= r.plain or r.plain <= 1.0


def test_nobody_is_timed_on_what_nobody_solves():
    infeasible = suite.case("infeasible(kind=joints)").problem
    (found,) = regret.regrets([("x", "", infeasible)], solvers=["pgs"], levels=(1e-3,), time_limit=0.05)
    assert found.best == ""


def test_candidates_are_ours_and_auto_is_not_one():
    own = regret.own_solvers()
    assert "newton" in own
    assert "auto" not in own
    assert "osqp" not in own


def test_the_command_writes_what_it_prints(tmp_path, capsys):
    out = tmp_path / "regret.json"
    with pytest.raises(SystemExit) as end:
        main(["bench", "auto", "stack(n=8)", "--levels", "1e-6", "--repeats", "1", "--out", str(out)])
    assert end.value.code == 0
    assert "1 problems and levels" in capsys.readouterr().out
    (row,) = json.loads(out.read_text())
    assert row["case"] == "stack(n=8)"


@pytest.mark.parametrize(
    ("args", "sign"),
    [
        (["--seeds", "5:2"], "A:B is needed"),
        (["--levels", "small"], "--levels"),
        (["--families", "wlid"], "wild"),
    ],
)
def test_a_senseless_request_is_refused(args, sign, capsys):
    with pytest.raises(SystemExit) as end:
        main(["bench", "auto", *args])
    assert end.value.code == 2
    assert sign in capsys.readouterr().err


def test_wild_problems_have_names_that_make_them_again():
    assert lv.suite.case("wild(seed=3, rows=40)").name == "wild(seed=3, rows=40)"
