"""Recorded curves, the schedule replayed on them, and rates fitted to them."""

import json
import math
from dataclasses import replace

import pytest

from lavender import suite
from lavender.bench import rates
from lavender.bench.curves import Curve, curves, read, write
from lavender.bench.replay import CALL, regret, replayed
from lavender.cli import main
from lavender.errors import InputError
from lavender.solvers import _plan
from lavender.solvers._plan import Costs
from lavender.solvers._structure import Structure

CASES = [suite.wild(seed=seed, rows=200) for seed in (0, 12, 28, 30)]


@pytest.fixture(scope="module")
def recorded():
    return list(curves([(c.name, c.reason, c.problem) for c in CASES], time_limit=0.2))


def test_a_curve_falls_and_its_time_rises(recorded):
    assert {curve.case for curve in recorded} == {case.name for case in CASES}
    for curve in recorded:
        times = [t for _, t, _ in curve.points]
        residuals = [r for _, _, r in curve.points]
        assert times == sorted(times) and residuals == sorted(residuals, reverse=True)
        assert all(t >= curve.setup for t in times) or not curve.points
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
    values = regret([(structure, made)])
    assert values and min(values) > 1.0
    # Somebody whom `auto` does not ask ends, nobody else does.
    hopeless = {name: replace(_hopeless(case), candidate=name) for name in made}
    ended = replace(_hopeless(case), candidate="lemke", points=((1, 1e-2, 1e-12),))
    assert max(regret([(structure, hopeless | {"lemke": ended})])) > 50.0
    assert regret([(structure, hopeless)]) == []


def _hopeless(case):
    points = tuple((n, 1e-4 * n, 0.5) for n in (1, 2, 4, 8))
    return _curve(case.problem, points, setup=1e-5)


def _curve(problem, points, setup):
    return Curve(
        case=problem.name, reason="", rows=problem.m, law=problem.law, operator=problem.operator,
        candidate="anderson", setup=setup, points=points, status="STALLED",
    )  # fmt: skip


def test_counts_of_few_problems_stay_near_those_of_all():
    case = suite.wild(seed=64)
    structure = Structure(case.problem)

    def ended(n):
        return structure, _curve(case.problem, ((n, 1e-3, 1e-9),), setup=1e-5)

    assert rates._middle([ended(8), ended(32), ended(64)]) == 32
    assert 10 < rates._middle([ended(80)], 10.0) < 14
    assert 60 < rates._middle([ended(80)] * 10 * rates.DRAWN, 10.0) < 80
    assert rates._middle([], 10.0) == 10


def test_times_that_are_made_of_rates_give_them_back():
    problems = [suite.wild(seed=seed, rows=400).problem for seed in range(90)]
    structures = [Structure(p) for p in problems if p.m and p.law in ("linear", "lcp")]
    chosen = []
    for s in structures:
        points = tuple((n, 1e-9 * (5e4 + n * (12.0 * s.m + 0.7 * s.sweep)), 0.5) for n in (1, 10, 100))
        chosen.append((s, _curve(s.problem, points, setup=5e-5)))
    assert len(chosen) >= rates.LEAST
    found = rates._least_squares(chosen, lambda s, n: [1.0, n * s.m, n * s.sweep])
    assert found == pytest.approx([5e4, 12.0, 0.7], rel=0.02)  # three digits are kept
    with pytest.raises(ValueError, match="30 are needed"):
        rates._least_squares(chosen[:5], lambda s, n: [1.0, n * s.m, n * s.sweep])


def test_the_file_holds_at_most_thirty_rates_and_every_candidate_has_its_cost():
    assert rates.count_rates(_plan.rates()) <= 30
    for case in CASES:
        costs = Costs(case.problem, 1e-6)
        for name in _plan.candidates(costs.structure):
            least, cost = costs.least(name), costs.of(name)
            assert least.setup >= 0.0 and cost.each > 0.0 and cost.count > 0.0
            assert (
                least.total <= 1.001 * cost.total or name == "newton"
            )  # of which bands are found by the analysis


def test_the_command_records_and_needs_enough_to_fit(tmp_path, capsys):
    path = tmp_path / "curves.jsonl"
    with pytest.raises(SystemExit) as end:
        main(["bench", "auto", "stack(n=70)", "--record", str(path), "--limit", "0.05"])
    assert end.value.code in (0, None)
    assert json.loads(path.read_text().splitlines()[0])["case"] == "stack(n=70)"
    with pytest.raises(ValueError, match="30 are needed"):
        main(["bench", "auto", "--fit", str(path)])
