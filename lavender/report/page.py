"""Render the report as one HTML file without external parts, for dark and light themes, phones and print."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Sequence
from typing import Any

from lavender.base.deadline import format_seconds
from lavender.base.errors import require_packages
from lavender.report import table_specs
from lavender.report.bench import recommendation, statistics
from lavender.report.bench.record import format_tolerance, make_file_name
from lavender.report.bench.statistics import RESIDUAL_NOISE_FACTOR, TIME_NOISE_FACTOR
from lavender.report.bench.store import Records
from lavender.report.figures import FLAT_LINES_NOTE, Figures, is_plug_in
from lavender.report.findings import Report
from lavender.report.plotting import plot_for_page
from lavender.report.text import (
    format_count,
    format_left_out_count,
    format_residual,
    list_cases_not_loaded,
    list_diagnostics,
)
from lavender.report.verdict import Verdict

# Number of solvers that the page initially draws in colour; the style sheet has this many colours.
MAX_NAMED = 7
MAX_FAILURES = 500  # Largest number of failures on a page; a page of 200 problems then has less than 3 MB.
# Largest number of comparisons of sweep orders on a page; those with the widest spread are kept.
MAX_SPREADS = 100


@functools.cache
def create_environment() -> Any:
    """Compile the templates, once."""
    require_packages("the page of a report", "jinja2")
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("lavender.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        seconds=format_seconds,
        residual=format_residual,
        tolerance=format_tolerance,
        anchor=make_file_name,
        numbers=keep_numbers_together,
    )
    environment.globals.update(
        table_specs=table_specs,
        statistics=statistics,
        format_count=format_count,
        format_left_out_count=format_left_out_count,
        isfinite=math.isfinite,
    )
    environment.globals.update(
        noise=TIME_NOISE_FACTOR,
        residual_noise=RESIDUAL_NOISE_FACTOR,
        max_failures=MAX_FAILURES,
        max_spreads=MAX_SPREADS,
        flat_lines_note=FLAT_LINES_NOTE,
    )
    return environment


#: Matches texts that are not broken across lines: a number with exponent or unit, a unit in brackets, or an option.
NUMBER = re.compile(
    r"(?<![\w.])\d[\d.]*(?:e-?\d+(?:\s(?:m/s|N\ss|√J))?|\s(?:µs|ms|s|m/s|rad/s|N\ss|√J|%|times|iterations?|sweeps?))"
    r"(?!\w)|(?<![\w-])--[a-z][a-z-]*|\[[^\]]{1,24}\]"
)


def keep_numbers_together(text: str) -> Any:
    """Return escaped HTML in which each number stays on one line with its exponent and unit."""
    from jinja2.filters import do_forceescape, do_mark_safe

    return do_mark_safe(NUMBER.sub(r'<span class="v">\g<0></span>', str(do_forceescape(text))))


def render_page(report: Report, figures: Figures, saved: bool = True) -> str:
    """Return the page as HTML. Every text from a file, a problem or a backend is escaped.

    `figures` are the figures of the report's records. If `saved` is true, they are also SVG and PNG files in the
    page's folder, to which the page links.
    """
    records = report.ranked_records
    return create_environment().get_template("index.html.j2").render(
        report=report, records=records, verdict=report.verdict, tolerances=report.tolerances, saved=saved,
        tolerance=report.tolerances[len(report.tolerances) // 2],
        links=_map_rankings_to_anchors(report.rankings), left_out=list_cases_not_loaded(records),
        diagnostics=list_diagnostics(records), **_render_drawings(records, figures, report.verdict),
        **_describe_cases(report),
    )  # fmt: skip


def _render_drawings(records: Records, figures: Figures, verdict: Verdict) -> dict[str, Any]:
    """Return the SVG drawings by name, and the names of the drawings in each section of the page."""
    names = sorted({r.solver for r in records} | {c.solver for f in figures for c in f.curves})
    number = {name: i for i, name in enumerate(names)}
    named = [*verdict.leaders, *(name for name in names if is_plug_in(name) and name not in verdict.leaders)]
    # The drawings of a case have no title: the heading above them is the name of the case.
    titles = {f.name: "" for some in figures.cases.values() for f in some}
    return {
        "drawings": {  # The texts of the drawings are escaped.
            make_file_name(figure.name): plot_for_page(figure, number, named, titles.get(figure.name))
            for figure in figures
        },
        "solvers": names,
        "named": named[:MAX_NAMED],
        "number": number,
        # Names of the drawings by section of the page and by subject (case, law or sequence).
        "drawn": {
            place: {name: [make_file_name(figure.name) for figure in some] for name, some in group.items()}
            for place, group in figures.groups_by_section.items()
        },
    }


def _describe_cases(report: Report) -> dict[str, Any]:
    """Return the tables of each case; none for a campaign, which has thousands of cases."""
    records, tolerances = report.ranked_records, report.tolerances
    by_case: dict[str, list[statistics.Reach]] = {}
    if not report.is_campaign:
        for reach in statistics.summarize_runs_by_case(records, tolerances):
            by_case.setdefault(reach.case, []).append(reach)
    tolerance = tolerances[len(tolerances) // 2]
    fastest = {name: _select_fastest(rows, tolerance) for name, rows in by_case.items()}
    stored = any(math.isfinite(x.stored) for x in records.cases.values())
    cases = [
        {
            "info": records.cases[name],
            "reaches": table_specs.tabulate_times_to_tolerances(rows, tolerances).without_columns("case"),
        }
        for name, rows in by_case.items()
    ]
    return {
        "cases": cases,
        "case_list": table_specs.tabulate_cases(records, fastest, tolerance, stored),
        "difficulty": table_specs.tabulate_difficulties(
            statistics.compute_difficulties(records) if cases else []
        ),
    }


def _map_rankings_to_anchors(lines: Sequence[recommendation.FamilyAdvice]) -> dict[str, str]:
    """Return, for each structure and sequence, the id of the part of the page that describes it."""
    parts = {line.name: "sequence" if line.sequence else "family" for line in lines}
    return {name: f"{part}-{make_file_name(name)}" for name, part in parts.items()}


def _select_fastest(rows: Sequence[statistics.Reach], tolerance: float) -> statistics.Reach | None:
    """Return the fastest solver to the tolerance from a cold start, without a false claim."""
    candidates = [
        r for r in rows if r.start == "cold" and not r.status_conflict and math.isfinite(r.times[tolerance])
    ]
    return min(candidates, key=lambda r: r.times[tolerance], default=None)
