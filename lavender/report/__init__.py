"""Measure solvers on cases, and write the runs as terminal tables, figures, files and a page.

records = lavender.report.run(["pile.npz"], ["pgs", "osqp"])
records.frame                                # one row for each run, a pandas DataFrame
lavender.report.write(records, "report")     # records.csv, tables, figures, index.html
lavender.report.read("report")               # the records again
lavender.report.tables.tabulate_times(lavender.report.Report(records))
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lavender.report import tables
    from lavender.report.cases import Item, classify_structure, make_sequence, resolve_sources
    from lavender.report.findings import Report, write
    from lavender.report.records import CaseInfo, Record, Records, Run, Skip
    from lavender.report.runner import Event, carry_impulses, run, select_solver_names
    from lavender.report.store import Store, read
    from lavender.report.timing import CampaignPlan, Plan

# Module -> public names in it, imported when a name is first used: tables and pages need pandas, solving does not.
_PUBLIC_NAMES = {
    "cases": ("Item", "classify_structure", "make_sequence", "resolve_sources"),
    "findings": ("Report", "write"),
    "records": ("CaseInfo", "Record", "Records", "Run", "Skip"),
    "store": ("Store", "read"),
    "timing": ("CampaignPlan", "Plan"),
    "runner": ("Event", "carry_impulses", "run", "select_solver_names"),
}
_MODULE_OF_NAME = {name: module for module, names in _PUBLIC_NAMES.items() for name in names}

__all__ = [
    "CampaignPlan", "CaseInfo", "Event", "Item", "Plan", "Record", "Records", "Report", "Run", "Skip", "Store",
    "carry_impulses", "classify_structure", "make_sequence", "read", "resolve_sources", "run", "select_solver_names",
    "tables", "write",
]  # fmt: skip
__dir__ = sorted(__all__).copy  # Completion shows public names only.


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name == "tables":
        return import_module("lavender.report.tables")
    if name not in _MODULE_OF_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULE_OF_NAME[name]}"), name)
    globals()[name] = value
    return value
