"""The report as one self-contained HTML file: no network, dark and light, phone and print."""

from __future__ import annotations

import importlib.util
import json
import math
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lavender.bench.record import file_name, level_name
from lavender.bench.store import Records
from lavender.report import tables
from lavender.report.curves import Figure, Figures
from lavender.report.draw import plotly_data
from lavender.report.style import looks
from lavender.report.text import residual, seconds

if TYPE_CHECKING:
    from lavender.bench.peers import Peers

__all__ = ["page"]

MOST = 2000  # failures on a page, for browsers' sake; a campaign may have more


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


def page(
    records: Records,
    figures: Figures,
    title: str = "lavender report",
    *,
    old: Records | None = None,
    times: Sequence[float] = (),
    saved: bool = True,
    peers: Peers | None = None,
) -> str:
    """The whole page. Every text that came from a file, a problem or a backend is escaped.

    Parameters
    ----------
    records : Records
    figures : Figures
        Of these records: `curves.figures`.
    old : Records, optional
        An earlier run to compare with.
    times : s, optional
        Time budgets of the recommendation.
    saved : bool
        The figures are beside the page as SVG and PNG.
    peers : Peers, optional
        A run of `lavender bench peers`, whose figures are among `figures`.
    """
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("lavender.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(seconds=seconds, residual=residual, level=level_name, anchor=file_name)
    content = _content(records, figures, old, tuple(times) or tables.time_budgets(records), peers)
    figures_json = json.dumps(content.pop("figures"), allow_nan=False).replace("<", "\\u003c")
    return environment.get_template("index.html.j2").render(
        title=title,
        saved=saved,
        figures_json=figures_json,
        plotly=plotly_source(),
        inf=math.inf,
        isfinite=math.isfinite,
        **content,
    )


def _content(
    records: Records, figures: Figures, old: Records | None, times: Sequence[float], peers: Peers | None
) -> dict[str, Any]:
    look = looks({r.solver for r in records} | ({c.solver for f in figures for c in f.curves}))
    levels = tables.levels_of(records)
    campaign = tables.is_campaign(records)
    by_case: dict[str, list[tables.Reach]] = {}
    if not campaign:  # thousands of cases: the tables over all of them say it
        for reach in tables.reaches(records, levels):
            by_case.setdefault(reach.case, []).append(reach)
    cases = [
        {"info": records.cases[name], "reaches": rows, "figures": _keys(figures.cases.get(name, ()))}
        for name, rows in by_case.items()
    ]
    changes = tables.changes(old, records) if old is not None else []
    rivals = None
    if peers is not None:
        from lavender.report.rivals import content  # with the engine behind it

        rivals = content(peers)
    return {
        "figures": {file_name(figure.name): plotly_data(figure, look) for figure in figures},
        "runs": list(records.runs.values()),
        "levels": levels,
        "times": times,
        "advice": [] if campaign else tables.advice(records, times),
        "families": tables.families(records),
        "family_figures": {f: file_name(figure.name) for f, figure in figures.families.items()},
        "claims": tables.claims(records),
        "failures": tables.failures(records),
        "most": MOST,
        "cases": cases,
        "profiles": {law: _keys(some) for law, some in figures.profiles.items()},
        "means": tables.geometric_means(records),
        "shift": tables.shift_of(records),
        "limit": tables.limit_of(records),
        "spreads": sorted(tables.spreads(records), key=lambda s: -s.factor),
        "lost": [s for s in records.skips if not s.solver],
        "refused": [s for s in records.skips if s.solver],
        "campaign": campaign,
        "robustness": tables.robustness(records) if campaign else [],
        "budgets": sorted({r.max_iter for r in records if r.mode == "budget"}),
        "sequences": tables.by_sequence(records),
        "sequence_figures": {name: _keys(some) for name, some in figures.sequences.items()},
        "compared": old is not None,
        "changes": [c for c in changes if c.kind != "same"],
        "n_changes": len(changes),
        "n_records": len(records),
        "n_cases": len({r.case for r in records if r.step < 0}),
        "look": look,
        "peers": rivals,
        "peer_figures": {place: _keys(some) for place, some in figures.peers.items()},
    }


def _keys(some: Iterable[Figure]) -> list[str]:
    return [file_name(figure.name) for figure in some]
