"""Records -> terminal tables, plots, a page. Never solves.

records = lavender.bench.read("report/records.jsonl")
lavender.report.reaches(records)          # plain rows
lavender.report.write(records, "report")  # records.csv, records.json, figures, index.html
lavender.report.write(lavender.report.Report(records, earlier), "report")  # compared with an earlier run
"""

from lavender.report.findings import Report
from lavender.report.tables import (
    advice,
    claims,
    failures,
    families,
    geometric_means,
    passes,
    profiles,
    reaches,
    spreads,
)
from lavender.report.write import write

__all__ = [
    "Report",
    "advice",
    "claims",
    "failures",
    "families",
    "geometric_means",
    "passes",
    "profiles",
    "reaches",
    "spreads",
    "write",
]
