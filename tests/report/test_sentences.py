"""Sentences that recommend, count or blame say what brute force over the rows of random tables finds."""

import json
import math
import re

import numpy as np
import pytest

from lavender.report import Report
from lavender.report.sweeps import SweepStudy
from lavender.report.tables import read_engine_answers
from lavender.report.text import format_speed, format_time
from tests.report.synthetic import BUDGET, FALSE_CLAIM, lines_of, record, report_of

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


@pytest.mark.parametrize("seed", range(25))
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


@pytest.mark.parametrize("seed", range(12))
def test_steps_that_do_not_count_are_counted_once(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 9))
    idle = set(rng.choice(n - 2, int(rng.integers(1, n - 2)), replace=False).tolist())
    made = [
        record(f"walk[{k}]", "pgs", 1e-3, 1e-4, **BUDGET | {"step": k, "velocity": 1e-4})
        for k in range(n)
    ]
    facts = {f"walk[{k}]": {"nothing_to_do": True} for k in idle}
    study = SweepStudy(report_of(*made, walk=True, cases=facts))
    text = next(x for x in study.sentences if "recorded step" in x)
    found = re.search(r"the zero impulse solves (\d+)", text)
    assert (int(found[1]) if found else 0) == len(idle - {0})
    counted = n - len(idle | {0})
    assert f"Of {n} recorded steps" in text and f"compared on {counted}" in text


# -- the answers of an engine ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_sentences_on_the_engine_are_those_of_brute_force(seed, tmp_path):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 8))
    answers = [
        {
            "file": f"step_{k}.npz", "rows": 8, "seconds": 1e-3, "solver": "theirs", "verdict": "wrong",
            "relative": float(10.0 ** rng.uniform(-8.0, 0.0)), "velocity": draw_error(rng),
            "worst": f"row {k}", "energy_gain": float(rng.choice([-1.0, 0.0, 0.5, 2.0]) * rng.random()),
        }
        for k in range(n)
    ]  # fmt: skip
    (tmp_path / "engine.jsonl").write_text("\n".join(json.dumps(x) for x in answers) + "\n")
    made = [record(f"case{k}", "pgs", 1e-3, 1e-8) for k in range(n)]
    facts = {f"case{k}": {"source": str(tmp_path / f"step_{k}.npz")} for k in range(n)}
    lines = lines_of(*made, cases=facts)
    report = Report(lines, None, None, read_engine_answers([], lines))
    text = " ".join(report.sentences)
    worst = max(x["velocity"] for x in answers)
    named = re.search(r"leaves up to (.+?) \(row (\d+)\), above (.+?) in (\d+) of", text)
    assert answers[int(named[2])]["velocity"] == worst and named[1] == format_speed(worst)
    assert int(named[4]) == sum(x["velocity"] > report.error_limit for x in answers)
    gains = {f"case{k}": x["energy_gain"] for k, x in enumerate(answers) if x["energy_gain"] > 0.0}
    told = [x for x in report.warnings if "your engine in" in x]
    assert bool(told) == bool(gains)
    if gains:
        count, most, case = re.search(
            r"your engine in (\d+) steps?, at most (\S+) J \((\w+)\)", told[0]
        ).groups()
        assert int(count) == len(gains) and gains[case] == max(gains.values())
        assert float(most) == pytest.approx(max(gains.values()), rel=0.06)


# -- the recommended solver --------------------------------------------------------------------------------------------

TOL = 1e-6


def draw_runs(seed):
    """Draw runs of a few solvers on a few problems: solved or not, false claims, equal times, pairs without a run."""
    rng = np.random.default_rng(seed)
    solvers = rng.choice(
        ["auto", "newton", "pgs", "direct", "admm"], int(rng.integers(2, 5)), replace=False
    ).tolist()
    cases = [f"case{i}" for i in range(int(rng.integers(2, 6)))]
    speed = {solver: 10.0 ** rng.uniform(-3.0, -1.0) for solver in solvers}
    if rng.random() < 0.3:
        speed = dict.fromkeys(solvers, 1e-2)
    made, table, false = [], {}, set()
    for solver in solvers:
        for case in cases:
            if rng.random() < 0.08:
                continue
            time = speed[solver] * float(rng.choice([1.0, 1.0, 1.02, 3.0]))
            relative = float(
                rng.choice([1e-8, 1e-6, 1.1e-6, 0.3, math.inf], p=[0.5, 0.2, 0.1, 0.15, 0.05])
            )
            more = {}
            if relative > TOL:
                more = {"status": "MAX_ITERATIONS", "claims": False}
                if rng.random() < 0.15:
                    more = FALSE_CLAIM
                    false.add(solver)
            made.append(record(case, solver, time, relative, **more))
            table[solver, case] = time if relative <= TOL else None
    # The zero impulse solves this problem: neither its times nor its claims count.
    for solver in solvers:
        more = FALSE_CLAIM if rng.random() < 0.3 else {}
        made.append(record("idle", solver, 10.0 ** rng.uniform(-5.0, 0.0), 1e-9, **more))
    return report_of(*made, cases={"idle": {"nothing_to_do": True}}), table, false


@pytest.mark.parametrize("seed", range(25))
def test_recommended_solver_is_that_of_brute_force(seed):
    report, table, false = draw_runs(seed)
    solvers, cases = (sorted({key[i] for key in table}) for i in (0, 1))
    solved = {s: [table[s, c] for c in cases if table.get((s, c)) is not None] for s in solvers}
    # Shifted geometric means over the solved problems.
    means = {s: math.exp(np.mean(np.log(np.add(t, 1e-5)))) - 1e-5 for s, t in solved.items() if t}
    verdict, text = report.verdict, " ".join(report.sentences)
    if not means:
        assert report.first == "" and verdict.startswith("No solver brings")
        return
    first = report.first
    honest = [s for s in means if s not in false] or list(means)
    most = max(len(solved[s]) for s in honest)
    best = [s for s in honest if len(solved[s]) == most]
    # A tie within the noise of repetitions, of 4 %, goes to auto.
    assert first in best and means[first] <= 1.05 * min(means[s] for s in best)
    n = len(cases)
    some = f"all {n} problems" if most == n else f"{most} of {n} problems"
    assert f"se {first}: it solves {some}" in verdict
    worst = max(solved[first])
    assert f"{format_time(means[first])} on average ({format_time(worst)} at worst" in verdict
    hardest = re.search(r"at worst, on (\w+)", verdict)[1]
    assert table[first, hardest] == worst
    missed = {s: sum(1 for c in cases if (s, c) in table and table[s, c] is None) for s in solvers}
    for count, name in re.findall(r"(\d+) by (\w+)", text):
        assert missed[name] == int(count) > 0
    assert ("Not solved" in text) == any(missed.values())
    for name, count in re.findall(r"(?:faster: |, )(\w+) on (\d+)", text):
        quicker = [
            c for c in cases
            if table.get((first, c)) is not None and table.get((name, c)) is not None
            and table[first, c] > 1.25 * table[name, c] and name not in false
        ]  # fmt: skip
        assert len(quicker) >= int(count) > 0
    slower = {
        c: table[first, c] / min(table[s, c] for s in solvers if table.get((s, c)) and s not in false | {first})
        for c in cases if table.get((first, c))
        and any(table.get((s, c)) for s in solvers if s not in false | {first})
    }  # fmt: skip
    counted = {c: x for c, x in slower.items() if x > 1.25}
    assert ("On single problems" in text) == bool(counted)
    if counted:
        found = re.search(r"is then up to ([\d.]+)× slower \((\w+)\)", text)
        assert counted[found[2]] == max(counted.values())
        assert float(found[1]) == pytest.approx(max(counted.values()), rel=0.06)
