"""Sentences that recommend, count or blame say what brute force over the rows of random tables finds."""

import math
import re

import numpy as np
import pytest

from lavender.report.sweeps import SweepStudy
from lavender.report.text import format_speed
from tests.report.synthetic import BUDGET, record, report_of

LIMIT = 1e-3
PLAIN = ("pgs", "sequential_impulses", "block_gauss_seidel", "jacobi")
ALL = (*PLAIN, "anderson", "nncg")


def draw_error(rng):
    """Draw a velocity error [m/s]: near the limit on both sides, at the limit, tiny, diverged."""
    kind = rng.random()
    if kind < 0.1:
        return LIMIT
    if kind < 0.2:
        return math.inf
    if kind < 0.3:
        return 0.0
    return LIMIT * float(np.exp(rng.uniform(-1.5, 0.7)))


def draw_sweeps(seed):
    """Draw a report of swept steps, and {(start, solver, sweeps): errors of the steps after the first}."""
    rng = np.random.default_rng(seed)
    solvers = rng.choice(ALL, int(rng.integers(1, 5)), replace=False).tolist()
    budgets = sorted(rng.choice([2, 4, 8, 16, 32], int(rng.integers(1, 6)), replace=False).tolist())
    starts, n = (["cold"], ["cold", "carried"])[int(rng.integers(2))], int(rng.integers(2, 5))
    made, table = [], {}
    for start in starts:
        for solver in solvers:
            for budget in budgets:
                errors = [draw_error(rng) for _ in range(n)]
                if (
                    rng.random() < 0.4 and budget != budgets[0]
                ):  # As most solvers: fewer errors with more sweeps.
                    errors = [
                        0.3 * e for e in table.get((start, solver, budgets[0]), errors[1:])
                    ] + errors[:1]
                    errors = errors[::-1]
                measured = n if rng.random() < 0.93 else n - 1
                for step in range(measured):
                    velocity = (
                        10.0 if step == 0 else errors[step]
                    )  # The first step counts for nothing.
                    made.append(record(
                        f"walk[{step}]", solver, 1e-3, velocity,
                        **BUDGET | {"max_iter": budget, "start": start, "velocity": velocity, "step": step},
                    ))  # fmt: skip
                if measured == n:
                    table[start, solver, budget] = errors[1:n]
    return report_of(*made, walk=True), table, budgets


def find_need(table, start, solver):
    """Return the smallest number of sweeps of which, and of all larger ones, no error exceeds the limit."""
    measured = sorted(budget for s, name, budget in table if (s, name) == (start, solver))
    good = [
        b
        for b in measured
        if all(max(table[start, solver, c]) <= LIMIT for c in measured if c >= b)
    ]
    return good[0] if good else None


@pytest.mark.parametrize("seed", range(40))
def test_recommended_sweeps_are_those_of_brute_force(seed):
    report, table, budgets = draw_sweeps(seed)
    starts = {start for start, _, _ in table}
    if not starts:
        pytest.skip("no number of sweeps was measured on every step")
    study = SweepStudy(report)
    start = "carried" if "carried" in starts else "cold"
    solvers = {solver for s, solver, _ in table if s == start}
    needs = {solver: find_need(table, start, solver) for solver in solvers}
    enough = {solver: n for solver, n in needs.items() if n is not None}
    preferred = {solver: n for solver, n in enough.items() if solver in PLAIN} or enough
    if found := re.match(r"(\d+) sweeps of (\w+) keep every", study.verdict):
        n, solver = int(found[1]), found[2]
        assert needs[solver] == n == min(preferred.values())
        fewer = [b for b in budgets if b < n and (start, solver, b) in table]
        text = (
            f"{fewer[-1]} leave {format_speed(max(table[start, solver, fewer[-1]]), limit=LIMIT)}"
            if fewer
            else ""
        )
        assert text in study.verdict and ("leave" in study.verdict) == bool(fewer)
    else:
        found = re.match(r"(\d+) sweeps of (\w+) are not enough: they leave (.*);", study.verdict)
        assert not enough and found, study.verdict
        measured = [b for s, name, b in table if (s, name) == (start, found[2])]
        assert int(found[1]) == max(measured)
        assert found[3] == format_speed(max(table[start, found[2], max(measured)]), limit=LIMIT)
    assert study.is_bad == (not enough)
    text = " ".join(study.sentences)
    for solver, n in re.findall(r"(\w+) needs (\d+)(?=[;.])", text.partition("From cold")[0]):
        assert needs[solver] == int(n)
    for solver, n in re.findall(r"(\w+) more than (\d+)", text):
        assert needs[solver] is None and int(n) == budgets[-1]
    if start == "carried":
        cold = find_need(table, "cold", study.first)
        if "the number is the same" in text:
            assert cold == needs[study.first]
        elif other := re.search(r"From cold starts (\w+) needs (\d+)", text):
            assert (other[1], int(other[2])) == (study.first, cold)
        else:
            assert cold is None and f"{budgets[-1]} of {study.first} are not enough" in text
