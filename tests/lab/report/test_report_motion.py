"""Reports by motion error, and cases with nothing to do."""

import csv
import dataclasses
import json
import math
import re

import pytest
from stacks import idle_problem
from worked import chromium

import lavender as lv
from lavender import bench
from lavender.lab.bench import recommendation, statistics
from lavender.lab.report import motion_tables, table_specs
from lavender.lab.report.figures import build_figures
from lavender.lab.report.findings import Report
from lavender.lab.report.verdict import build_verdict
from lavender.lab.report.write import write

PLAN = bench.Plan(
    tolerances=(1e-3,), velocity_tolerances=(1e-2, 1e-4), budgets=(8,), repeats=1, orders=(), time_limit=60.0
)


@pytest.fixture(scope="module")
def records():
    return bench.run(["stack(n=16)", idle_problem()], ["pgs", "anderson"], PLAN)


def test_times_to_a_speed_are_those_of_runs_that_reached_it(records):
    for row in statistics.summarize_runs_by_case(motion_tables.convert_to_motion_errors(records)):
        runs = [r for r in records if (r.case, r.solver, r.start) == (row.case, row.solver, row.start)]
        for tolerance, time in row.times.items():
            some = [r.time_min for r in runs if r.mode == "tol" and r.motion_speed <= tolerance]
            assert time == min(some, default=math.inf)
        assert row.best == min(r.motion_speed for r in runs)
        assert row.bound >= 0.0
    assert motion_tables.get_velocity_tolerances(records) == (1e-2, 1e-4)


def test_the_first_sentence_is_by_motion_error_if_that_was_asked_for(records):
    found = Report(records)
    line, *_ = recommendation.recommend_from_single_runs(found.records_by_motion_error)
    said = found.verdict.statements[0]
    assert said.text.startswith(f"Use {line.by_tolerance[1e-4].best.solver}: it solves stack(n=16) in ")
    assert "until no body has a velocity error above 1e-4 m/s." in said.text
    # the line to copy does what the sentence says
    problem = lv.suite.case("stack(n=16)").problem
    assert eval(said.call_line, {"lv": lv, "problem": problem}).motion_error().speed <= 1e-4
    (run,) = found.ranked_records.runs.values()
    found.ranked_records.add(dataclasses.replace(run, plan={**run.plan, "velocity_tolerances": ()}))
    first, *_, last = build_verdict(found.ranked_records).statements
    assert "down to 1e-3 of the error of the zero impulse" in first.text
    assert last.text.startswith("By motion error ") and "1e-3 m/s" in last.text


def test_without_motion_errors_there_is_nothing_to_show(tmp_path):
    plain = bench.run(
        ["stack(n=4)"], ["pgs"], bench.Plan(tolerances=(1e-3,), budgets=(), repeats=1, orders=())
    )
    found = Report(plain)
    assert len(found.records_by_motion_error) == 0 and found.velocity_tolerances == ()
    assert (
        table_specs.tabulate_motion_errors(found).rows
        == table_specs.tabulate_best_solver_by_motion_error(found).rows
        == []
    )
    assert build_figures(plain).moved is None
    page = write(plain, tmp_path, figures=False).read_text(encoding="utf-8")
    assert "by-motion" not in page.split("<body>")[1]


def test_what_has_nothing_to_do_is_in_no_ranking(records, tmp_path):
    """Nobody solves it, nobody fails: it counts in no table, and its residual is told in units."""
    busy = statistics.drop_cases_solved_at_zero(records)
    assert {r.case for r in busy} == set(busy.cases) == {"stack(n=16)"}
    assert statistics.drop_cases_solved_at_zero(busy) is busy
    (case,) = motion_tables.list_cases_solved_at_zero(records)
    assert (case.case, case.rows) == ("flying apart", 3)
    assert case.velocity == max(r.velocity for r in records if r.case == "flying apart")
    text = write(records, tmp_path, figures=False).read_text(encoding="utf-8")
    assert text.count("flying apart") == 1  # in that table, and nowhere else
    assert "flying apart" not in (tmp_path / "summary.md").read_text(encoding="utf-8")
    with open(tmp_path / "records.csv", newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    # Success of what has nothing to do is neither true nor false.
    said = {(row["success"], row["nothing_to_do"]) for row in rows if row["case"] == "flying apart"}
    assert said == {("", "True")} and "motion_speed" in rows[0]
    assert {row["success"] for row in rows if row["case"] != "flying apart"} == {"True", "False"}
    entries = json.loads((tmp_path / "records.json").read_text(encoding="utf-8"))["records"]
    assert {e["success"] for e in entries if e["case"] == "flying apart"} == {None}


def test_a_campaign_counts_cases_by_motion_error_too(tmp_path):
    lv.io.save(idle_problem(), tmp_path / "idle.npz")
    plan = bench.CampaignPlan(tolerances=(1e-3,), budgets=(1, 64), orders=(), motion=True)
    found = bench.run(["stack(n=4)", "stack(n=32)", str(tmp_path / "idle.npz")], ["pgs"], plan, workers=1)
    made = Report(found)
    best = [
        min(r.motion_speed for r in made.ranked_records if r.case == case)
        for case in made.ranked_records.cases
    ]
    rows = statistics.compute_robustness(made.records_by_motion_error)
    for row in rows:
        assert row.cases == len(best) == 2
        assert row.reached == {tolerance: sum(v <= tolerance for v in best) for tolerance in row.reached}
    assert sum(row.reached[1e-2] for row in rows) > 0
    page = write(made, tmp_path, figures=False).read_text(encoding="utf-8")
    assert "to 1e-3 m/s" in re.sub(r"</?span[^>]*>", "", page)


#: Where the window has the first point of a curve.
POINT = """d => { const [x, y] = d.getAttribute("d").match(/\\d+/g).map(Number);
    const p = new DOMPoint(x, y).matrixTransform(d.getScreenCTM()); return [p.x, p.y]; }"""


@pytest.mark.slow
@pytest.mark.parametrize("script", [True, False], ids=["script", "no script"])
def test_one_switch_changes_the_axes_of_all_charts(records, tmp_path, script):
    """In a real browser, also without JavaScript, and as it is printed; a point near the pointer is told in words."""
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
        if script:
            other.first.scroll_into_view_if_needed()
            page.mouse.move(*other.first.locator(".d").first.evaluate(POINT))
            assert re.search(r"^(pgs|anderson), .*, [\d.]+ (s|ms|µs), ", page.locator(".tip").text_content())
        page.emulate_media(media="print")
        assert other.first.is_visible()
        assert not page.locator(".axes").is_visible()
        browser.close()
