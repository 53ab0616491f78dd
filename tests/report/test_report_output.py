"""Terminal, page, files and figures of one report in which every part has something to show."""

import html.parser
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from approved_texts import check_text
from rich.console import Console

from lavender.report import drawing, figures, write
from lavender.report.render import print_table, write_files
from tests.report.synthetic import EVIL, FALSE_CLAIM, example, record, report_of, shown, skip


class Reader(html.parser.HTMLParser):
    """Elements of a page that do not close, the files that it loads, ids, links, and alternative texts."""

    VOID = frozenset({"meta", "br", "hr", "img", "input", "link", "path", "use", "rect", "wbr"})

    def __init__(self, text):
        super().__init__()
        self.open = []
        self.loads = []
        self.ids = []
        self.wrong = []
        self.alts = []
        self.words = []
        self.tags = set()
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
    report = example(folder)
    events = []
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
        "terminal": shown(report, 120, complete=True),
        "terminal, short": shown(report, 80),
        "summary.md": (out / "summary.md").read_text(encoding="utf-8"),
        "words of the page": "\n".join(
            Reader((out / "index.html").read_text(encoding="utf-8")).words
        ),
        **{
            path.name: path.read_text(encoding="utf-8")
            for path in sorted((out / "tables").iterdir())
        },
    }
    for name, text in texts.items():
        check_text("report.txt", name, text.replace(str(out.parent), "FOLDER"))


def test_report_write_has_files_of_every_table_figure_and_run(written):
    report, out, events = written
    assert {p.name for p in out.iterdir()} == {
        "records.csv",
        "index.html",
        "summary.md",
        "figures",
        "tables",
    }
    assert {p.stem for p in (out / "tables").glob("*.csv")} == {*report.sections, "matrix"}
    kinds = {
        kind: {p.stem for p in (out / "figures").glob(f"*.{kind}")} for kind in drawing.FILE_KINDS
    }
    assert all(
        names == {"time-to-accuracy", "profile", "error-against-time"} for names in kinds.values()
    )
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
    assert {e.phase for e in events} == {"writing"} and [e.done for e in events] == list(
        range(events[0].total)
    )


def test_entry_of_bibtex_agrees_with_the_citation_file(written):
    root = Path(__file__).resolve().parents[2]
    lines = (root / "CITATION.cff").read_text(encoding="utf-8").splitlines()
    title, author = (
        next(x.split(key)[1].strip(' "') for x in lines if key in x)
        for key in ("title:", "- name:")
    )
    entry = (written[1] / "tables" / "lavender.bib").read_text(encoding="utf-8")
    assert f"title = {{{{{title}}}}}" in entry and f"author = {{{{{author}}}}}" in entry
    assert "version = {0.1},\n  year = {2026}" in entry


def test_no_cell_of_a_report_says_nan_or_inf(tmp_path):
    """One solver dies on every problem of a structure, and 45 problems are lines by structure."""
    made = []
    for i in range(45):
        made.append(record(f"case {i}", "auto", 1e-3, 1e-9))
        made.append(
            record(
                f"case {i}",
                "dead",
                1.0,
                float("inf"),
                status="ERROR",
                velocity=float("nan"),
                times=(),
            )
        )
        made.append(record(f"case {i}", "slow", 1.0, 0.5))
    report = report_of(*made)
    write(report, tmp_path, figures=False)
    files = [
        p.read_text(encoding="utf-8")
        for p in (tmp_path / "index.html", tmp_path / "tables" / "solvers.tex")
    ]
    for text in (
        *files,
        shown(report, complete=True),
        (tmp_path / "summary.md").read_text(encoding="utf-8"),
    ):
        assert not re.search(r"(?i)(?<![a-z-])(nan|inf)(?![a-z])", text)
    csv = pd.read_csv(tmp_path / "tables" / "runs.csv", keep_default_na=False).to_numpy().ravel()
    assert "nan" not in set(map(str, csv))


@pytest.mark.parametrize(("cases", "width"), [(1, 60), (45, 80), (45, 10_000)])
def test_terminal_short_report_of_any_size_has_the_answer_first_and_ten_solvers(cases, width):
    made = []
    names = [f"case {i} of a folder with a long name" for i in range(cases)]
    for name in names:
        for j in range(14):
            more = (
                {**FALSE_CLAIM, "status_conflict": "says CONVERGED " * 9}
                if j > 5
                else {"load": 9.0}
            )
            made.append(record(name, f"solver_{j}", 1e-3 * (1 + j), 1e-7, **more))
    facts = {
        name: {"structure": f"structure {i}", "diagnostics": ["something looks wrong"]}
        for i, name in enumerate(names)
    }
    skips = [skip(name, "newton", "takes laws linear") for name in names]
    skips += [skip(name + "b", "", "did not load: " + "x" * 100) for name in names]
    lines = shown(report_of(*made, cases=facts, more=skips), width).splitlines()
    assert max(map(len, lines)) <= width and lines[0].startswith("Use solver_0")
    assert sum(bool(re.match(r"solver_\d+ +\d", line)) for line in lines) == 10
    text = "\n".join(lines)
    assert all(
        word in text for word in ("false claim, the", "left out", "suspicious", "machine was busy")
    )


def test_write_files_has_frames_as_csv_and_data_as_json(tmp_path):
    frame = pd.DataFrame({"a": ["<x>"], "time [s]": [2e-3]})
    write_files(tmp_path, {"numbers.json": {"n": 1}, "tables/errors.csv": frame, "a.txt": "text"})
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "tables" / "errors.csv"), frame)
    assert (tmp_path / "numbers.json").read_text() == '{\n "n": 1\n}\n' and (
        tmp_path / "a.txt"
    ).read_text() == "text"


def test_profile_is_the_share_of_cases_within_a_factor_of_the_fastest():
    times = pd.DataFrame({"a": [1.0, 2.0], "b": [4.0, 1.0], "c": [np.nan, 1.0]}, index=["x", "y"])
    svg = figures.draw_profile(times, ["x", "y"], None)
    assert "Solved within twice the fastest time: x 33 %, y 100 %" in svg


def test_page_of_forty_problems_and_twenty_solvers_is_within_150_kb(tmp_path):
    made = [
        record(f"problem {i}", f"solver_{j}", 1e-3 * (1 + j), 1e-8, tol=tol)
        for i in range(20)
        for j in range(20)
        for tol in (1e-3, 1e-6)
    ]
    write(report_of(*made), tmp_path)
    assert (tmp_path / "index.html").stat().st_size <= 150_000


@pytest.mark.parametrize("close", [1e-9, 1e-6, 2e-5, 1e-4, 1e-2])
def test_strip_of_errors_names_each_colour_once_and_shows_the_limit(close):
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    errors = np.array([[0.0, 0.99e-4, 1.01e-4, 1.0, np.nan]])
    drawing.draw_error_strip(axes, errors, close, limit=1e-4, extent=(0, 5, 1, 0))
    names = [text.get_text() for text in axes.texts]
    assert len(set(names)) == len(names) and "≤ 0.1\u00a0mm/s" in names and names[-1] == "more"
    _, below, above, far, empty = axes.images[0].get_array()[0].tolist()
    orange = [list(color) for color in drawing.ERROR_COLORS[-2:]]
    assert [above, far] == orange and below not in orange and empty == [0.0] * 4


@pytest.mark.parametrize(
    ("width", "head"), [(19, ["iterations,", "cold"]), (16, ["iteratio", "ns, cold"])]
)
def test_head_of_a_table_folds_between_words_if_the_table_fits(width, head):
    console = Console(width=width, record=True)
    print_table(console, pd.DataFrame({"solver": ["pgs"], "iterations, cold": [8]}))
    lines = console.export_text().split("\n")
    assert [line.removeprefix("solver").strip() for line in lines[:2]] == head
