"""One report with everything in it, compared with the files in `golden` as a whole.

To write these anew after a change on purpose: LAVENDER_UPDATE_GOLDEN=1 python -m pytest tests/report/test_golden.py
"""

import html.parser
import os
import re
from pathlib import Path

import pytest

from lavender.report.figures import build_figures
from lavender.report.write import write
from tests.report.synthetic import EVIL, example, shown

GOLDEN = Path(__file__).with_name("golden")


class Page(html.parser.HTMLParser):
    """The text of a page, what it loads, and whether its elements close."""

    VOID = frozenset({"meta", "br", "hr", "img", "input", "link"})
    LINES = frozenset({"p", "tr", "li", "pre", "summary", "h1", "h2", "h3", "h4", "dt", "label"})

    def __init__(self, text):
        super().__init__()
        self.open, self.loads, self.ids, self.links, self.wrong, self.text = [], [], set(), set(), [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.ids.add(values.get("id"))
        if values.get("href", "").startswith("#"):
            self.links.add(values["href"][1:])
        self.loads += [v for k, v in attrs if k in ("src", "srcset", "data")]
        self.loads += [values["href"]] if tag == "link" else []
        if tag not in self.VOID:
            self.open.append(tag)
        # Folded parts, marked rows and cells, and the place of a drawing are part of what a page shows.
        bad = " bad" if values.get("class") == "bad" else ""
        folded = " open" if tag == "details" and "open" in values else ""
        mark = {"tr": f"\n|{bad}", "td": " | ", "th": " | ", "details": f"\n<details{folded}>"}
        if tag == "svg":
            self.text.append(f"\n[drawing of {values['aria-label']}:")
        elif "data-l" in values:
            self.text.append(f" {values['data-l']},")
        self.text.append(mark.get(tag, "\n" if tag in self.LINES else ""))

    def handle_endtag(self, tag):
        if self.open.pop() != tag:
            self.wrong.append(tag)
        self.text.append("]" if tag == "svg" else "")

    def handle_data(self, data):
        if "svg" in self.open and data.endswith(("[-]", "[m/s]", "[%]")):  # the title of the vertical axis
            self.text.append(f" {data} of")
        elif not {"style", "script", "svg", "title"} & set(self.open):
            self.text.append(" ".join(data.split()) + " " * data[-1:].isspace())

    @property
    def shown(self):
        lines = (" ".join(line.split()) for line in "".join(self.text).splitlines())
        return "\n".join(line for line in lines if line) + "\n"


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("golden") / "steps"
    folder.mkdir()
    found = example(folder)
    write(found, folder / "out")
    return found, folder


def check(name, text, folder):
    text = "\n".join(line.rstrip() for line in text.replace(str(folder), "FOLDER").splitlines()) + "\n"
    if os.environ.get("LAVENDER_UPDATE_GOLDEN"):
        GOLDEN.mkdir(exist_ok=True)
        (GOLDEN / name).write_text(text, encoding="utf-8")
    assert text == (GOLDEN / name).read_text(encoding="utf-8")


def test_the_terminal_shows_the_recommendation_first_and_everything_on_request(written):
    found, folder = written
    check("terminal.txt", shown(found, 100), folder)
    check("tables.txt", shown(found, 150, complete=True), folder)


def test_the_page_is_well_formed_stands_alone_and_shows_every_part(written):
    found, folder = written
    text = (folder / "out" / "index.html").read_text(encoding="utf-8")
    page = Page(text)
    assert (page.open, page.wrong, page.loads) == ([], [], [])
    assert page.links <= page.ids
    assert "<script>alert" not in text and "<b>row" not in text and EVIL not in text
    drawn = build_figures(found.ranked_records)
    assert text.count("<svg") == len(list(drawn))
    first = text[text.index("<body>") : text.index('<details class="part"')]
    assert first.count("<svg") == 1 and 'class="b"' in first and "<table" not in first
    check("page.txt", page.shown, folder)


def test_the_summary(written):
    _, folder = written
    out = folder / "out"
    summary = (out / "summary.md").read_text(encoding="utf-8")
    check("summary.md", re.sub(r"(?m)^\|.*\n", "", summary), folder)  # its tables are those of tables.txt
    assert len(re.findall(r"(?m)^\| pile \|", summary)) > 10


def test_files_are_whole(written):
    found, folder = written
    out = folder / "out"
    assert {p.name for p in out.iterdir()} == {
        "records.csv", "records.json", "index.html", "summary.md", "figures"
    }  # fmt: skip
    saved = {p.name for p in (out / "figures").iterdir()}
    assert len(saved) == 2 * len(list(build_figures(found.ranked_records)))
    assert all(p.stat().st_size > 1000 for p in (out / "figures").iterdir())
