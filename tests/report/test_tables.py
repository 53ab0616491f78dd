"""Tables and pages are readable: one unit and format in a column, whole numbers on a line, whole titles."""

import io
import itertools
import re
from dataclasses import replace

import pytest
from rich.console import Console

from lavender.report import figures, table_specs
from lavender.report.bench import statistics
from lavender.report.findings import Report
from lavender.report.page import create_environment, keep_numbers_together, render_page
from lavender.report.plotting import HEIGHT, LEFT, WIDTH, plot_for_page
from lavender.report.summary_page import PageSection, SummaryPage
from lavender.report.table import Cell, Table
from lavender.report.terminal import print_table
from lavender.report.text import NONE, format_significant_digits, format_sizes, format_times_in_one_unit
from tests.report.synthetic import info, record, records_of


def test_times_of_a_table_have_one_unit_which_the_heads_name():
    rows = [["pgs", Cell.time(298e-6), Cell.time(1.02e-3, after=" (7/8)")], ["jacobi", Cell.time(33.1e-3), NONE],
            ["never", Cell.time(float("inf")), Cell.time(640e-6)]]  # fmt: skip
    table = Table(["solver", "to 1e-3", "to 1e-6"], rows)
    assert table.heads == ["solver", "to 1e-3 [ms]", "to 1e-6 [ms]"]
    assert table.cell_texts == [
        ["pgs", "0.298", "1.02 (7/8)"],
        ["jacobi", "33.1", NONE],
        ["never", NONE, "0.640"],
    ]
    again = replace(table, rows=table.rows[:1]).without_columns("to 1e-3 [ms]")
    assert again.heads == ["solver", "to 1e-6 [ms]"] and again.cell_texts == [["pgs", "1.02 (7/8)"]]


@pytest.mark.parametrize(
    ("values", "texts"),
    [
        ([0.27, 24.0, 0.31], ["0.27", "24", "0.31"]),
        ([0.27, 3.5e-2], ["2.7e-1", "3.5e-2"]),
        ([0.0, 0.5, float("nan")], ["0", "0.5", NONE]),
        ([], []),
    ],
)
def test_sizes_of_a_column_have_one_format(values, texts):
    assert format_sizes(values) == texts


@pytest.mark.parametrize(
    ("x", "text"), [(0.06522, "0.0652"), (16.0, "16.0"), (1023.0, "1020"), (9.996, "10.0"), (0.0, "0")]
)
def test_digits_are_significant_ones(x, text):
    assert format_significant_digits(x) == text


def test_the_unit_is_that_of_the_middle():
    assert format_times_in_one_unit([2e-6, 4e-6])[0] == "µs"
    assert format_times_in_one_unit([20e-6, 20.0]) == ("ms", ["0.0200", "20000"])


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        ("it takes 298 µs on average", ["298 µs"]),
        ("an error of 2.2e-16, 5.5e-4 m/s", ["2.2e-16", "5.5e-4 m/s"]),
        ("converged (50.0 %), in 6 worlds", ["50.0 %"]),
        ("after 16 iterations; a1e-3 is a name", ["16 iterations"]),
        ("again with --no-reuse", ["--no-reuse"]),
        ("5 s together (--sequence-time-limit)", ["5 s", "--sequence-time-limit"]),
        ("at most [m/s, rad/s]", ["[m/s, rad/s]"]),
        ("6 worlds", []),
    ],
)
def test_numbers_stay_on_one_line_with_their_units(text, kept):
    html = str(keep_numbers_together(text))
    assert re.findall(r'<span class="v">(.*?)</span>', html) == kept
    assert re.sub(r"<[^>]*>", "", html) == text


def test_texts_with_numbers_are_escaped():
    assert "<b>" not in str(keep_numbers_together("<b>1e-3</b>"))
    style = create_environment().get_template("style.css").render()
    assert re.search(r"\.v \{[^}]*nowrap", style)


def titles(svg):
    return re.findall(r'<text class="t" x="(\d+)" y="(-?\d+)">([^<]*)</text>', svg)


def test_no_title_of_a_chart_is_cut():
    points = [(1.0, 1.0), (2.0, 0.1)]
    title = "a model with a long name of many words in a folder with a long name, to 1e-6; 4 more solvers not drawn"
    figure = figures.Figure(
        "x", title, "step", "error [m/s]", (figures.Curve.from_points("pgs", "pgs", points),)
    )
    svg = plot_for_page(figure, {"pgs": 0})
    lines = titles(svg)
    assert " ".join(text for *_, text in lines) == title and len(lines) == 2
    # 15 units is the mean width of a character on a phone.
    assert all(int(x) + 15 * len(text) <= WIDTH for x, _, text in lines)
    low = int(re.search(r'viewBox="0 (-?\d+) ', svg)[1])
    assert all(int(y) - 24 >= low for _, y, _ in lines)  # inside of the drawing


def test_names_of_single_points_stand_to_the_right_of_all_points():
    points = [(x, x) for x in (1.0, 2.0, 9.0)]
    curves = tuple(replace(figures.Curve.from_points(name, name, points), points=True) for name in ("a", "b"))
    svg = plot_for_page(
        figures.Figure("x", "", "time [s]", "error [m/s]", curves), {"a": 0, "b": 1}, ("a", "b")
    )
    places = re.findall(r'<text x="(\d+)" y="(\d+)">([ab])</text>', svg)
    assert [name for *_, name in places] == ["a", "b"] and len({y for _, y, _ in places}) == 2
    edge = int(re.search(r'data-x="\S+ \S+ \S+ \d+ (\d+)"', svg)[1])
    assert all(int(x) > edge for x, *_ in places) and edge > LEFT


def draw_with_names(names):
    curves = tuple(
        figures.Curve.from_points(name, name, [(1.0, 1.0), (2.0 + i, 1e-3 / (1 + i))])
        for i, name in enumerate(names)
    )
    figure = figures.Figure("x", "", "sweeps", "error [m/s]", curves)
    return plot_for_page(figure, {name: i for i, name in enumerate(names)}, names[:1])


def test_all_names_of_a_few_curves_are_shown_inside_of_the_drawing_and_cover_no_point():
    names = ["pgs", "a solver with a long name", *"abcdef"]
    svg = draw_with_names(names)
    edge = int(re.search(r'data-x="\S+ \S+ \S+ \d+ (\d+)"', svg)[1])
    places = re.findall(r'<text x="(\d+)" y="(\d+)">([^<]+)</text>', svg)
    assert len(places) == svg.count('<g class="c s') == len(names) and svg.count(" k") == len(names)
    assert all(edge < int(x) <= WIDTH - 13.5 * len(name) for x, _, name in places)
    heights = sorted(int(y) for _, y, _ in places)
    assert all(b - a >= 30 for a, b in itertools.pairwise(heights)) and heights[-1] < HEIGHT - 90
    assert " k" not in draw_with_names([*names, "g"])  # the names of many curves would cover each other


def test_a_summary_page_has_a_drawing_for_a_screen_and_one_for_a_phone():
    figure = figures.Figure(
        "x", "t", "step", "error [m/s]", (figures.Curve.from_points("a", "a", [(1.0, 1.0)]),)
    )
    html = SummaryPage(
        "title", "in 3.0 s", [PageSection("part", figures=[figure])], {}, warning="busy"
    ).render_html()
    widths = [int(w) for w in re.findall(r'viewBox="0 -?\d+ (\d+) ', html)]
    assert len(widths) == 2 and widths[0] > 1.5 * widths[1]
    assert html.index('class="screen"') < html.index('class="phone"')
    assert '<p class="warn">busy</p>' in html and '<span class="v">3.0 s</span>' in html


def steps_of(solver, seconds, n=4, **more):
    return [
        record(f"s {i}", solver, seconds, 1e-7, step=i, start=start, **more)
        for i in range(n)
        for start in ("cold", "carried")
    ]


@pytest.fixture
def sequence():
    names = ("anderson", "jacobi", "newton", "nncg", "pgs", "sequential_impulses", "sor")
    made = [r for k, name in enumerate(names) for r in steps_of(name, 1e-3 * (k + 1))]
    made += steps_of("anderson", 5e-4, mode="budget", tol=0.0, max_iter=8)
    made += steps_of("anderson", 9e-3, tol=1e-9)
    found = records_of(*made)
    for i in range(4):
        found.add(replace(info(f"s {i}", "lcp", ("stack",)), sequence="s"))
    return found


def test_a_sequence_is_a_row_of_each_solver(sequence):
    passes = statistics.group_runs_by_pass(sequence)
    table = table_specs.tabulate_sequence(passes)
    assert table.heads == ["solver", "to 1e-6 [ms]", "to 1e-9 [ms]", "8 iterations"]
    assert table.cell_texts[0] == ["anderson", "4.00", "36.0", "1.0e-7"]
    assert [row[0] for row in table.cell_texts][:3] == ["anderson", "jacobi", "newton"]  # as fast as recorded
    assert len(table.rows) == 7 < len(table_specs.tabulate_sequence_passes(passes).rows)


def test_a_figure_of_a_sequence_has_one_tolerance_and_few_solvers(sequence):
    passes = statistics.group_runs_by_pass(sequence)
    timed = [w for w in passes if w.mode == "tol" and w.tol == 1e-6]
    figure = figures.build_pass_figure("s", timed)
    assert {c.solver for c in figure.curves} == {"anderson", "jacobi", "newton", "nncg", "pgs"}
    assert figure.left_out == ("sequential_impulses", "sor")
    carried = next(c for c in figure.curves if c.label == "anderson")
    later = figures.build_pass_figure(
        "s", [replace(w, numbers=dict.fromkeys(w.numbers, (0, 3, 4, 9))) for w in timed]
    )
    assert carried.x == (0, 1, 2, 3) and {c.x for c in later.curves} == {(0, 3, 4, 9)}  # as recorded
    assert carried.y == pytest.approx([1e-3, 2e-3, 3e-3, 4e-3])  # the time of all steps so far
    drawn = figures.build_figures(sequence).sequences["s"]
    assert [f.title for f in drawn] == ["s: 8 iterations", "s: to 1e-9"]  # the middle of 1e-6 and 1e-9


@pytest.mark.parametrize("width", [100, 60, 44, 30])
def test_numbers_stay_whole_in_a_narrow_terminal(width):
    heads = ["case", "solver", "to 1e-6", "best residual of all runs", "status", "claim"]
    rows = [[f"box_stack(n=1{i})", "sequential_impulses", Cell.time(1.5e-3 * i), f"{i}.0e-16", "CONVERGED", ""]
            for i in (1, 2)]  # fmt: skip
    out = io.StringIO()
    print_table(Console(file=out, width=width), Table(heads, rows))
    text = out.getvalue()
    assert all(number in text.split() for number in ("1.50", "3.00", "1.0e-16", "2.0e-16", "CONVERGED"))
    assert max(map(len, text.splitlines())) <= width
    assert "claim" not in text  # a column without any text
    assert ("solver" in text.splitlines()[0]) == (width == 100)


def test_a_sequence_has_a_section_in_the_terminal(sequence):
    (section,) = (s for s in table_specs.list_sections(Report(sequence)) if s.title.startswith("Sequence"))
    assert section.title == "Sequence s" and len(section.table.rows) == 7


def test_plug_ins_are_in_colour_on_the_page():
    names = ("anderson", "direct", "jacobi", "newton", "nncg", "pgs", "my_solver")
    made = [record(case, name, 1e-3 * (1 + i), 1e-7) for case in "ab" for i, name in enumerate(names)]
    report = Report(records_of(*made))
    page = render_page(report, figures.build_figures(report.all_records))
    number = sorted(names).index("my_solver")
    assert re.search(rf'value="{number}" checked', page) and f".s{number} {{ --c:" in page
    assert len(re.findall(r'type="checkbox" value="\d+" checked', page)) < len(names)
