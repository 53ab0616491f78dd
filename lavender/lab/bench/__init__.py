"""Case x solver x budget -> records, timed in one place.

    records = lavender.lab.bench.run(["pile.npz"], ["pgs", "osqp"])
    records.rows()       # plain dictionaries, or records.frame() for pandas

Nothing here draws or prints; `lavender.lab.report` reads the records.
"""

from lavender.lab.bench.cases import Item, resolve, sequence, steps_in, structure_of
from lavender.lab.bench.machine import cpu_name
from lavender.lab.bench.record import CaseInfo, Record, Run, Skip, level_name
from lavender.lab.bench.running.campaign import CampaignPlan, campaign, seeds
from lavender.lab.bench.running.finals import finals
from lavender.lab.bench.running.plan import Plan
from lavender.lab.bench.running.runner import Event, carry, run, solver_names
from lavender.lab.bench.running.timing import Ask, Task, measure, one_thread
from lavender.lab.bench.store import Records, Store, read, write_csv, write_json

__all__ = [
    "Ask",
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
    "campaign",
    "carry",
    "cpu_name",
    "finals",
    "level_name",
    "measure",
    "one_thread",
    "read",
    "resolve",
    "run",
    "seeds",
    "sequence",
    "solver_names",
    "steps_in",
    "structure_of",
    "write_csv",
    "write_json",
]
