"""Terminal, page, files and figures of one report in which every part has something to show."""

import html.parser
import io
import json
import re
import sys
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from approved_texts import check_text
from rich.console import Console
from worked import python

from lavender.report import figures as drawing
from lavender.report import write
from lavender.report.figures import Curve, Figure, assign_styles, build_figures, render_svg
from lavender.report.findings import COMMAND_LINES, MAX_LINES, SECTIONS
from lavender.report.render import (
    NUMBER,
    Section,
    Statement,
    keep_numbers_together,
    print_table,
    render_page,
    write_files,
)
from tests.report.synthetic import EVIL, FALSE_CLAIM, example, record, report_of, shown, skip


class Page(html.parser.HTMLParser):
    """Elements of a page that do not close, the files that it loads, ids, links and alternative texts."""

    VOID = frozenset({"meta", "br", "hr", "img", "input", "link", "path", "use", "rect"})

    def __init__(self, text):
        super().__init__()
        self.open, self.loads, self.ids, self.links, self.wrong, self.alts = [], [], set(), set(), [], []
        self.words = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.ids.add(values.get("id"))
        if values.get("href", "").startswith("#"):
            self.links.add(values["href"][1:])
        self.loads += [v for k, v in attrs if k in ("src", "srcset", "data")]
        self.loads += [values["href"]] if tag == "link" else []
        if values.get("role") == "img":
            self.alts.append(values["aria-label"])
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_data(self, data):
        if not {"svg", "style", "script", "table"} & set(self.open):
            self.words += [" ".join(data.split())] if data.strip() else []

    def handle_endtag(self, tag):
        if tag not in self.VOID and self.open.pop() != tag:
            self.wrong.append(tag)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report") / "steps"
    folder.mkdir()
    report, events = example(folder), []
    write(report, folder / "out", watch=events.append)
    return report, folder / "out", events


def test_page_is_well_formed_and_complete_without_other_files(written):
    report, out, _ = written
    text = (out / "index.html").read_text(encoding="utf-8")
    page = Page(text)
    assert (page.open, page.wrong, page.loads) == ([], [], [])
    assert page.links <= page.ids and {*report.sections, "machine", "limits"} <= page.ids
    assert "<script>alert" not in text and "<b>row" not in text and EVIL not in text
    figures = build_figures(report)
    assert page.alts == [figure.description for figure in figures] and len(figures) >= 2
    first = text[text.index("<body>") : text.index('<details class="part"')]
    assert first.count("<svg") == 1 and "<table" not in first and "Use auto" in first


def test_texts_of_a_report_with_every_part_are_approved(written):
    """The terminal, the summary and the words of the page outside of its tables, and the tables."""
    report, out, _ = written
    texts = {
        "terminal": shown(report, 120, complete=True), "terminal, short": shown(report, 80),
        "summary.md": (out / "summary.md").read_text(encoding="utf-8"),
        "words of the page": "\n".join(Page((out / "index.html").read_text(encoding="utf-8")).words),
        **{path.name: path.read_text(encoding="utf-8") for path in sorted((out / "tables").glob("*.csv"))},
    }  # fmt: skip
    for name, text in texts.items():
        check_text("report.txt", name, text.replace(str(out.parent), "FOLDER"))


def test_report_write_has_files_of_every_table_figure_and_run(written):
    report, out, events = written
    assert {p.name for p in out.iterdir()} == {
        "records.csv", "index.html", "summary.md", "figures", "tables"
    }  # fmt: skip
    assert {p.stem for p in (out / "tables").glob("*.csv")} == set(report.sections)
    assert set(report.sections) - set(SECTIONS) == {"changes", "idle", "diagnostics", "skipped"}
    assert set(SECTIONS) - set(report.sections) == {"costs"}  # Two cases are too few for a fit.
    for figure in (out / "figures").iterdir():
        assert ElementTree.parse(figure).getroot().tag.endswith("svg")
    assert r"\begin{tabular}" in (out / "tables" / "claims.tex").read_text()
    assert EVIL not in (out / "summary.md").read_text(encoding="utf-8")
    assert {e.phase for e in events} == {"writing"} and [e.done for e in events] == list(range(events[0].total))


@pytest.mark.parametrize("width", [60, 80, 120])
def test_terminal_complete_report_stays_within_the_width_and_cuts_nothing(written, width):
    report = written[0]
    out = shown(report, width, complete=True)
    assert max(map(len, out.splitlines())) <= width and "…" not in out
    for section in report.sections.values():
        assert section.title.split()[0] in out


@pytest.mark.parametrize(("cases", "width"), [(1, 40), (40, 20), (40, 80), (40, 10_000)])
def test_terminal_short_report_has_25_lines_within_the_width(cases, width):
    """Warnings of every kind, names of any length and as many structures as there are words."""
    made, names = [], [f"case {i} of a folder with a long name" for i in range(cases)]
    for name in names:
        for j in range(8):
            more = {**FALSE_CLAIM, "status_conflict": "says CONVERGED " * 9} if j > 5 else {"load": 9.0}
            made.append(record(name, f"solver_{j}", 1e-3 * (1 + j), 1e-7, **more))
    facts = {
        name: {"structure": f"structure {i}", "diagnostics": ["something looks wrong"]} for i, name in enumerate(names)
    }
    skips = [skip(name, "newton", "takes laws linear") for name in names]
    skips += [skip(name + "b", "", "did not load: " + "x" * 100) for name in names]
    report = report_of(*made, cases=facts, more=skips)
    lines = shown(report, width).splitlines()
    assert len(lines) + COMMAND_LINES <= (MAX_LINES if width > 40 else 60)  # A sentence takes the lines that it needs.
    assert max(map(len, lines)) <= width and lines[0].startswith("Use solver_0")
    assert sum("more: --tables" in line for line in lines) == 1
    assert any(line.startswith("false claim, the ") for line in lines)


def test_print_table_that_is_too_wide_leaves_numbers_out_and_keeps_the_first_column():
    name = "worlds/worst_of_a_long_name_1.npz"
    table = pd.DataFrame({"file": [name], **{f"number {i} [m/s]": ["1.234567"] for i in range(8)}})
    out = io.StringIO()
    print_table(Console(file=out, width=80), table, cut=True)
    text = out.getvalue()
    assert "number 0" in " ".join(text.split()) and "number 7" not in text and max(map(len, text.splitlines())) <= 80
    assert name in "".join(line[:80].split("  ")[0].strip() for line in text.splitlines()[1:]).replace("file", "")


def test_styles_tell_solvers_apart_and_plug_ins_have_their_own_colours():
    styles = assign_styles(["auto", "direct", "newton", "pgs", "osqp", "anderson", "mine", "yours"])
    assert len({(s["color"], s["linestyle"]) for s in styles.values()}) == len(styles)
    assert {styles[n]["color"] for n in ("mine", "yours")} <= set(drawing.PLUG_IN_COLORS)
    assert not set(drawing.PLUG_IN_COLORS) & set(drawing.SOLVER_COLORS)
    assert assign_styles(["auto", "x"])["auto"] == assign_styles(["auto", "pgs"])["auto"]


def test_render_svg_has_texts_gaps_and_names_of_every_kind():
    nan, inf = float("nan"), float("inf")
    curves = (
        Curve("a", "_a$\\frac$b", (1e-3, 0.0, 2e-3, 3e-3), (1e-2, 1e-3, inf, 0.0)),
        Curve("b", "<b>&", (nan,), (nan,)), Curve("c", "x" * 99, (1e-3,), (1.0,), points=True),
    )  # fmt: skip
    styles = assign_styles("abc")
    svg = render_svg(Figure("f", "a title of $1 & $2", "time [s]", "residual [-]", curves, tolerances=(1e-3,)), styles)
    texts = [t.text for t in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")]
    assert "a title of $1 & $2" in texts and "<b>&" in texts and any(t and t.endswith("…") for t in texts)
    assert render_svg(Figure("f", "", "", "", curves), styles) == render_svg(Figure("f", "", "", "", curves), styles)


def test_render_svg_draws_a_covered_curve_wider_so_that_it_can_be_seen():
    """As `auto`, which runs newton, has the times of `newton` within 5 %."""
    x, y = np.geomspace(1e-4, 1e-1, 30), np.geomspace(1.0, 1e-9, 30)
    curves = [Curve("auto", "auto", x, y), Curve("newton", "newton", x, 1.05 * y), Curve("pgs", "pgs", x, 9.0 * y)]
    svg = ElementTree.fromstring(render_svg(Figure("f", "", "", "", curves), assign_styles(c.solver for c in curves)))
    paths = {g.get("id"): g[0].get("style") for g in svg.iter("{http://www.w3.org/2000/svg}g") if len(g)}
    width = [float(re.search(r"stroke-width: ([\d.]+)", paths[f"{c.solver}--{i}"])[1]) for i, c in enumerate(curves)]
    assert width[0] > 2.0 * width[1] and width[1] == width[2]


def test_build_overall_figure_is_the_median_of_the_residuals_reached_by_each_time():
    made = [record(c, "pgs", t, x) for c, t, x in (("a", 1e-3, 1e-2), ("b", 1e-2, 1e-4), ("c", 1e-1, 1e-6))]
    made.append(record("a", "some", 1e-3, 1e-8))
    figure = drawing.build_overall_figure(report_of(*made))
    assert figure.title == "Error against time, median over 3 cases"
    by = {c.solver: c for c in figure.curves}
    # Two of three cases have a result from 10 ms on; the median is then the worse of the two.
    assert by["pgs"].x[0] == pytest.approx(1e-2, rel=0.2) and by["pgs"].y[0] == 1e-2 and by["pgs"].y[-1] == 1e-4
    assert "some" not in by or by["some"].label == "some (1 of 3 cases)"


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        ("in 1.05 ms on average", ["1.05 ms"]), ("1e-6 m/s", ["1e-6 m/s"]), ("--tables [m/s]", ["--tables", "[m/s]"]),
        ("h1 and 3 cases", []),
    ],
)  # fmt: skip
def test_keep_numbers_together_marks_numbers_with_their_units(text, kept):
    assert NUMBER.findall(text) == kept
    assert str(keep_numbers_together(f"<b>{text}")).count("<span") == len(kept)
    assert str(keep_numbers_together("<b>")) == "&lt;b&gt;"


def test_write_files_of_a_page_has_its_figures_tables_and_numbers(tmp_path):
    figure = Figure("over-time", "Errors", "step", "error", (Curve("worst", "worst", (0, 1), (1.0, 2.0)),))
    frame = pd.DataFrame({"a": ["<x>"], "time [s]": [2e-3]})
    sections = [Section("Errors", [frame], figures=[figure], short=1), Section("Empty", [frame.iloc[:0]])]
    text = render_page("Audit", [Statement("A sentence.")], sections, folder=tmp_path / "figures")
    write_files(tmp_path, {"index.html": text, "numbers.json": {"n": 1}, "tables/errors.csv": frame})
    page = Page((tmp_path / "index.html").read_text(encoding="utf-8"))
    assert (page.open, page.wrong, page.alts) == ([], [], [figure.description])
    assert (tmp_path / "figures" / "over-time.svg").exists() and "&lt;x&gt;" in text and "Empty" not in text
    assert "time <span class=" not in text and '<span class="n">time [ms]</span>' in text and ">2.00</span>" in text
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "tables" / "errors.csv"), frame)
    assert json.loads((tmp_path / "numbers.json").read_text()) == {"n": 1}


@pytest.mark.nightly
@pytest.mark.skipif(sys.platform == "win32", reason="the peak of memory is read by the resource module")
def test_report_of_100000_runs_needs_less_than_500_mb(tmp_path):
    code = f"""import json
from lavender.report.store import to_jsonable
from tests.report.synthetic import lines_of, record
made = record("c0", "auto", 1e-3, 1e-8)
cases = [record(f"c{{i}}", "auto", 1e-3, 1e-8) for i in range(1000)]
with open({str(tmp_path / "records.jsonl")!r}, "w") as f:
    for row in lines_of(*cases).iloc[:1001].to_dict("records"):
        f.write(json.dumps(to_jsonable({{k: v for k, v in row.items() if v == v}})) + "\\n")
    for i in range(100_000):
        change = {{"case": f"c{{i % 1000}}", "sha": f"shac{{i % 1000}}", "solver": f"s{{i // 1000 % 20}}"}}
        f.write(json.dumps(to_jsonable(made | change | {{"tol": 10.0 ** -(1 + i // 20_000)}})) + "\\n")
"""
    python("-c", code)
    code = f"""import resource
from lavender.report import Report, read, write
lines = read({str(tmp_path / "records.jsonl")!r})
write(lines, {str(tmp_path / "out")!r})
print(len(Report(lines).runs), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"""
    count, peak = map(int, python("-c", code).stdout.split())
    assert count == 100_000 and peak < 500 * 1024  # [KiB] on Linux
    assert re.search(r"auto|s\d+", (tmp_path / "out" / "tables" / "structures.csv").read_text())
