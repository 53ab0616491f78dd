"""Render the report as one HTML file without external parts, for dark and light themes, phones and print."""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Any

from lavender.base.errors import require_packages
from lavender.report.figures import build_figures, list_solvers
from lavender.report.findings import Report
from lavender.report.plotting import assign_styles, draw_figures
from lavender.report.records import make_file_name
from lavender.report.tables import select_failures
from lavender.report.text import format_count, list_cases_not_loaded, list_diagnostics


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
    environment.filters.update(anchor=make_file_name, numbers=keep_numbers_together)
    environment.globals.update(format_count=format_count)
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


def render_page(report: Report, figures: bool = True, folder: Path | None = None) -> str:
    """Return the page as HTML. Every text from a file, a problem or a backend is escaped.

    With `folder`, each figure is also written there as an SVG file, to which the page does not refer.
    """
    built = build_figures(report) if figures else []
    drawn = draw_figures(built, assign_styles(list_solvers(built)), folder)
    return str(
        create_environment().get_template("index.html.j2").render(
            title="lavender report", report=report, drawn=drawn,
            left_out=list_cases_not_loaded(report.records), diagnostics=list_diagnostics(report.records),
            n_failures=len(select_failures(report)) if len(report.frame) else 0,
        )
    )  # fmt: skip
