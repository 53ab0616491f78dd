"""Sentences of a report, its lines to copy, and what of them fits on a terminal."""

import dataclasses
import json
import math

import pytest

from lavender import bench
from lavender.base.deadline import format_seconds
from lavender.report import table_specs
from lavender.report.bench import statistics
from lavender.report.engine import read_engine_answers
from lavender.report.findings import Report
from lavender.report.terminal import COMMAND_LINES, MAX_LINES
from lavender.report.text import format_percent, format_ratio, format_residual
from lavender.report.verdict import build_verdict
from tests.report.synthetic import BUDGET, example, interleaved, record, records_of, shown


def test_numbers_are_written_with_what_they_know():
    assert [format_seconds(t) for t in (1.0, 0.0123, 1e-3, 4.5e-5, 9e-8, 123.4, math.inf)] == [
        "1.00 s", "12.3 ms", "1.00 ms", "45.0 µs", "0.09 µs", "123 s", "–",
    ]  # fmt: skip
    percents = [format_percent(n, 10_000, 1) for n in (10_000, 9_999, 1, 0)]
    assert percents == ["100.0 %", "99.9 %", "0.01 %", "0.0 %"]
    assert (format_percent(999, 1000), format_percent(1, 3)) == ("99 %", "33 %")
    assert [format_ratio(x) for x in (1.34, 2.0, 85.0, 99.7, 1234.4, 7.3e13, math.nan)] == [
        "1.3 times", "2.0 times", "85 times", "100 times", "1234 times", "1e14 times", "–",
    ]  # fmt: skip
    assert [format_residual(x) for x in (3.44e-7, 0.0, math.inf, 1.0)] == ["3.4e-7", "0", "inf", "1.0e0"]


def test_the_sentence_has_the_worst_case():
    found = records_of(record("a", "auto", 4e-3, 1e-7), record("b", "auto", 4e-2, 1e-7))
    (said, *_) = build_verdict(found).statements
    assert said.text.startswith(
        "Use auto: it solves your 2 stacks in 12.7 ms on average (40.0 ms at worst, b), cold, down to 1e-6 of the error"
    )
    # Of two runs put together: x never ran on b, which is no miss of its own.
    parts = build_verdict(records_of(record("a", "x", 0.004, 1e-9), record("b", "y", 9.0, 0.5)))
    assert "(a miss counted as 2.00 s; on 1 it has no run)" in parts.joined_text
    nobody = build_verdict(records_of(record("a", "x", 1.0, 0.5)))
    assert nobody.joined_text == "No solver brings your stack down to 1e-6 of the error of the zero impulse."


def test_a_plug_in_is_named_with_its_place_and_time_in_the_terminal():
    made = [
        record(case, name, 1e-3 * (1 + i), 1e-7)
        for case in "ab"
        for i, name in enumerate(("auto", "pgs", "nncg"))
    ]
    made += [record("a", "my_solver", 2.5e-3, 1e-7), record("b", "my_solver", 2.5e-3, 1e-7)]
    report = Report(records_of(*made))
    assert "Plug-in my_solver: place 3 of 4, 2 of 2 solved in 2.50 ms." in shown(report)
    made += [record(case, "other", 9e-3, 0.5) for case in "ab"]
    sentence = next(s for s in build_verdict(records_of(*made)).statements if s.one_line)
    assert sentence.text.endswith("in 2.50 ms; other: place 5 of 5, 0 of 2 solved.")
    # A recommended plug-in is in the first sentence already.
    first = build_verdict(records_of(*made, *(record(case, "mine", 1e-4, 1e-7) for case in "ab")))
    assert first.statements[0].text.startswith("Use mine") and "Plug-in mine" not in first.joined_text


def test_budgets_with_one_recommended_solver_have_one_sentence():
    budgets = {4: ("pgs", 0.4), 8: ("pgs", 0.2), 16: ("nncg", 1e-3), 32: ("nncg", 1e-5), 64: ("nncg", 1e-7)}
    made = [record("a", "nncg", 1e-3, 1e-7)]
    for n, (best, left) in budgets.items():
        for name in ("pgs", "nncg"):
            more = BUDGET | {"max_iter": n, "work": {"sweeps": n}, "iterations": n}
            made.append(record("a", name, 1e-4, left if name == best else 0.6, **more))
    made += [record("a", "nncg", 1e-4, 0.9, **BUDGET | {"max_iter": 2, "work": {"sweeps": 2}})]
    swept = [
        s
        for s in build_verdict(records_of(*made), sweeps=(2, *budgets)).statements
        if s.text.startswith("With")
    ]
    starts = [
        "With 2 sweeps no solver serves",
        "With 4 and 8 sweeps, use pgs",
        "With 16, 32 and 64 sweeps, use nncg",
    ]
    assert [s.text.startswith(start) for s, start in zip(swept, starts, strict=True)] == [True] * 3
    assert "at the 90th percentile 1.0e-3, 1.0e-5 and 1.0e-7." in swept[2].text
    assert swept[2].call_line == 'lv.solve(problem, "nncg", tol=0, max_iter=16)  # or 32, 64'
    alone = build_verdict(records_of(*made), sweeps=(8,)).statements[-1]
    assert alone.text.startswith("With 8 sweeps, use pgs") and alone.call_line.endswith("max_iter=8)")


def test_runs_with_more_processes_than_cores_are_counted():
    """The synthetic machine has two cores; the mean load of 1.75 is no reason to call all times invalid."""
    loads = (1.0, 1.0, 2.0, 3.0)
    made = [record(f"case {i}", "pgs", 1e-3, 1e-7, load=load) for i, load in enumerate(loads)]
    report = Report(records_of(*made))
    warning = (
        "In 1 of 4 runs more processes were runnable (up to 3) than the machine has cores (2), so their times may be "
        "too long."
    )
    assert (report.busy_warning, report.load_warning) == ("", warning)
    assert report.load_summary == f"Load during the runs: 1.8 on average and 3 at most, on 2 cores. {warning}"
    assert warning in shown(report)
    assert (
        Report(records_of(*made[:3])).load_warning == ""
        and Report(records_of(record("a", "x", 1.0, 1.0))).load_summary == ""
    )


def test_no_iteration_limit_of_a_factorising_solver_is_offered_for_a_time():
    newton = {**BUDGET, "work": {"factorisations": 8}}
    found = records_of(record("a", "newton", 1.0, 1e-7), record("a", "newton", 1e-4, 1e-3, **newton))
    assert build_verdict(found, [1e-3]).statements[0].code == ('lv.solve(problem, "newton", tol=1e-6)',)


def test_a_machine_is_busy_by_the_mean_over_the_runs():
    """A few runs may meet something else: load 6 on two cores is void, 2.3 is not."""
    for busy, told in ((20, "The machine was busy: load 6.0 on 2 cores"), (5, ""), (0, "")):
        made = [record(f"c{i}", "pgs", 1e-3, 1e-7, load=6.0 if i < busy else 1.1) for i in range(20)]
        assert Report(records_of(*made)).busy_warning[:41] == told


# -- the engine that recorded the steps -----------------------------------------------------------------------


def recorded(folder, answers):
    """Records of three solvers on cases that an engine recorded, with its own answers: (time, residual) of each."""
    lines = [
        {
            "file": f"step_{i}.npz",
            "rows": 3,
            "seconds": t,
            "relative": x,
            "solver": "NEWTON",
            "verdict": "wrong",
        }
        for i, (t, x) in enumerate(answers)
    ]
    folder.mkdir()
    (folder / "engine.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    made = []
    for i in range(len(answers)):
        interleaved(made, f"{folder.name} {i}", "auto", 32e-6 * (1 + i), 1e-8)
        interleaved(made, f"{folder.name} {i}", "newton", 48e-6 * (1 + i), 1e-8)
        made.append(record(f"{folder.name} {i}", "pgs", 450e-6 * (1 + i), 1e-8))
    found = records_of(*made)
    for i in range(len(answers)):
        found.add(
            dataclasses.replace(found.cases[f"{folder.name} {i}"], source=str(folder / f"step_{i}.npz"))
        )
    return found


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
    made = Report(found, engines=read_engine_answers([str(tmp_path / "robot")], found))
    text = made.verdict.statements[0].text
    assert text.startswith("First is the engine's own Newton") == first
    solved = sum(x <= 1e-6 for _, x in answers)
    charged = [t if x <= 1e-6 else 2.0 for t, x in answers]  # the limit is 2 s
    score = statistics.compute_geometric_mean(charged, statistics.MEAN_TIME_SHIFT)
    ours = format_seconds(statistics.compute_geometric_mean([40e-6, 80e-6], statistics.MEAN_TIME_SHIFT))
    if solved:
        assert (
            f"in {format_seconds(score)} on average" in text
            or f"takes {format_seconds(score)} on average" in text
        )
    else:
        assert "engine's own Newton solves none of them" in text
    assert "se auto: " in text and f"in {ours} on average" in text
    (structure,) = table_specs.tabulate_recommended_solvers(made).rows
    assert structure[2].lead == "auto" and structure[2].text == ours
    assert (format_seconds(score) in str(structure[-1])) == (solved > 0)
    table = table_specs.tabulate_engines(made)
    own = dict(zip(table.heads, table.rows[0], strict=True))
    assert (own["first here"], own["to 1e-6, here"]) == ("auto", ours)
    assert own["to 1e-6"].startswith(format_seconds(score) if solved else "–")
    ends = ("interleaved", "inside the engine", "alone")
    rows = [line.split()[0] for line in shown(made).splitlines() if line.endswith(ends)]
    wanted = ["auto", "newton", "pgs"]
    if solved:
        wanted.insert(0 if first else 2 if solved == 2 else 3, "engine's")
    assert rows == wanted


def test_an_engine_that_answered_only_some_cases_is_not_in_the_first_sentence(tmp_path):
    found, other = (recorded(tmp_path / name, [(1e-6, 1e-9)] * 2) for name in ("robot", "other"))
    (tmp_path / "other" / "engine.jsonl").unlink()
    for case in other.cases.values():
        found.add(dataclasses.replace(case, structure=("pile",)))
    for r in other:
        found.add(r)
    engines = read_engine_answers([str(tmp_path / "robot")], found)
    made = Report(found, engines=engines)
    assert "engine" not in made.verdict.statements[0].text
    by_name = {str(row[0]): row[-1] for row in table_specs.tabulate_recommended_solvers(made).rows}
    assert by_name["stack"].lead == "Newton" and by_name["pile"].text == "–"
    # Records that are shown again name the folders themselves.
    assert read_engine_answers(["records.jsonl"], found) == engines


# -- on a terminal --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [60, 80, 120])
def test_tables_stay_within_the_terminal_and_nothing_is_cut(tmp_path, width):
    found = example(tmp_path)
    out = shown(found, width, complete=True)
    assert max(map(len, out.splitlines())) <= width
    assert "…" not in out
    for line in found.rankings:
        assert line.name in out
        for best in (a.best for a in (*line.by_tolerance.values(), *line.by_time.values())):
            assert best is None or best.solver in out


@pytest.mark.parametrize(("cases", "width"), [(1, 40), (40, 20), (40, 80), (40, 10_000)])
def test_in_short_the_terminal_shows_25_lines_within_its_width(cases, width):
    """Warnings of every kind, names of any length and as many structures as there are words."""
    made, names = [], [f"case {i} of a folder with a long name" for i in range(cases)]
    claim = {"claim_check": "contradicted", "status_conflict": "says CONVERGED " * 9}
    for name in names:
        for j in range(30):
            more = claim if j > 27 else {"load": 9.0}
            made.append(record(name, f"solver_{j}", 1e-3 * (1 + j), 1e-7, **more))
    found = records_of(*made, structure={name: (f"structure {i}",) for i, name in enumerate(names)})
    for name in names:
        found.add(dataclasses.replace(found.cases[name], diagnostics=("something looks wrong",)))
        found.add(bench.Skip("run", name + "b", "", "did not load: " + "x" * 100))
        found.add(bench.Skip("run", name, "newton", "takes laws linear"))
    lines = shown(Report(found), width).splitlines()
    assert len(lines) + COMMAND_LINES <= (MAX_LINES if width > 20 else 35)  # a sentence takes what it takes
    assert max(map(len, lines)) <= width
    assert lines[0].startswith("Use solver_0")
    assert sum("more: --tables" in line for line in lines) == 1
    assert any(line.startswith("false claim, the ") for line in lines)
