"""What measures `auto`: records of all solvers, the tree replayed on them, regret by hand, the fit of the rates."""

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks.auto import command
from benchmarks.auto.record import LEVELS, Record, records
from benchmarks.auto.replay import CALL, LINE, LOST, RULES, SHIFT, fit, regrets, replayed, summary
from lavender import suite
from lavender.judge.residuals import reference
from lavender.solvers.auto import Tree
from lavender.solvers.costs import RATES


def curve(solver, points, setup=0.0, case="a"):
    return Record(case, solver, setup, points)


@pytest.fixture(scope="module")
def stack():
    problem = suite.stack(n=200).problem
    reference(problem)
    return problem


@pytest.fixture(scope="module")
def recorded(stack):
    return list(records([("stack(n=200)", stack)], 0.2))


def test_records_are_of_every_solver_that_takes_the_problem(recorded):
    assert {"anderson", "newton", "direct", "auto"} <= {r.solver for r in recorded}
    assert "newton over rows" not in {r.solver for r in recorded}
    for r in recorded:
        assert (np.diff([t for _, t, _ in r.points]) >= 0.0).all()
        assert r.to(1e-3)[0] <= r.to(1e-9)[0]
    auto = next(r for r in recorded if r.solver == "auto")
    assert auto.to(1e-6)[0] < math.inf


def test_a_line_that_solves_ends_the_replay(stack):
    curves = {"anderson": curve("anderson", [(1, 1e-4, 1e-9)]), "newton": curve("newton", [(3, 1e-3, 1e-9)])}
    assert replayed(Tree(stack), curves, 1e-6, iter) == pytest.approx(CALL + LINE + 1e-4)


def test_sweeps_that_never_end_cost_what_they_had_and_then_newton_solves(stack):
    slow = [(n, 1e-6 * n, 1.0) for n in range(1, 100_000, 50)]
    curves = {"anderson": curve("anderson", slow), "newton": curve("newton", [(3, 1e-3, 1e-9)])}
    time = replayed(Tree(stack), curves, 1e-6, iter)
    assert 1e-3 < time < 2e-3 + 3 * LINE
    del curves["newton"]
    assert replayed(Tree(stack), curves, 1e-6, iter) == math.inf


@pytest.mark.parametrize("name", RULES)
def test_every_rule_is_one(stack, name, recorded):
    curves = {r.solver: r for r in recorded}
    time = replayed(Tree(stack), curves, 1e-3, RULES[name])
    assert min(r.to(1e-3)[0] for r in recorded) <= time < 1.0
    assert len(regrets([(stack, curves)], RULES[name])) == len(LEVELS)


def test_regret_is_over_the_best_with_the_shift(stack):
    curves = {"direct": curve("direct", [(1, 1e-3, 1e-10)]), "auto": curve("auto", [(1, 3e-3, 1e-7)])}
    first, second, third = regrets([(stack, curves)], None)
    assert first[0] == second[0] == pytest.approx((3e-3 + SHIFT) / (1e-3 + SHIFT))
    assert third[0] == math.inf
    assert "unsolved 1" in summary([first, second, third]) and f"{LOST:.0f}" in summary([third])


def test_the_fit_writes_twelve_rates_that_count_what_is_recorded(stack, recorded):
    curves = {r.solver: r for r in recorded}
    rates = fit([(stack, curves)] * 8)
    assert rates.keys() == RATES.keys() and rates["work"].keys() == RATES["work"].keys()
    numbers = [
        x for value in rates.values() for x in (value.values() if isinstance(value, dict) else [value])
    ]
    assert len(numbers) == 12 and min(numbers) > 0.0


def test_the_command_records_and_judges(tmp_path):
    path, out = tmp_path / "records.jsonl", tmp_path / "rates.json"
    run = CliRunner().invoke
    done = run(command, ["stack(n=100)", "granularF(n=3)", "--limit", "0.05", "--record", str(path)])
    assert done.exit_code == 0, done.output
    told = run(command, ["--judge", str(path)])
    assert told.exit_code == 0 and "the two-line rule" in told.output and "unsolved 0" in told.output, (
        told.output
    )
    fitted = run(command, ["--fit", str(path), "--out", str(out)])
    assert fitted.exit_code == 0, fitted.output
    assert json.loads(out.read_text()).keys() == RATES.keys()
    assert run(command, []).exit_code != 0
