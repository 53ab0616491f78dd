"""Reports by motion error, cases with nothing to do, and references beside files."""

import csv
import json
import math
from dataclasses import replace

import pytest
from stacks import idle_problem
from worked import chromium

import lavender as lv
from lavender import bench
from lavender.lab.report import choices, contents, moved, tables
from lavender.lab.report.curves import figures
from lavender.lab.report.findings import Report
from lavender.lab.report.verdict import verdict
from lavender.lab.report.write import write

PLAN = bench.Plan(
    levels=(1e-3,), speed_levels=(1e-2, 1e-4), budgets=(8,), repeats=1, orders=(), time_limit=60.0
)


@pytest.fixture(scope="module")
def records():
    return bench.run(["stack(n=16)", idle_problem()], ["pgs", "anderson"], PLAN)


def test_times_to_a_speed_are_those_of_runs_that_reached_it(records):
    for row in tables.reaches(moved.by_speed(records)):
        runs = [r for r in records if (r.case, r.solver, r.start) == (row.case, row.solver, row.start)]
        for level, time in row.times.items():
            assert time == min((r.time_min for r in runs if r.motion_speed <= level), default=math.inf)
        assert row.best == min(r.motion_speed for r in runs)
        assert row.bound >= 0.0
    assert moved.speed_levels(records) == (1e-2, 1e-4)


def test_the_first_sentence_is_by_motion_error_where_that_was_asked_for(records):
    working = moved.working(records)
    said = verdict(working)
    line, *_ = choices.advice_alone(moved.by_speed(working))
    best = line.by_level[1e-4].best
    assert said.text.startswith(f"Use {best.solver}: it solves stack(n=16) in ")
    assert "until no body is wrong by more than 1e-4 m/s." in said.told[0].text
    # the line to copy does what the sentence says
    problem = lv.suite.case("stack(n=16)").problem
    solution = eval(said.told[0].line, {"lv": lv, "problem": problem})
    assert solution.motion_error().speed <= 1e-4
    plain = records_without(records, "speed_levels")
    found = verdict(moved.working(plain))
    assert "down to 1e-3 of the error of doing nothing" in found.told[0].text
    assert found.told[-1].text.startswith("By motion error ") and "1e-3 m/s" in found.told[-1].text


def records_without(records, name):
    """The same, as if its plan had not had an entry."""
    out = bench.Records()
    for run in records.runs.values():
        out.add(replace(run, plan={k: v for k, v in run.plan.items() if k != name}))
    for entry in (*records.cases.values(), *records):
        out.add(entry)
    return out


def test_without_motion_errors_there_is_nothing_to_show(tmp_path):
    plain = bench.run(["stack(n=4)"], ["pgs"], bench.Plan(levels=(1e-3,), budgets=(), repeats=1, orders=()))
    assert len(moved.by_speed(plain)) == 0
    assert contents.moved_table(Report(plain)).rows == contents.speed_table(Report(plain)).rows == []
    assert moved.speed_levels(plain) == ()
    assert figures(plain).moved is None
    page = write(plain, tmp_path, figures=False).read_text(encoding="utf-8")
    assert "by-motion" not in page.split("<body>")[1]


def test_what_has_nothing_to_do_is_in_no_ranking(records):
    """Nobody solves it, nobody fails: it counts in no table, and its residual is told in units."""
    busy = moved.working(records)
    assert "flying apart" not in busy.cases
    assert {r.case for r in busy} == {"stack(n=16)"}
    assert len(busy) < len(records)
    (case,) = moved.idle(records)
    assert (case.case, case.rows) == ("flying apart", 3)
    assert case.velocity == max(r.velocity for r in records if r.case == "flying apart")
    assert {a.ranking[0].cases for line in choices.advice_alone(busy) for a in line.by_level.values()} == {1}
    assert moved.working(busy) is busy


def test_the_page_and_the_summary_show_both(records, tmp_path):
    index = write(records, tmp_path, figures=False)
    text = index.read_text(encoding="utf-8")
    assert "By motion error" in text
    assert "to 1e-4 m/s" in text
    assert "Nothing to do" in text
    assert text.count("flying apart") == 1  # in that table, and nowhere else
    assert "flying apart" not in (tmp_path / "summary.md").read_text(encoding="utf-8")
    with open(tmp_path / "records.csv", newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert "motion_speed" in rows[0]
    # Success of what has nothing to do is neither true nor false.
    said = {(row["success"], row["nothing_to_do"]) for row in rows if row["case"] == "flying apart"}
    assert said == {("", "True")}
    assert {row["success"] for row in rows if row["case"] != "flying apart"} == {"True", "False"}
    entries = json.loads((tmp_path / "records.json").read_text(encoding="utf-8"))["records"]
    assert {e["success"] for e in entries if e["case"] == "flying apart"} == {None}


def test_a_campaign_counts_cases_by_motion_error_too(tmp_path):
    idle = tmp_path / "idle.npz"
    lv.io.save(idle_problem(), idle)
    plan = bench.CampaignPlan(levels=(1e-3,), budgets=(1, 64), orders=(), motion=True)
    found = bench.run(["stack(n=4)", "stack(n=32)", str(idle)], ["pgs"], plan, workers=1)
    rows = tables.robustness(moved.by_speed(moved.working(found)))
    best = {r.case: math.inf for r in moved.working(found)}
    for r in moved.working(found):
        best[r.case] = min(best[r.case], r.motion_speed)
    for row in rows:
        assert row.cases == 2
        for level, n in row.reached.items():
            assert n == sum(v <= level for v in best.values())
    assert sum(row.reached[1e-2] for row in rows) > 0
    page = write(found, tmp_path, figures=False).read_text(encoding="utf-8")
    assert "to 1e-3 m/s" in page
    text = (tmp_path / "summary.md").read_text(encoding="utf-8")
    assert f"| {rows[0].family} | pgs | 2 | " in text
    assert "By motion error" in text


# -- the switch of the axes ------------------------------------------------------------------------------


def test_figures_by_motion_error_hold_the_speeds_of_the_records(records):
    found = figures(moved.working(records))
    assert set(found.moved.cases) == set(found.cases)
    for one, other in zip(found.cases["stack(n=16)"], found.moved.cases["stack(n=16)"], strict=True):
        assert one.y_title == "relative residual [-]"
        assert other.y_title == "motion error [m/s]"
        assert other.name == f"motion {one.name}"
        assert one.x_title == other.x_title
    error = found.moved.cases["stack(n=16)"][0]
    told = {max(r.motion_speed, 1e-17) for r in records if r.case == "stack(n=16)" and r.usable}
    assert {y for curve in error.curves for y in curve.y} <= told
    assert error.levels == (1e-2, 1e-4)
    names = [figure.name for figure in found]
    assert len(names) == len(set(names))  # each has a file of its own


@pytest.mark.slow
@pytest.mark.parametrize("script", [True, False], ids=["script", "no script"])
def test_one_switch_changes_the_axes_of_all_charts(records, tmp_path, script):
    """In a real browser, also without JavaScript, and as it is printed."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (extra: dev)")
    found = chromium()
    index = write(records, tmp_path, figures=False)
    with playwright.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=found, args=["--no-sandbox"])
        page = browser.new_context(
            java_script_enabled=script, viewport={"width": 400, "height": 800}
        ).new_page()
        page.goto(index.resolve().as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= 400
        one, other = page.locator(".row.r .chart"), page.locator(".row.m .chart")
        assert not page.locator(".axes").is_visible()  # no chart of theirs is unfolded
        page.locator("#cases > summary").click()
        assert one.count() == other.count() > 0
        assert one.first.is_visible()
        assert not other.first.is_visible()
        page.locator("label[for=by-motion]").click()
        assert other.first.is_visible()
        assert not any(chart.is_visible() for chart in one.all())
        assert "motion error [m/s]" in other.first.text_content()
        assert page.locator("#filter").is_visible() == script
        page.emulate_media(media="print")
        assert other.first.is_visible()
        assert not page.locator(".axes").is_visible()
        browser.close()
