"""Tables and sentences of a report, from records that nothing solved."""

import json
import math

import numpy as np
import pandas as pd
import pytest

from lavender.base.deadline import format_seconds
from lavender.report import Report, tables
from lavender.report.findings import recommend
from lavender.report.render import format_cells, format_markdown, list_number_heads
from lavender.report.tables import read_engine_answers
from lavender.report.text import format_percent
from lavender.report.timing import add_times
from tests.report.synthetic import BUDGET, FALSE_CLAIM, lines_of, record, report_of, shown


def rank(*made, tolerance=1e-6, **more):
    return tables.rank_solvers(report_of(*made, **more), tolerance)


def test_get_times_loose_tolerance_and_budgets_do_not_count():
    made = [
        record("a", "pgs", 1e-5, 1e-7, tol=1e-3),
        record("a", "pgs", 3e-5, 1e-7),
        record("a", "pgs", 1e-6, 1e-9, **BUDGET),
    ]
    report = report_of(*made)
    assert report.get_times(1e-6).loc["pgs", "a"] == 3e-5
    assert report.get_times(1e-3).loc["pgs", "a"] == 1e-5
    assert math.isnan(report.get_times(1e-9).loc["pgs", "a"])


def test_rank_solvers_solved_cases_come_before_time_and_false_claims_last():
    made = [record(c, "slow", 1e-2, 1e-8) for c in "ab"]
    made += [record("a", "fast", 1e-5, 1e-8), record("b", "fast", 1e-5, 1e-2)]
    made += [record("a", "liar", 1e-6, 1e-8), record("b", "liar", 1e-6, 1e-8, **FALSE_CLAIM)]
    ranking = rank(*made)
    assert list(ranking.index) == ["slow", "fast", "liar"]
    assert list(ranking["solved"]) == [2, 1, 2]
    assert ranking.loc["fast", "mean"] == pytest.approx(
        1e-5, rel=1e-12
    )  # The miss is in no mean; some roundings.
    assert ranking.loc["slow", "hardest"] in ("a", "b") and ranking.loc["slow", "worst"] == 1e-2


@pytest.mark.parametrize(("ratio", "first"), [(1.07, "auto"), (1.2, "direct")])
def test_rank_solvers_times_within_noise_are_ties_with_auto_first(ratio, first):
    """The repetitions of these records differ by 2 %, so noise is the minimum of 5 % or twice 2 %, plus the shift."""
    made = [x for c in "ab" for x in (record(c, "direct", 1.0, 1e-8), record(c, "auto", ratio, 1e-8))]
    noisy = [add_times(r, [x * r["time"] for x in (1.0, 1.04, 1.08)]) for r in made]
    ranking = rank(*noisy)
    assert ranking.index[0] == first
    assert list(ranking["tie"]) == ([True, True] if first == "auto" else [True, False])
    assert not rank(record("a", "pgs", 1.0, 1.0))[
        "tie"
    ].any()  # A solver that solves nothing ties with nothing.


def test_rank_solvers_another_solver_changes_no_mean():
    made = [record(c, "pgs", t, 1e-8) for c, t in (("a", 1e-3), ("b", 1e-2))]
    with_other = rank(*made, record("a", "slow", 1.9, 1e-8))
    assert with_other.loc["pgs", "mean"] == rank(*made).loc["pgs", "mean"]
    assert with_other.loc["slow", "solved"] == 1 and with_other.loc["slow", "cases"] == 2


def test_group_cases_by_structure_words_laws_and_sequences_are_groups():
    made = [record(c, "pgs", 1.0, 1e-8) for c in ("a", "b", "c", "walk[0]")]
    facts = {"b": {"structure": "stack, redundant", "law": "coulomb"},
             "c": {"structure": "pile, friction", "law": "coulomb"}}  # fmt: skip
    assert report_of(*made, cases=facts, walk=True).structures == {
        "stack, coulomb / redundant": ["b"], "stack, lcp": ["a"], "pile / friction": ["c"], "sequence walk": ["walk[0]"]
    }  # fmt: skip


def test_tabulate_fastest_names_solver_share_ties_and_time():
    made = [record(c, s, t, 1e-8) for c in "ab" for s, t in (("newton", 1.0), ("auto", 1.001), ("pgs", 3.0))]
    made.append(record("c", "pgs", 1.0, 0.5))
    table = tables.tabulate_fastest(report_of(*made))
    (row,) = table.to_dict("records")
    assert (row["structure"], row["cases"]) == ("stack", 3)
    assert row["to 1e-6"] == "auto (2/3) ≈ newton"
    assert row["time to 1e-6 [s]"] == pytest.approx(1.001)


def test_tabulate_costs_exponent_of_a_power_law_is_fitted():
    rows = {f"c{n}": n for n in (10, 30, 100, 300, 1000)}
    made = [record(c, "pgs", 1e-6 * n**1.5, 1e-8) for c, n in rows.items()]
    made += [record(c, "few", 1e-6, 1e-8) for c in list(rows)[:3]]
    table = tables.tabulate_costs(report_of(*made, cases={c: {"rows": n} for c, n in rows.items()}))
    assert list(table["solver"]) == ["pgs"]  # Three cases are too few for a fit.
    (row,) = table.to_dict("records")
    assert (row["exponent of rows"], row["scatter [factor]"]) == (1.5, 1.0)
    assert (row["cases"], row["rows"]) == (5, "10 to 1000")
    assert row["fit at 1000 rows [s]"] == pytest.approx(1e-6 * 1000**1.5)


def test_tabulate_claims_counts_contradicted_claims_and_deaths():
    made = [record("a", "pgs", 1.0, 1e-8), record("b", "pgs", 1.0, 0.5, **FALSE_CLAIM)]
    made.append(record("c", "pgs", 1.0, math.inf, status="KILLED", claims=False))
    made.append(record("c", "pgs", 1.0, 0.1, **BUDGET))
    (row,) = tables.tabulate_claims(report_of(*made)).to_dict("records")
    assert row == {
        "solver": "pgs", "runs": 4, "correct rate [%]": 50.0, "claims": 2, "contradicted": 1, "to a tolerance": 3,
        "reached": 1, "died": 1,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("runs", "false", "rate"), [(3, 1, 66.7), (2, 0, 100.0), (2100, 1, 99.9), (2, 2, 0.0)]
)
def test_tabulate_claims_rounds_rates_and_keeps_0_and_100_for_exact_ones(runs, false, rate):
    made = [record(f"c{i}", "pgs", 1.0, 1e-8, **(FALSE_CLAIM if i < false else {})) for i in range(runs)]
    assert list(tables.tabulate_claims(report_of(*made))["correct rate [%]"]) == [rate]


@pytest.mark.parametrize(
    ("part", "whole", "digits", "text"),
    [
        (130, 150, 1, "86.7 %"), (25, 150, 1, "16.7 %"), (546, 900, 1, "60.7 %"), (2, 3, 0, "67 %"),
        (0, 7, 1, "0.0 %"), (7, 7, 0, "100 %"), (1, 3000, 1, "0.03 %"), (2999, 3000, 1, "99.97 %"),
        (999, 1000, 0, "99.9 %"), (1, 1000, 0, "0.1 %"),
    ],
)  # fmt: skip
def test_format_percent_rounds_and_keeps_0_and_100_for_exact_shares(part, whole, digits, text):
    assert format_percent(part, whole, digits) == text


def test_tabulate_failures_lists_misses_above_the_floor_with_their_reason():
    made = [
        record("a", "good", 1.0, 1e-8), record("a", "floor", 1.0, 1e-5, roundoff_floor=1e-5),
        record("a", "missed", 1.0, 1e-2, message="slow"), record("a", "liar", 1.0, 0.5, **FALSE_CLAIM),
        record("a", "proved", 1.0, 1.0, status="INFEASIBLE"), record("a", "budget", 1.0, 0.5, **BUDGET),
    ]  # fmt: skip
    table = tables.tabulate_failures(report_of(*made))
    assert dict(zip(table["solver"], table["reason"], strict=True)) == {
        "missed": "slow",
        "liar": "✗ says CONVERGED. ",
    }


def test_tabulate_sequences_compares_cold_with_carried_and_carrying_apart():
    made = []
    for step in range(4):
        for start, t, carry in (("cold", 2e-3, math.nan), ("carried", 1e-3, 3e-4)):
            more = {"start": start, "step": step, "iterations": 3, "carry_time": carry}
            made.append(record(f"walk[{step}]", "auto", t, 1e-8, **more))
    (row,) = tables.tabulate_sequences(report_of(*made, walk=True)).to_dict("records")
    assert (row["sequence"], row["steps, cold"], row["iterations, carried"]) == ("walk", 4, 12)
    assert row["time, cold [s]"] == pytest.approx(8e-3) and row["cold / carried"] == 2.0
    assert row["carrying [s]"] == pytest.approx(1.2e-3)


def sweep(step, start, n, velocity, solver="pgs", **more):
    more = {"step": step, "start": start, "velocity": velocity, **more}
    return record(f"walk[{step}]", solver, 1e-5, 10.0 * velocity, **{**BUDGET, "max_iter": n, **more})


def test_recommend_sweeps_is_the_smallest_number_that_keeps_every_step_below_the_limit(tmp_path):
    """The limit is 1 mm/s; three steps, of which the first has no step before it and the second is harder."""
    errors = {("cold", 8): 3e-3, ("cold", 16): 9e-4, ("carried", 8): 9e-4, ("carried", 4): 1.1e-3}
    made = [sweep(i, start, n, [1.0, v, 1e-5][i], motion_error=[1.0, 2 * v, 0.0][i]) for (start, n), v in errors.items()
            for i in range(3)]  # fmt: skip
    made += [sweep(i, "carried", 2, 1e-6, "anderson") for i in range(3)]  # accelerated: only in the table
    made += [sweep(1, "carried", 2, 1e-6, "sequential_impulses")]  # one step of three
    lines = lines_of(*made, walk=True, cases={"walk[1]": {"source": str(tmp_path / "b.npz")}})
    answer = {
        "file": "b.npz",
        "rows": 3,
        "relative": 0.1,
        "velocity": 2.5e-3,
        "iterations": 8,
        "solver": "PGS",
    }
    (tmp_path / "engine.jsonl").write_text(json.dumps(answer))
    report = Report(lines, engines=read_engine_answers([], lines))
    assert recommend(report)[0].text == (
        "walk: 8 sweeps of pgs with warm starts keep every velocity error below 1 mm/s (9.0e-4 m/s; cold: 16 of pgs); "
        "the engine's own 8 iterations (PGS): 2.5e-3 m/s."
    )
    table = tables.tabulate_sweeps(report).set_index(["solver", "sweeps"])
    assert list(dict.fromkeys(table.index.get_level_values(0))) == ["sequential_impulses", "pgs", "anderson"]
    row = table.loc["pgs", 8]
    assert (row["velocity error, cold [m/s]"], row["velocity error, carried [m/s]"]) == (3e-3, 9e-4)
    assert (row["residual, carried [-]"], row["motion error, cold [m/s]"], row["steps"]) == (9e-3, 6e-3, 2)
    assert "8 sweeps of pgs" in shown(report, 80).splitlines()[0]
    text = recommend(report_of(*made[:3], *made[9:12], walk=True))[0].text
    assert "no measured number of sweeps keeps" in text and "1.1e-3 m/s, after 4 sweeps" in text
    text = recommend(report_of(*made[:3], *made[9:15], walk=True))[0].text
    assert "2 sweeps of anderson with" in text and "; without acceleration 4 of pgs leave 1.1e-3 m/s" in text


@pytest.mark.parametrize(("changes", "count"), [({}, 0), ({"iterations": 2}, 3), ({"solution_hash": "x"}, 3)])
def test_recommend_counts_the_solves_that_a_carried_start_changed(changes, count):
    made = [record(f"walk[{k}]", "auto", 2e-3, 1e-8, step=k, iterations=3) for k in range(4)]
    made += [
        add_times({**r, "start": "carried", "carry_time": 2e-5, **(changes if r["step"] else {})}, [1e-3])
        for r in made
    ]
    assert recommend(report_of(*made, walk=True))[0].text.startswith(
        "Use auto: it solves the 4 steps of walk in 1.00 ms on average, with the impulses of the previous recorded "
        f"step as start (mapping them takes 20.0 µs a step, not included; it changed {count} of 4 solves), down to"
    )


def test_tabulate_in_time_counts_late_runs_as_misses():
    made = [record(c, "late", 1.0, 1e-9) for c in "ab"] + [record(c, "early", 1e-3, 1e-2) for c in "ab"]
    (row,) = tables.tabulate_in_time(Report(lines_of(*made), times=[1e-2])).to_dict("records")
    assert (row["in 10.0 ms"], row["residual in 10.0 ms [-]"]) == ("early", 1e-2)
    (row,) = tables.tabulate_in_time(Report(lines_of(*made[:2]), times=[1e-2])).to_dict("records")
    assert row["in 10.0 ms"] == "none"


def test_tabulate_budgets_has_median_and_90th_percentile():
    made = [record(f"c{i}", "pgs", 1.0, x, **BUDGET) for i, x in enumerate(np.linspace(0.1, 1.0, 10))]
    (row,) = tables.tabulate_budgets(report_of(*made)).to_dict("records")
    assert row["8 iterations, median [-]"] == pytest.approx(
        0.55
    )  # Between 0.5 and 0.6, as pandas interpolates.
    assert row["8 iterations, 90 % [-]"] == pytest.approx(0.91)
    made += [record(f"d{i}", "pgs", 1.0, np.inf, **BUDGET) for i in range(5)]
    (row,) = tables.tabulate_budgets(report_of(*made)).to_dict("records")
    assert row["8 iterations, median [-]"] == pytest.approx(0.8) and row["8 iterations, 90 % [-]"] == np.inf


def step_record(step, solver, relative, **more):
    return record(f"walk[{step}]", solver, 1e-3, relative, **{"step": step, "start": "carried", **more})


def test_recommend_steps_after_the_time_limit_of_a_pass_are_not_reached_and_have_no_residual():
    made = [step_record(i, "pgs", 1e-8) for i in range(3)] + [step_record(3, "pgs", 0.25)]
    made += [step_record(i, "pgs", 0.5, **BUDGET) for i in range(6)]
    made += [step_record(i, "pgs", 5e-4, tol=1e-3) for i in range(6)]
    text = recommend(report_of(*made, walk=True))[0].text
    assert "misses 3 of the 6 steps of walk" in text and "Missed: walk[3] (residual 2.5e-1)." in text
    assert "Not reached within the time of a pass (--sequence-time-limit): 2 steps." in text
    assert "walk[4]" not in text and "walk[5]" not in text


def test_stopped_sequence_shows_finished_solvers():
    solvers = ["auto", "pgs", "nncg"]
    made = [step_record(i, "auto", 1e-8) for i in range(4)] + [
        step_record(i, "pgs", 0.5, **BUDGET) for i in range(4)
    ]
    report = report_of(*made, walk=True, whole=False, solvers=solvers)
    assert set(report.frame["solver"]) == {"auto"} and report.unfinished == ["pgs", "nncg"]
    assert "Stopped: auto solves the 4 steps of walk" in recommend(report)[0].text
    assert "Not measured to the end: pgs, nncg." in recommend(report)[0].text
    # A later sequence that is not finished changes nothing for cases on which all solvers were measured.
    cases = [record("a", s, 1e-3, 1e-8) for s in solvers]
    report = report_of(*cases, *made, walk=True, whole=False)
    assert set(report.frame["case"]) == {"a"} and report.unfinished == []


@pytest.mark.parametrize(
    ("now", "drift", "change"),
    [
        (1.2e-3, 1.0, None),
        (2e-3, 1.0, "slower"),
        (0.5e-3, 1.0, "faster"),
        (2e-3, 2.0, None),
        (None, 1.0, "lost"),
    ],
)
def test_tabulate_changes_names_changes_beyond_noise_and_drift(now, drift, change):
    old = lines_of(record("a", "pgs", 1e-3, 1e-8))
    residual = 1e-2 if now is None else 1e-8
    new = lines_of(record("a", "pgs", now or 1e-3, residual, calibration_time=1e-4 * drift))
    table = tables.tabulate_changes(Report(new, old))
    assert list(table["change"]) == [change] if change else "change" not in table
    assert list(table["compared"]) == [1]


# -- sentences ---------------------------------------------------------------------------------------------


def test_recommend_names_worst_case_ties_misses_and_the_call():
    made = [record(c, s, t, 1e-8) for c in "abc" for s, t in (("auto", 1e-3), ("direct", 1.0001e-3))]
    made += [record("d", s, 1.0, 1e-2) for s in ("auto", "direct")]
    (statement,) = recommend(report_of(*made))
    assert statement.text == (
        "Use auto: it misses 1 of your 4 stacks and solves the others in 1.00 ms on average, cold, down to 1e-6 of the "
        "error of the zero impulse. Missed: d (residual 1.0e-2). As fast within the noise of the repetitions: direct "
        "(1.00 ms)."
    )
    assert statement.call_line == 'lv.solve(problem, "auto", tol=1e-6)'
    slow = [record(c, "pgs", t, 1e-8) for c, t in (("a", 1e-4), ("b", 1e-4), ("c", 1e-1))]
    assert "in 1.06 ms on average (100 ms at worst, c), cold" in recommend(report_of(*slow))[0].text


def test_recommend_stopped_run_counts_completely_measured_problems_only():
    made = [record(c, s, 1e-3, 1e-8) for c in "ab" for s in ("auto", "pgs")] + [
        record("c", "auto", 1e-3, 1e-8)
    ]
    (statement,) = recommend(report_of(*made, whole=False))
    assert statement.text.startswith(
        "Stopped: auto solves the 2 problems measured so far in 1.00 ms on average"
    )
    (statement,) = recommend(report_of(record("a", "auto", 1.0, 1.0), whole=False))
    assert statement.text.startswith("Stopped: no solver brings the 1 problem measured so far")
    report = report_of(*made[-1:], whole=False, solvers=["auto", "pgs"])
    assert recommend(report)[0].text == "Stopped: no problem was measured with every solver."


def test_recommend_plug_ins_are_named_with_place_and_time():
    made = [record("a", s, t, 1e-8) for s, t in (("auto", 1e-3), ("mine", 2e-3), ("other", 3e-3))]
    text = recommend(report_of(*made))[0].text
    assert "Plug-in mine: place 2 of 3, solves 1 case in 2.00 ms; other: place 3 of 3" in text


@pytest.mark.parametrize(
    ("answers", "place"),
    [
        ([(1e-5, 1e-9), (2e-5, 1e-9)], "First is the engine's own Newton"),
        ([(1e-4, 1e-9), (2e-4, 1e-9)], "impulse. The engine's own Newton"),  # slower
        (
            [(3.9e-5, 1e-9), (8e-5, 1e-9)],
            "As fast within the noise of the repetitions is the engine's own Newton",
        ),
        ([(1e-6, 1e-9), (1e-6, 1e-2)], "impulse. The engine's own Newton"),  # fewer cases
        ([(1e-6, 1e-2), (1e-6, math.nan)], "impulse. The engine's own Newton"),  # none
    ],
)
def test_recommend_engine_is_ranked_by_the_same_rule(tmp_path, answers, place):
    facts = {"rows": 3, "solver": "NEWTON", "verdict": "wrong"}
    lines = [
        {"file": f"step_{i}.npz", "seconds": t, "relative": x, **facts} for i, (t, x) in enumerate(answers)
    ]
    (tmp_path / "engine.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    made = [
        record(f"c{i}", s, t * (1 + i), 1e-8) for i in range(2) for s, t in (("auto", 4e-5), ("pgs", 5e-4))
    ]
    facts = {f"c{i}": {"source": str(tmp_path / f"step_{i}.npz")} for i in range(2)}
    lines = lines_of(*made, cases=facts)
    report = Report(lines, engines=read_engine_answers([], lines))
    text = recommend(report)[0].text
    assert place in text and text.count("engine's own") == 1
    solved = sum(x <= 1e-6 for _, x in answers)
    mean = tables.compute_mean([t for t, x in answers if x <= 1e-6]) if solved else math.nan
    expected = ["misses all of 2 cases", "misses 1 of 2 cases and solves the other in", "solves 2 cases in"][
        solved
    ]
    assert expected + (f" {format_seconds(mean)}" if solved else "") in text
    (row,) = tables.tabulate_engines(report).to_dict("records")
    assert row["first here"] == ("≈ auto" if "noise" in place else "auto") and row[
        "first to 1e-6 [s]"
    ] == pytest.approx(tables.compute_mean([4e-5, 8e-5]))
    assert row["own to 1e-6 [s]"] == pytest.approx(mean, nan_ok=True)


def test_terminal_names_each_crashed_plug_in_with_its_error_and_the_law_of_equal_names():
    dead = {"status": "ERROR", "claims": False}
    made = [record(c, "auto", 1e-3, 1e-8) for c in "ab"]
    made += [record(c, "mine", 0.0, math.inf, message="ValueError: of mine", **dead) for c in "ab"]
    made += [record("b", "yours", 0.0, math.inf, message="TypeError: of yours", **dead)]
    lines = lines_of(*made, cases={"b": {"law": "coulomb"}})
    text = shown(Report(lines), 100)
    assert "crashed (1 of 2): mine on a: ERROR: ValueError: of mine" in text
    assert "crashed (2 of 2): yours on b: ERROR: TypeError: of yours" in text
    lines.at[0, "plan"]["campaign"] = True  # without times: a row for each solver and law
    table = shown(Report(lines), 100).splitlines()
    assert [row.split()[:2] for row in table if " auto" in row] == [["coulomb", "auto"], ["lcp", "auto"]]


def test_tables_name_every_solver_within_the_noise_of_the_fastest():
    made = [record("a", s, t, 1e-8) for s, t in (("pgs", 1e-3), ("auto", 1.03e-3), ("direct", 1.2e-3))]
    report = report_of(*made)
    assert list(tables.tabulate_cases(report)["fastest to 1e-6"]) == ["auto ≈ pgs"]
    assert list(tables.tabulate_times(report)["solver"]) == ["auto", "pgs", "direct"]
    assert list(tables.rank_solvers(report, 1e-6)["place"]) == [1, 1, 3]


# -- texts of tables ---------------------------------------------------------------------------------------


def test_format_cells_times_have_one_unit_and_sizes_one_format():
    frame = pd.DataFrame({
        "solver": ["a", "b"], "time [s]": [1.5e-3, math.nan], "rows": [3, 4], "residual [-]": [1e-7, 0.5],
        "x": [2.5, 3.0], "share": ["12 %", "3.1 %"], "none [-]": [math.nan, math.nan], "text": ["", ""],
    })  # fmt: skip
    texts = format_cells(frame)
    assert list(texts) == ["solver", "time [ms]", "rows", "residual [-]", "x", "share"]
    assert texts.to_numpy().tolist() == [
        ["a", "1.50", "3", "1.0e-7", "2.5", "12 %"], ["b", "–", "4", "5.0e-1", "3", "3.1 %"]
    ]  # fmt: skip
    assert list_number_heads(texts) == set(texts) - {"solver"}
    assert list(format_cells(pd.DataFrame({"n": ["x", "y"], "t [s]": [2e-6, 3e-6]}))) == ["n", "t [µs]"]
    sizes = format_cells(pd.DataFrame({"a [-]": [0.35, 0.2], "b [m/s]": [2.9e-3, math.nan]}))
    assert sizes.to_numpy().tolist() == [["3.5e-1", "2.9e-3"], ["2.0e-1", "–"]]
    markdown = format_markdown(pd.DataFrame({"a": ["<b>|*x*"]}))
    assert markdown == ["| a |", "|---|", r"| &lt;b&gt;\|\*x\* |"]


def test_tables_of_200_cases_of_which_few_are_solved_are_complete():
    """pandas has codes of one byte for up to 127 categories, and did not align them with codes of two bytes."""
    made = [
        record(f"c{i}", s, 1e-3, 1e-8 if i < 3 else 0.5, tol=1e-3)
        for i in range(200)
        for s in ("auto", "pgs")
    ]
    report = report_of(*made)
    assert len(report.sections["runs"].frames[0]) == 400
    assert report.sections["runs"].frames[0]["to 1e-3 [s]"].notna().sum() == 6
    assert len(report.sections["failures"].frames[0]) == 394


def test_select_failures_lists_a_false_claim_of_a_run_that_reached_its_tolerance():
    made = [record("a", "liar", 1e-3, 1e-9, **FALSE_CLAIM), record("a", "auto", 1e-3, 1e-9)]
    assert tables.select_failures(report_of(*made))["solver"].tolist() == ["liar"]
