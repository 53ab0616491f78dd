"""Write records as terminal tables, plots and a page. Nothing here solves a problem.

records = lavender.lab.bench.read_records("report/records.jsonl")
lavender.lab.report.summarize_runs_by_case(records)          # plain rows
lavender.lab.report.write(records, "report")  # records.csv, records.json, figures, index.html
lavender.lab.report.write(lavender.lab.report.Report(records, earlier), "report")  # compared with an earlier run
"""

from lavender.lab.bench.resampling import recommend_solvers
from lavender.lab.bench.statistics import (
    compute_mean_times_by_law,
    compute_order_spreads,
    compute_profiles,
    compute_robustness,
    count_claims,
    group_cases_by_family,
    group_runs_by_pass,
    list_failures,
    summarize_runs_by_case,
)
from lavender.lab.report.findings import Report
from lavender.lab.report.write import write

__all__ = [
    "Report",
    "compute_mean_times_by_law",
    "compute_order_spreads",
    "compute_profiles",
    "compute_robustness",
    "count_claims",
    "group_cases_by_family",
    "group_runs_by_pass",
    "list_failures",
    "recommend_solvers",
    "summarize_runs_by_case",
    "write",
]
__dir__ = sorted(__all__).copy  # Completion shows public names only.
