"""How to choose and the report's page are made of the same records and say the same."""

import re
import sys
from pathlib import Path

import pytest

from lavender import bench

DOCS = Path(__file__).resolve().parent.parent.parent / "docs"
TOLERANCES = (1e-3, 1e-6)


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """The generated pages of a small measurement."""
    sys.path.insert(0, str(DOCS))
    try:
        import generate
    finally:
        sys.path.remove(str(DOCS))
    folder = tmp_path_factory.mktemp("pages")
    plan = bench.Plan(TOLERANCES, budgets=(4,), repeats=1, time_limit=0.2, warm=False, orders=())
    cases = ("stack(n=8)", "box_stackF(n=2)", "chain(n=5)")
    records = bench.run(
        cases, ("auto", "direct", "newton", "sequential_impulses"), plan, folder / "r.jsonl"
    ).select_latest_run()
    generate.TOLERANCES, kept = TOLERANCES, generate.TOLERANCES
    try:
        generate.measured_page(generate.Site(folder), records, {})
    finally:
        generate.TOLERANCES = kept
    return folder


def plain(cell):
    """Words of a cell: of markdown or HTML, without marks, lines and what only the page adds."""
    cell = re.sub(r"<span[^>]*>(worst|p95)[^<]*</span>", " ", cell)
    cell = re.sub(r'<span class="warn">([^<]*)</span>', r"(\1)", cell)
    return " ".join(re.sub(r"<[^>]*>|\*\*", " ", cell).split())


def test_every_cell_is_that_of_the_report(pages):
    lines = (pages / "measured.md").read_text(encoding="utf-8").splitlines()
    cells = [[plain(c) for c in line.strip("| ").split(" | ")] for line in lines if line.startswith("| ")]
    to_tolerance, in_time = cells[: len(cells) // 2], cells[len(cells) // 2 :]  # two tables there, one here
    shown = [[*a, *b[1:]] for a, b in zip(to_tolerance, in_time, strict=True)]
    html = (pages / "report.html").read_text(encoding="utf-8")
    body = re.search(r'<table class="advice">(.*?)</table>', html, re.DOTALL)[1]
    rows = [
        [plain(c) for c in re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.DOTALL)]
        for row in re.findall(r"<tr>(.*?)</tr>", body, re.DOTALL)
    ]
    assert [[c.replace(" / ", " ") for c in row] for row in rows] == shown
    assert len(rows) >= 3
    names = {cell.split()[0] for row in rows[1:] for cell in row[1:]}
    assert names <= {"auto", "direct", "newton", "sequential_impulses", "none"} and names


def test_the_page_of_measurements_leads_to_the_report(pages):
    assert "(report.html)" in (pages / "measured.md").read_text(encoding="utf-8")
