"""What measures `auto`: regret by hand and by a small run, recorded curves, the schedule replayed, rates fitted."""

import json
import math
from dataclasses import replace
from importlib import resources

import pytest
from click.testing import CliRunner

from benchmarks.auto import command, rates, regret, replay
from benchmarks.auto.curves import Curve, curves, read, write
from benchmarks.auto.rates import Structure
from benchmarks.auto.replay import CALL, Costs, candidates, replayed
from benchmarks.drawn import wild
from lavender import suite
from lavender.errors import InputError, LavenderError
from lavender.solvers.costs import rates as plan_rates

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
    assert "1 of them not by auto" in regret.table(found)


def test_a_run_times_what_solved():
    cases = [(c.name, c.reason, c.problem) for c in (suite.stack(8), suite.chain(5))]
    found = list(regret.regrets(cases, levels=(1e-3, 1e-6), repeats=2))
    assert [(r.case, r.level) for r in found] == [
        ("stack(n=8)", 1e-3), ("stack(n=8)", 1e-6), ("chain(n=5)", 1e-3), ("chain(n=5)", 1e-6),
    ]  # fmt: skip
    for r in found:
        assert r.best in regret.own_solvers()
        assert r.auto_solved
        assert r.best_time > 0.0
        assert r.auto_time > 0.0
        assert r.shifted <= r.plain or r.plain <= 1.0


def test_nobody_is_timed_on_what_nobody_solves():
    infeasible = suite.case("infeasible(kind=joints)").problem
    (found,) = regret.regrets([("x", "", infeasible)], solvers=["pgs"], levels=(1e-3,), time_limit=0.05)
    assert found.best == ""


CASES = [wild(seed=seed, rows=200) for seed in (0, 12, 28, 30)]


@pytest.fixture(scope="module")
def recorded():
    return list(curves([(c.name, c.reason, c.problem) for c in CASES], time_limit=0.2))


def test_a_curve_falls_and_its_time_rises(recorded):
    assert {curve.case for curve in recorded} == {case.name for case in CASES}
    for curve in recorded:
        times = [t for _, t, _ in curve.points]
        residuals = [r for _, _, r in curve.points]
        assert times == sorted(times) and residuals == sorted(residuals, reverse=True)
        assert curve.time(0.0) >= curve.time(1e-6) >= curve.time(1e-3)


def test_what_is_written_is_read_again(recorded, tmp_path):
    path = tmp_path / "curves.jsonl"
    assert write(path, recorded) == len(recorded)
    assert list(read([path])) == recorded
    path.write_text('{"case": 1}\n')
    with pytest.raises(InputError, match="line 1"):
        list(read([path]))


def test_a_replay_takes_no_less_than_the_best_and_ends_where_somebody_does(recorded):
    for case in CASES:
        made = {c.candidate: c for c in recorded if c.case == case.name}
        structure = Structure(case.problem)
        best = min(curve.time(1e-3) for curve in made.values())
        assert replayed(structure, made, 1e-3) > best + CALL * 0.999
        assert math.isinf(replayed(structure, dict.fromkeys(made, _hopeless(case)), 1e-3))


def test_replayed_regret_is_above_one_and_counts_what_does_not_end_for_much(recorded):
    case = CASES[0]
    structure = Structure(case.problem)
    made = {c.candidate: c for c in recorded if c.case == case.name}
    values = replay.regret([(structure, made)])
    assert values and min(values) > 1.0
    # Somebody whom `auto` does not ask ends, nobody else does.
    hopeless = {name: replace(_hopeless(case), candidate=name) for name in made}
    ended = replace(_hopeless(case), candidate="lemke", points=((1, 1e-2, 1e-12),))
    assert max(replay.regret([(structure, hopeless | {"lemke": ended})])) > 50.0
    assert replay.regret([(structure, hopeless)]) == []


def _hopeless(case):
    points = tuple((n, 1e-4 * n, 0.5) for n in (1, 2, 4, 8))
    return _curve(case.problem, points, setup=1e-5)


def _curve(problem, points, setup):
    return Curve(
        case=problem.name, reason="", rows=problem.m, law=problem.law, operator=problem.operator,
        candidate="anderson", setup=setup, points=points, status="STALLED",
    )  # fmt: skip


def test_counts_of_few_problems_stay_near_those_of_all():
    case = wild(seed=64)
    structure = Structure(case.problem)

    def ended(n):
        return structure, _curve(case.problem, ((n, 1e-3, 1e-9),), setup=1e-5)

    assert rates.middle([ended(8), ended(32), ended(64)]) == 32
    assert 10 < rates.middle([ended(80)], 10.0) < 14
    assert 60 < rates.middle([ended(80)] * 10 * rates.DRAWN, 10.0) < 80
    assert rates.middle([], 10.0) == 10


def test_times_that_are_made_of_rates_give_them_back():
    problems = [wild(seed=seed, rows=400).problem for seed in range(90)]
    structures = [Structure(p) for p in problems if p.m and p.law in ("linear", "lcp")]
    chosen = []
    for s in structures:
        points = tuple((n, 1e-9 * (5e4 + n * (12.0 * s.m + 0.7 * s.sweep)), 0.5) for n in (1, 10, 100))
        chosen.append((s, _curve(s.problem, points, setup=5e-5)))
    assert len(chosen) >= rates.LEAST
    found = rates.least_squares(chosen, lambda s, n: [1.0, n * s.m, n * s.sweep])
    assert found == pytest.approx([5e4, 12.0, 0.7], rel=0.02)  # three digits are kept
    with pytest.raises(ValueError, match="30 are needed"):
        rates.least_squares(chosen[:5], lambda s, n: [1.0, n * s.m, n * s.sweep])


def test_nine_in_ten_end_within_what_is_sure():
    now, problem = plan_rates(), suite.case("stack(n=100)").problem
    structure = Structure(problem)
    cost = Costs(problem, rates.LEVEL, now, structure).of("direct").total
    curves = [_curve(problem, ((3, 1e-9 * share * cost, 1e-9),), setup=0.0) for share in range(1, 12)]
    never = _curve(problem, ((3, 1.0, 0.5),), setup=0.0)
    assert rates.surely({"direct": [(structure, c) for c in (*curves, never)]}, now) == pytest.approx(10.0)


def test_the_file_holds_at_most_thirty_rates_and_every_candidate_has_its_cost():
    text = resources.files("lavender.solvers").joinpath("rates.json").read_text(encoding="utf-8")
    assert 0 < rates.count_rates(json.loads(text)) <= 30
    for case in CASES:
        costs = Costs(case.problem, 1e-6)
        for name in candidates(costs.structure):
            least, cost = costs.least(name), costs.of(name)
            assert least.setup >= 0.0 and cost.each > 0.0 and cost.count > 0.0
            assert (
                least.total <= 1.001 * cost.total or name == "newton"
            )  # of which bands are found by the analysis


def asked(*words):
    """What the command prints."""
    return CliRunner().invoke(command, words, catch_exceptions=False).output


def test_the_command_records_and_needs_enough_to_fit(tmp_path):
    path = tmp_path / "curves.jsonl"
    asked("stack(n=70)", "--record", str(path), "--limit", "0.05")
    assert json.loads(path.read_text().splitlines()[0])["case"] == "stack(n=70)"
    with pytest.raises(ValueError, match="30 are needed"):
        asked("--fit", str(path))


def test_the_command_writes_what_it_prints(tmp_path):
    out = tmp_path / "regret.json"
    words = asked("stack(n=8)", "--levels", "1e-6", "--repeats", "1", "--out", str(out))
    assert "1 problems and levels" in words
    (row,) = json.loads(out.read_text())["lines"]
    assert row["case"] == "stack(n=8)"


@pytest.mark.parametrize(
    ("words", "sign"),
    [
        (["--seeds", "5:2"], "A:B is needed"),
        (["--levels", "small"], "--levels"),
        (["--families", "wlid"], "wild"),
        (["--seeds", "0:1000000000000"], "1000000000000 seeds"),
    ],
)
def test_a_senseless_request_is_refused(words, sign):
    with pytest.raises(LavenderError, match=sign):
        asked(*words)
