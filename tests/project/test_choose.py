"""How to choose and the report's page are made of the same records and say the same."""

import re
import sys
from pathlib import Path

import pytest

from lavender.report import Plan, Report, run, tables

DOCS = Path(__file__).resolve().parent.parent.parent / "docs"
TOLERANCES = (1e-3, 1e-6)


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """The folder of the generated pages of a small measurement, and its report."""
    sys.path.insert(0, str(DOCS))
    try:
        import generate
    finally:
        sys.path.remove(str(DOCS))
    folder = tmp_path_factory.mktemp("pages")
    plan = Plan(TOLERANCES, budgets=(4,), repeats=1, time_limit=0.2, warm=False, orders=())
    cases = ("stack(n=8)", "box_stackF(n=2)", "chain(n=5)")
    report = Report(run(cases, ("auto", "direct", "newton", "sequential_impulses"), plan, folder / "r.jsonl"))
    generate.TOLERANCES, kept = TOLERANCES, generate.TOLERANCES
    try:
        generate.measured_page(generate.Site(folder), report, {})
    finally:
        generate.TOLERANCES = kept
    return folder, report


def test_measured_page_has_the_solvers_of_the_report(pages):
    folder, report = pages
    lines = (folder / "measured.md").read_text(encoding="utf-8").splitlines()
    cells = [line.strip("| ").split(" | ") for line in lines if line.startswith("| ")]
    (head,) = (i for i, row in enumerate(cells) if row[0] == "structure")
    html = (folder / "report.html").read_text(encoding="utf-8")
    frame = tables.tabulate_fastest(report)
    rows = cells[head + 1 : head + 1 + len(frame)]
    named = [[re.match(r"\*\*(.*?)\*\*", cell)[1] for cell in row[1:]] for row in rows]
    assert named == [[names.partition(" ≈ ")[0] for names in row[2::2]] for row in frame.values.tolist()]
    assert len(frame) >= 3
    for name in frame["structure"]:
        assert f"<td>{name}</td>" in html


def test_measured_page_links_to_the_report(pages):
    assert "(report.html)" in (pages[0] / "measured.md").read_text(encoding="utf-8")
