"""Records -> terminal tables, plots, a page. Never solves.

records = lavender.bench.read("report/records.jsonl")
lavender.report.reaches(records)          # plain rows
lavender.report.write(records, "report")  # records.csv, records.json, figures, index.html
"""

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
