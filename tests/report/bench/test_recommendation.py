"""Solvers rank by what was measured, a rerun agrees, and resampling says how sure a ranking is."""

import dataclasses
import math
import random
import re

import numpy as np
import pytest
from stacks import chain

import lavender as lv
from lavender import bench, report
from lavender.report.bench import recommendation, statistics
from lavender.report.bench.resampling import (
    rank_calls_in_time,
    rank_calls_to_tolerance,
    select_calls_with_most_cases,
)
from lavender.report.figures import build_figures
from lavender.report.verdict import build_verdict
from tests.report.synthetic import BUDGET, FALSE_CLAIM, info, record, records_of

CASES = [f"case {i}" for i in range(6)]
ROBOTS = {"ant": 1.0, "cheetah": 3.0, "hopper": 0.7, "humanoid": 5.0, "walker": 1.5, "reacher": 0.4}


def by_tolerance(records):
    return [a for line in report.recommend_solvers(records) for a in line.by_tolerance.values()]


def by_time(records, times=()):
    return [a for line in report.recommend_solvers(records, times) for a in line.by_time.values()]


# -- runs that were timed one after the other -----------------------------------------------------------------


def test_who_solves_most_is_first_and_false_claims_are_last():
    found = records_of(
        record("a", "quick", 0.1, 1e-7), record("b", "quick", 0.1, 1e-1),
        record("a", "sure", 1.0, 1e-7), record("b", "sure", 1.0, 1e-7),
        record("a", "liar", 0.1, 1e-7), record("b", "liar", 0.1, 1e-7, **FALSE_CLAIM),
        structure={"a": ("stack",), "b": ("stack", "redundant")},
    )  # fmt: skip
    by = {(a.family, a.target): a for a in by_tolerance(found)}
    assert [c.solver for c in by["stack", 1e-6].ranking] == ["sure", "quick", "liar"]
    assert by["stack", 1e-6].best.solved == 2
    assert by["redundant", 1e-6].best.solver == "sure"


def jittered(records, seed, most=1.1):
    """The same records as another run would time them."""
    rng = random.Random(seed)
    made = []
    for r in records:
        t = r.time_min * most ** rng.uniform(-1.0, 1.0)
        made.append(dataclasses.replace(r, time_min=t, time_median=t))
    return records_of(*made)


def close_race():
    """Three that differ by less than noise, one that does not, and one that needs all of a time budget."""
    made = []
    for i in range(4):
        case = f"case {i}"
        for solver, time in (("zeta", 1.0), ("auto", 1.1), ("beta", 1.05), ("slow", 2.0)):
            made.append(record(case, solver, (1.0 + i) * 1e-3 * time, 1e-7))
        stalled = {"success": False, "status": "STALLED", "claims": False}
        made.append(record(case, "edge", 1e-3, 1e-9, tol=1e-12, **stalled))
    return records_of(*made)


def test_those_within_noise_are_ties_and_a_rerun_keeps_the_recommendation():
    first = close_race()
    by = {a.target: a for a in by_tolerance(first)}
    assert {by[1e-6].best.solver, *by[1e-6].tied_solvers} == {"edge"}
    others = records_of(*(r for r in first if r.solver != "edge"))
    tolerance = recommendation.rank_to_tolerance(others, "all", CASES[:4], 1e-6)
    assert (tolerance.best.solver, tolerance.tied_solvers) == ("auto", ("beta", "zeta"))
    times = (1e-3, 2e-3, 5e-3)
    for seed in range(40):
        again = jittered(first, seed)
        pairs = zip(
            [*by_tolerance(first), *by_time(first, times)],
            [*by_tolerance(again), *by_time(again, times)],
            strict=True,
        )
        for old, new in pairs:
            assert (new.family, new.target) == (old.family, old.target)
            if old.best is not None and new.best is not None:
                assert old.best.solver in {new.best.solver, *new.tied_solvers}


def test_another_solver_changes_nobodys_score():
    first = close_race()
    more = records_of(*first, *(record(f"case {i}", "new", 1e-7, 1e-9) for i in range(4)))
    for how in (by_tolerance, lambda r: by_time(r, [1e-3, 1e-2])):
        for old, new in zip(how(first), how(more), strict=True):
            scores = {c.solver: c.score for c in new.ranking}
            assert {c.solver: scores[c.solver] for c in old.ranking} == {
                c.solver: c.score for c in old.ranking
            }
    assert "new" in {c.solver for c in by_tolerance(more)[0].ranking}


def test_the_mean_ranks_and_the_worst_case_is_named():
    times = {"even": (3e-3, 3e-3, 3e-3), "odd": (1e-3, 1e-3, 60e-3)}  # a median would say odd
    made = [record(c, s, t, 1e-7) for s, ts in times.items() for c, t in zip("abc", ts, strict=True)]
    (advice,) = (a for a in by_tolerance(records_of(*made)) if a.target == 1e-6)
    assert advice.best.solver == "even"
    assert (advice.ranking[1].worst, advice.ranking[1].hardest) == (60e-3, "c")


def test_time_budgets_are_those_given_and_the_sweeps_are_named():
    found = records_of(
        record("a", "pgs", 0.25, 1e-4, **BUDGET),
        record("a", "pgs", 3.0, 1e-7, work={"sweeps": 90}),
        record("a", "direct", 4.0, 1e-12, work={"factorisations": 1}),
    )
    (line,) = report.recommend_solvers(found, [0.5, 5.0])
    assert (line.name, line.n_cases, line.sequence) == ("stack", 1, False)
    best = {x: (a.best.solver, a.best.how) for x, a in line.by_tolerance.items()}
    assert best == {1e-3: ("pgs", "90 sweeps"), 1e-6: ("pgs", "90 sweeps")}
    assert {t: a.best.solver for t, a in line.by_time.items()} == {0.5: "pgs", 5.0: "direct"}


def test_a_step_that_nobody_was_asked_for_is_missed_and_a_folder_may_have_the_name_of_a_structure():
    made = [record(f"stack[{i}]", "x", 1e-3, 1e-8, step=i) for i in range(2)]
    found = records_of(record("a", "x", 1e-5, 1e-8), *made)
    for i in range(3):  # the pass ended after two of three steps
        found.add(info(f"stack[{i}]", sequence="stack", step=i))
    lines = report.recommend_solvers(found, [1.0])
    assert [(x.name, x.n_cases, x.sequence) for x in lines] == [("stack", 1, False), ("stack", 3, True)]
    for line, solved in zip(lines, (1, 2), strict=True):
        for best in (line.by_tolerance[1e-6].best, line.by_time[1.0].ranking[0]):
            assert (best.solved, best.cases) == (solved, line.n_cases)
    # charged the time limit of 2 s, as a case is
    score = lines[1].by_tolerance[1e-6].best.score
    assert score == pytest.approx((1e-3**2 * 2.0) ** (1 / 3), rel=0.05)


def test_sequences_are_compared_carried_against_cold():
    problems = [lv.Problem.lcp(chain(6).matrix, np.ones(6) * (1 + 0.001 * i)) for i in range(4)]
    plan = bench.Plan(tolerances=(1e-6,), budgets=(5,), repeats=1)
    records = bench.run(bench.make_sequence(problems, "load"), ["pgs", "direct"], plan)
    budget, tolerance, exact = statistics.group_runs_by_pass(records)
    assert (budget.solver, budget.max_iter, budget.steps) == ("pgs", 5, 4)
    cold = [r for r in records if r.solver == "pgs" and r.mode == "budget" and r.start == "cold"]
    assert budget.total_times["cold"] == sum(r.time_min for r in cold)
    assert budget.residuals["cold"] == tuple(r.relative for r in cold)
    assert budget.carried_gain > 1.0
    assert tolerance.iterations["carried"] < tolerance.iterations["cold"]
    assert set(exact.residuals) == {"cold"}
    (line,) = report.recommend_solvers(records, [1e-9, 10.0])
    assert (line.name, line.n_cases, line.sequence) == ("load", 4, True)
    # Only an exact solver, or a run to the tolerance, brings all four steps there; nothing is done in a nanosecond.
    best = line.by_tolerance[1e-6].best
    assert (best.solved, best.cases, best.how in ("to 1e-6, cold", "to 1e-6, carried")) == (4, 4, True)
    assert line.by_time[1e-9].best is None
    reached = {c.solver: c for c in line.by_time[10.0].ranking}
    means = {
        f"{w.target}, {start}": math.exp(np.mean(np.log(np.clip(w.residuals[start], 1e-17, 1.0))))
        for w in (budget, tolerance)
        for start in ("cold", "carried")
    }
    assert reached["pgs"].how == min(means, key=lambda how: means[how])
    assert reached["pgs"].score == pytest.approx(min(means.values()))
    at_budget, to_tolerance = build_figures(records).sequences["load"]
    curves = [(c.label, c.y) for c in at_budget.curves]
    assert curves == [("pgs", budget.residuals["carried"]), ("pgs (cold)", budget.residuals["cold"])]
    total = pytest.approx(np.cumsum(exact.times["cold"]))  # the time so far
    assert [c.y for c in to_tolerance.curves if c.solver == "direct"] == [total]
    assert report.summarize_runs_by_case(records) == []  # steps are no cases of their own


def test_misses_in_a_time_count():
    """Nearly exact on seven cases of ten and nothing on three ranks behind a little on all of them."""
    made = []
    for i in range(10):
        made.append(record(f"c{i}", "whole", 1.0, 1e-7))
        for solver, left in (("deep", 1e-15 if i < 7 else 1.0), ("wide", 1e-1)):
            made.append(record(f"c{i}", solver, 1e-4, left, **BUDGET))
    found = records_of(*made)
    (line,) = report.recommend_solvers(found, [1e-3])
    advice, swept = line.by_time[1e-3], line.by_sweeps[8.0]
    ranking = [(c.solver, c.solved, c.score) for c in advice.ranking]
    assert ranking[:2] == [("wide", 10, 0.1), ("deep", 7, 1.0)]
    assert (swept.target, swept.best.solver) == (8.0, "wide")
    rest = records_of(
        *(r for r in made if r.solver != "wide")
    )  # 7 of 10 are not nine of ten, in whatever time
    assert build_verdict(rest, [1e-3]).joined_text.endswith("residual on nine cases of ten in 1.00 ms.")


# -- lines that were timed alternately ---------------------------------------------------------------------------


def interleaved(speeds, seed, cases=CASES, noise=1.04, rerun=1.0, sizes=None, repeats=7):
    """Records of interleaved lines: each case has its size, each repetition its noise, a rerun its own machine."""
    rng = random.Random(seed)
    machine = rerun ** rng.uniform(-1.0, 1.0)
    made = []
    for i, case in enumerate(cases):
        size = machine * 1e-3 * (1.0 + i if sizes is None else sizes[case])
        for solver, of_case in speeds.items():
            factor = of_case if isinstance(of_case, float) else of_case(i)
            times = tuple(size * factor * noise ** rng.gauss(0.0, 1.0) for _ in range(repeats))
            more = {"timing_mode": "call", "times": times, "calibration_time": 1e-4 * machine}
            made.append(record(case, solver, min(times), 1e-7, interleave_group="one", **more))
            made.append(record(case, solver, min(times), 1e-7, **more))
    return records_of(*made)


def race(records, tolerance=1e-6):
    return rank_calls_to_tolerance(records, select_calls_with_most_cases(records, "call"), tolerance)


def test_a_clear_winner_is_named_alone_and_wins_every_resampling():
    found = race(interleaved({"auto": 1.5, "fast": 1.0, "slow": 2.0}, 0))
    assert (found.named_calls, found.shares[0], found.loss) == (("fast",), 1.0, 1.0)


def test_cases_that_disagree_make_it_unsure_and_both_are_named():
    speeds = {"even": 1.0, "odd": lambda i: (0.5, 2.0)[i % 2]}
    found = race(interleaved(speeds, 0))
    assert set(found.named_calls) == {"even", "odd"}
    assert found.shares[0] < 0.9
    assert found.loss > 1.05
    text = " ".join(s.text for s in build_verdict(interleaved(speeds, 0)).statements)
    assert all(re.search(rf"{name} \([\d.]* ms\) in \d* %", text) for name in speeds)
    assert "takes" in text  # The loss of the choice in the other resamplings.


@pytest.mark.parametrize(
    ("speeds", "noise"),
    [({"auto": 1.02, "newton": 1.0, "nncg": 1.6}, 1.04), ({"a": 1.0, "b": 1.0, "c": 1.01, "d": 1.4}, 1.1)],
)
def test_three_reports_of_a_near_tie_name_the_same_set(speeds, noise):
    """Each report is of another hour, on a machine up to 1.6 times as fast; the truly fastest is among the named."""
    fastest = min(speeds, key=speeds.get)
    agreed = []
    for first in range(0, 18, 3):
        found = [
            race(interleaved(speeds, seed, tuple(ROBOTS), noise, rerun=1.6, sizes=ROBOTS, repeats=21))
            for seed in range(first, first + 3)
        ]
        assert all(fastest in f.named_calls for f in found)
        agreed.append(len({frozenset(f.named_calls) for f in found}) == 1)
    assert sum(agreed) >= 5  # of 6: two standard errors are no certainty


def test_who_misses_a_case_is_never_the_first_whatever_the_mean_says():
    made = []
    for case in CASES:
        sure, quick = (1e-3, 1e-7), (1e-6, 1.0 if case == CASES[0] else 1e-12)
        for solver, (t, left) in (("sure", sure), ("quick", quick)):
            made.append(
                record(case, solver, t, left, timing_mode="call", interleave_group="one", times=(t,) * 3)
            )
    found = race(records_of(*made))
    assert [(c.solver, c.solved) for _, c in found.ranking] == [("sure", 6), ("quick", 5)]


def test_lines_that_were_refused_different_cases_are_compared_on_all_of_them():
    size = {"easy": 1e-3, "both": 1e-2, "hard": 1e-1}
    made = [
        record(case, solver, t, 1e-7, interleave_group="one", timing_mode="call", times=(t,) * 7, **more)
        for case in size
        for solver, factor, refused in (("slow", 2.0, "hard"), ("quick", 1.0, "easy"))
        for t in (factor * size[case],)
        for more in ({}, {"mode": "time", "time_limit": 0.5})
        if case != refused
    ]
    records = records_of(*made)
    found = race(records)
    charged = {"slow": (2e-3, 2e-2, 2.0), "quick": (2.0, 1e-2, 1e-1)}  # a miss costs the limit of 2 s
    for _, choice in found.ranking:
        assert (choice.solved, choice.cases) == (2, 3)
        each = [t + statistics.MEAN_TIME_SHIFT for t in charged[choice.solver]]
        assert choice.score == pytest.approx(math.prod(each) ** (1.0 / 3.0) - statistics.MEAN_TIME_SHIFT)
    assert max(found.shares) < 1.0
    quick = rank_calls_in_time(records, select_calls_with_most_cases(records, "call"), 1.0)
    served = {(c.solver, c.solved, c.cases, c.worst) for _, c in quick.ranking}
    assert served == {("slow", 2, 3, 1.0), ("quick", 2, 3, 1.0)}


def test_what_comes_too_late_in_more_than_one_repetition_of_twenty_is_not_served():
    def line(solver, late):
        times = (2e-3,) * late + (0.5e-3,) * (20 - late)
        more = {
            "mode": "time",
            "time_limit": 0.5e-3,
            "timing_mode": "call",
            "interleave_group": "one",
            "times": times,
        }
        return record("a", solver, min(times), 1e-2, residual_per_repeat=(1e-2,) * 20, **more)

    found = records_of(line("punctual", 1), line("late", 2))
    ranking = rank_calls_in_time(found, select_calls_with_most_cases(found, "call"), 1e-3).ranking
    assert {c.solver: c.solved for _, c in ranking} == {"punctual": 1, "late": 0}


def test_lines_that_took_turns_on_fewer_cases_do_not_replace_those_that_solved_more():
    made = [record(case, "x", 1e-3, 1e-9) for case in "abc"]
    made.append(
        record(
            "a",
            "x",
            2e-3,
            1e-9,
            timing_mode="call",
            interleave_group="one",
            times=(2e-3,) * 5,
            calibration_time=1e-4,
        )
    )
    (line,) = report.recommend_solvers(records_of(*made))
    assert (line.by_tolerance[1e-6].best.solved, line.by_tolerance[1e-6].best.score) == (
        3,
        pytest.approx(1e-3),
    )


@pytest.mark.parametrize("n", [2, 3])
def test_a_batch_of_some_of_the_cases_is_not_told_beside_a_call_on_all(n):
    made = interleaved({"auto": 1.0, "pgs": 2.0}, 0, cases=CASES[:3])
    for r in [r for r in made if r.interleave_group and r.case in CASES[:n]]:
        made.add(dataclasses.replace(r, timing_mode="batch"))
    code = [line for t in build_verdict(made).statements for line in t.code]
    assert any("solve_many" in line for line in code) == (n == 3)
