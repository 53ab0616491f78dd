"""The report as one self-contained HTML file: no network, dark and light, phone and print."""

from __future__ import annotations

import importlib.util
import json
import math
from functools import cache
from pathlib import Path
from typing import Any

from lavender.bench.record import level_name
from lavender.bench.store import Records
from lavender.report import curves, tables
from lavender.report.draw import file_name, plotly_data
from lavender.report.style import looks
from lavender.report.text import residual, seconds

__all__ = ["page"]


@cache
def plotly_source() -> str:
    """plotly.js as it ships in the Python package plotly, to embed."""
    spec = importlib.util.find_spec("plotly")
    assert spec is not None and spec.submodule_search_locations  # a dependency of lavender
    source = Path(spec.submodule_search_locations[0], "package_data", "plotly.min.js").read_text(
        encoding="utf-8"
    )
    # Nothing inside may end the script element that holds it.
    return source.replace("</script", "<\\/script")


def page(records: Records, title: str = "lavender report", old: Records | None = None) -> str:
    """The whole page. Every text that came from a file, a problem or a backend is escaped."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("lavender.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(seconds=seconds, residual=residual, level=level_name, anchor=file_name)
    content = _content(records, old)
    figures = json.dumps(content.pop("figures"), allow_nan=False).replace("<", "\\u003c")
    return environment.get_template("index.html.j2").render(
        title=title,
        figures_json=figures,
        plotly=plotly_source(),
        inf=math.inf,
        isfinite=math.isfinite,
        **content,
    )


def _content(records: Records, old: Records | None) -> dict[str, Any]:
    look = looks(r.solver for r in records)
    levels = tables.levels_of(records)
    figures: dict[str, Any] = {}

    def add(figure: curves.Figure) -> str:
        if not figure.curves:
            return ""
        key = file_name(figure.name)
        figures[key] = plotly_data(figure, look)
        return key

    by_case: dict[str, list[tables.Reach]] = {}
    for reach in tables.reaches(records, levels):
        by_case.setdefault(reach.case, []).append(reach)
    if tables.is_campaign(records):
        by_case = {}  # thousands of them: the tables over all say it
    cases = [
        {
            "info": records.cases[name],
            "reaches": rows,
            "work_precision": add(curves.work_precision(records, name)),
            "budget": add(curves.budget_figure(records, name)),
        }
        for name, rows in by_case.items()
    ]
    families = tables.families(records)
    family_figures = {
        f: add(curves.family_figure(records, f, cs)) for f, cs in families.items() if len(cs) > 1
    }
    profiles: dict[str, list[str]] = {}
    for profile in tables.profiles(records):
        if profile.cases > 1:
            key = add(curves.profile_figure(profile))
            if key:
                profiles.setdefault(profile.law, []).append(key)
    walks = tables.walks(records)
    middle = sorted({w.max_iter for w in walks if w.mode == "budget"})
    shown = (
        [w for w in walks if w.mode == "budget" and w.max_iter == middle[len(middle) // 2]] if middle else []
    )
    changes = tables.changes(old, records) if old is not None else []
    advice_level, advice_time = tables.advice_by_level(records), tables.advice_by_time(records)
    return {
        "figures": figures,
        "runs": list(records.runs.values()),
        "levels": levels,
        "times": tables.time_budgets(records),
        "families": families,
        "family_figures": family_figures,
        "by_level": {(a.family, a.target): a for a in advice_level},
        "by_time": {(a.family, a.target): a for a in advice_time},
        "claims": tables.claims(records),
        "failures": tables.failures(records),
        "cases": cases,
        "profiles": profiles,
        "means": tables.geometric_means(records),
        "shift": tables.shift_of(records),
        "limit": tables.limit_of(records),
        "spreads": sorted(tables.spreads(records), key=lambda s: -s.factor),
        "lost": [s for s in records.skips if not s.solver],
        "refused": [s for s in records.skips if s.solver],
        "campaign": tables.is_campaign(records),
        "robustness": tables.robustness(records) if tables.is_campaign(records) else [],
        "budgets": sorted({r.max_iter for r in records if r.mode == "budget"}),
        "walks": walks,
        "walk_figures": [key for key in (add(curves.walk_figure(w)) for w in shown) if key],
        "compared": old is not None,
        "changes": [c for c in changes if c.kind != "same"],
        "n_changes": len(changes),
        "n_records": len(records),
        "n_cases": len({r.case for r in records}),
        "look": look,
    }
