"""Records -> terminal tables, plots, a page. Never solves.

records = lavender.lab.bench.read("report/records.jsonl")
lavender.lab.report.reaches(records)          # plain rows
lavender.lab.report.write(records, "report")  # records.csv, records.json, figures, index.html
lavender.lab.report.write(lavender.lab.report.Report(records, earlier), "report")  # compared with an earlier run
"""

from lavender.lab.report.finals import advice
from lavender.lab.report.findings import Report
from lavender.lab.report.tables import (
    claims,
    failures,
    families,
    geometric_means,
    passes,
    profiles,
    reaches,
    spreads,
)
from lavender.lab.report.write import write

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
