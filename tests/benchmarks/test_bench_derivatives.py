"""`python -m benchmarks derivatives`: what counts as agreement, as flagged, and as beyond differences."""

from dataclasses import replace

import numpy as np

import lavender as lv
from benchmarks import derivatives
from lavender import suite


def test_bench_derivative_agrees_with_differences_and_a_wrong_one_does_not(monkeypatch):
    problem = suite.case("pyramidF(k=2, sliding=0.5)").problem.relaxed("cone")
    found = derivatives.compared("suite", problem)
    assert derivatives.agrees(found) and found.off < 1e-6
    right = lv.Derivative.jvp

    def wrong(self, **changes):
        t = right(self, **changes)
        return replace(t, slack=1.001 * t.slack)

    monkeypatch.setattr(lv.Derivative, "jvp", wrong)
    assert not derivatives.agrees(derivatives.compared("suite", problem))


def test_bench_derivative_at_a_switch_is_flagged_and_not_compared():
    a = np.eye(3)
    edge = lv.Problem.contact(a, [10.0, 5.0, 0.0], mu=[0.5])
    found = derivatives.compared("made", edge)
    assert found.flagged == "switching" and np.isnan(found.off)
    table = derivatives.agreement(
        [found, derivatives.compared("made", lv.Problem.contact(a, [10.0, 4.0, 0.0], mu=[0.5]))]
    )
    assert "| coulomb | matrix | 2 | 50.0% | 0 | 1 | 1 of 1 | 0 of 0 |" in table


def test_bench_derivative_of_a_rejected_direction_is_flagged():
    twice = lv.Problem.linear(np.ones((2, 2)), [1.0, 1.0])  # one row given twice
    found = derivatives.compared("made", twice)
    assert found.flagged == "refused" and np.isnan(found.off)
    assert "| linear | matrix | 1 | 100.0% | 1 | 0 | 0 of 0 | 0 of 0 |" in derivatives.agreement([found])
