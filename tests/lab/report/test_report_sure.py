"""How sure a recommendation is: resamplings, misses that count, drift, and what others take by their own interface."""

import math
import random
import re

import pytest

from lavender import bench, report
from lavender.base.deadline import seconds
from lavender.lab.report import choices, tables
from lavender.lab.report.finals import in_time, lines, to_level
from lavender.lab.report.findings import Report
from lavender.lab.report.verdict import verdict
from tests.lab.report.test_report import record, records_of, shown

CASES = [f"case {i}" for i in range(6)]
ROBOTS = {"ant": 1.0, "cheetah": 3.0, "hopper": 0.7, "humanoid": 5.0, "walker": 1.5, "reacher": 0.4}


def in_turns(speeds, seed, cases=CASES, noise=1.04, rerun=1.0, sizes=None, repeats=7):
    """Records of lines that took turns: each case has its size, each repetition its noise, a rerun its own machine."""
    rng = random.Random(seed)
    machine = rerun ** rng.uniform(-1.0, 1.0)
    made = []
    for i, case in enumerate(cases):
        size = machine * 1e-3 * (1.0 + i if sizes is None else sizes[case])
        for solver, of_case in speeds.items():
            factor = of_case if isinstance(of_case, float) else of_case(i)
            times = tuple(size * factor * noise ** rng.gauss(0.0, 1.0) for _ in range(repeats))
            more = {"way": "call", "times": times, "pace": 1e-4 * machine}
            made.append(record(case, solver, min(times), 1e-7, turns="one", **more))
            made.append(record(case, solver, min(times), 1e-7, **more))
    return records_of(*made)


def race(records, level=1e-6):
    return to_level(records, lines(records, "call"), level)


def test_a_clear_winner_is_named_alone_and_wins_every_resampling():
    found = race(in_turns({"auto": 1.5, "fast": 1.0, "slow": 2.0}, 0))
    assert found.named == ("fast",)
    assert found.shares[0] == 1.0
    assert found.loss == 1.0
    told = verdict(in_turns({"auto": 1.5, "fast": 1.0}, 0)).told
    assert re.fullmatch(
        r"Among the fastest, within noise, .*: fast \([23]\.\d* ms\) in 100 %\.", told[1].text
    )


def test_cases_that_disagree_make_it_unsure_and_both_are_named():
    speeds = {"even": 1.0, "odd": lambda i: (0.5, 2.0)[i % 2]}
    found = race(in_turns(speeds, 0))
    assert set(found.named) == {"even", "odd"}
    assert found.shares[0] < 0.9
    assert found.loss > 1.05
    text = verdict(in_turns(speeds, 0)).told[1].text
    assert all(re.search(rf"{name} \([\d.]* ms\) in \d* %", text) for name in speeds)
    assert "it takes" in text  # and what the choice loses where the other is faster


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
            race(in_turns(speeds, seed, tuple(ROBOTS), noise, rerun=1.6, sizes=ROBOTS, repeats=21))
            for seed in range(first, first + 3)
        ]
        assert all(fastest in f.named for f in found)
        agreed.append(len({frozenset(f.named) for f in found}) == 1)
    assert sum(agreed) >= 5  # of 6: two standard errors are no certainty


def test_who_misses_a_case_is_never_the_first_whatever_the_mean_says():
    made = []
    for case in CASES:
        sure, quick = (1e-3, 1e-7), (1e-6, 1.0 if case == CASES[0] else 1e-12)
        for solver, (t, left) in (("sure", sure), ("quick", quick)):
            made.append(record(case, solver, t, left, way="call", turns="one", times=(t,) * 3))
    found = race(records_of(*made))
    assert found.ranking[0][1].solver == "sure"
    assert [c.solved for _, c in found.ranking] == [6, 5]


def test_lines_that_were_refused_different_cases_are_compared_on_all_of_them():
    size = {"easy": 1e-3, "both": 1e-2, "hard": 1e-1}
    made = [
        record(case, solver, t, 1e-7, turns="one", way="call", times=(t,) * 7, **more)
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
        each = [t + tables.SHIFT for t in charged[choice.solver]]
        assert choice.score == pytest.approx(math.prod(each) ** (1.0 / 3.0) - tables.SHIFT)
    assert max(found.shares) < 1.0
    quick = in_time(records, lines(records, "call"), 1.0)
    assert {(c.solver, c.solved, c.cases, c.worst) for _, c in quick.ranking} == {
        ("slow", 2, 3, 1.0),
        ("quick", 2, 3, 1.0),
    }


def test_in_a_time_misses_count_and_the_sentence_says_how_many():
    """Nearly exact on seven cases of ten and nothing on three ranks behind a little on all of them."""
    cases = [f"c{i}" for i in range(10)]
    made = []
    for i, case in enumerate(cases):
        made.append(record(case, "whole", 1.0, 1e-7))
        for solver, left in (("deep", 1e-15 if i < 7 else 1.0), ("wide", 1e-1)):
            budget = {"mode": "budget", "tol": 0.0, "max_iter": 8, "work": {"sweeps": 8}, "claims": False}
            made.append(record(case, solver, 1e-4, left, **budget))
    found = records_of(*made)
    (line,) = report.advice(found, [1e-3])
    advice, swept = line.by_time[1e-3], line.by_sweeps[8.0]
    assert [(c.solver, c.solved, c.score) for c in advice.ranking][:2] == [
        ("wide", 10, 0.1),
        ("deep", 7, 1.0),
    ]
    assert "take wide, 8 sweeps: it serves 10 of 10" in verdict(found, [1e-3]).text
    alone = verdict(records_of(*(r for r in made if r.solver != "wide")), [1e-3]).text
    assert alone.endswith("Nothing serves in 1.00 ms.")  # 7 of 10 are not nine of ten, in whatever time
    assert (swept.target, swept.best.solver) == (8.0, "wide")
    assert "With 8 sweeps, take wide" in verdict(found, sweeps=[8]).text
    rest = records_of(*(r for r in made if r.solver != "wide"))
    assert verdict(rest, sweeps=[8]).text.endswith("With 8 sweeps nothing serves nine cases of ten.")


def test_what_comes_too_late_in_more_than_one_repetition_of_twenty_is_not_served():
    def line(solver, late):
        times = (2e-3,) * late + (0.5e-3,) * (20 - late)
        more = {"mode": "time", "time_limit": 0.5e-3, "way": "call", "turns": "one", "times": times}
        return record("a", solver, min(times), 1e-2, reached=(1e-2,) * 20, **more)

    found = records_of(line("punctual", 1), line("late", 2))
    served = {c.solver: c.solved for _, c in in_time(found, lines(found, "call"), 1e-3).ranking}
    assert served == {"punctual": 1, "late": 0}


def test_no_iteration_limit_of_a_factorising_solver_is_offered_for_a_time():
    newton = {"mode": "budget", "tol": 0.0, "max_iter": 8, "work": {"factorisations": 8}, "claims": False}
    found = records_of(record("a", "newton", 1.0, 1e-7), record("a", "newton", 1e-4, 1e-3, **newton))
    said = verdict(found, [1e-3])
    assert said.told[0].code == ('lv.solve(problem, "newton", tol=1e-6)',)
    assert said.told[0].in_c.startswith("lavender export c liblavender --solver newton --for ")


def test_a_slower_machine_is_no_slower_code():
    old = in_turns({"pgs": 1.0, "auto": 1.0}, 0, noise=1.0)
    by = [bench.Record(**{**vars(r), "time_min": 1.6 * r.time_min, "pace": 1.6 * r.pace}) for r in old]
    slower = [bench.Record(**{**vars(r), "time_min": 1.6 * r.time_min}) for r in old]
    assert {c.kind for c in tables.changes(old, records_of(*by))} == {"same"}
    assert {c.kind for c in tables.changes(old, records_of(*slower))} == {"slower"}
    assert tables.drift(old, records_of(*by)) == pytest.approx(1.6)


def test_backends_are_told_by_their_own_interface_too():
    found = bench.run(["stack(n=6)"], ["auto", "osqp"], bench.Plan(levels=(1e-6,), budgets=(), repeats=2))
    (osqp,) = tables.backends(found)
    (r,) = (r for r in found if r.solver == "osqp")
    assert 0.0 < r.own_min < r.time_min
    assert (osqp.solver, osqp.solved) == ("osqp", 1)
    assert osqp.own == pytest.approx(r.own_min)
    assert osqp.whole == pytest.approx(r.time_min)


@pytest.mark.parametrize("n", [2, 3])
def test_a_batch_of_some_of_the_cases_is_not_told_beside_a_call_on_all(n):
    made = in_turns({"auto": 1.0, "pgs": 2.0}, 0, cases=CASES[:3])
    for r in [r for r in made if r.turns and r.case in CASES[:n]]:
        made.add(bench.Record(**{**vars(r), "way": "batch"}))
    assert any("solve_many" in line for t in verdict(made).told for line in t.code) == (n == 3)


def test_a_line_says_where_it_starts_and_leaves_the_guess_out():
    """Of cases that bring a guess, where a cold start was timed; a loop that carries impulses needs no such line."""
    cold, carried = in_turns({"auto": 1.0}, 0), in_turns({"auto": 1.0}, 0)
    for case, info in list(cold.cases.items()):
        cold.add(bench.CaseInfo(**{**vars(info), "guess": "answer"}))
        step = {"guess": "start", "sequence": "walk", "step": CASES.index(case)}
        carried.add(bench.CaseInfo(**{**vars(info), **step}))
    more = {"start": "carried", "way": "steps"}
    carried.records = [
        bench.Record(**{**vars(r), **more, "step": CASES.index(r.case)}) for r in carried.records
    ]
    said = verdict(cold).told[0]
    assert said.code == (
        "problem = dataclasses.replace(problem, guess=None)", 'lv.solve(problem, "auto", tol=1e-6)',
    )  # fmt: skip
    assert ", cold, down to 1e-6 " in said.text
    said = verdict(carried).told[0]
    assert any("impulse=start" in x for x in said.code) and not any("dataclasses" in x for x in said.code)
    assert ", warm from the step before, down to 1e-6 " in said.text


def test_the_headline_is_of_all_sequences():
    made = []
    for name in ("a", "b", "c"):
        for step in range(4):
            for solver, t in (("auto", 1e-3), ("pgs", {"a": 1e-4}.get(name, 1e-2))):
                made.append(record(f"{name}[{step}]", solver, t, 1e-7, start="carried", step=step))
    found = records_of(*made)
    for case, info in list(found.cases.items()):
        found.add(bench.CaseInfo(**{**vars(info), "sequence": case[0], "step": int(case[2])}))
    assert verdict(found).text.startswith(
        "Use auto: it solves the 12 steps of your 3 sequences in 1.00 ms on average, warm from the step before, down"
    )
    told = verdict(found).told[0]
    assert told.line == 'solution = lv.solve(problem, "auto", impulse=start, tol=1e-6)'
    assert len(told.code) == 5  # with the loop that carries impulses, which a terminal shows on request
    assert shown(Report(found), 400).splitlines()[1] == f"    {told.line}  # the lines around it: --tables"


@pytest.mark.parametrize("way", ["call", "steps"])
def test_the_first_screen_has_one_time_for_each_solver(way):
    """That of the lines in turns, also by structure, where the runs that these were chosen from took half the time."""
    made = in_turns({"newton": 1.0, "auto": 1.5}, 0, repeats=3)
    for i, case in enumerate(CASES):
        for solver, t in (("newton", 5e-4), ("auto", 7e-4), ("pgs", 9e-2)):
            made.add(record(case, solver, t * (1 + i), 1e-10, tol=1e-9))
        step = {"sequence": "walk", "step": i} if way == "steps" else {"structure": ("pile",)}
        made.add(bench.CaseInfo(**{**vars(made.cases[case]), **step}))
    if way == "steps":
        more = {"start": "carried", "way": "steps"}
        made.records = [
            bench.Record(**{**vars(r), **more, "step": CASES.index(r.case)}) for r in made.records
        ]
    found = Report(made)
    first, second = (choice for _, choice in found.verdict.raced)
    assert first.solver == "newton" and f"in {seconds(first.score)} on average" in found.verdict.told[0].text
    (line,) = found.lines
    assert line.by_level[1e-6].best.solver == "newton" and line.by_level[1e-6].best.score == first.score
    (alone,) = choices.advice_alone(made)
    assert alone.by_level[1e-6].best.score < 0.7 * first.score  # alone it was quicker
    assert line.by_level[1e-3] == alone.by_level[1e-3]
    table = [re.split(r"  +", row.strip()) for row in shown(found).partition("\n\n")[2].splitlines()]
    start = "carried" if way == "steps" else "cold"
    assert table[0] == ["solver", "to 1e-6", "asked", "timed"]
    assert table[1] == ["newton", seconds(first.score), f"to 1e-6, {start}", "in turns"]
    assert table[2] == ["auto", seconds(second.score), f"to 1e-6, {start}", "in turns"]
    assert table[3][0] == "pgs" and table[3][-1] == "alone"
