"""Tables say what the records say; the page stands alone and hides nothing."""

import dataclasses
import html
import io
import json
import math
import random

import numpy as np
import pytest
from rich.console import Console
from stacks import chain

import lavender as lv
from lavender import bench, report
from lavender.base.deadline import seconds
from lavender.lab.bench.record import CaseInfo, Record, Run
from lavender.lab.report import choices, contents, curves, tables
from lavender.lab.report.curves import overall_figure
from lavender.lab.report.engine import contestants
from lavender.lab.report.findings import Report
from lavender.lab.report.terminal import print_report
from lavender.lab.report.text import percent, residual, times
from lavender.lab.report.verdict import verdict

LEVELS = (1e-3, 1e-6)
FALSE_CLAIM = {"claim_check": "contradicted", "status_conflict": "says CONVERGED"}


def info(case, law="lcp", structure=("stack",)):
    return CaseInfo("run", case, case, "sha" + case, law, 8, 8, 0, 0, 22, 1.0, structure, True, "a reason")


def record(case, solver, time, relative, **more):
    values = {
        "run": "run", "case": case, "sha": "sha" + case, "solver": solver, "options": {}, "start": "cold",
        "mode": "tol",
        "tol": 1e-6, "max_iter": 0, "time_limit": 2.0, "order": "given", "seed": 0, "relative": relative,
        "energy": relative, "velocity": relative, "floor": 1e-15, "status": "CONVERGED", "claims": True,
        "time_min": time, "time_median": time, "setup_min": time / 2, "solve_min": time / 2, "setup_median": time / 2,
        "solve_median": time / 2, "repeats": 1, "success": relative <= more.get("tol", 1e-6),
    }  # fmt: skip
    return Record(**(values | more))


def records_of(*made, structure=None, law=None):
    found = bench.Records()
    found.add(
        Run(
            "run",
            "2026-01-01",
            "0.1",
            "3.11",
            "linux",
            "a cpu",
            2,
            1,
            {"numpy": "2"},
            {"levels": list(LEVELS)},
        )
    )
    for case in dict.fromkeys(r.case for r in made):
        found.add(info(case, (law or {}).get(case, "lcp"), (structure or {}).get(case, ("stack",))))
    for r in made:
        found.add(r)
    return found


def shown(found, width=200, **more):
    """What the terminal shows of it."""
    out = io.StringIO()
    print_report(found, Console(file=out, width=width), **more)
    return out.getvalue()


def by_level(records):
    return [a for line in report.advice(records) for a in line.by_level.values()]


def by_time(records, times=()):
    return [a for line in report.advice(records, times) for a in line.by_time.values()]


def test_time_to_a_level_is_that_of_the_cheapest_run_that_reached_it():
    found = records_of(
        record("a", "x", 5.0, 1e-4, tol=1e-3),
        record("a", "x", 9.0, 1e-8),
        record(
            "a", "x", 1.0, 9e-4, mode="budget", tol=0.0, max_iter=4, status="MAX_ITERATIONS", claims=False
        ),
        record("a", "x", 0.1, 1e-9, order="reverse", mode="budget"),  # another order does not count
        record("a", "y", 2.0, 2e-3, tol=1e-3, status="STALLED", claims=False),
        record("a", "y", 3.0, 0.5, tol=1e-3, **FALSE_CLAIM),
    )
    x, y = report.reaches(found)
    assert dict(x.times) == {1e-3: 1.0, 1e-6: 9.0}
    assert (x.best, x.status) == (1e-8, "CONVERGED")
    assert dict(y.times) == {1e-3: math.inf, 1e-6: math.inf}
    assert (y.best, y.status_conflict) == (2e-3, "says CONVERGED")


@pytest.mark.parametrize(
    ("check", "conflict", "mark", "wrong"),
    [
        ("confirmed", "", "", 0),
        ("not proven", "", "not proven", 0),
        ("contradicted", "says INFEASIBLE, auto found a solution", "✗ contradicted", 1),
    ],
)
def test_a_claim_that_is_not_proven_is_neither_a_proof_nor_a_false_claim(check, conflict, mark, wrong):
    claim = {"status": "INFEASIBLE", "claim_check": check, "status_conflict": conflict}
    found = records_of(record("a", "x", 1.0, 0.5, **claim))
    assert len(report.failures(found)) == (0 if check == "confirmed" else 1)
    assert [c.wrong for c in report.claims(found)] == [wrong]
    table = contents.reach_table(report.reaches(found), LEVELS)
    assert str(table.rows[0][table.heads.index("claim")]) == mark
    assert table.marks == ["bad" if wrong else ""]


def test_profiles_count_misses_and_refusals_at_infinity():
    found = records_of(
        record("a", "fast", 1.0, 1e-7), record("a", "slow", 3.0, 1e-7),
        record("b", "fast", 2.0, 1e-1, success=False), record("b", "slow", 4.0, 1e-7),
        record("c", "slow", 1.0, 1e-7), record("d", "slow", 1.0, 1.0), record("d", "fast", 1.0, 1.0),
    )  # fmt: skip
    profile = next(p for p in report.profiles(found) if p.level == 1e-6)
    assert profile.cases == 4
    assert dict(profile.curves) == {"fast": ((1.0, 0.25),), "slow": ((1.0, 0.5), (3.0, 0.75))}


def test_shifted_geometric_means_charge_misses_the_limit():
    found = records_of(
        record("a", "x", 1.0, 1e-7), record("b", "x", 4.0, 1e-7),
        record("a", "y", 1.0, 1e-7), record("b", "y", 0.5, 1.0, success=False),
        record("a", "z", 1.0, 1e-7),  # does not take b: not compared
    )  # fmt: skip
    means = report.geometric_means(found)["lcp"][1e-6]
    shift = tables.SHIFT
    assert set(means) == {"x", "y"}
    assert means["x"] == (pytest.approx(math.sqrt((1 + shift) * (4 + shift)) - shift), 2, 2)
    assert means["y"] == (pytest.approx(math.sqrt((1 + shift) * (2 + shift)) - shift), 1, 2)  # limit 2 s


def test_advice_puts_who_solves_most_first_and_false_claims_last():
    found = records_of(
        record("a", "quick", 0.1, 1e-7), record("b", "quick", 0.1, 1e-1),
        record("a", "sure", 1.0, 1e-7), record("b", "sure", 1.0, 1e-7),
        record("a", "liar", 0.1, 1e-7), record("b", "liar", 0.1, 1e-7, **FALSE_CLAIM),
        structure={"a": ("stack",), "b": ("stack", "redundant")},
    )  # fmt: skip
    by = {(a.family, a.target): a for a in by_level(found)}
    assert [c.solver for c in by["stack", 1e-6].ranking] == ["sure", "quick", "liar"]
    assert by["stack", 1e-6].best.solved == 2
    assert by["redundant", 1e-6].best.solver == "sure"
    assert list(report.families(found)) == ["stack", "redundant"]
    alone = records_of(record("a", "x", 1.0, 1e-7), structure={"a": ("stack", "redundant", "friction")})
    assert report.families(alone) == {"stack / redundant / friction": ["a"]}


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
        made.append(
            record(case, "edge", 1e-3, 1e-9, tol=1e-12, success=False, status="STALLED", claims=False)
        )
    return records_of(*made)


def test_those_within_noise_are_ties_and_a_rerun_keeps_the_recommendation():
    first = close_race()
    by = {a.target: a for a in by_level(first)}
    assert by[1e-6].best.solver == "edge"
    assert {by[1e-6].best.solver, *by[1e-6].ties} == {"edge"}
    level = choices.to_level(
        records_of(*(r for r in first if r.solver != "edge")), "all", [f"case {i}" for i in range(4)], 1e-6
    )
    assert (level.best.solver, level.ties) == ("auto", ("beta", "zeta"))
    times = (1e-3, 2e-3, 5e-3)
    for seed in range(40):
        again = jittered(first, seed)
        for old, new in zip(
            [*by_level(first), *by_time(first, times)],
            [*by_level(again), *by_time(again, times)],
            strict=True,
        ):
            assert (new.family, new.target) == (old.family, old.target)
            if old.best is not None and new.best is not None:
                assert old.best.solver in {new.best.solver, *new.ties}


def test_another_solver_changes_nobodys_score():
    first = close_race()
    more = records_of(*first, *(record(f"case {i}", "new", 1e-7, 1e-9) for i in range(4)))
    for how in (by_level, lambda r: by_time(r, [1e-3, 1e-2])):
        for old, new in zip(how(first), how(more), strict=True):
            scores = {c.solver: c.score for c in new.ranking}
            assert {c.solver: scores[c.solver] for c in old.ranking} == {
                c.solver: c.score for c in old.ranking
            }
    assert "new" in {c.solver for c in by_level(more)[0].ranking}


def test_the_number_shown_is_the_number_ranked_by(tmp_path):
    found = records_of(
        record("a", "even", 3e-3, 1e-7), record("b", "even", 3e-3, 1e-7), record("c", "even", 3e-3, 1e-7),
        record("a", "odd", 1e-3, 1e-7), record("b", "odd", 1e-3, 1e-7), record("c", "odd", 60e-3, 1e-7),
    )  # fmt: skip
    (advice,) = (a for a in by_level(found) if a.target == 1e-6)
    assert advice.best.solver == "even"  # a median would say odd
    odd = advice.ranking[1]
    assert (odd.worst, odd.hardest) == (60e-3, "c")
    assert seconds(advice.best.score) in report.write(found, tmp_path, figures=False).read_text()


def test_a_structure_with_two_laws_is_two_families():
    found = records_of(record("a", "x", 1.0, 1e-7), record("b", "x", 1.0, 1e-7), law={"b": "coulomb"})
    assert report.families(found) == {"stack, coulomb": ["b"], "stack, lcp": ["a"]}


def test_one_sentence_and_a_line_to_copy_come_first(tmp_path):
    budget = {
        "mode": "budget",
        "tol": 0.0,
        "status": "MAX_ITERATIONS",
        "claims": False,
        "work": {"sweeps": 8},
    }
    found = records_of(
        record("a", "auto", 4e-3, 1e-7), record("b", "auto", 4e-2, 1e-7),
        record("a", "pgs", 1e-4, 1e-1, max_iter=8, **budget), record("b", "pgs", 1e-4, 1e-1, max_iter=8, **budget),
    )  # fmt: skip
    found.source = "my report/records.jsonl"
    said = verdict(found, [1e-3, 1.0])
    told = " Records of an earlier version: the line itself was not timed."
    assert [t.text for t in said.told] == [
        "Use auto: it solves your 2 stacks in 12.7 ms on average (40.0 ms at worst, b), cold, down to 1e-6 of the "
        "error of doing nothing." + told,
        "If you have only 1.00 ms, take pgs, 8 sweeps: it serves 2 of 2 (at most half of the start's residual), "
        "at the 90th percentile 1.0e-1." + told,
    ]
    assert [t.line for t in said.told] == [
        'lv.solve(problem, "auto", tol=1e-6)',
        'lv.solve(problem, "pgs", tol=0, max_iter=8)',
    ]
    assert said.told[0].in_c == (
        "lavender export c liblavender --solver auto --for 'my report/records.jsonl'"
    )
    assert said.leaders == ("auto", "pgs")
    text = html.unescape(report.write(Report(found, None, [1e-3, 1.0]), tmp_path, figures=False).read_text())
    assert text.index(said.told[0].text) < text.index(said.told[0].line) < text.index("<table")
    # Of two runs put together: x never ran on b, which is no miss of its own.
    parts = verdict(records_of(record("a", "x", 0.004, 1e-9), record("b", "y", 9.0, 0.5)))
    assert "(a miss counted as 2.00 s; on 1 it has no run)" in parts.told[0].text
    nobody = verdict(records_of(record("a", "x", 1.0, 0.5)))
    assert nobody.text == "No solver brings your stack down to 1e-6 of the error of doing nothing."
    assert "Python's share" in text  # a limitation, on every page


@pytest.mark.parametrize(
    ("solver", "law", "structure", "sign"),
    [
        ("nncg", "coulomb", ("stack", "friction", "ellipses"), "problem.disk"),
        ("direct", "coulomb", ("stack", "friction"), "bounded rows alone"),
        ("pgs", "coulomb", ("stack", "friction"), "problem.csr"),
        ("nncg", "coulomb", ("stack", "friction"), ""),
    ],
)
def test_no_calls_in_c_for_what_the_library_does_not_take(solver, law, structure, sign):
    found = records_of(record("a", solver, 4e-3, 1e-7), law={"a": law}, structure={"a": structure})
    found.cases["a"] = dataclasses.replace(found.cases["a"], bodies=6)
    told = verdict(found).told[0].in_c
    assert (told.startswith("not in C: ") and sign in told) if sign else "--solver nncg" in told


def test_time_budgets_are_those_given_and_the_sweeps_are_named(tmp_path):
    budget = {"mode": "budget", "tol": 0.0, "status": "MAX_ITERATIONS", "claims": False}
    found = records_of(
        record("a", "pgs", 0.25, 1e-4, max_iter=8, work={"sweeps": 8}, **budget),
        record("a", "pgs", 3.0, 1e-7, work={"sweeps": 90}),
        record("a", "direct", 4.0, 1e-12, work={"factorisations": 1}),
    )
    (line,) = report.advice(found, [0.5, 5.0])
    assert (line.name, line.size, line.sequence) == ("stack", 1, False)
    assert {x: (a.best.solver, a.best.how) for x, a in line.by_level.items()} == {
        1e-3: ("pgs", "8 sweeps"),
        1e-6: ("pgs", "90 sweeps"),
    }
    assert {t: a.best.solver for t, a in line.by_time.items()} == {0.5: "pgs", 5.0: "direct"}
    text = report.write(Report(found, None, [0.5, 5.0]), tmp_path, figures=False).read_text()
    assert "<th>in 500 ms</th><th>in 5.00 s</th>" in text.replace("\n", "")
    assert "| in 500 ms | in 5.00 s |" in (tmp_path / "summary.md").read_text()


def test_claims_failures_and_spreads():
    found = records_of(
        record("a", "x", 1.0, 1e-7), record("a", "x", 1.0, 1e-2, **FALSE_CLAIM),
        record("a", "y", math.nan, math.inf, status="CRASHED (SIGSEGV)", claims=False, success=False, message="died"),
        record("a", "z", 1.0, 1e-5, status="FLOOR", floor=1e-5),  # excused
        record("a", "w", 1.0, math.inf, status="INFEASIBLE", floor=math.nan, success=False, worst_name="row 3"),
        *(record("a", "x", 1.0, r, mode="budget", tol=0.0, max_iter=8, order=o, claims=False, status="MAX_ITERATIONS")
          for o, r in (("given", 1e-2), ("reverse", 4e-2))),
    )  # fmt: skip
    by = {c.solver: c for c in report.claims(found)}
    assert (by["x"].claims, by["x"].wrong) == (2, 1)
    assert (by["y"].crashed, by["y"].asked, by["y"].reached) == (1, 1, 0)
    # Of what was run again in turns the first run counts; a run to a limit of time is in turns alone.
    for mode, wrong in (("tol", 1), ("time", 2)):
        more = records_of(
            *found,
            record(
                "a",
                "x",
                1.0,
                1e-2,
                mode=mode,
                turns="one",
                claim_check="contradicted",
                status_conflict="says CONVERGED",
            ),
        )
        assert next(c.wrong for c in report.claims(more) if c.solver == "x") == wrong
        assert sum(bool(f.status_conflict) for f in report.failures(more)) == wrong
        counted = f", the first of {wrong}" if wrong > 1 else ""
        assert f"false claim{counted}: a, x: says CONVERGED" in shown(Report(more))
    assert [(f.solver, f.status) for f in report.failures(found)] == [
        ("x", "CONVERGED"),
        ("y", "CRASHED (SIGSEGV)"),
        ("w", "INFEASIBLE"),
    ]
    (spread,) = report.spreads(found)
    assert (spread.budget, spread.factor) == (8, 4.0)
    assert tables.Spread("a", "x", 8, {"given": 1e-16, "reverse": 4e-15}, floor=2e-15).factor == 2.0


def test_numbers_are_written_with_what_they_know():
    assert [seconds(t) for t in (1.0, 0.0123, 1e-3, 4.5e-5, 9e-8, 123.4, math.inf)] == [
        "1.00 s", "12.3 ms", "1.00 ms", "45.0 µs", "0.09 µs", "123 s", "–",
    ]  # fmt: skip
    assert times(99.7) == "100 times"
    assert [percent(n, 10_000, 1) for n in (10_000, 9_999, 1, 0)] == ["100.0 %", "99.9 %", "0.01 %", "0.0 %"]
    assert (percent(999, 1000), percent(1, 3)) == ("99 %", "33 %")
    assert [times(x) for x in (1.34, 85.0, 1234.4, 7.3e13, math.nan)] == [
        "1.3 times", "85 times", "1234 times", "10^14 times", "–",
    ]  # fmt: skip
    assert [residual(x) for x in (3.44e-7, 0.0, math.inf, 1.0)] == ["3.4e-7", "0", "inf", "1.0e0"]


def test_the_picture_of_all_cases_is_the_median_of_what_was_reached_by_each_time():
    rng = np.random.default_rng(5)
    made = [
        record(case, solver, 10.0 ** rng.uniform(-5, -2), 10.0 ** rng.uniform(-9, -1))
        for case in "abcdefg"
        for solver in ("pgs", "newton")
        for _ in range(6)
    ]
    found = overall_figure(records_of(*made))
    assert [c.solver for c in found.curves] == ["newton", "pgs"]
    for curve in found.curves:
        for t, low, middle, high in zip(curve.x, curve.low, curve.y, curve.high, strict=True):
            reached = []
            for case in "abcdefg":
                own = [r for r in made if r.case == case and r.solver == curve.solver]
                reached.append(min((r.relative for r in own if r.time_min <= t * (1 + 1e-9)), default=1.0))
            assert middle == sorted(reached)[3]
            assert (low, high) == (sorted(reached)[1], sorted(reached)[5])
        assert list(curve.y) == sorted(curve.y, reverse=True)
    # Shares of a batch, and the least time of repetitions of which another left less, are no points of it.
    more = [record("a", "pgs", 1e-9, 1e-12, turns="one", way=way, mode=mode) for way, mode in
            (("batch", "tol"), ("call", "time"))]  # fmt: skip
    assert repr(overall_figure(records_of(*made, *more))) == repr(found)  # whose floor is NaN


def test_a_report_of_nothing_says_so(tmp_path):
    records = bench.run([lv.Problem.lcp(np.eye(2), np.ones(2))], ["sor"], bench.Plan())
    text = report.write(records, tmp_path).read_text()
    assert "No case ran" in text
    assert "takes laws linear" in text


def test_a_frame_has_the_rows(real):
    pandas = pytest.importorskip("pandas", reason="a frame needs pandas (extra: frame)")
    frame = real[0].frame()
    assert isinstance(frame, pandas.DataFrame)
    assert len(frame) == len(real[0])
    assert frame["relative"].tolist() == [r.relative for r in real[0]]


def test_a_step_that_nobody_was_asked_for_is_missed_and_a_folder_may_have_the_name_of_a_structure():
    made = [record(f"stack[{i}]", "x", 1e-3, 1e-8, step=i) for i in range(2)]
    found = records_of(record("a", "x", 1e-5, 1e-8), *made)
    for i in range(3):  # the pass ended after two of three steps
        found.add(dataclasses.replace(info(f"stack[{i}]"), sequence="stack", step=i))
    lines = report.advice(found, [1.0])
    assert [(x.name, x.size, x.sequence) for x in lines] == [("stack", 1, False), ("stack", 3, True)]
    for line, solved in zip(lines, (1, 2), strict=True):
        for best in (line.by_level[1e-6].best, line.by_time[1.0].ranking[0]):
            assert (best.solved, best.cases) == (solved, line.size)
    # charged the time limit of 2 s, as a case is
    score = lines[1].by_level[1e-6].best.score
    assert score == pytest.approx((1e-3**2 * 2.0) ** (1 / 3), rel=0.05)


def test_sequences_are_compared_carried_against_cold(tmp_path):
    problems = [lv.Problem.lcp(chain(6).matrix, np.ones(6) * (1 + 0.001 * i)) for i in range(4)]
    plan = bench.Plan(levels=(1e-6,), budgets=(5,), repeats=1)
    records = bench.run(bench.sequence(problems, "load"), ["pgs", "direct"], plan)
    budget, level, exact = tables.passes(records)
    assert (budget.solver, budget.max_iter, budget.steps) == ("pgs", 5, 4)
    cold = [r for r in records if r.solver == "pgs" and r.mode == "budget" and r.start == "cold"]
    assert budget.time["cold"] == sum(r.time_min for r in cold)
    assert budget.residuals["cold"] == tuple(r.relative for r in cold)
    assert budget.gain > 1.0
    assert level.iterations["carried"] < level.iterations["cold"]
    assert set(exact.residuals) == {"cold"}
    text = report.write(records, tmp_path, figures=False).read_text()
    assert 'id="sequence-load"' in text
    (line,) = report.advice(records, [1e-9, 10.0])
    assert (line.name, line.size, line.sequence) == ("load", 4, True)
    # Only an exact solver, or a run to the level, brings all four steps there; nothing is done in a nanosecond.
    best = line.by_level[1e-6].best
    assert (best.solved, best.cases, best.how in ("to 1e-6, cold", "to 1e-6, carried")) == (4, 4, True)
    assert line.by_time[1e-9].best is None
    reached = {c.solver: c for c in line.by_time[10.0].ranking}
    means = {
        f"{w.asked}, {start}": math.exp(np.mean(np.log(np.clip(w.residuals[start], 1e-17, 1.0))))
        for w in (budget, level)
        for start in ("cold", "carried")
    }
    assert reached["pgs"].how == min(means, key=lambda how: means[how])
    assert reached["pgs"].score == pytest.approx(min(means.values()))
    drawn = curves.figures(records)
    at_budget, to_level = drawn.sequences["load"]
    assert [(c.label, c.y) for c in at_budget.curves] == [
        ("pgs", budget.residuals["carried"]), ("pgs (cold)", budget.residuals["cold"]),
    ]  # fmt: skip
    assert [(c.label, c.y) for c in to_level.curves if c.solver == "direct"] == [
        ("direct", exact.times["cold"])
    ]
    assert (
        len(list(drawn)) - len(drawn.over) == len(drawn.sequences["load"]) == 2
    )  # the budget, and to the level
    assert report.reaches(records) == []  # steps are no cases of their own


def test_changes_beyond_noise_are_named(tmp_path):
    old = records_of(
        record("a", "x", 1.0, 1e-7), record("a", "y", 1.0, 1e-7), record("a", "z", 1.0, 1e-2, success=False),
        record("a", "w", 1.0, 1e-7), record("a", "v", 1.0, 1e-7, time_median=1.5), record("b", "x", 1.0, 1e-7),
    )  # fmt: skip
    new = records_of(
        record("a", "x", 3.0, 1e-7), record("a", "y", 1.1, 1e-7), record("a", "z", 1.0, 1e-7),
        record("a", "w", 1.0, 1e-4, success=False), record("a", "v", 1.9, 1e-7),
    )  # fmt: skip
    found = {c.solver: c for c in tables.changes(old, new) if c.level == 1e-6}
    assert {s: c.kind for s, c in found.items()} == {
        "x": "slower", "y": "same", "z": "reached", "w": "lost", "v": "same",
    }  # fmt: skip
    assert found["v"].noise == 2.0  # its repeats spread by half
    text = report.write(Report(new, old), tmp_path, figures=False).read_text()
    assert "Against the earlier run" in text
    assert text.count("slower 3 times") == 2  # to both levels
    for said in (
        shown(Report(new, old), whole=True),
        (tmp_path / "summary.md").read_text(),
    ):  # the page's tables, from top to bottom
        assert said.count("slower 3 times") == 2 and "Against" in said
    # A case whose numbers have changed is not compared.
    moved = records_of(record("a", "x", 3.0, 1e-7))
    moved.cases["a"] = CaseInfo(**{**vars(info("a")), "sha": "another"})
    assert tables.changes(old, moved) == []
    text = report.write(Report(moved, old), tmp_path, figures=False).read_text()
    assert "no case has the same numbers in both" in text


def recorded(folder, answers, solver="NEWTON", sequence=""):
    """Records of two solvers on cases that an engine recorded, with its own answers: (time, residual) of each."""
    lines = [
        {
            "file": f"step_{i}.npz",
            "rows": 3,
            "seconds": time,
            "relative": relative,
            "solver": solver,
            "verdict": "wrong",
        }
        for i, (time, relative) in enumerate(answers)
    ]
    folder.mkdir(exist_ok=True)
    (folder / "engine.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    made = []
    for i in range(len(answers)):
        for name, time in (("auto", 40e-6), ("newton", 60e-6), ("pgs", 900e-6)):
            case = f"{folder.name} {i}"
            made.append(record(case, name, 0.5 * time * (1 + i), 1e-8))  # alone twice as fast
            if name != "pgs":
                more = {"way": "call", "turns": "one", "times": (time * (1 + i),) * 7, "pace": 1e-4}
                made.append(record(case, name, time * (1 + i), 1e-8, **more))
    found = records_of(*made)
    for i in range(len(answers)):
        own = {"source": str(folder / f"step_{i}.npz"), "sequence": sequence, "step": i if sequence else -1}
        found.add(dataclasses.replace(found.cases[f"{folder.name} {i}"], **own))
    return found


def mean(values, shift=tables.SHIFT):
    return math.exp(sum(math.log(v + shift) for v in values) / len(values)) - shift


@pytest.mark.parametrize(
    ("answers", "first"),
    [
        ([(1e-5, 1e-9), (2e-5, 1e-9)], True),  # faster
        ([(1e-4, 1e-9), (2e-4, 1e-9)], False),  # slower
        ([(1e-6, 1e-9), (1e-6, 1e-2)], False),  # fewer cases
        ([(1e-6, 1e-2), (1e-6, math.nan)], False),  # none
    ],
)
def test_the_first_sentence_the_structures_and_the_engine_have_one_set_of_numbers(tmp_path, answers, first):
    found = recorded(tmp_path / "robot", answers)
    engines = contestants([str(tmp_path / "robot")], found)
    made = Report(found, engines=engines)
    text = made.verdict.told[0].text
    assert text.startswith("First is the engine's own Newton") == first
    solved = sum(relative <= 1e-6 for _, relative in answers)
    score = mean([time if relative <= 1e-6 else 2.0 for time, relative in answers])  # the limit is 2 s
    if solved:
        assert f"in {seconds(score)} on average" in text or f"takes {seconds(score)} on average" in text
    else:
        assert "engine's own Newton solves none of them" in text
    ours = seconds(mean([40e-6, 80e-6]))
    assert "se auto: " in text and f"in {ours} on average" in text
    (structure,) = contents.advice_table(made).rows
    assert structure[2].lead == "auto" and structure[2].text == ours
    assert (seconds(score) in str(structure[-1])) == (solved > 0)
    (row,) = contents.engine_table(made).rows
    own = dict(zip(contents.engine_table(made).heads, row, strict=True))
    assert (own["first here"], own["to 1e-6, here"]) == ("auto", ours)
    assert own["to 1e-6"].startswith(seconds(score) if solved else "–")
    terminal = shown(made).splitlines()
    assert sum(line.startswith("engine's Newton") for line in terminal) == (solved > 0)
    ends = ("in turns", "inside the engine", "alone")
    rows = [line.split()[0] for line in terminal if line.endswith(ends)]
    wanted = ["auto", "newton", "pgs"]
    if solved:
        wanted.insert(0 if first else 2 if solved == 2 else 3, "engine's")
    assert rows == wanted


def test_an_engine_that_answered_only_some_cases_is_not_in_the_first_sentence(tmp_path):
    found = recorded(tmp_path / "robot", [(1e-6, 1e-9), (1e-6, 1e-9)])
    other = recorded(tmp_path / "other", [(1e-6, 1e-9)])
    (tmp_path / "other" / "engine.jsonl").unlink()
    for case in other.cases.values():
        found.add(dataclasses.replace(case, structure=("pile",)))
    for r in other:
        found.add(r)
    engines = contestants([str(tmp_path / "robot")], found)
    made = Report(found, engines=engines)
    assert "engine" not in made.verdict.told[0].text
    by_name = {str(row[0]): row[-1] for row in contents.advice_table(made).rows}
    assert by_name["stack"].lead == "Newton" and by_name["pile"].text == "–"
    # Records that are shown again name the folders themselves.
    assert contestants(["records.jsonl"], found) == engines


def test_lines_that_took_turns_on_fewer_cases_do_not_replace_those_that_solved_more():
    made = [record(case, "x", 1e-3, 1e-9) for case in "abc"]
    made.append(record("a", "x", 2e-3, 1e-9, way="call", turns="one", times=(2e-3,) * 5, pace=1e-4))
    (line,) = report.advice(records_of(*made))
    assert (line.by_level[1e-6].best.solved, line.by_level[1e-6].best.score) == (3, pytest.approx(1e-3))
