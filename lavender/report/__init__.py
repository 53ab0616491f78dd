"""Write records as terminal tables, plots and a page. Nothing here solves a problem.

records = lavender.report.bench.read_records("report/records.jsonl")
lavender.report.summarize_runs_by_case(records)          # plain rows
lavender.report.write(records, "report")  # records.csv, records.json, figures, index.html
lavender.report.write(lavender.report.Report(records, earlier), "report")  # compared with an earlier run
"""

from lavender.report.bench.resampling import recommend_solvers
from lavender.report.bench.statistics import (
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
from lavender.report.findings import Report
from lavender.report.write import write

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
