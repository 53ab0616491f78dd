"""The report as one self-contained HTML file: no network, dark and light, phone and print."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

from lavender.base.deadline import seconds
from lavender.lab.bench.record import file_name, level_name
from lavender.lab.bench.store import Records
from lavender.lab.report import choices, contents, tables
from lavender.lab.report.curves import Figures
from lavender.lab.report.findings import Report
from lavender.lab.report.svg import svg
from lavender.lab.report.tables import NOISE, RESIDUAL_NOISE
from lavender.lab.report.text import count, left_out, residual, suspicions, without
from lavender.lab.report.verdict import Verdict

MOST = 500  # failures on a page, for its weight: 200 problems are to fit into 3 MB
MOST_SPREADS = 100  # widest spreads of sweep orders on a page


@functools.cache
def environment() -> Any:
    """The templates, compiled once."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("lavender.lab.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(seconds=seconds, residual=residual, level=level_name, anchor=file_name)
    environment.globals.update(
        contents=contents, tables=tables, count=count, without=without, isfinite=math.isfinite
    )
    environment.globals.update(
        noise=NOISE, residual_noise=RESIDUAL_NOISE, most=MOST, most_spreads=MOST_SPREADS
    )
    return environment


def page(report: Report, figures: Figures, saved: bool = True) -> str:
    """The whole page. Every text that came from a file, a problem or a backend is escaped.

    `figures` are those of the report's records; `saved`: they are beside the page as SVG and PNG.
    """
    records = report.records
    return environment().get_template("index.html.j2").render(
        report=report, records=records, verdict=report.verdict, levels=report.levels, saved=saved,
        level=report.levels[len(report.levels) // 2], links=_links(report.lines), left_out=left_out(records),
        suspicions=suspicions(records), **_drawings(records, figures, report.verdict), **_cases(report),
    )  # fmt: skip


def _drawings(records: Records, figures: Figures, found: Verdict) -> dict[str, Any]:
    """The figures, and by section the names of its own; of motion errors beside those of residuals."""
    names = sorted({r.solver for r in records} | {c.solver for f in figures for c in f.curves})
    number = {name: i for i, name in enumerate(names)}
    # Under the heading of a case its name says nothing new.
    own = [f.name for some in figures.cases.values() for f in some]
    titles = {name: "" for plain in own for name in (plain, f"motion {plain}")}
    return {
        "drawings": {  # each escapes what it holds
            file_name(figure.name): svg(figure, number, found.leaders, titles.get(figure.name))
            for figure in figures
        },
        "solvers": names,
        "number": number,
        "by_motion": figures.moved is not None,
        "drawn": _keys(figures),
        "moved_drawn": _keys(figures.moved or Figures()),
    }


def _keys(figures: Figures) -> dict[str, dict[str, list[str]]]:
    return {
        place: {name: [file_name(figure.name) for figure in some] for name, some in group.items()}
        for place, group in figures.places.items()
    }


def _cases(report: Report) -> dict[str, Any]:
    """Each case with its solvers; none of a campaign: of thousands the tables over all of them say it."""
    records, levels = report.records, report.levels
    by_case: dict[str, list[tables.Reach]] = {}
    if not report.is_campaign:
        for reach in tables.reaches(records, levels):
            by_case.setdefault(reach.case, []).append(reach)
    level = levels[len(levels) // 2]
    fastest = {name: _fastest(rows, level) for name, rows in by_case.items()}
    stored = any(math.isfinite(x.stored) for x in records.cases.values())
    cases = [
        {"info": records.cases[name], "reaches": contents.reach_table(rows, levels).without("case")}
        for name, rows in by_case.items()
    ]
    return {
        "cases": cases,
        "case_list": contents.case_table(records, fastest, level, stored),
        "difficulty": contents.difficulty_table(tables.difficulties(records) if cases else []),
    }


def _links(lines: Sequence[choices.Line]) -> dict[str, str]:
    """Where on the page more is said of a structure or sequence."""
    parts = {line.name: "sequence" if line.sequence else "family" for line in lines}
    return {name: f"{part}-{file_name(name)}" for name, part in parts.items()}


def _fastest(rows: Sequence[tables.Reach], level: float) -> tables.Reach | None:
    """Who brings a case to the level first, from a cold start, with claims that hold."""
    honest = [
        r for r in rows if r.start == "cold" and not r.status_conflict and math.isfinite(r.times[level])
    ]
    return min(honest, key=lambda r: r.times[level], default=None)
