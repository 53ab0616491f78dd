"""Terminal, page, files and figures of one report in which every part has something to show."""

import html.parser
import io
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from approved_texts import check_text
from rich.console import Console
from worked import python

from lavender.report import drawing, figures, write
from lavender.report.page import Page
from lavender.report.render import print_table, write_files
from lavender.report.text import format_power, format_speed, format_time
from tests.report.synthetic import EVIL, FALSE_CLAIM, example, record, report_of, shown, skip


class Reader(html.parser.HTMLParser):
    """Elements of a page that do not close, the files that it loads, ids, links, and alternative texts."""

    VOID = frozenset({"meta", "br", "hr", "img", "input", "link", "path", "use", "rect"})

    def __init__(self, text):
        super().__init__()
        self.open, self.loads, self.ids, self.wrong, self.alts, self.words, self.tags = [], [], [], [], [], [], set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.tags.add(tag)
        self.ids += [values["id"]] if "id" in values else []
        self.loads += [v for k, v in attrs if k in ("src", "srcset", "data")]
        self.loads += [values["href"]] if tag == "link" else []
        if values.get("role") == "img":
            self.alts.append(values["aria-label"])
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_data(self, data):
        if not {"svg", "style", "table"} & set(self.open):
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


def test_page_is_well_formed_and_complete_without_scripts_and_other_files(written):
    text = (written[1] / "index.html").read_text(encoding="utf-8")
    page = Reader(text)
    assert (page.open, page.wrong, page.loads) == ([], [], []) and "script" not in page.tags
    assert len(page.ids) == len(set(page.ids))
    assert "<b>row" not in text and EVIL not in text
    assert len(page.alts) == 3 and all(re.search(r"\d", alt) for alt in page.alts)
    first = text[text.index("<body>") : text.index("<details")]
    assert first.count("<svg") == 3 and "Use auto" in first


def test_texts_of_a_report_with_every_part_are_approved(written):
    """The terminal, the summary and the words of the page outside of its tables, and the tables."""
    report, out, _ = written
    texts = {
        "terminal": shown(report, 120, complete=True), "terminal, short": shown(report, 80),
        "summary.md": (out / "summary.md").read_text(encoding="utf-8"),
        "words of the page": "\n".join(Reader((out / "index.html").read_text(encoding="utf-8")).words),
        **{path.name: path.read_text(encoding="utf-8") for path in sorted((out / "tables").iterdir())},
    }  # fmt: skip
    for name, text in texts.items():
        check_text("report.txt", name, text.replace(str(out.parent), "FOLDER"))


def test_report_write_has_files_of_every_table_figure_and_run(written):
    report, out, events = written
    assert {p.name for p in out.iterdir()} == {"records.csv", "index.html", "summary.md", "figures", "tables"}
    assert {p.stem for p in (out / "tables").glob("*.csv")} == {*report.sections, "matrix"}
    kinds = {kind: {p.stem for p in (out / "figures").glob(f"*.{kind}")} for kind in drawing.FILE_KINDS}
    assert all(names == {"time-to-accuracy", "profile", "error-against-time"} for names in kinds.values())
    for figure in (out / "figures").glob("*.svg"):
        root = ElementTree.parse(figure).getroot()
        assert root.tag.endswith("svg")
        # The page's own background is behind a figure, also a dark one; a PNG is pasted elsewhere.
        background = next(x for x in root.iter() if x.get("id", "").endswith("patch_1"))
        assert "fill: none" in background[0].get("style")
        corner = pytest.importorskip("matplotlib.image").imread(figure.with_suffix(".png"))[0, 0]
        assert (corner == 1.0).all()
    assert (out / "figures" / "profile.pdf").read_bytes().startswith(b"%PDF")
    latex = (out / "tables" / "solvers.tex").read_text(encoding="utf-8")
    assert r"\toprule" in latex and "nan" not in latex.lower()
    assert EVIL not in (out / "summary.md").read_text(encoding="utf-8")
    assert {e.phase for e in events} == {"writing"} and [e.done for e in events] == list(range(events[0].total))


def test_entry_of_bibtex_agrees_with_the_citation_file(written):
    root = Path(__file__).resolve().parents[2]
    lines = (root / "CITATION.cff").read_text(encoding="utf-8").splitlines()
    title, author = (next(x.split(key)[1].strip(' "') for x in lines if key in x) for key in ("title:", "- name:"))
    entry = (written[1] / "tables" / "lavender.bib").read_text(encoding="utf-8")
    assert f"title = {{{{{title}}}}}" in entry and f"author = {{{{{author}}}}}" in entry
    assert "version = {0.1}, year = {2026}" in entry


def test_no_cell_of_a_report_says_nan_or_inf(tmp_path):
    """One solver dies on every problem of a structure, and 45 problems are lines by structure."""
    made = []
    for i in range(45):
        made.append(record(f"case {i}", "auto", 1e-3, 1e-9))
        made.append(record(f"case {i}", "dead", 1.0, float("inf"), status="ERROR", velocity=float("nan"), times=()))
        made.append(record(f"case {i}", "slow", 1.0, 0.5))
    report = report_of(*made)
    write(report, tmp_path, figures=False)
    files = [p.read_text(encoding="utf-8") for p in (tmp_path / "index.html", tmp_path / "tables" / "solvers.tex")]
    for text in (*files, shown(report, complete=True), (tmp_path / "summary.md").read_text(encoding="utf-8")):
        assert not re.search(r"(?i)(?<![a-z-])(nan|inf)(?![a-z])", text)
    csv = pd.read_csv(tmp_path / "tables" / "runs.csv", keep_default_na=False).to_numpy().ravel()
    assert "nan" not in set(map(str, csv))


@pytest.mark.parametrize("width", [60, 80, 120])
def test_terminal_complete_report_stays_within_the_width(written, width):
    out = shown(written[0], width, complete=True)
    assert max(map(len, out.splitlines())) <= width
    for section in written[0].sections.values():
        assert section.title.split()[0] in out


@pytest.mark.parametrize(("cases", "width"), [(1, 60), (45, 80), (45, 10_000)])
def test_terminal_short_report_of_any_size_has_the_answer_first_and_ten_solvers(cases, width):
    made, names = [], [f"case {i} of a folder with a long name" for i in range(cases)]
    for name in names:
        for j in range(14):
            more = {**FALSE_CLAIM, "status_conflict": "says CONVERGED " * 9} if j > 5 else {"load": 9.0}
            made.append(record(name, f"solver_{j}", 1e-3 * (1 + j), 1e-7, **more))
    facts = {
        name: {"structure": f"structure {i}", "diagnostics": ["something looks wrong"]} for i, name in enumerate(names)
    }
    skips = [skip(name, "newton", "takes laws linear") for name in names]
    skips += [skip(name + "b", "", "did not load: " + "x" * 100) for name in names]
    lines = shown(report_of(*made, cases=facts, more=skips), width).splitlines()
    assert max(map(len, lines)) <= width and lines[0].startswith("Use solver_0")
    assert sum(bool(re.match(r"solver_\d+ +\d", line)) for line in lines) == 10
    text = "\n".join(lines)
    assert all(word in text for word in ("false claim, the", "left out", "suspicious", "machine was busy"))


def test_print_table_that_is_too_wide_names_the_columns_that_it_leaves_out():
    name = "worlds/worst_of_a_long_name_1.npz"
    table = pd.DataFrame({"file": [name], **{f"number {i} [m/s]": ["1.234567"] for i in range(12)}})
    out = io.StringIO()
    print_table(Console(file=out, width=80), table, optional=["number 3 [m/s]"])
    text = out.getvalue()
    left_out = text[text.index("not shown: ") :]
    assert left_out.startswith("not shown: number 3 [m/s], number 11 [m/s]") and "number 0" not in left_out
    assert max(map(len, text.splitlines())) <= 80 and "number 0" in " ".join(text.split())
    assert name in "".join(line[:80].split("  ")[0].strip() for line in text.splitlines()[1:]).replace("file", "")


def test_write_files_has_frames_as_csv_and_data_as_json(tmp_path):
    frame = pd.DataFrame({"a": ["<x>"], "time [s]": [2e-3]})
    write_files(tmp_path, {"numbers.json": {"n": 1}, "tables/errors.csv": frame, "a.txt": "text"})
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "tables" / "errors.csv"), frame)
    assert (tmp_path / "numbers.json").read_text() == '{\n "n": 1\n}\n' and (tmp_path / "a.txt").read_text() == "text"


# -- figures ----------------------------------------------------------------------------------------


def test_figures_draw_no_text_outside_of_the_canvas(monkeypatch):
    """Labels at the ends of lines were cut where names of solvers are long."""
    from matplotlib.figure import Figure

    outside, save = [], Figure.savefig

    def check_and_save(self, *given, **more):
        self.canvas.draw()
        width, height = self.get_size_inches() * self.dpi
        for axes in self.axes:
            for text in (*axes.texts, axes.xaxis.label, axes.yaxis.label):
                box = text.get_window_extent()
                if box.x0 < -1 or box.x1 > width + 1 or box.y0 < -1 or box.y1 > height + 1:
                    outside.append((text.get_text(), box))
        return save(self, *given, **more)

    monkeypatch.setattr(Figure, "savefig", check_and_save)
    names = ["auto", "sequential_impulses", "block_gauss_seidel", "a_plug_in_with_a_name_that_is_long"]
    made = [
        record(case, name, 10.0 ** (i - 4), x, tol=tol)
        for case in "ab" for i, name in enumerate(names) for tol, x in ((1e-3, 1e-4), (1e-6, 1e-8))
    ]  # fmt: skip
    report_of(*made).make_page().render()
    assert outside == []


@pytest.mark.parametrize("n", [1, 2, 9])
def test_spread_labels_keeps_order_gap_and_range(n):
    values = np.random.default_rng(n).uniform(0.0, 1.0, n).round(1)
    y = drawing.spread_labels(values, 0.06, 0.0, 1.0)
    order = np.argsort(values, kind="stable")
    assert (np.diff(y[order]) >= 0.06 - 1e-9).all() and y.min() >= -1e-9 and y.max() <= 1.0 + 1e-9


def test_profile_is_the_share_of_cases_within_a_factor_of_the_fastest():
    times = pd.DataFrame({"a": [1.0, 2.0], "b": [4.0, 1.0], "c": [np.nan, 1.0]}, index=["x", "y"])
    svg = figures.draw_profile(times, ["x", "y"], None)
    assert "Solved within twice the fastest time: x 33 %, y 100 %" in svg


def test_style_sheet_has_a_contrast_of_at_least_4_5_in_both_themes():
    """Of every text on the paper and on the cells of a matrix, after the formula of WCAG 2."""
    css = Page("", "", "").render()
    themes = [dict(re.findall(r"--(\w+): (#[0-9a-f]{3,6})", part)) for part in css.split("@media screen")[:2]]

    def luminance(color):
        code = color[1:] if len(color) == 7 else "".join(2 * c for c in color[1:])
        rgb = [int(code[i : i + 2], 16) / 255.0 for i in (0, 2, 4)]
        return np.dot(
            [0.2126, 0.7152, 0.0722], [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in rgb]
        )

    def contrast(one, two):
        low, high = sorted((luminance(one), luminance(two)))
        return (high + 0.05) / (low + 0.05)

    for theme in (themes[0], themes[0] | themes[1]):
        texts = ["ink", "quiet", "link", "bad", "ok", *(f"s{i}" for i in range(5))]
        pairs = [(name, "paper") for name in texts] + [(f"t{i}", f"h{i}") for i in range(5)] + [("bad", "badbg")]
        assert {
            pair: contrast(*(theme[x] for x in pair)) for pair in pairs if contrast(*(theme[x] for x in pair)) < 4.5
        } == {}


def test_formats_have_two_digits_and_units_that_do_not_break():
    assert [format_time(t) for t in (2.5e-8, 8.14e-6, 6.11e-4, 9.99e-4, 0.25, 12.0)] == [
        "0.025\u00a0µs", "8.1\u00a0µs", "611\u00a0µs", "999\u00a0µs", "250\u00a0ms", "12\u00a0s"
    ]  # fmt: skip
    assert [format_speed(v) for v in (0.0, 5e-14, 2.3e-7, 2.3e-4, 0.0234, 1.5, 13.0, np.nan)] == [
        *("0\u00a0m/s", "5e-14\u00a0m/s", "0.23\u00a0µm/s", "0.23\u00a0mm/s", "23\u00a0mm/s", "1.5\u00a0m/s"),
        *("13\u00a0m/s", "–"),
    ]  # fmt: skip
    assert format_speed(0.41, "rad/s") == "0.41\u00a0rad/s" and format_speed(2e-3, "rad/s") == "2\u00a0mrad/s"
    assert [format_power(x) for x in (1e-9, 0.1, 1.0, 100.0, 1e4)] == ["10⁻⁹", "0.1", "1", "100", "10⁴"]


def test_page_of_forty_problems_and_twenty_solvers_has_at_most_150_kb(tmp_path):
    made = [
        record(f"problem {i}", f"solver_{j}", 1e-3 * (1 + j), 1e-8, tol=tol)
        for i in range(20) for j in range(20) for tol in (1e-3, 1e-6)
    ]  # fmt: skip
    write(report_of(*made), tmp_path)
    assert (tmp_path / "index.html").stat().st_size <= 150_000


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
