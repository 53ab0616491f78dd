"""Write records as terminal tables, plots and a page. Nothing here solves a problem.

records = lavender.lab.bench.read("report/records.jsonl")
lavender.lab.report.reaches(records)          # plain rows
lavender.lab.report.write(records, "report")  # records.csv, records.json, figures, index.html
lavender.lab.report.write(lavender.lab.report.Report(records, earlier), "report")  # compared with an earlier run
"""

from lavender.lab.bench.resampling import recommend_solvers
from lavender.lab.bench.statistics import (
    claims,
    failures,
    families,
    geometric_means,
    passes,
    profiles,
    reaches,
    robustness,
    spreads,
)
from lavender.lab.report.findings import Report
from lavender.lab.report.write import write

__all__ = [
    "Report",
    "claims",
    "failures",
    "families",
    "geometric_means",
    "passes",
    "profiles",
    "reaches",
    "recommend_solvers",
    "robustness",
    "spreads",
    "write",
]
