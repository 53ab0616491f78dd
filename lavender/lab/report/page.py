"""The report as one self-contained HTML file: no network, dark and light, phone and print."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

from lavender.base.deadline import seconds
from lavender.lab.bench.record import file_name, level_name
from lavender.lab.bench.store import Records
from lavender.lab.report import contents, tables
from lavender.lab.report.curves import Figures
from lavender.lab.report.findings import Report
from lavender.lab.report.svg import svg
from lavender.lab.report.tables.advice import NOISE, RESIDUAL_NOISE
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
    return environment


def page(report: Report, figures: Figures, saved: bool = True) -> str:
    """The whole page. Every text that came from a file, a problem or a backend is escaped.

    Parameters
    ----------
    report : Report
    figures : Figures
        Of its records: `curves.figures`.
    saved : bool
        The figures are beside the page as SVG and PNG.
    """
    return environment().get_template("index.html.j2").render(
        saved=saved, count=count, inf=math.inf, isfinite=math.isfinite, **_content(report, figures)
    )  # fmt: skip


def _content(report: Report, figures: Figures) -> dict[str, Any]:
    """Everything that the template names."""
    records, found, levels, campaign = report.records, report.verdict, report.levels, report.is_campaign
    failures = tables.failures(records)
    spreads = sorted(tables.spreads(records), key=lambda s: -s.factor)
    return {
        **_drawings(records, figures, found),
        **_cases(records, levels),
        **_changes(report.before, records),
        "verdict": found,
        "busy": report.busy,
        "idle": contents.idle_table(report.every),
        "suspicions": suspicions(records),
        "left_out": left_out(records),
        "engines": contents.engine_table(report.engines),
        "moved": None if campaign else contents.moved_table(report),
        "speed_advice": None if campaign else contents.speed_table(report),
        "noise": NOISE,
        "residual_noise": RESIDUAL_NOISE,
        "level": levels[len(levels) // 2],
        "runs": list(records.runs.values()),
        "levels": levels,
        "advice": contents.advice_table(report, _links(report.lines)),
        "swept": contents.sweeps_table(report.lines),
        "families": tables.families(records),
        "claims": contents.claim_table(records),
        "n_failures": len(failures),
        "failures": contents.failure_table(failures[:MOST], campaign),
        "most": MOST,
        "most_spreads": MOST_SPREADS,
        "means": {law: contents.mean_table(by) for law, by in tables.geometric_means(records).items()},
        "backends": contents.backend_table(records),
        "shift": tables.SHIFT,
        "limit": tables.limit_of(records),
        "n_spreads": len(spreads),
        "spreads": contents.spread_table(spreads[:MOST_SPREADS]),
        "lost": [s for s in records.skips if not s.solver],
        "refused": contents.skip_table([s for s in records.skips if s.solver]),
        "campaign": campaign,
        "robustness": contents.robustness_table(tables.robustness(records) if campaign else [], levels),
        "robustness_by_speed": contents.robustness_table(
            tables.robustness(report.by_speed) if campaign else [], report.speeds, " m/s"
        ),
        "sequences": {
            name: contents.pass_table(passes).without("sequence", "steps")
            for name, passes in tables.by_sequence(records).items()
        },
        "steps": {
            name: f"{passes[0].steps} steps{without(passes[0].left_out)}"
            for name, passes in tables.by_sequence(records).items()
        },
        "n_records": len(records),
        "n_cases": len({r.case for r in records}),
    }


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


def _cases(records: Records, levels: Sequence[float]) -> dict[str, Any]:
    """Each case with its solvers; none of a campaign: of thousands the tables over all of them say it."""
    by_case: dict[str, list[tables.Reach]] = {}
    if not tables.is_campaign(records):
        for reach in tables.reaches(records, levels):
            by_case.setdefault(reach.case, []).append(reach)
    level = levels[len(levels) // 2]
    fastest = {name: _fastest(rows, level) for name, rows in by_case.items()}
    stored = any(math.isfinite(x.stored) for x in records.cases.values())
    cases = [
        {
            "info": records.cases[name],
            "reaches": contents.reach_table(rows, levels).without("case"),
        }
        for name, rows in by_case.items()
    ]
    return {
        "cases": cases,
        "case_list": contents.case_table(records, fastest, level, stored),
        "difficulty": contents.difficulty_table(tables.difficulties(records) if cases else []),
        "difficulty_note": contents.DIFFICULTY,
    }


def _links(lines: Sequence[tables.Line]) -> dict[str, str]:
    """Where on the page more is said of a structure or sequence."""
    parts = {line.name: "sequence" if line.sequence else "family" for line in lines}
    return {name: f"{part}-{file_name(name)}" for name, part in parts.items()}


def _changes(old: Records | None, records: Records) -> dict[str, Any]:
    """What differs from an earlier run beyond noise."""
    found = tables.changes(old, records) if old is not None else []
    return {
        "compared": old is not None,
        "drift": 1.0 if old is None else tables.drift(old, records),
        "changes": None if old is None else contents.change_table(old, records),
        "n_changes": len(found),
        "not_compared": contents.NOT_COMPARED,
    }


def _fastest(rows: Sequence[tables.Reach], level: float) -> tables.Reach | None:
    """Who brings a case to the level first, from a cold start, with claims that hold."""
    honest = [r for r in rows if r.start == "cold" and not r.contradicted and math.isfinite(r.times[level])]
    return min(honest, key=lambda r: r.times[level], default=None)
