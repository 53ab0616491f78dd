"""Measure solvers on cases: records of each case, solver and budget, timed in one place.

    records = lavender.report.bench.run(["pile.npz"], ["pgs", "osqp"])
    records.rows()       # plain dictionaries, or records.frame() for pandas

Nothing here draws or prints; `lavender.report` reads the records.
"""

from lavender.report.bench.cases import (
    Item,
    classify_structure,
    list_steps_in_folder,
    make_sequence,
    resolve_sources,
)
from lavender.report.bench.machine import get_cpu_name
from lavender.report.bench.record import CaseInfo, Record, Run, Skip, format_tolerance
from lavender.report.bench.running.alternating import time_alternately
from lavender.report.bench.running.plan import CampaignPlan, Plan
from lavender.report.bench.running.runner import Event, carry_impulses, run, select_solver_names
from lavender.report.bench.running.timing import CallSpec, Task, limit_to_one_thread, measure_task
from lavender.report.bench.store import Records, Store, read_records, write_csv, write_json

__all__ = [
    "CallSpec",
    "CampaignPlan",
    "CaseInfo",
    "Event",
    "Item",
    "Plan",
    "Record",
    "Records",
    "Run",
    "Skip",
    "Store",
    "Task",
    "carry_impulses",
    "classify_structure",
    "format_tolerance",
    "get_cpu_name",
    "limit_to_one_thread",
    "list_steps_in_folder",
    "make_sequence",
    "measure_task",
    "read_records",
    "resolve_sources",
    "run",
    "select_solver_names",
    "time_alternately",
    "write_csv",
    "write_json",
]
__dir__ = sorted(__all__).copy  # Completion shows public names only.
