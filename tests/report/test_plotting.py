"""Figures hold the runs that they show; one plotter draws them for files, papers and the page."""

import math
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from lavender.report import figures
from lavender.report.plotting import (
    assign_styles,
    choose_limits,
    choose_ticks,
    label_axis,
    plot_figure,
    plot_for_page,
)
from lavender.solvers import registry
from tests.report.synthetic import BUDGET, EVIL, example, record, records_of


def test_styles_tell_solvers_apart():
    names = [f"s{i}" for i in range(24)] + ["pgs", "direct"]
    found = assign_styles(names)
    assert len({(k.color, k.dash, k.marker) for k in found.values()}) == len(names)
    assert found["pgs"].color != found["direct"].color
    assert found == assign_styles(reversed(names))


def test_a_drawing_holds_the_runs_of_its_solvers(tmp_path):
    """Their coordinates, as a page's script reads them with the ranges of the axes, are times and residuals."""
    records = example(tmp_path).ranked_records

    def value(axis, place):
        log, low, high, first, last = map(float, axis.split())
        x = low + (high - low) * (place - first) / (last - first)
        return 10.0**x if log else x

    for case in ("pile", EVIL):
        figure = figures.build_work_precision(records, case)
        root = ElementTree.fromstring(plot_for_page(figure, {"pgs": 1}, ["pgs"]))
        drawn = {g.get("data-l"): g for g in root.iter("g") if any(p.get("class") == "d" for p in g)}
        assert list(drawn) == [c.label for c in figure.curves]
        assert drawn["pgs"].get("class") == "c s1 k"
        for c in figure.curves:
            runs = [
                r
                for r in records
                if (r.case, r.solver, r.order, r.interleave_group) == (case, c.solver, "given", "")
            ]
            points = sorted((r.time_min, r.relative) for r in runs if r.is_usable)
            assert sorted(zip(c.x, c.y, strict=True)) == points and len(c.notes) == len(points)
            (dots,) = (p.get("d") for p in drawn[c.label] if p.get("class") == "d")
            places = np.array([list(map(int, p)) for p in re.findall(r"M(\d+) (\d+)h0", dots)])
            # A unit of the drawing: 626 for at least a decade of time, some 17 decades of residual on 486.
            assert np.abs(np.log10(value(root.get("data-x"), places[:, 0]) / np.array(c.x))).max() < 0.01
            assert np.abs(np.log10(value(root.get("data-y"), places[:, 1]) / np.array(c.y))).max() < 0.04


@pytest.mark.parametrize("steps", [True, False])
def test_names_at_the_ends_of_curves_neither_cover_each_other_nor_leave_the_drawing(steps):
    names = ["auto", "block_gauss_seidel", "sequential_impulses"]
    made = [
        figures.Curve(n, n, (1.0, 2.0 + i, 9.0), (50.0, 100.0, 100.0), steps=steps)
        for i, n in enumerate(names)
    ]
    root = ElementTree.fromstring(
        plot_for_page(figures.Figure("f", "t", "x", "y", tuple(made), y_log=False), {}, names)
    )
    texts = [(t.text, int(t.get("x")), int(t.get("y"))) for t in root.iter("text") if t.text in names]
    assert sorted(t[0] for t in texts) == names
    assert min(np.diff(sorted(t[2] for t in texts))) >= 26  # the largest letters, on a phone
    assert all(x + 12.2 * len(name) <= 1000 for name, x, _ in texts)  # 22 units high: 0.55 of it wide


def test_a_drawing_survives_what_has_no_place_on_its_axes():
    odd = figures.Curve("a", "a", (0.0, 1e-300, 1.0, math.inf), (1.0, math.nan, 0.0, 1.0))
    noted = figures.Curve("a", "_$a$", (1.0,), (1.0,), ("<&",))
    flat = figures.Curve("a", "a", (1.0, 1.0), (5.0, 5.0))
    for drawn in (
        figures.Figure("f", "<t>&$x_", "x", "y", (odd,)),
        figures.Figure("f", "t", "x", "y", (), x_log=False, y_log=False),
        figures.Figure("f", "t", "x [s]", "y", (noted,), tolerances=(0.0,)),
        figures.Figure("f", "t", "x", "y", (flat,), False, False),
    ):
        assert plot_for_page(drawn, {}) == plot_for_page(drawn, {})
        ElementTree.fromstring(plot_for_page(drawn, {}))
        plot_figure(drawn, assign_styles(["a"])).draw_without_rendering()


@pytest.mark.parametrize(
    ("low", "high", "log", "unit", "tick"),
    [
        (1e-5, 1e-4, True, "µs", "100"), (1e-4, 1.0, True, "ms", "0.1"), (0.5, 50.0, True, "s", "10"),
        (1e-9, 1e-8, True, "ns", "1"), (0.1, 0.9, False, "ms", "400"), (0.2, 0.2, True, "ms", "100"),
        (1e-17, 1.0, True, "ns", "1e6"), (4.0, 16.0, True, "s", "5"),
    ],
)  # fmt: skip
def test_an_axis_and_its_ticks_have_one_unit(low, high, log, unit, tick):
    limits = choose_limits([low, high], log)
    assert limits[0] < low <= high < limits[1]
    ticks = choose_ticks(limits, log)
    title, words = label_axis("time [s]", limits, ticks, log)
    assert title == f"time [{unit}]"
    assert 2 <= len(words) <= 9
    assert tick in words and all(re.fullmatch(r"[\d.]+(e-?\d+)?", word) for word in words)
    assert len({"e" in word for word in words if word != "1"}) == 1  # one format


def test_the_picture_of_all_cases_is_the_median_of_what_was_reached_by_each_time():
    rng = np.random.default_rng(5)
    made = [
        record(case, solver, 10.0 ** rng.uniform(-5, -2), 10.0 ** rng.uniform(-9, -1))
        for case in "abcdefg"
        for solver in ("pgs", "newton")
        for _ in range(6)
    ]
    found = figures.build_overall_figure(records_of(*made))
    assert [c.solver for c in found.curves] == ["newton", "pgs"]
    for curve in found.curves:
        for t, low, middle, high in zip(curve.x, curve.low, curve.y, curve.high, strict=True):
            reached = []
            for case in "abcdefg":
                own = [r for r in made if r.case == case and r.solver == curve.solver]
                reached.append(min((r.relative for r in own if r.time_min <= t * (1 + 1e-9)), default=1.0))
            assert (low, middle, high) == tuple(np.sort(reached)[[1, 3, 5]])
        assert list(curve.y) == sorted(curve.y, reverse=True)
    # Shares of a batch, and the least time of repetitions of which another left less, are no points of it.
    more = [record("a", "pgs", 1e-9, 1e-12, interleave_group="one", timing_mode=timed, mode=mode) for timed, mode in
            (("batch", "tol"), ("call", "time"))]  # fmt: skip
    assert repr(figures.build_overall_figure(records_of(*made, *more))) == repr(found)  # whose floor is NaN


def test_an_axis_of_time_names_the_code_that_was_timed():
    titles = {"call": "time of a call [s]", "steps": "time of a call [s]", "": "time of set-up and solve [s]"}
    for mode, title in titles.items():
        found = records_of(record("a", "pgs", 1e-3, 1e-7, timing_mode=mode))
        assert figures.build_work_precision(found, "a").x_title == title
        assert figures.build_overall_figure(found).x_title == title
    both = records_of(*(record("a", "pgs", 1e-3, 1e-7, timing_mode=mode) for mode in ("call", "")))
    assert figures.build_overall_figure(both).x_title == "time [s]"


def test_a_plug_in_has_a_colour_that_no_solver_of_lavender_has():
    own = [name for name, spec in registry.specs().items() if spec.builtin]
    everyone = assign_styles(["my_solver", *own])
    assert everyone["my_solver"].color not in {everyone[name].color for name in own}
    for some in (["my_solver"], ["my_solver", "pgs", "osqp"], ["direct", "my_solver", "auto"]):
        assert all(style == everyone[name] for name, style in assign_styles(some).items())
    # A selection of the records keeps the colours of all of them.
    found = records_of(*(record("a", name, 1e-3, 1e-7) for name in ("a_solver", "my_solver", "pgs")))
    selection = found.of_solvers(["my_solver", "pgs"]).select_latest_run()
    assert {r.solver for r in selection} == {"my_solver", "pgs"}
    assert assign_styles(selection.solvers)["my_solver"] == assign_styles(found.solvers)["my_solver"]
    assert assign_styles(found.solvers)["my_solver"].color != assign_styles(found.solvers)["a_solver"].color


def test_error_against_work_counts_passes_and_leaves_other_work_out():
    made = []
    for case in "abc":
        made += [
            record(case, "pgs", 1e-3 * n, 10.0**-n, work={"sweeps": 10**n}, mode="budget", max_iter=10**n)
            for n in (1, 2, 3)
        ]
        made.append(record(case, "my_solver", 5.0, 1e-7, work={"products": 50}))
        made.append(record(case, "admm", 1e-3, 1e-9, work={"solves": 3, "factorisations": 1}))
    figure = figures.build_overall_figure(records_of(*made), "work")
    assert (figure.name, figure.x_title) == ("work over all", "passes over A")
    assert [c.solver for c in figure.curves] == ["my_solver", "pgs"] and "(admm)" in figure.note
    (pgs,) = (c for c in figure.curves if c.solver == "pgs")
    reached = {
        n: [x for p, x in zip(pgs.x, pgs.y, strict=True) if p * (1 + 1e-9) >= 10**n] for n in (1, 2, 3)
    }
    assert {n: max(x) for n, x in reached.items()} == {n: pytest.approx(10.0**-n) for n in (1, 2, 3)}
    assert not figures.build_overall_figure(records_of(*made[4::5]), "work").curves  # admm alone


def test_an_axis_of_iterations_names_their_unit():
    sweeps = [record("a", "pgs", 1e-3, 1e-2, **BUDGET)]
    other = record("a", "admm", 1e-3, 1e-2, **BUDGET | {"work": {"solves": 8}})
    assert figures.build_budget_figure(records_of(*sweeps), "a").x_title == "sweeps"
    assert (
        figures.build_budget_figure(records_of(*sweeps, other), "a").x_title
        == "iterations, each solver's own unit"
    )
