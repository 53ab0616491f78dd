"""Measure solvers on cases: records of each case, solver and budget, timed in one place.

    records = lavender.lab.bench.run(["pile.npz"], ["pgs", "osqp"])
    records.rows()       # plain dictionaries, or records.frame() for pandas

Nothing here draws or prints; `lavender.lab.report` reads the records.
"""

from lavender.lab.bench.cases import Item, expand_seeds, resolve, sequence, steps_in, structure_of
from lavender.lab.bench.machine import cpu_name
from lavender.lab.bench.record import CaseInfo, Record, Run, Skip, format_tolerance
from lavender.lab.bench.running.alternating import time_alternately
from lavender.lab.bench.running.plan import CampaignPlan, Plan
from lavender.lab.bench.running.runner import Event, carry, run, solver_names
from lavender.lab.bench.running.timing import CallSpec, Task, measure, one_thread
from lavender.lab.bench.store import Records, Store, read, write_csv, write_json

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
    "carry",
    "cpu_name",
    "expand_seeds",
    "format_tolerance",
    "measure",
    "one_thread",
    "read",
    "resolve",
    "run",
    "sequence",
    "solver_names",
    "steps_in",
    "structure_of",
    "time_alternately",
    "write_csv",
    "write_json",
]
